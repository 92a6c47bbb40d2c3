"""Broken BVH, AMC, ASF and TRC texts either read or raise FormatError, quickly and in little memory."""

import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_formats_acclaim import AMC, ASF
from test_formats_bvh import SMALL
from test_formats_points import TRC

from jaxmocap.errors import FormatError
from jaxmocap.formats import acclaim, asf, bvh, trc
from jaxmocap.motion import Motion

TOKENS = [
    b"nan", b"-inf", b"1e999", b"1_0", b"0x10", b"1" * 10_000, b"1e" + b"9" * 5000, b"-", b".", b"1e308", b"5e-324",
    b"Frames: 999999999999", b"Frames: 99999999999999999999", b"{", b"}", b"JOINT x {" * 2000, b"CHANNELS 999999999",
    b"CHANNELS 6", b"End Site", b"MOTION", b"ROOT", b":bonedata", b"begin", b"end", b"dof l", b"\0", b"\xff\xfe", b"7",
]  # fmt: skip

READERS: dict[str, tuple[bytes, Callable[[bytes], Motion], Callable[[Motion], bytes]]] = {
    "bvh": (SMALL, lambda data: bvh.parse_bvh(data, "f"), bvh.format_bvh),
    "amc": (AMC, lambda data: acclaim.parse_amc(data, "f", asf.parse_asf(ASF, "f")), acclaim.format_amc),
    "asf": (ASF, lambda data: acclaim.parse_amc(AMC, "f", asf.parse_asf(data, "f")), acclaim.format_amc),
    "trc": (TRC, lambda data: trc.parse_trc(data, "f"), trc.format_trc),
}


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data after one to three accidents."""
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(data) + 1))
        match int(rng.integers(0, 6)):
            case 0:  # a byte flips
                data = data[:at] + bytes([int(rng.integers(0, 256))]) + data[at + 1 :]
            case 1:  # the end is lost
                data = data[: max(at, 1)]
            case 2:  # a piece is lost
                data = data[:at] + data[at + int(rng.integers(1, 40)) :]
            case 3:  # a line stands twice
                lines = data.splitlines(keepends=True)
                if lines:
                    n = int(rng.integers(0, len(lines)))
                    data = b"".join([*lines[: n + 1], *lines[n:]])
            case 4:  # a digit comes in
                data = data[:at] + b"%d" % rng.integers(0, 10) + data[at:]
            case _:  # a token comes in
                data = data[:at] + b" " + TOKENS[int(rng.integers(0, len(TOKENS)))] + b" " + data[at:]
    return data


@pytest.mark.parametrize("kind", READERS)
def test_accidents(kind: str):
    original, read, write = READERS[kind]
    rng = np.random.default_rng(7)
    read_back = refused = 0
    tracemalloc.start()
    try:
        for _ in range(500):
            data = mutated(original, rng)
            try:
                motion = read(data)
            except FormatError as error:
                assert str(error).startswith("f")
                refused += 1
                continue
            assert np.isfinite(motion.values).all()
            if kind != "asf":
                assert write(motion) == data
            read_back += 1
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert refused > 50
    assert read_back > 5
    assert peak < 64 << 20


@pytest.mark.parametrize("name", ["cmu_bvh/09/09_06.bvh", "cmu_amc/05/05_01.amc"])
def test_accidents_of_real_files(data_dir: Path, name: str):
    original = (data_dir / name).read_bytes()[:40_000]
    original = original[: original.rindex(b"\n")]
    skeleton = asf.parse_asf((data_dir / "cmu_amc" / "05" / "05.asf").read_bytes(), "s")
    rng = np.random.default_rng(8)
    refused = 0
    for _ in range(100):
        data = mutated(original, rng)
        try:
            _ = bvh.parse_bvh(data, "f") if name.endswith("bvh") else acclaim.parse_amc(data, "f", skeleton)
        except FormatError:
            refused += 1
    assert refused > 30


BOMBS = """
import resource, sys
from jaxmocap.errors import FormatError
from jaxmocap.formats import bvh, acclaim, asf, trc
with open("/proc/self/statm") as f:
    used = int(f.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30),) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (40, 40))
head = b"HIERARCHY\\nROOT a\\n{\\nOFFSET 0 0 0\\nCHANNELS 3 Xrotation Yrotation Zrotation\\n"
motion = b"}\\nMOTION\\nFrames: %d\\nFrame Time: 1\\n"
bombs = [
    head + b"JOINT b\\n{\\nOFFSET 0 0 0\\n" * 300_000,
    head + b"{" * 3_000_000,
    head + b"}" * 3_000_000,
    head + b"End Site\\n{\\nOFFSET 0 0 0\\n}\\n" * 100_000,
    head + b"JOINT " + b"b " * 2_000_000,
    head + b"JOINT b" + b" " * 3_000_000 + b"x",
    head + b" " * 5_000_000,
    head + motion % 999_999_999_999 + b"1 2 3\\n",
    head + motion % 10 ** 20 + b"1 2 3\\n",
    head + motion % 1 + b"1" * 5_000_000 + b"x 2 3",
    head + motion % 1 + b"1" * 5_000_000 + b" 2 3",
    head + motion % 1 + b"0." + b"1" * 5_000_000 + b" 2 x",
    head + motion % 1 + b"0." + b"1" * 5_000_000 + b" 2 3",
    head + motion % 1 + b"1e" + b"1" * 5_000_000 + b" 2 3",
    head + motion % 1 + b"1\\n" * 1_000_000,
    head + motion % 1 + b"nan " * 1_000_000,
    b"\\xef\\xbb\\xbf" * 1_000_000,
    b"\\n" * 5_000_000 + b"x",
]
for n, bomb in enumerate(bombs):
    try:
        bvh.parse_bvh(bomb, "bomb")
        print("read", n)
    except FormatError as error:
        assert len(str(error)) < 300, error
"""


def test_bombs_stay_within_a_gibibyte_and_seconds():
    done = subprocess.run([sys.executable, "-c", BOMBS], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["read", "12"]  # 0.111... of five million digits is a number
