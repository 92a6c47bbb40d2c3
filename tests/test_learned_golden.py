"""Streams of `learned` decode for ever as they were written: integers equal, joints within a thousandth of a centimetre."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.codecs import decode, load_artifact
from jaxmocap.codecs.artifact import Artifact
from jaxmocap.codecs.container import DIGEST_BYTES, read_stream
from jaxmocap.codecs.learned import bands
from jaxmocap.codecs.learned.codec import model_of, params_of
from jaxmocap.codecs.learned.payload import read_layers
from jaxmocap.codecs.learned.setting import read_setting
from jaxmocap.codecs.released import RELEASED
from jaxmocap.kinematics import positions_cm

GOLDEN = Path(__file__).parent / "golden" / "learned"
NAMES = ["joints", "shell", "a-jump-bounded", "three-qualities", "own-rig", "two-chunks", "one-frame"]


def integers_sha256(data: bytes, model: Artifact) -> str:
    """Of all that is decoded before there is a float."""
    stream, learned = read_stream(data), model_of(model)
    header = stream.header
    flags, metric = params_of(header)
    setting = read_setting(header.skeleton, flags, learned, metric)
    octaves = bands.octave_count(learned.rig.frame_time if header.frame_time is None else header.frame_time)
    digest = hashlib.sha256()
    for n in range(header.chunk_count):
        frames = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        payloads = [stream.chunk(n, layer) for layer in range(stream.layers)]
        for coded in read_layers(payloads, frames, octaves, setting.basis, learned.densities):
            of_levels = [*coded.levels, *coded.jumps, *coded.corrections]
            for integers in ([coded.step_index, coded.direction], *of_levels):
                digest.update(np.asarray(integers).astype("<i4").tobytes())
    return digest.hexdigest()


def facts(data: bytes, model: Artifact) -> dict:
    """What a golden file says of its stream."""
    motion = decode(data, model)
    at = np.asarray(positions_cm(motion))
    frames, joints = at.shape[:2]
    some = [(t, j) for t in sorted({0, frames // 2, frames - 1}) for j in sorted({0, joints // 2, joints - 1})]
    return {
        "frames": frames,
        "joints": joints,
        "frame_time": motion.frame_time,
        "unit_cm": motion.unit_cm,
        "integers_sha256": integers_sha256(data, model),
        "positions_cm": [[t, j, np.round(at[t, j], 5).tolist()] for t, j in some],
    }


def test_the_shipped_model_has_a_number():
    assert bytes.fromhex(load_artifact("learned").digest)[:DIGEST_BYTES] in RELEASED


@pytest.mark.parametrize("name", NAMES)
def test_golden_streams_decode_for_ever(name: str):
    expected = json.loads((GOLDEN / f"{name}.json").read_text())
    model = load_artifact(GOLDEN / expected.pop("model"))
    found = facts((GOLDEN / f"{name}.jmc").read_bytes(), model)
    for (_, _, place), (_, _, wanted) in zip(found.pop("positions_cm"), expected.pop("positions_cm"), strict=True):
        np.testing.assert_allclose(place, wanted, rtol=0, atol=1e-3)
    assert found == expected
