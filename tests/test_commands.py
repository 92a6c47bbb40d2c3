"""The command line: what it prints, what it writes, and how it fails."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.__main__ import run
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.motion import Motion
from jaxmocap.skeleton import Skeleton
from jaxmocap.synthesis import walk

UNIT = ["--unit-cm", "5.6444"]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    write_motion(walk(5, 3.0), folder / "walk.bvh")
    return folder


def report(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    """The JSON of a command that succeeds, and that prints nothing else."""
    assert run([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a command that fails for bad input."""
    assert run(list(map(str, arguments))) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("jaxmocap: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


def test_encode_decode_compare(files: Path, capsys: pytest.CaptureFixture[str]):
    source, stream = files / "walk.bvh", files / "walk.jmc"
    made = report(capsys, "encode", source, "-o", stream, *UNIT, "--mean-error", 0.5)
    assert made["frames"] == 360 and made["raw_bytes"] == 360 * 31 * 12
    assert made["text_bytes"] == source.stat().st_size and made["stream_bytes"] == stream.stat().st_size
    assert made["ratio"] == pytest.approx(made["raw_bytes"] / made["stream_bytes"])
    assert made["codec"] == "learned" and made["metric"] == "shell" and made["seconds"] > 0
    assert 0.4 < made["shell_mean_cm"] <= 0.5 < made["shell_max_cm"] and 0.3 < made["mean_cm"] < 0.5
    report(capsys, "decode", stream, "-o", files / "back.bvh")
    text = report(capsys, "compare", source, files / "back.bvh", *UNIT)
    direct = report(capsys, "compare", source, stream, *UNIT)
    assert text["mean_cm"] == pytest.approx(made["mean_cm"], abs=1e-3)
    assert direct["mean_cm"] == pytest.approx(made["mean_cm"], abs=1e-6)
    assert len(direct["per_joint_cm"]) == 31 and direct["shell_mean_cm"] > 0 and direct["arms"] > 0


def test_frames_are_as_in_python(files: Path, capsys: pytest.CaptureFixture[str]):
    stream = files / "range.jmc"
    report(capsys, "encode", files / "walk.bvh", "-o", stream, *UNIT, "--codec", "lsdt-clip", "--config", '{"clip_frames": 60}')
    report(capsys, "decode", stream, "-o", files / "all.npz")
    whole = np.load(files / "all.npz")["positions"]
    for text, wanted in (("100:130", slice(100, 130)), (":7", slice(None, 7)), ("-5:", slice(-5, None))):
        got = report(capsys, "decode", stream, "-o", files / "part.npz", f"--frames={text}")
        assert got["frames"] == len(whole[wanted])
        np.testing.assert_allclose(np.load(files / "part.npz")["positions"], whole[wanted], atol=2e-4)


def test_max_error_holds_for_what_is_written(files: Path, capsys: pytest.CaptureFixture[str]):
    report(capsys, "encode", files / "walk.bvh", "-o", files / "max.jmc", *UNIT, "--max-error", 1.0)
    report(capsys, "decode", files / "max.jmc", "-o", files / "max.bvh")
    assert report(capsys, "compare", files / "walk.bvh", files / "max.bvh", *UNIT)["max_cm"] <= 1.0


def test_metric_says_what_the_error_is_of(files: Path, capsys: pytest.CaptureFixture[str]):
    arguments = ("encode", files / "walk.bvh", "-o", files / "metric.jmc", *UNIT, "--mean-error", 1.0)
    shell, joints = (report(capsys, *arguments, "--metric", metric) for metric in ("shell", "joints"))
    assert shell["shell_mean_cm"] <= 1.0 and 0.8 < joints["mean_cm"] <= 1.0 < joints["shell_mean_cm"]
    assert joints["stream_bytes"] < shell["stream_bytes"]
    assert report(capsys, "info", files / "metric.jmc")["metric"] == "joints"
    assert report(capsys, *arguments, "--codec", "lsdt-clip")["metric"] == "joints"


def test_a_beginning_of_a_progressive_stream_decodes(files: Path, capsys: pytest.CaptureFixture[str]):
    source, stream, front = files / "walk.bvh", files / "progressive.jmc", files / "front.jmc"
    made = report(capsys, "encode", source, "-o", stream, *UNIT, "--mean-error", 0.5, "--qualities", 2)
    assert report(capsys, "info", stream)["qualities"] == 2
    front.write_bytes(stream.read_bytes()[: int(0.9 * made["stream_bytes"])])
    assert "byte" in refusal(capsys, "decode", front, "-o", files / "front.bvh")
    report(capsys, "decode", front, "-o", files / "front.bvh", "--quality", 1)
    coarse = report(capsys, "compare", source, files / "front.bvh", *UNIT)
    assert 0.5 < coarse["shell_mean_cm"] <= 1.1
    assert "qualities 1 to 2" in refusal(capsys, "decode", stream, "-o", files / "front.bvh", "--quality", 3)
    refused = refusal(capsys, "encode", source, "-o", stream, "--codec", "lsdt-clip", "--qualities", 2)
    assert "--qualities is for codecs that take it" in refused


def test_without_a_unit_errors_are_in_file_units(files: Path, capsys: pytest.CaptureFixture[str]):
    made = report(capsys, "encode", files / "walk.bvh", "-o", files / "u.jmc", "--mean-error", 0.1)
    assert made["unit"] == "file units" and 0.08 < made["shell_mean_cm"] <= 0.1
    assert report(capsys, "info", files / "u.jmc")["unit_cm"] is None


def test_default_target_is_half_a_percent_of_the_height(files: Path, capsys: pytest.CaptureFixture[str]):
    made = report(capsys, "encode", files / "walk.bvh", "-o", files / "d.jmc", *UNIT)
    height = read_motion(files / "walk.bvh").skeleton.height() * 5.6444
    assert 0.8 * 0.005 * height < made["shell_mean_cm"] <= 0.005 * height


def test_start_leaves_frames_out(files: Path, capsys: pytest.CaptureFixture[str]):
    assert report(capsys, "encode", files / "walk.bvh", "-o", files / "s.jmc", *UNIT, "--start", 120)["frames"] == 240
    assert report(capsys, "compare", files / "walk.bvh", files / "s.jmc", *UNIT, "--start", 120)["frames"] == 240
    assert "leave out" in refusal(capsys, "encode", files / "walk.bvh", "-o", files / "s.jmc", "--start", 360)


def test_info(files: Path, capsys: pytest.CaptureFixture[str]):
    motion = report(capsys, "info", files / "walk.bvh", *UNIT)
    assert motion["format"] == "bvh" and motion["frames"] == 360 and motion["joints"] == 31 and motion["frame_rate"] == 120
    report(capsys, "encode", files / "walk.bvh", "-o", files / "i.jmc", *UNIT)
    stream = report(capsys, "info", files / "i.jmc")
    assert stream["codec"] == "learned" and stream["frames"] == 360
    assert sum(stream["sections"].values()) == stream["bytes"] == (files / "i.jmc").stat().st_size
    assert run(["info", str(files / "i.jmc")]) == 0 and "sections" in capsys.readouterr().out


def test_info_of_a_learned_stream(files: Path, capsys: pytest.CaptureFixture[str]):
    """Of a jump, at a step that was asked for; then of a rig that no model knows."""
    motion = read_motion(files / "walk.bvh").frames(0, 60)
    values = motion.values.copy()
    values[0] = 0
    write_motion(motion.with_values(values), files / "jump.bvh")
    report(capsys, "encode", files / "jump.bvh", "-o", files / "jump.jmc", *UNIT, "--step", 2.0, "--metric", "joints")
    found = report(capsys, "info", files / "jump.jmc")
    assert found["metric"] == "joints" and found["steps_cm"] == [2.0] and found["jumps"] == 1
    assert found["basis"] == "the model's" and found["nonzero_levels"] > 20
    assert {"framing", "bones", "motion"} <= found["sections"].keys()

    s = motion.skeleton
    other = Skeleton([f"j{n}" for n in range(31)], s.parents, s.offsets, s.channels, s.end_joints, s.end_offsets)
    write_motion(Motion(other, motion.values, motion.frame_time), files / "other.bvh")
    report(capsys, "encode", files / "other.bvh", "-o", files / "other.jmc", *UNIT, "--step", 4.0)
    found = report(capsys, "info", files / "other.jmc")
    assert found["basis"] == "its own" and found["sections"]["basis"] > 50 and found["metric"] == "shell"
    assert sum(found["sections"].values()) == found["bytes"]


def test_view_and_export(files: Path, capsys: pytest.CaptureFixture[str]):
    report(capsys, "encode", files / "walk.bvh", "-o", files / "v.jmc", *UNIT)
    page = report(capsys, "view", files / "walk.bvh", files / "v.jmc", "-o", files / "v.html", *UNIT)
    assert (files / "v.html").stat().st_size == page["bytes"] > 20_000
    report(capsys, "view", files / "walk.bvh", "-o", files / "one.html")
    for codec in ("learned", "lsdt-clip"):
        for kind in ("safetensors", "npz", "c"):
            made = report(capsys, "export", codec, "--format", kind, "-o", files / f"model.{kind}")
            assert (files / f"model.{kind}").stat().st_size == made["bytes"] > 10_000
        described = report(capsys, "info", files / "model.safetensors")
        assert described["codec"] == codec and described["digest"] == made["digest"] and described["joints"] == 31


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["encode", "{}/none.bvh", "-o", "{}/x.jmc"], "none.bvh: No such file"),
        (["encode", "{}/notes.txt", "-o", "{}/x.jmc"], "unknown suffix"),
        (["encode", "{}/cut.bvh", "-o", "{}/x.jmc"], "cut.bvh"),
        (["encode", "{}/walk.bvh", "-o", "{}/none/x.jmc"], "No such file"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--mean-error", "-1"], "above 0"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--mean-error", "1", "--step", "1"], "give one of"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--codec", "zip"], "lsdt-clip"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--config", "[]"], "JSON object"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--config", '{"metric": "feet"}'], "'joints', 'shell'"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--codec", "lsdt-clip", "--metric", "shell"], "--metric is for codecs"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--codec", "learned", "--model", "lsdt-clip"], "not for learned"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--config", '{"speed": 1}'], "does not take"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--model", "{}/walk.bvh"], "no jaxmocap model"),
        (["encode", "{}/walk.bvh", "-o", "{}/x.jmc", "--unit-cm", "0"], "--unit-cm is"),
        (["decode", "{}/walk.bvh", "-o", "{}/x.bvh"], "walk.bvh: this is no jaxmocap stream"),
        (["decode", "{}/good.jmc", "-o", "{}/x.fbx"], ".fbx"),
        (["decode", "{}/good.jmc", "-o", "{}/x.bvh", "--frames", "9"], "A:B"),
        (["decode", "{}/good.jmc", "-o", "{}/x.bvh", "--frames", "400:500"], "good.jmc: frames"),
        (["decode", "{}/flipped.jmc", "-o", "{}/x.bvh"], "flipped.jmc"),
        (["compare", "{}/walk.bvh", "{}/short.npz"], "frames"),
        (["info", "{}/empty.jmc"], "ends at byte 0"),
        (["train", "{}/none", "-o", "{}/m.safetensors"], "no such file or folder"),
        (["train", "{}", "-o", "{}/m.safetensors", "--codec", "zip"], "lsdt-clip"),
        (["export", "nothing", "--format", "c", "-o", "{}/x.h"], "lsdt-clip"),
        (["bench", "lsdt", "--data", "{}"], "cmu_bvh"),
    ],
    ids=lambda value: " ".join(value).replace("{}/", "") if isinstance(value, list) else "",
)
def test_bad_input_is_one_line(files: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], wanted: str):
    if not (files / "good.jmc").is_file():
        report(capsys, "encode", files / "walk.bvh", "-o", files / "good.jmc", *UNIT)
        data = bytearray((files / "good.jmc").read_bytes())
        data[40] ^= 4
        (files / "flipped.jmc").write_bytes(data)
        (files / "empty.jmc").touch()
        (files / "notes.txt").write_text("hello")
        (files / "cut.bvh").write_bytes((files / "walk.bvh").read_bytes()[:20_000])
        write_motion(read_motion(files / "walk.bvh").frames(0, 9), files / "short.npz")
    before = {f.name for f in files.iterdir()}
    assert wanted in refusal(capsys, *(a.replace("{}", str(files)) for a in arguments))
    assert {f.name for f in files.iterdir()} == before, "a failed run leaves no file behind"


def test_a_real_process_reports_on_stderr_and_exits(files: Path):
    command = [sys.executable, "-m", "jaxmocap", "decode", str(files / "nowhere.jmc"), "-o", str(files / "x.bvh"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == "" and "nowhere.jmc" in done.stderr


def test_train_writes_model_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for seed in (1, 2):
        write_motion(walk(seed, 2.0), tmp_path / f"{seed}.bvh")
    model = tmp_path / "model.safetensors"
    made = report(capsys, "train", tmp_path, "-o", model, *UNIT, "--codec", "lsdt-clip")
    assert made["files"] == 2 and made["frames"] == 480 and len(made["objective"]) == 300
    assert json.loads(model.with_suffix(".json").read_text())["digest"] == made["digest"]
    assert model.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert not list(tmp_path.glob("*.partial"))
    stream = tmp_path / "a.jmc"
    encoded = report(capsys, "encode", tmp_path / "1.bvh", "-o", stream, "--model", model, *UNIT, "--mean-error", 1.0)
    assert encoded["codec"] == "lsdt-clip", "the codec is the one that the model is for"
    assert "--model" in refusal(capsys, "decode", stream, "-o", tmp_path / "a.bvh")
    assert report(capsys, "decode", stream, "-o", tmp_path / "a.bvh", "--model", model)["frames"] == 240
    embedded = report(capsys, "encode", tmp_path / "1.bvh", "-o", stream, "--model", model, *UNIT, "--embed-model")
    assert embedded["stream_bytes"] > made["bytes"]
    assert report(capsys, "decode", stream, "-o", tmp_path / "a.bvh")["frames"] == 240
