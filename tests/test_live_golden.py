"""Files and packets of `live` decode for ever as they were written: integers equal, joints within a thousandth of a cm."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.codecs import decode, load_artifact
from jaxmocap.codecs.artifact import Artifact
from jaxmocap.codecs.container import DIGEST_BYTES, read_stream
from jaxmocap.codecs.live.codec import model_of, params_of, read_chunk
from jaxmocap.codecs.live.setting import read_setting
from jaxmocap.codecs.live.stream import Decoder
from jaxmocap.codecs.released import RELEASED
from jaxmocap.kinematics import positions_cm
from jaxmocap.motion import Motion

GOLDEN = Path(__file__).parent / "golden" / "live"
NAMES = ["joints", "shell", "own-rig-two-chunks", "one-frame"]


def integers_sha256(data: bytes, model: Artifact) -> str:
    """Of all that is decoded before there is a float."""
    stream, live = read_stream(data), model_of(model)
    header = stream.header
    flags, metric = params_of(header)
    setting = read_setting(header.skeleton, flags, live, metric)
    digest = hashlib.sha256()
    for n in range(header.chunk_count):
        frames = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        direction, places = read_chunk(stream.chunk(n), frames, setting, live)
        digest.update(np.array([direction]).astype("<i8").tobytes() + places.astype("<i8").tobytes())
    return digest.hexdigest()


def some_positions(motion: Motion) -> list:
    at = np.asarray(positions_cm(motion))
    frames, joints = at.shape[:2]
    some = [(t, j) for t in sorted({0, frames // 2, frames - 1}) for j in sorted({0, joints // 2, joints - 1})]
    return [[t, j, np.round(at[t, j], 5).tolist()] for t, j in some]


def facts(data: bytes, model: Artifact) -> dict:
    """What a golden file says of its stream."""
    motion = decode(data, model)
    return {
        "frames": motion.frame_count,
        "joints": motion.skeleton.joint_count,
        "frame_time": motion.frame_time,
        "unit_cm": motion.unit_cm,
        "integers_sha256": integers_sha256(data, model),
        "positions_cm": some_positions(motion),
    }


def packet_facts(packets: list[bytes], model: Artifact) -> dict:
    """What the golden file of packets says of what they show."""
    decoder = Decoder(model)
    shown = [frame for frame in map(decoder.push, packets) if frame]
    assert decoder.skeleton and decoder.frame_time
    motion = Motion(decoder.skeleton, np.stack([f.values for f in shown]), decoder.frame_time, decoder.unit_cm)
    return {"first": shown[0].number, "frames": len(shown), "positions_cm": some_positions(motion)}


def assert_as_written(found: dict, expected: dict) -> None:
    for (_, _, place), (_, _, wanted) in zip(found.pop("positions_cm"), expected.pop("positions_cm"), strict=True):
        np.testing.assert_allclose(place, wanted, rtol=0, atol=1e-3)
    assert found == expected


def test_the_shipped_model_has_a_number():
    assert bytes.fromhex(load_artifact("live").digest)[:DIGEST_BYTES] in RELEASED


@pytest.mark.parametrize("name", NAMES)
def test_golden_streams_decode_for_ever(name: str):
    expected = json.loads((GOLDEN / f"{name}.json").read_text())
    model = load_artifact(GOLDEN / expected.pop("model"))
    assert_as_written(facts((GOLDEN / f"{name}.jmc").read_bytes(), model), expected)


def test_golden_packets_decode_for_ever():
    expected = json.loads((GOLDEN / "packets.json").read_text())
    model = load_artifact(GOLDEN / expected.pop("model"))
    packets = [bytes.fromhex(packet) for packet in expected.pop("packets")]
    assert_as_written(packet_facts(packets, model), expected)
