"""The rules of the house that a machine can hold: who imports whom, what stays unimported, the links at the root."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxmocap
from jaxmocap.codecs import Target, make
from jaxmocap.synthesis import walk

PACKAGE = Path(jaxmocap.__file__).parent
ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("core", "codecs", "training", "top")  # each may import itself and those before it
TOP = ("bench", "commands", "__main__")
PEERS = {"brotli", "fpzip", "pcodec", "pyppmd", "pysz", "zfpy"}
OUTSIDE = {
    "core": {"jax", "equinox", "numpy", "scipy", "jaxtyping"},
    "codecs": {"jax", "equinox", "numpy", "scipy", "jaxtyping", "constriction", "safetensors", "threadpoolctl", "zstandard"},
    "training": {"jax", "equinox", "numpy", "scipy", "jaxtyping", "safetensors", "optax", "matplotlib", "threadpoolctl"},
    "top": {"jax", "equinox", "numpy", "scipy", "jaxtyping", "matplotlib", "tyro", "tqdm", "zstandard", *PEERS},
}


def layer(parts: tuple[str, ...]) -> str:
    first = parts[0] if parts else ""
    return "top" if first in TOP else first if first in ("codecs", "training") else "core"


def imports(file: Path) -> list[tuple[str, ...]]:
    """Absolute names of all that a file imports, as tuples."""
    here = ("jaxmocap", *file.relative_to(PACKAGE).with_suffix("").parts)
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found += [tuple(alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level] if node.level else ()
            module = tuple(node.module.split(".")) if node.module else ()
            found += [(*base, *module, alias.name) for alias in node.names]
    return found


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda f: str(f.relative_to(PACKAGE)))
def test_imports_go_down_only(file: Path):
    mine = layer(file.relative_to(PACKAGE).with_suffix("").parts)
    for name in imports(file):
        if name[0] == "jaxmocap":
            theirs = layer(name[1:])
            assert LAYERS.index(theirs) <= LAYERS.index(mine), f"{mine} imports {'.'.join(name)}"
        else:
            known = name[0] in sys.stdlib_module_names or name[0] in OUTSIDE[mine]
            assert known, f"{mine} imports {'.'.join(name)}"


def test_importing_jaxmocap_is_light():
    heavy = ("optax", "matplotlib", "tyro", "constriction", "scipy", "tqdm")
    code = f"import sys, jaxmocap; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_decoding_compiles_nothing_and_needs_no_optimiser(tmp_path: Path):
    """Of a stream of the default codec, by the command: what a cold start would wait for."""
    stream = tmp_path / "walk.jmc"
    stream.write_bytes(make({"target": Target("step", 4.0)}).encode(walk(1, 0.5)))
    code = f"""
import sys, jax, jax.numpy
from jaxmocap.__main__ import run
compiled = []
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: compiled.append(name))
assert run(["decode", {str(stream)!r}, "-o", {str(tmp_path / "walk.bvh")!r}]) == 0
print([m for m in ("optax", "matplotlib", "scipy") if m in sys.modules], [name for name in compiled if "compile" in name])
jax.numpy.ones(3) + 1
assert any("compile" in name for name in compiled), "the listener hears nothing"
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[] []"


def test_links_at_the_root_are_the_real_folders():
    if not (ROOT / "pyproject.toml").is_file() or not (ROOT / "jaxmocap").is_dir():
        pytest.skip("the tests run outside a checkout")
    for name in ("codecs", "training"):
        assert (ROOT / name).is_symlink() and (ROOT / name).resolve() == (ROOT / "jaxmocap" / name).resolve()
