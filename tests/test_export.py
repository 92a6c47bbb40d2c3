"""Exported models read back exactly, and a decoder in C made of one of them agrees with Python on whole streams."""

import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmocap import Motion, synthesis
from jaxmocap.codecs import lsdt_basis, lsdt_clip
from jaxmocap.codecs.artifact import Artifact, load_artifact, make_artifact, parse_artifact
from jaxmocap.codecs.base import Target
from jaxmocap.codecs.clips import cut
from jaxmocap.codecs.container import read_stream
from jaxmocap.codecs.entropy.range_coder import PythonEncoder, RangeEncoder
from jaxmocap.codecs.entropy.tables import FrequencyTable
from jaxmocap.codecs.lsdt_clip import LsdtClip
from jaxmocap.codecs.lsdt_model import LsdtModel
from jaxmocap.codecs.quantise import STEPS, step_cm
from jaxmocap.codecs.rig import bones_of, read_skeleton
from jaxmocap.formats import read_motion
from jaxmocap.training.export import KINDS, _meaning, export_model

SOURCES = Path(__file__).parent / "c"
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror", "-O1")


@pytest.fixture(scope="module")
def artifact() -> Artifact:
    return load_artifact("lsdt-clip")


def compiler_of(names: tuple[str, ...]) -> str:
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip(f"no compiler: none of {', '.join(names)} is installed")
    return found


@pytest.fixture(scope="module")
def build(artifact: Artifact, tmp_path_factory: pytest.TempPathFactory):
    """Compiles a source of tests/c beside the exported header."""
    folder = tmp_path_factory.mktemp("c")
    (folder / "lsdt_clip.h").write_bytes(export_model(artifact, "c"))

    def compiled(source: str, compilers: tuple[str, ...], *flags: str) -> Path:
        compiler = compiler_of(compilers)
        program = folder / f"{Path(source).stem}_{compilers[0]}"
        command = [compiler, *flags, *STRICT, f"-I{folder}", str(SOURCES / source), "-o", str(program), "-lm"]
        result = subprocess.run(command, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        return program

    return compiled


@pytest.fixture(scope="module")
def decoder(build) -> Path:
    return build("decode_clip.c", ("cc", "gcc", "clang"), "-std=c99")


class Decoded(NamedTuple):
    positions: np.ndarray  # cm, (frames, joints, 3)
    levels: np.ndarray  # clip after clip, flat
    bones: np.ndarray  # cm


def decode_in_c(decoder: Path, data: bytes, folder: Path) -> Decoded:
    (folder / "in.jmc").write_bytes(data)
    outputs = [folder / name for name in Decoded._fields]
    subprocess.run([decoder, folder / "in.jmc", *outputs], check=True, timeout=20)
    positions, levels, bones = (np.fromfile(o, t) for o, t in zip(outputs, ("<f4", "<i4", "<f8"), strict=True))
    frames = read_stream(data).header.frames
    return Decoded(positions.reshape(frames, -1, 3), levels, bones.reshape(-1, 3))


def decode_in_python(artifact: Artifact, data: bytes) -> Decoded:
    """What `lsdt_clip.decode` has before it fits rotations."""
    stream, model = read_stream(data), LsdtModel.load(artifact)
    header = stream.header
    form, clip_frames, index = lsdt_clip._params(header)
    skeleton, scale, _, known = read_skeleton(header.skeleton, model.rig, header.unit_cm, index)
    assert known
    coding = lsdt_basis.known(model)
    rate = round(1 / (header.frame_time or model.rig.frame_time))
    clips = []
    for n in range(header.chunk_count):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        lengths = cut(held, clip_frames).lengths
        clips += lsdt_clip._decode_chunk(form, stream.chunk(n), lengths, coding, index, rate)
    c = cut(header.frames, clip_frames)
    levels = np.zeros((c.padded, 3, clip_frames, coding.components), np.int32)
    for n, clip in enumerate(clips):
        levels[n, :, : clip.shape[1]] = clip
    positions = np.asarray(lsdt_clip._positions(jnp.asarray(levels), c, coding, index))[: header.frames]
    return Decoded(positions, np.concatenate([clip.ravel() for clip in clips]), bones_of(skeleton) * scale)


def assert_same(artifact: Artifact, decoder: Path, data: bytes, folder: Path) -> None:
    ours, theirs = decode_in_python(artifact, data), decode_in_c(decoder, data, folder)
    np.testing.assert_array_equal(theirs.levels, ours.levels)
    assert np.count_nonzero(ours.levels) > 100
    np.testing.assert_allclose(theirs.positions, ours.positions, rtol=0, atol=1e-3)
    np.testing.assert_allclose(theirs.bones, ours.bones, rtol=1e-12)


def encoded(artifact: Artifact, motion: Motion, mean: float = 1.0, **settings) -> bytes:
    return LsdtClip(artifact, target=Target("mean", mean), **settings).encode(motion)


@pytest.fixture(scope="module")
def walk_stream(artifact: Artifact) -> bytes:
    return encoded(artifact, synthesis.walk(3, 2.6))


def test_c_decodes_one_chunk(artifact, decoder, walk_stream, tmp_path):
    assert read_stream(walk_stream).header.chunk_count == 1
    assert_same(artifact, decoder, walk_stream, tmp_path)


@pytest.mark.parametrize("form", ["runs", "paper"])
def test_c_decodes_many_chunks_of_short_clips(artifact, decoder, form, tmp_path):
    """The last clip is a single frame, at a frame rate that is not the model's."""
    motion = synthesis.walk(5, 601 / 100, frame_rate=100.0)
    data = encoded(artifact, motion, clip_frames=60, form=form)
    assert read_stream(data).header.chunk_count == 3
    assert_same(artifact, decoder, data, tmp_path)


def test_c_decodes_bones_that_point_elsewhere_and_an_embedded_model(artifact, decoder, tmp_path):
    motion = synthesis.walk(1, 0.7)
    s = motion.skeleton
    turned = type(s)(s.names, s.parents, s.offsets[:, [1, 2, 0]], s.channels, s.end_joints, s.end_offsets)
    motion = Motion(turned, motion.values, motion.frame_time)
    data = encoded(artifact, motion, 0.1, clip_frames=120, embed=True)
    header = read_stream(data).header
    assert header.skeleton[0] == 1 and header.model == artifact.data and header.unit_cm == 0
    assert_same(artifact, decoder, data, tmp_path)


@pytest.mark.parametrize("name", ["09/09_06", "02/02_05"])
def test_c_decodes_real_motion(artifact, decoder, data_dir, name, tmp_path):
    motion = read_motion(data_dir / "cmu_bvh" / f"{name}.bvh", 5.6444).frames(1)
    assert_same(artifact, decoder, encoded(artifact, motion), tmp_path)


def test_c_refuses_what_is_damaged(decoder, walk_stream, tmp_path):
    """The checksum covers every byte, so no flipped one may pass; nor may a prefix, nor a suffix."""
    flipped = [bytearray(walk_stream) for _ in range(0, len(walk_stream), 7)]
    for n, data in enumerate(flipped):
        data[7 * n] ^= 1 << n % 8
    prefixes = [walk_stream[:n] for n in (0, 3, 7, 20, len(walk_stream) // 2, len(walk_stream) - 1)]
    for data in [*flipped, *prefixes, walk_stream + b"\0"]:
        (tmp_path / "in.jmc").write_bytes(data)
        command = [decoder, tmp_path / "in.jmc", *(tmp_path / name for name in Decoded._fields)]
        assert subprocess.run(command, capture_output=True, timeout=20).returncode == 2
    assert not (tmp_path / "positions").exists()


@pytest.mark.parametrize(
    ("compilers", "standard"), [(("cc", "gcc", "clang"), "-std=c99"), (("c++", "g++", "clang++"), "-std=c++11")]
)
def test_c_arrays_read_back_exactly(artifact, build, compilers, standard, tmp_path):
    language = "-xc++" if "++" in standard else "-xc"
    program = build("dump_model.c", compilers, language, standard)
    subprocess.run([program, tmp_path / "dump"], check=True, timeout=20)
    t = artifact.tensors
    steps = np.array([step_cm(i) for i in range(STEPS)], np.float32)
    names = ("basis", "rig.bones", "rig.expected", "runs.240.scale", "runs.240.value", "paper.60.value")
    wanted = bytes.fromhex(artifact.digest) + steps.tobytes() + b"".join(t[name].tobytes() for name in names)
    assert (tmp_path / "dump").read_bytes() == wanted


def test_c_header_holds_every_tensor_and_the_rig(artifact):
    header = export_model(artifact, "c").decode("ascii")
    for name, tensor in artifact.tensors.items():
        sizes = "".join(rf"\[{n}\]" for n in tensor.shape)
        assert re.search(rf"static const \w+ lsdt_clip_{name.replace('.', '_')}{sizes} =", header), name
    for name in artifact.spec["rig"]["names"]:
        assert f'"{name}"' in header
    assert artifact.digest in header


def test_c_header_survives_hostile_names(artifact, build, tmp_path):
    """Names come from motion files: quotes, backslashes, trigraphs and letters beyond ASCII must not break the C."""
    name = 'a"\\*/ ??/\u00e9\n1'
    rig = {**artifact.spec["rig"], "names": [name, *artifact.spec["rig"]["names"][1:]], "end_joints": []}
    hostile = make_artifact({**artifact.spec, "rig": rig}, artifact.tensors)
    (tmp_path / "lsdt_clip.h").write_bytes(export_model(hostile, "c"))
    source = tmp_path / "names.c"
    source.write_text('#include <stdio.h>\n#include "lsdt_clip.h"\nint main(void){return puts(lsdt_clip_names[0])<0;}')
    program = build(str(source), ("cc", "gcc", "clang"), "-std=c99")
    assert subprocess.run([program], capture_output=True, check=True).stdout.decode() == name + "\n"


@pytest.mark.parametrize("encoder", [PythonEncoder, RangeEncoder])
def test_example_of_the_specification(encoder):
    coder, table = encoder(), FrequencyTable(np.array([40000, 20000, 5000, 536]))
    for symbol in (0, 1, 2, 3, 0, 0, 1):
        coder.encode(symbol, table)
    coder.encode_bits(0b10110011100011, 14)
    for symbol in (3, 3, 2):
        coder.encode(symbol, table)
    coder.encode_bits(1, 1)
    assert coder.finish().hex() == "8ea3fa6ef2f945"


def test_c_header_of_learned_reads_back_exactly(tmp_path):
    """Half floats, which C lacks, and constants that are NaN where a channel moves."""
    model = load_artifact("learned")
    (tmp_path / "learned.h").write_bytes(export_model(model, "c"))
    t = model.tensors
    wanted = {"joints.synthesis": np.float32, "constants": np.float64, "slow.weight0": np.int16, "tail": np.uint16}
    assert t["joints.synthesis"].dtype == np.float16 and np.isnan(t["constants"]).any()
    writes = "".join(f"fwrite(learned_{n.replace('.', '_')}, sizeof learned_{n.replace('.', '_')}, 1, f);" for n in wanted)
    text = f'#include <stdio.h>\n#include "learned.h"\nint main(int n, char **a){{FILE *f = fopen(a[n - 1], "wb");{writes}'
    (tmp_path / "dump.c").write_text(text + "return fclose(f);}")
    compiler = compiler_of(("cc", "gcc", "clang"))
    command = [compiler, "-std=c99", *STRICT, "-Wno-unused-variable", "-Wno-unused-const-variable", f"-I{tmp_path}"]
    subprocess.run([*command, tmp_path / "dump.c", "-o", tmp_path / "dump"], check=True)
    subprocess.run([tmp_path / "dump", tmp_path / "out"], check=True, timeout=20)
    found = (tmp_path / "out").read_bytes()
    for name, kind in wanted.items():
        size = t[name].size * np.dtype(kind).itemsize
        np.testing.assert_array_equal(np.frombuffer(found[:size], kind).reshape(t[name].shape), t[name].astype(kind))
        found = found[size:]
    assert not found


@pytest.mark.parametrize("artifact", [load_artifact("lsdt-clip"), load_artifact("learned")], ids=lambda a: a.spec["codec"])
def test_npz_round_trip(artifact):
    data = export_model(artifact, "npz")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    spec, digest = json.loads(arrays.pop("spec").item()), arrays.pop("digest").item().decode()
    assert make_artifact(spec, arrays).digest == digest == artifact.digest


def test_safetensors_round_trip(artifact):
    assert parse_artifact(export_model(artifact, "safetensors"), "copy") == artifact


@pytest.mark.parametrize("codec", ["learned", "lsdt-clip"])
def test_every_array_of_a_shipped_model_has_a_meaning(codec):
    """One that has none is called by its name."""
    for name in load_artifact(codec).tensors:
        assert _meaning(name) != name


@pytest.mark.parametrize("kind", KINDS)
def test_equal_models_give_equal_bytes(artifact, kind):
    reversed_order = dict(reversed(artifact.tensors.items()))
    assert export_model(artifact, kind) == export_model(Artifact(artifact.spec, reversed_order, artifact.data), kind)


def test_unknown_kind(artifact):
    with pytest.raises(ValueError, match="onnx.*safetensors, npz, c"):
        export_model(artifact, "onnx")
