"""`lsdt-clip`: real motion, what decoding imports, and released streams that must decode for ever."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.codecs import decode, load_artifact, lsdt_basis, make
from jaxmocap.codecs.artifact import Artifact
from jaxmocap.codecs.clips import cut
from jaxmocap.codecs.coefficients_runs import frame_rate
from jaxmocap.codecs.container import read_stream
from jaxmocap.codecs.lsdt_clip import _decode_chunk, _model, _params
from jaxmocap.codecs.rig import read_skeleton
from jaxmocap.errors import JaxmocapError
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.kinematics import positions_cm
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.synthesis import walk

GOLDEN = Path(__file__).parent / "golden"
UNIT_CM = 5.6444


def decoded_levels(data: bytes, artifact: Artifact) -> np.ndarray:
    """All levels of a stream, clip after clip: integers, so the same on every machine."""
    stream = read_stream(data)
    header, model = stream.header, _model(artifact)
    form, clip_frames, index = _params(header)
    skeleton, _, rest, known = read_skeleton(header.skeleton, model.rig, header.unit_cm or None, index)
    coding = lsdt_basis.known(model) if known else lsdt_basis.read_own(rest, skeleton.joint_count, model, form)
    rate = frame_rate(header.frame_time or model.rig.frame_time)
    clips = []
    for n in range(header.chunk_count):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        clips += _decode_chunk(form, stream.chunk(n), cut(held, clip_frames).lengths, coding, index, rate)
    return np.concatenate([c.ravel() for c in clips])


@pytest.mark.parametrize("name", sorted(f.stem for f in GOLDEN.glob("*.jmc")))
def test_golden_streams_decode_for_ever(name):
    expected = json.loads((GOLDEN / f"{name}.json").read_text())
    data = (GOLDEN / f"{name}.jmc").read_bytes()
    model = load_artifact(GOLDEN / expected["model"])
    levels = decoded_levels(data, model)
    assert int((levels != 0).sum()) == expected["nonzeros"]
    assert hashlib.sha256(levels.astype("<i4").tobytes()).hexdigest() == expected["levels_sha256"]
    motion = decode(data, artifact=model)
    shape = (motion.frame_count, motion.skeleton.joint_count, motion.frame_time, motion.unit_cm)
    assert shape == (expected["frames"], expected["joints"], expected["frame_time"], expected["unit_cm"])
    at = np.asarray(positions_cm(motion))
    for frame, joint, place in expected["positions_cm"]:
        np.testing.assert_allclose(at[frame, joint], place, rtol=0, atol=1e-3)


def test_golden_streams_are_there():
    assert len(list(GOLDEN.glob("*.jmc"))) >= 7


@pytest.mark.parametrize("clip", ["09/09_06", "02/02_05"])
def test_real_motion(data_dir, clip):
    motion = read_motion(data_dir / "cmu_bvh" / f"{clip}.bvh", UNIT_CM).frames(1)
    sizes = {}
    for form in ("runs", "paper"):
        codec = make({"form": form, "target": {"kind": "mean", "cm": 1.0}})
        data = codec.encode(motion)
        assert compare(motion, codec.decode(data))["mean_cm"] <= 1.0
        sizes[form] = len(data)
    assert sizes["runs"] < sizes["paper"]
    assert motion.frame_count * motion.skeleton.joint_count * 12 / sizes["runs"] > 100


def test_decoding_imports_nothing_of_training(tmp_path):
    motion = walk(seed=4, seconds=1.0)
    stream, out = tmp_path / "walk.jmc", tmp_path / "walk.bvh"
    stream.write_bytes(make({"target": {"kind": "mean", "cm": 1.0}}).encode(motion))
    code = (
        "import runpy, sys\n"
        f"sys.argv = ['jaxmocap', 'decode', {str(stream)!r}, '-o', {str(out)!r}]\n"
        "try:\n    runpy.run_module('jaxmocap', run_name='__main__')\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
        "print(*sorted(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.splitlines()[-1].split())
    assert "jaxmocap.codecs" in imported
    assert not {"optax", "matplotlib", "jaxmocap.training"} & imported
    assert read_motion(out, UNIT_CM).frame_count == motion.frame_count


def test_unit_known_or_not_takes_the_same_bytes(tmp_path):
    """BVH has no unit: a figure of the model's rig is taken to be of the model's unit, and its bones decode the same."""
    motion = walk(seed=4, seconds=1.0)
    nameless = Motion(motion.skeleton, motion.values, motion.frame_time, None)
    known = make({"target": {"kind": "step", "cm": 8.0}}).encode(motion)
    unknown = make({"target": {"kind": "step", "cm": 8.0 / UNIT_CM}}).encode(nameless)
    decoded = decode(unknown)
    assert decoded.unit_cm is None
    np.testing.assert_allclose(decoded.values, decode(known).values, atol=1e-3)
    write_motion(decoded, tmp_path / "out.bvh")


def test_finest_step_is_refused_far_from_the_origin():
    motion = walk(seed=4, seconds=1.0)
    values = motion.values.copy()
    values[:, 0] += 1e5
    with pytest.raises(JaxmocapError, match="too fine"):
        make({"target": {"kind": "step", "cm": 0.01}}).encode(motion.with_values(values))


@pytest.mark.parametrize("settings", [{"clip_frames": 100}, {"form": "zip"}, {"target": {"kind": "step", "cm": 1e-4}}])
def test_settings_out_of_range(settings):
    with pytest.raises(ValueError, match="wanted"):
        make(settings).encode(walk(seed=4, seconds=1.0))
