"""`jaxmocap bench rd`: peers keep their bounds, streams hold all that decoding needs, and the whole report on small data."""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from jaxmocap import Motion, Skeleton
from jaxmocap.__main__ import run
from jaxmocap.bench import data as bench_data
from jaxmocap.bench import rd, rd_positions, rd_report, rd_text
from jaxmocap.bench.rd_peers import PEERS
from jaxmocap.bench.rd_positions import ALL_FRAMES, THINNED, ArrayCoder
from jaxmocap.codecs import LsdtClip, Target, load_artifact
from jaxmocap.commands.bench import PARTS
from jaxmocap.errors import JaxmocapError
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.kinematics import positions_cm
from jaxmocap.metrics import compare
from jaxmocap.synthesis import walk

LSDT = {"codec": "lsdt-clip"}


@pytest.fixture(scope="module")
def motions() -> dict[str, Motion]:
    return {"one": walk(1, 1.0), "two": walk(2, 1.5)}


def coder(name: str) -> ArrayCoder:
    try:
        return PEERS[name]()
    except ImportError as error:
        pytest.skip(f"{error.name} is not installed")


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.parametrize("shape", [(63, 400), (6, 17), (3, 1)])
def test_peers_keep_their_bounds(name: str, shape: tuple[int, int]):
    made = coder(name)
    channels = np.random.default_rng(0).normal(0, 3, shape).cumsum(1) - 200
    for bound in (0.003, 0.1, 5.0):
        for way in made.ways:
            data = way(channels, bound)
            assert np.abs(made.decompress(data, shape) - channels).max() <= bound * 1.001 + 1e-4


def test_large_differences_survive():
    made = coder("quantise, delta, xz")
    channels = np.array([[0.0, 1e6, -1e6, 3.0], [127.0, -128.0, 0.0, 0.0]])
    for way in made.ways:
        assert np.array_equal(made.decompress(way(channels, 0.5), channels.shape), channels)


@pytest.mark.parametrize("name", PEERS)
def test_streams_of_positions_meet_a_mean_error(name: str, motions: dict[str, Motion]):
    made, motion = coder(name), motions["one"]
    positions, sizes = np.asarray(positions_cm(motion), np.float64), []
    for cm in (0.1, 1.0):
        for everies in (ALL_FRAMES, THINNED):
            data = rd_positions.encode(positions, motion.skeleton, made, cm, everies)
            error = np.linalg.norm(rd_positions.decode(data, motion.skeleton, made) - positions, axis=-1).mean()
            assert 0.9 * cm < error <= cm
            sizes.append(len(data))
    assert sizes[1] <= sizes[0] and sizes[3] < sizes[2] < sizes[0]


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_few_frames(frames: int, motions: dict[str, Motion]):
    made, motion = coder("quantise, delta, xz"), motions["one"].frames(0, frames)
    positions = np.asarray(positions_cm(motion), np.float64)
    data = rd_positions.encode(positions, motion.skeleton, made, 0.5)
    assert np.linalg.norm(rd_positions.decode(data, motion.skeleton, made) - positions, axis=-1).mean() <= 0.5


def test_joints_that_coincide_are_sent_once():
    turns = ("Zrotation", "Xrotation", "Yrotation")
    offsets = np.array([[0, 0, 0], [0, 0, 0], [0, 5, 0], [0, 0, 0]])
    channels = (("Xposition", "Yposition", "Zposition"), turns, turns, turns)
    skeleton = Skeleton(("a", "b", "c", "d"), (-1, 0, 1, 2), offsets, channels)
    motion = Motion(skeleton, np.random.default_rng(0).normal(0, 9, (80, 12)).cumsum(0), 1 / 60)
    positions = np.asarray(positions_cm(motion), np.float64)
    seen: list[tuple[int, int]] = []
    made = coder("quantise, delta, xz")

    def decompress(data: bytes, shape: tuple[int, int]) -> np.ndarray:
        seen.append(shape)
        return made.decompress(data, shape)

    watched = ArrayCoder(made.ways, decompress)
    data = rd_positions.encode(positions, skeleton, watched, 0.5, ALL_FRAMES)
    assert np.linalg.norm(rd_positions.decode(data, skeleton, watched) - positions, axis=-1).mean() <= 0.5
    assert set(seen) == {(6, 80)}


def test_what_no_stream_meets_is_out_of_reach(motions: dict[str, Motion]):
    made, motion = coder("quantise, delta, xz"), motions["one"]
    positions = np.asarray(positions_cm(motion), np.float64)
    with pytest.raises(JaxmocapError, match="out of reach"):
        rd_positions.encode(positions, motion.skeleton, made, 1e-9, (32,))
    row = rd.pooled(motions, rd.by_positions(made, (32,)), Target("mean", 1e-9))
    assert set(row) == {"target_cm", "missing"} and rd.ratio_at([row], 1e-9) is None


def test_rows_count_the_bytes_of_whole_streams(motions: dict[str, Motion]):
    row = rd.pooled(motions, rd.by_codec(LSDT), Target("mean", 1.0))
    codec = LsdtClip(load_artifact("lsdt-clip"), target=Target("mean", 1.0))
    streams = {name: codec.encode(motion) for name, motion in motions.items()}
    assert [clip["bytes"] for clip in row["clips"]] == [len(data) for data in streams.values()]
    frames = {name: motion.frame_count for name, motion in motions.items()}
    joints = motions["one"].skeleton.joint_count
    assert row["ratio"] == pytest.approx(sum(frames.values()) * joints * 12 / sum(map(len, streams.values())))
    errors = {name: compare(motion, codec.decode(streams[name])) for name, motion in motions.items()}
    for measure in ("mean_cm", "shell_mean_cm"):
        total = sum(float(errors[name][measure]) * count for name, count in frames.items())  # type: ignore[arg-type]
        assert row[measure] == pytest.approx(total / sum(frames.values()))
    for measure in ("max_cm", "shell_max_cm"):
        assert row[measure] == pytest.approx(max(float(e[measure]) for e in errors.values()))  # type: ignore[arg-type]
    assert f"{row['ratio']:.1f}:1" in rd_text.text({"shell": row})


def test_ratios_between_points():
    rows = [{"mean_cm": cm, "ratio": 100 * cm**0.8} for cm in (2.0, 0.1, 0.5)]
    rows.append({"target_cm": 9.0, "missing": "out of reach"})
    for cm in (0.1, 0.2, 1.0, 2.0):
        assert rd.ratio_at(rows, cm) == pytest.approx(100 * cm**0.8)
    assert rd.ratio_at(rows, 0.09) is None and rd.ratio_at(rows, 2.1) is None and rd.ratio_at([], 1.0) is None


def test_peers_that_are_not_installed_are_said(monkeypatch: pytest.MonkeyPatch):
    for package in ("pysz", "zfpy"):
        monkeypatch.setitem(sys.modules, package, None)
    made, missing = rd.methods()
    assert missing["SZ3"] == "pysz" and missing["zfp"] == "zfpy"
    assert {"lsdt-clip runs", "lsdt-clip paper", "quantise, delta, xz", "quantise, delta, xz, thinned"} <= set(made)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder laid out as the benchmark's data, of short walks; `learned` is a codec that learns in a second."""
    names = ["cmu_bvh/09/09_06.bvh", "cmu_bvh/09/09_02.bvh", "cmu_bvh/01/01_01.bvh", "cmu_bvh/01/01_02.bvh"]
    for seed, name in enumerate([*names, *(f"{rd_report.RIG}/{n}.bvh" for n in ("08", "09", "10"))]):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_motion(walk(seed, 2.5), tmp_path / name)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(bench_data, "TEST", ("09_06",))
    monkeypatch.setattr(rd_report, "TEST", ("09_06",))
    monkeypatch.setattr(rd_report, "SUBJECTS", ("09",))
    monkeypatch.setattr(rd_report, "TARGETS_CM", (1.0,))
    monkeypatch.setattr(rd_report, "TRAINED_CM", (1.0,))
    monkeypatch.setattr(rd_report, "MAX_CM", 8.0)
    monkeypatch.setattr(rd, "PEERS", {"quantise, delta, xz": PEERS["quantise, delta, xz"]})
    monkeypatch.setattr(rd, "LEARNED", LSDT)
    monkeypatch.setattr(rd, "COLUMNS", {"learned": LSDT, "lsdt-clip runs": LSDT})
    return tmp_path


def test_report(small: Path, capsys: pytest.CaptureFixture[str]):
    parts = [name for name in rd_report.PARTS if name != "shell"]  # lsdt-clip has no such metric
    out = small / "out"
    assert run(["bench", "rd", "--parts", *parts, "--data", str(small), "--output", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["rd"]
    assert list(result) == parts and json.loads((out / "rd.json").read_text()) == result
    assert (out / "rd.png").read_bytes().startswith(b"\x89PNG")
    table = result["curves"]["methods"]
    assert [row["target_cm"] for row in table["learned"]] == [1.0, rd_report.BEYOND_CM]
    assert all(row["mean_cm"] <= row["target_cm"] for rows in table.values() for row in rows)
    (cut,) = result["first_frame"]["clips"]
    assert cut["frames"] == read_motion(small / "cmu_bvh/09/09_06.bvh").frame_count
    assert cut["cost"] == cut["bytes"] - cut["bytes_without"]
    assert len(result["bounds"]["clips"]) == 4
    for row in result["bounds"]["clips"]:
        assert row["max_cm"] <= 8.0 and row["factor"] == row["bytes"] / row["bytes_for_mean"]
    (person,) = result["people"]
    assert person["clips"] == ["09_06"] and person["files"] == 2
    (row,) = person["rows"]
    assert row["cost"] == row["stranger"]["bytes"] / row["known"]["bytes"] - 1
    assert row["named"]["bytes"] <= row["known"]["bytes"]
    assert result["rig"]["clips"] == ["09", "10"] and result["rig"]["files"] == 1
    peer = "quantise, delta, xz"
    assert set(result["rig"]["curves"]) == {"trained on its rig", "basis in the stream", peer, f"{peer}, thinned"}
    assert not list(small.glob("*.partial"))
    said = rd_text.text(result)
    assert all(name in said for name in (*table, "09_06 alone", "T-pose", "largest error", "another rig"))


def test_parts_are_those_of_rd(data_dir: Path, capsys: pytest.CaptureFixture[str]):
    assert PARTS["rd"] == tuple(rd_report.PARTS)
    assert run(["bench", "lsdt", "--parts", "curves", "--data", str(data_dir)]) == 2
    assert "--parts" in capsys.readouterr().err
