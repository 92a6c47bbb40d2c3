"""`jaxmocap bench lsdt`: packets meet their errors, speeds are measured, and all figures of small data with their numbers."""

import base64
import functools
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxmocap import Motion
from jaxmocap.__main__ import run
from jaxmocap.bench import data as bench_data
from jaxmocap.bench import lsdt, lsdt_methods, lsdt_packets, lsdt_players, lsdt_plots, lsdt_report, lsdt_speeds, lsdt_text
from jaxmocap.bench.lsdt_methods import CLIP_BASED, FRAME_BASED
from jaxmocap.bench.lsdt_packets import SHOWN_FROM, Packets
from jaxmocap.codecs import Target, decode, lsdt_frame, make
from jaxmocap.codecs.container import read_stream
from jaxmocap.commands.bench import PARTS
from jaxmocap.errors import JaxmocapError
from jaxmocap.formats import write_motion
from jaxmocap.metrics import compare
from jaxmocap.synthesis import walk


@pytest.fixture(scope="module")
def motions() -> dict[str, Motion]:
    return {"one": walk(1, 1.0), "two": walk(2, 0.75)}


def points(pairs: list[tuple[float, float]]) -> list[dict]:
    return [{"ratio": ratio, "mean_cm": cm} for ratio, cm in pairs]


def test_errors_between_points():
    rows = points([(100 * cm**0.8, cm) for cm in (2.0, 0.1, 0.5)])
    for cm in (0.1, 0.2, 1.0, 2.0):
        assert lsdt.error_at(rows, 100 * cm**0.8) == pytest.approx(cm)
    assert lsdt.error_at(rows, 1.0) is None and lsdt.error_at(rows, 1e6) is None and lsdt.error_at([], 50.0) is None


def test_errors_saved_are_those_at_equal_ratio():
    ours, rival = points([(10, 0.1), (40, 0.4)]), points([(20, 0.4), (80, 1.6)])
    saved = lsdt.error_saved(ours, rival)
    assert [at["ratio"] for at in saved] == [20, 40], "only where both curves are"
    assert [at["saved"] for at in saved] == pytest.approx([0.5, 0.5])
    assert lsdt.error_saved(ours, points([(50, 1), (90, 2)])) == []


def test_rows_are_of_whole_streams(motions: dict[str, Motion]):
    method = FRAME_BASED["dct-frame"]
    (row,) = lsdt.rate_distortion(motions, method.codec, (1.0,))
    streams = {name: method.codec(Target("mean", 1.0)).encode(m) for name, m in motions.items()}
    assert row["bytes"] == sum(map(len, streams.values()))
    assert row["ratio"] == pytest.approx(sum(m.frame_count * 31 * 12 for m in motions.values()) / row["bytes"])
    for name, clip in zip(motions, row["clips"], strict=True):
        assert lsdt.of_clip([row], name) == [{"target_cm": 1.0, **clip}]
        assert clip["mean_cm"] <= 1.0 and clip["mean_cm"] == compare(motions[name], decode(streams[name]))["mean_cm"]
        assert sum(clip["sections"].values()) == clip["bytes"]


@pytest.mark.parametrize("name", [*FRAME_BASED, *CLIP_BASED])
def test_latency_is_what_table_2_says(name: str):
    """At a given step, what decodes of the first frames is the same whatever comes later; of fewer frames it is not."""
    method, motion = (FRAME_BASED | CLIP_BASED)[name], walk(3, 2.1)
    codec = method.codec(Target("step", 2.0))

    def off(frames: int) -> float:
        """How far the first of them are off when nothing comes after them."""
        whole, part = (codec.decode(codec.encode(m)) for m in (motion, motion.frames(0, frames)))
        largest = compare(whole.frames(0, frames), part)["max_cm"]
        assert isinstance(largest, float)
        return largest

    if method.latency_frames is None:
        assert off(motion.frame_count - 12) > 0.01
    else:
        assert off(max(method.latency_frames, 1)) < 1e-3
    if method.latency_frames:
        assert off(method.latency_frames - 12) > 0.01


def test_table_2_counts_the_streams_of_its_point():
    motions = {"one": walk(1, 1.0)}
    methods = {"mdtt": CLIP_BASED["mdtt"], "lsdt-frame": FRAME_BASED["lsdt-frame"]}
    curves = {name: lsdt.rate_distortion(motions, method.codec, (1.0,)) for name, method in methods.items()}
    frame, mdtt = lsdt_methods.table(curves, 1.0)
    assert (frame["method"], frame["latency_frames"], mdtt["latency_frames"]) == ("lsdt-frame", 0, None)
    (at,) = curves["mdtt"]
    assert mdtt["bytes"] == at["bytes"] and mdtt["ratio"] == at["ratio"] and mdtt["decode_fps"] == at["decode_fps"]
    stream = read_stream(CLIP_BASED["mdtt"].codec(Target("mean", 1.0)).encode(motions["one"]))
    assert mdtt["besides_bytes"] == len(stream.header.skeleton) > frame["besides_bytes"], "its bases travel"
    assert lsdt_methods.table(curves, 2.0) == []


def linear(slope: float, offset: float = 0.0) -> Callable[[Motion, float], Packets]:
    """A sender of known law: more error for fewer bytes."""
    return lambda motion, cm: Packets(cm, round(1000 / cm), slope * cm + offset)


@pytest.mark.parametrize("slope", [0.5, 0.9, 1.0, 1.1, 3.0])
def test_packets_are_searched_until_they_meet_the_error(slope: float, motions: dict[str, Motion]):
    sent = lsdt_packets.meeting(linear(slope), motions["one"], 0.5)
    assert 0.99 * 0.5 <= sent.mean_cm <= 0.5
    with pytest.raises(JaxmocapError, match="no packets"):
        lsdt_packets.meeting(linear(slope, 0.6), motions["one"], 0.5)


def test_packets_of_lsdt_frame_are_those_of_its_stream(motions: dict[str, Motion]):
    sent = lsdt_packets.by_lsdt_frame(motions["one"], 0.5)
    data = make({"codec": "lsdt-frame", "target": Target("mean", 0.5)}).encode(motions["one"])
    packets = lsdt_frame.packets(data)
    assert sent.bytes == sum(map(len, packets)) + 3 * len(packets) and len(packets) == motions["one"].frame_count
    late = [m.frames(SHOWN_FROM) for m in (motions["one"], decode(data))]
    assert sent.mean_cm == compare(*late)["mean_cm"]


def test_rows_of_packets(motions: dict[str, Motion]):
    found = lsdt_packets.rows(motions, (1.0,))
    assert list(found) == ["lsdt-frame", "live, 0 repeats", "live, 1 repeats"]
    once, twice = (found[f"live, {n} repeats"][0] for n in (0, 1))
    assert [c["mean_cm"] for c in once["clips"]] == [c["mean_cm"] for c in twice["clips"]], "the same frames are shown"
    assert once["bytes"] < twice["bytes"]
    for (row,) in found.values():
        assert all(clip["mean_cm"] <= 1.0 for clip in row["clips"]) and 0.8 < row["mean_cm"] <= 1.0
        frames = sum(m.frame_count for m in motions.values())
        assert row["bytes_a_packet"] == row["bytes"] / frames
        assert row["ratio"] == pytest.approx(31 * 12 / row["bytes_a_packet"])


class Busy:
    """A stream that takes `seconds` a frame by the clock that it moves."""

    now = 0.0

    def __init__(self, seconds: float):
        self.seconds = seconds

    def step(self) -> None:
        Busy.now += self.seconds


@pytest.mark.parametrize(("milliseconds", "count", "held"), [(1.0, 8, True), (1.0, 9, False), (8.2, 1, True), (8.4, 1, False)])
def test_streams_keep_up_while_frames_come_no_faster(milliseconds: float, count: int, held: bool):
    streams = [Busy(milliseconds / 1000) for _ in range(count)]
    assert lsdt_speeds.keeps_up(streams, 1 / 120, lambda: Busy.now) == held  # type: ignore[arg-type]


def test_speeds_are_of_single_frames(motions: dict[str, Motion]):
    for times in lsdt_speeds.a_frame(motions["one"], 1).values():
        assert 0 < times["median_ms"] <= times["p99_ms"] <= times["max_ms"]


def test_streams_held_are_as_many_as_keep_up(motions: dict[str, Motion], monkeypatch: pytest.MonkeyPatch):
    tried = []

    def five_keep_up(streams: list, frame_time: float, clock: Callable[[], float]) -> bool:
        tried.append(len(streams))
        return len(streams) <= 5

    monkeypatch.setattr(lsdt_speeds, "keeps_up", five_keep_up)
    assert lsdt_speeds.streams_held(motions["one"], 0) == 5 and tried == [1, 2, 4, 8, 6, 5]


def test_players_compare_at_the_same_ratio(motions: dict[str, Motion]):
    found = lsdt_players.measure(motions["one"])
    assert list(found) == ["fig8", "fig9"]
    for rows in found.values():
        ours, rival = rows.values()
        assert 0.9 * ours["bytes"] <= rival["bytes"] <= ours["bytes"]
        for row in rows.values():
            decoded = decode(base64.b64decode(row["stream"]))
            assert row["per_joint_cm"] == compare(motions["one"], decoded)["per_joint_cm"]
    pages = dict(lsdt_players.pages(motions["one"], found))
    assert list(pages) == ["fig8_lsdt-frame.html", "fig8_dct-frame.html", "fig9_lsdt-clip_runs_L240.html", "fig9_mdtt.html"]
    scales = [json.loads(page.split('"scale": ')[1].split("}")[0]) for page in pages.values()]
    assert scales[0] == scales[1] != scales[2] == scales[3], "heat is comparable within a figure"
    with pytest.raises(JaxmocapError, match="at most 10 bytes"):
        lsdt_players.of_size(FRAME_BASED["dct-frame"], motions["one"], 10)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder laid out as the benchmark's data, of short walks, and few errors to meet."""
    for seed, name in enumerate(("09_06", "05_02", "01_01")):
        file = tmp_path / f"cmu_bvh/{name[:2]}/{name}.bvh"
        file.parent.mkdir(parents=True, exist_ok=True)
        write_motion(walk(seed, 2.2 if name == "01_01" else 0.8), file)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(bench_data, "TEST", ("09_06", "05_02"))
    monkeypatch.setattr(lsdt_report, "FAST", "05_02")
    monkeypatch.setattr(lsdt_report, "FOUR", ("05_02",))
    monkeypatch.setattr(lsdt_report, "FRAME_TARGETS_CM", (0.3, 1.0, 2.0))
    monkeypatch.setattr(lsdt_report, "CLIP_TARGETS_CM", (1.0,))
    few = ("lsdt-clip runs L=240", "mdtt", "pca-rdo")
    monkeypatch.setattr(lsdt_report, "CLIP_BASED", {name: CLIP_BASED[name] for name in few})
    monkeypatch.setattr(lsdt_report, "PACKET_TARGETS_CM", (1.0,))
    monkeypatch.setattr(lsdt, "SPARSITIES", (2, 8))
    monkeypatch.setattr(lsdt, "cold_decode", functools.partial(lsdt.cold_decode, runs=1))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_figures(small: Path, capsys: pytest.CaptureFixture[str]):
    assert run(["bench", "lsdt", "--figures", "--data", str(small), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["lsdt"]
    out = small / "lsdt-figures"
    assert list(result) == [*lsdt_report.PARTS, "table"] and json.loads((out / "lsdt.json").read_text()) == result
    players = {f"fig{n}_{m}.html" for n, m in ((8, "lsdt-frame"), (8, "dct-frame"), (9, "lsdt-clip_runs_L240"), (9, "mdtt"))}
    drawn = {f"{name}.png" for name in lsdt_plots.FIGURES}
    assert {f.name for f in out.iterdir()} == players | drawn | {"lsdt.json"}
    assert all((out / name).read_bytes().startswith(b"\x89PNG") for name in drawn)
    for part, methods in (("frame_based", FRAME_BASED), ("rate_distortion", lsdt_report.CLIP_BASED)):
        assert list(result[part]) == list(methods)
        assert all(row["mean_cm"] <= row["target_cm"] for rows in result[part].values() for row in rows)
    assert {tuple(np.shape(basis)) for basis in result["bases"].values()} == {(31, 31)} and len(result["bases"]) == 4
    assert {codec: list(curves) for codec, curves in result["sparsity"].items()} == {
        "lsdt-frame": ["P=2", "P=8"],
        "lsdt-clip": ["P=2", "P=8"],
    }
    assert [row["method"] for row in result["table"]] == [*FRAME_BASED, *lsdt_report.CLIP_BASED]
    assert [row["repeats"] for row in result["speeds"]["live"]["rows"]] == [0, 1]
    said = lsdt_text.text(result)
    live, paper = (result["frame_based"][name][1]["ratio"] for name in ("live", "lsdt-frame"))
    assert f"{live / paper:.2f}" in said.split("live / lsdt-frame")[1].splitlines()[0]
    saved = [at["saved"] for at in lsdt.error_saved(result["frame_based"]["lsdt-frame"], result["frame_based"]["dct-frame"])]
    assert f"all    {min(saved):6.0%} to {max(saved):4.0%}" in said
    assert all(words in said for words in ("Table 2", "Fig. 3", "Fig. 4", "Fig. 5", "Fig. 6", "Fig. 7", "Figs. 8", "packet"))


def test_parts_alone(small: Path, capsys: pytest.CaptureFixture[str]):
    out = small / "out"
    assert run(["bench", "lsdt", "--parts", "bases", "spatial_transforms", "--data", str(small), "--output", str(out)]) == 0
    assert "Fig. 5" in capsys.readouterr().out
    assert {f.name for f in out.iterdir()} == {"lsdt.json", "fig2_bases.png", "fig5_transforms.png"}
    assert tuple(lsdt_report.PARTS) == PARTS["lsdt"]


def test_a_run_that_was_cut_short_goes_on(small: Path, monkeypatch: pytest.MonkeyPatch):
    partial, done = small / "out/lsdt.partial", []

    def measured(_: Path) -> dict:
        done.append(1)
        return {"of": len(done)}

    def cut(_: Path) -> dict:
        raise KeyboardInterrupt

    monkeypatch.setattr(lsdt_report, "PARTS", {"one": measured, "two": cut})
    with pytest.raises(KeyboardInterrupt):
        lsdt_report.measure(small, (), partial)
    monkeypatch.setattr(lsdt_report, "PARTS", {"one": measured, "two": measured})
    assert lsdt_report.measure(small, (), partial) == {"one": {"of": 1}, "two": {"of": 2}} and not partial.exists()
    monkeypatch.setattr(lsdt_report, "PARTS", {"one": measured, "two": cut})
    with pytest.raises(KeyboardInterrupt):
        lsdt_report.measure(small, (), partial)
    monkeypatch.setattr(lsdt_report, "PARTS", {"one": measured})
    assert lsdt_report.measure(small / "cmu_bvh", (), partial) == {"one": {"of": 4}}, "of other data nothing is taken"


@pytest.mark.parametrize(
    ("arguments", "wanted"), [(["lsdt", "--parts", "curves"], "none of lsdt"), (["lossless", "--figures"], "those of lsdt")]
)
def test_what_is_not_of_lsdt(arguments: list[str], wanted: str, capsys: pytest.CaptureFixture[str]):
    assert run(["bench", *arguments]) == 2
    assert wanted in capsys.readouterr().err
