"""TRC and npz: joint positions, units, byte exactness and refusals."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.errors import FormatError
from jaxmocap.formats import bvh, npz, read_motion, trc, write_motion
from jaxmocap.kinematics import pose
from jaxmocap.motion import Motion

TRC = b"""PathFileType\t4\t(X/Y/Z)\twalk.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
100.00\t100.00\t2\t2\tmm\t100.00\t1\t2
Frame#\tTime\tL.ASI\t\t\tR ASI\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2

1\t0.000\t1.5\t-0.00\t3\t4\t5\t6
2\t0.010\t10\t20\t30\t40\t50\t6e1
"""

POSITIONS = np.random.default_rng(3).normal(size=(5, 4, 3))
PARENTS = [-1, 0, 1, 0]


def points(**changes: object) -> Motion:
    fields: dict = dict(names=["a", "b", "c d", "a"], frame_time=0.01, parents=PARENTS, unit_cm=2.54) | changes
    return Motion.from_positions(POSITIONS, **fields)


def parse(data: bytes) -> Motion:
    return trc.parse_trc(data, "odd.trc")


def test_small_trc():
    motion = parse(TRC)
    assert motion.skeleton.names == ("L.ASI", "R ASI")
    assert motion.unit_cm == 0.1
    assert motion.frame_time == 0.01
    assert motion.values.tolist() == [[1.5, 0, 3, 4, 5, 6], [10, 20, 30, 40, 50, 60]]
    assert not motion.skeleton.has_rotations
    assert trc.format_trc(motion) == TRC
    assert trc.parse_trc(TRC, "x", unit_cm=3.0).unit_cm == 3.0
    values = motion.values.copy()
    values[0, 1], values[1, 5] = 0.0, 61.5
    changed = trc.format_trc(motion.with_values(values))
    assert changed == TRC.replace(b"-0.00", b"0.000000").replace(b"6e1", b"61.500000")


@pytest.mark.parametrize("ends", [b"\r\n", b"\r", b"\t\n", b"\t\t\r\n"])
def test_trc_line_ends_and_trailing_tabs(ends: bytes):
    text = TRC.replace(b"\n", ends)
    motion = parse(text)
    assert np.array_equal(motion.values, parse(TRC).values)
    assert trc.format_trc(motion) == text


@pytest.mark.parametrize(("unit", "cm"), [("mm", 0.1), ("cm", 1), ("m", 100), ("MM", 0.1), ("unknown", None)])
def test_trc_units(unit: str, cm: float | None):
    assert parse(TRC.replace(b"mm", unit.encode())).unit_cm == cm


@pytest.mark.parametrize("unit_cm", [None, 0.1, 2.54])
def test_new_trc_reads_back(tmp_path: Path, unit_cm: float | None):
    motion = points(unit_cm=unit_cm)
    write_motion(motion, tmp_path / "new.trc")
    again = read_motion(tmp_path / "new.trc")
    assert again.unit_cm == (None if unit_cm is None else 0.1)
    assert again.skeleton.names == motion.skeleton.names
    assert again.frame_time == pytest.approx(motion.frame_time, rel=1e-15)
    np.testing.assert_allclose(again.values.reshape(5, 4, 3) * again.scale, POSITIONS * motion.scale, atol=1e-6)


def test_bvh_becomes_trc_and_npz(data_dir: Path, tmp_path: Path):
    motion = bvh.read_bvh(data_dir / "cmu_bvh" / "09" / "09_06.bvh", unit_cm=5.6444)
    wanted = np.asarray(pose(motion).positions)
    for suffix in (".trc", ".npz"):
        write_motion(motion, tmp_path / f"out{suffix}")
        again = read_motion(tmp_path / f"out{suffix}")
        assert again.skeleton.names == motion.skeleton.names
        found = np.asarray(pose(again).positions)
        np.testing.assert_allclose(found * again.scale, wanted * motion.scale, atol=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        (b"PathFileType", b"Hello", 1, "wanted PathFileType"),
        (b"100.00\t100.00\t2\t2\tmm", b"100.00\t100.00\t3\t2\tmm", 3, "NumFrames says 3, but 2 rows"),
        (b"100.00\t100.00\t2\t2\tmm", b"100.00\t100.00\t2\t3\tmm", 4, "2 marker names, NumMarkers says 3"),
        (b"100.00\t100.00\t2\t2\tmm", b"0\t100.00\t2\t2\tmm", 3, "DataRate is 0"),
        (b"100.00\t100.00\t2\t2\tmm", b"nan\t100.00\t2\t2\tmm", 3, "'nan' is not"),
        (b"100.00\t100.00\t2\t2\tmm", b"1e-320\t100.00\t2\t2\tmm", 3, "DataRate"),
        (b"100.00\t100.00\t2\t2\tmm", b"100.00\t100.00\t2\t2\tfeet", 3, "the header lacks 'feet'; wanted .*one of mm"),
        (b"DataRate\t", b"Date\t", 3, "the header lacks 'datarate'"),
        (b"\t4\t5\t6\n", b"\t\t\t\n", 7, "marker 'R ASI' is missing"),
        (b"\t4\t5\t6\n", b"\n", 7, "marker 'R ASI' is missing"),
        (b"\t20\t30", b"\t\t30", 8, "marker 'L.ASI' is missing"),
        (b"\t20\t30", b"\tinf\t30", 8, "'inf' is not"),
        (b"\t20\t30", b"\t1_0\t30", 8, "'1_0' is not"),
        (b"\t20\t30", b"\t20\t30\t5", 8, "9 fields, wanted 8"),
        (b"walk", b"wa\0lk", 1, "binary"),
    ],
)
def test_trc_refusals(old: bytes, new: bytes, line: int, message: str):
    with pytest.raises(FormatError, match=rf"^odd\.trc, line {line}: .*{message}"):
        parse(TRC.replace(old, new))


def test_npz_round_trip(tmp_path: Path):
    motion = points()
    write_motion(motion, tmp_path / "a.npz")
    again = read_motion(tmp_path / "a.npz")
    assert again.skeleton.names == motion.skeleton.names
    assert again.skeleton.parents == tuple(PARENTS)
    assert (again.frame_time, again.unit_cm) == (0.01, 2.54)
    np.testing.assert_allclose(npz.global_positions(again), POSITIONS, rtol=0, atol=1e-15)
    write_motion(again, tmp_path / "b.npz")
    assert (tmp_path / "b.npz").read_bytes() == (tmp_path / "a.npz").read_bytes()
    assert read_motion(tmp_path / "a.npz", unit_cm=1.0).unit_cm == 1.0
    moved = again.with_values(again.values + 1)
    assert npz.format_npz(moved) != npz.format_npz(again)


def test_npz_of_free_points_keeps_every_bit():
    motion = points(parents=None, unit_cm=None)
    again = npz.parse_npz(npz.format_npz(motion), "x")
    assert again.unit_cm is None
    assert np.array_equal(again.values, POSITIONS.reshape(5, 12))


def with_arrays(**changes: np.ndarray | None) -> bytes:
    arrays: dict[str, np.ndarray | None] = dict(np.load(io.BytesIO(npz.format_npz(points()))).items())
    arrays |= changes
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for key, array in arrays.items():
            if array is not None:
                with archive.open(f"{key}.npy", "w") as member:
                    np.lib.format.write_array(member, array)
    return out.getvalue()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(positions=None), "no array 'positions'"),
        (dict(names=None), "no array 'names'"),
        (dict(positions=POSITIONS[0]), r"wanted floats \(frame, joint, 3\)"),
        (dict(positions=POSITIONS[:0]), "wanted floats"),
        (dict(positions=POSITIONS[..., :2]), "wanted floats"),
        (dict(positions=POSITIONS.astype(complex)), "wanted floats"),
        (dict(positions=np.where(POSITIONS > 1, np.nan, POSITIONS)), r"joint \d in frame \d is not finite"),
        (dict(positions=np.array([[[1e308] * 3, [-1e308] * 3] * 2])), "distance between two joints is not finite"),
        (dict(positions=np.array([{}], dtype=object)), "Python objects"),
        (dict(names=np.array(["a", "b"])), "wanted 4 strings"),
        (dict(names=np.arange(4)), "wanted 4 strings"),
        (dict(parents=np.array([-1, 0, 1])), "wanted 4 integers"),
        (dict(parents=np.array([-1, 0, 1, 3])), "must precede its child"),
        (dict(parents=np.array([-1, 0, 1, 99])), "out of bounds"),
        (dict(frame_time=np.float64(0)), "frame_time is 0"),
        (dict(frame_time=np.float64(np.nan)), "frame_time is nan"),
        (dict(frame_time=np.zeros(3)), "wanted one number"),
        (dict(unit_cm=np.float64(-1)), "unit_cm is -1"),
    ],
)
def test_npz_refusals(changes: dict[str, np.ndarray | None], message: str):
    with pytest.raises(FormatError, match=rf"^odd\.npz: .*{message}"):
        npz.parse_npz(with_arrays(**changes), "odd.npz")


def test_npz_that_announces_too_much():
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**3, 3)})
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("positions.npy", header.getvalue())
    with pytest.raises(FormatError, match="announce more than"):
        npz.parse_npz(out.getvalue(), "odd.npz")


def test_npz_cut_or_flipped_anywhere_is_refused_or_read():
    data = npz.format_npz(points())
    for n in range(0, len(data), 7):
        with pytest.raises(FormatError):
            npz.parse_npz(data[:n], "cut.npz")
    rng = np.random.default_rng(0)
    refused = 0
    for n in rng.integers(0, len(data), 300).tolist():
        flipped = bytearray(data)
        flipped[n] ^= int(rng.integers(1, 256))
        try:
            npz.parse_npz(bytes(flipped), "flipped.npz")
        except FormatError:
            refused += 1
    assert refused > 100


def test_suffixes(tmp_path: Path):
    with pytest.raises(FormatError, match=r"'.fbx'; known are .bvh, .amc, .trc, .npz"):
        read_motion(tmp_path / "a.fbx")
    with pytest.raises(FormatError, match="unknown suffix ''"):
        write_motion(points(), tmp_path / "a")
    write_motion(points(), tmp_path / "A.TRC")
    assert read_motion(tmp_path / "A.TRC").frame_count == 5
    with pytest.raises(FileNotFoundError):
        read_motion(tmp_path / "none.bvh")
    assert [p.name for p in tmp_path.iterdir()] == ["A.TRC"]
