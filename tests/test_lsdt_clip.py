"""`lsdt-clip`: real motion, what decoding imports, crafted skeletons, and streams that must decode for ever."""

import dataclasses
import hashlib
import json
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.codecs import decode, load_artifact, lsdt_basis, make
from jaxmocap.codecs.artifact import Artifact
from jaxmocap.codecs.bitstream import BitWriter, varint
from jaxmocap.codecs.clips import cut
from jaxmocap.codecs.coefficients_runs import frame_rate
from jaxmocap.codecs.container import read_stream, write_stream
from jaxmocap.codecs.lsdt_clip import _decode_chunk, _model, _params
from jaxmocap.codecs.rig import LENGTHS, OFFSETS, WHOLE, read_skeleton
from jaxmocap.errors import CorruptStream, JaxmocapError
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.kinematics import positions_cm
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS
from jaxmocap.synthesis import walk

GOLDEN = Path(__file__).parent / "golden"
UNIT_CM = 5.6444


def measured(source: Motion, decoded: Motion, measure: str = "mean_cm") -> float:
    value = compare(source, decoded)[measure]
    assert isinstance(value, float)
    return value


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
        codec = make({"codec": "lsdt-clip", "form": form, "target": {"kind": "mean", "cm": 1.0}})
        data = codec.encode(motion)
        assert measured(motion, codec.decode(data)) <= 1.0
        sizes[form] = len(data)
    assert sizes["runs"] < sizes["paper"]
    assert motion.frame_count * motion.skeleton.joint_count * 12 / sizes["runs"] > 100


def test_decoding_imports_nothing_of_training(tmp_path):
    motion = walk(seed=4, seconds=1.0)
    stream, out = tmp_path / "walk.jmc", tmp_path / "walk.bvh"
    stream.write_bytes(make({"codec": "lsdt-clip", "target": {"kind": "mean", "cm": 1.0}}).encode(motion))
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
    known = make({"codec": "lsdt-clip", "target": {"kind": "step", "cm": 8.0}}).encode(motion)
    unknown = make({"codec": "lsdt-clip", "target": {"kind": "step", "cm": 8.0 / UNIT_CM}}).encode(nameless)
    decoded = decode(unknown)
    assert decoded.unit_cm is None
    np.testing.assert_allclose(decoded.values, decode(known).values, atol=1e-3)
    write_motion(decoded, tmp_path / "out.bvh")


def test_finest_step_is_refused_far_from_the_origin():
    motion = walk(seed=4, seconds=1.0)
    values = motion.values.copy()
    values[:, 0] += 1e5
    with pytest.raises(JaxmocapError, match="too fine"):
        make({"codec": "lsdt-clip", "target": {"kind": "step", "cm": 0.01}}).encode(motion.with_values(values))


@pytest.mark.parametrize("settings", [{"clip_frames": 100}, {"form": "zip"}, {"target": {"kind": "step", "cm": 1e-4}}])
def test_settings_out_of_range(settings):
    with pytest.raises(ValueError, match="wanted"):
        make({"codec": "lsdt-clip", **settings}).encode(walk(seed=4, seconds=1.0))


@pytest.fixture(scope="session")
def short() -> bytes:
    return make({"codec": "lsdt-clip", "target": {"kind": "mean", "cm": 1.0}}).encode(walk(seed=4, seconds=1.0))


def with_skeleton(data: bytes, skeleton: bytes, unit_cm: float | None = None) -> bytes:
    """The stream of one chunk with another skeleton section, and a checksum that holds."""
    stream = read_stream(data)
    return write_stream(dataclasses.replace(stream.header, skeleton=skeleton, unit_cm=unit_cm), [stream.chunk(0)])


def still(data: bytes, skeleton: bytes) -> bytes:
    """The same with no coded motion: an empty payload says that all levels are zero, whatever the rig."""
    return write_stream(dataclasses.replace(read_stream(data).header, skeleton=skeleton), [b""])


def golombs(value_bits: int, order: int, count: int, flag: bool) -> bytes:
    """`count` of the largest Exp-Golomb integers of so many bits."""
    writer = BitWriter()
    for _ in range(count):
        writer.write(1, int(flag))
        writer.write(1, value_bits - order + 1)
        writer.write((1 << value_bits) - 1, value_bits)
    return writer.to_bytes()


@pytest.mark.parametrize("bits", [30, 45, 60])
def test_bones_beyond_all_measure(short, bits):
    """The largest bones that the bits can say, in kilometres or in units of atoms."""
    header = read_stream(short).header
    rig = _model(load_artifact("lsdt-clip")).rig
    _, _, index = _params(header)
    octave = index // 16 - 13
    orders = [max(0, int(s).bit_length() - 17 - octave) for s in rig.spread]
    lengths = BitWriter()
    for order in orders:
        lengths.write(1, bits - order + 1)
        lengths.write((1 << bits) - 1, bits)
    count = 3 * (len(rig.skeleton.offsets) + len(rig.skeleton.end_offsets))
    for section in (bytes([LENGTHS, 128]) + lengths.to_bytes(), bytes([OFFSETS, 20]) + golombs(bits, 20, count, True)):
        for unit_cm in (None, 2e-9, 5e8):
            assert_decodes_or_is_refused(with_skeleton(short, section, unit_cm))


def assert_decodes_or_is_refused(data: bytes) -> None:
    try:
        motion = decode(data)
    except JaxmocapError:
        return
    assert np.isfinite(motion.values).all()


OUTLINE = {
    "names": ["a", "b", "c"],
    "parents": [-1, 0, 1],
    "channels": [[*POSITION_CHANNELS, *ROTATION_CHANNELS], [*ROTATION_CHANNELS], [*ROTATION_CHANNELS]],
    "end_joints": [2],
}
EYES = np.tile(np.eye(3), (3, 1, 1)).tolist()


def whole(outline: object, joints: int = 3, ends: int = 1) -> bytes:
    text = outline if isinstance(outline, bytes) else json.dumps(outline).encode()
    packed = zlib.compress(text, 9, wbits=-15)
    bones = golombs(12, 4, 3 * (joints + ends), True)
    own = zlib.compress(bytes([100] * joints + [0] * (2 * joints) + [30] * 3 + [0] * 17), 9, wbits=-15)
    return bytes([WHOLE]) + varint(len(packed)) + packed + bytes([4]) + bones + varint(1) + own


def test_crafted_outline_as_such_decodes(short):
    for outline in (OUTLINE, {**OUTLINE, "axes": EYES}, {**OUTLINE, "colour": 1}):
        assert decode(still(short, whole(outline))).skeleton.names == ("a", "b", "c")


@pytest.mark.parametrize(
    "change",
    [
        {"axes": [[[float("nan")] * 3] * 3] * 3},
        {"axes": [[[float("inf")] * 3] * 3] * 3},
        {"axes": [[[1e200] * 3] * 3] * 3},
        {"axes": [[[10**400] * 3] * 3] * 3},
        {"axes": EYES[:2]},
        {"axes": "text"},
        {"axes": {"a": 1}},
        {"axes": [[["x"] * 3] * 3] * 3},
        {"axes": [EYES[0], EYES[1], [1]]},
        {"parents": [-1, 0, 2]},
        {"parents": [-2, 0, 1]},
        {"parents": [-1, 0, 10**30]},
        {"parents": [-1, 0, True]},
        {"parents": [-1, 0, 1.0]},
        {"parents": [-1, 0]},
        {"names": []},
        {"names": ["a", "b", 3]},
        {"names": "abc"},
        {"channels": [1, 2, 3]},
        {"channels": [["Wrotation"], [], []]},
        {"channels": [[["Xrotation"]], [], []]},
        {"channels": [[{}], [], []]},
        {"channels": [None, [], []]},
        {"channels": ["Xrotation", [], []]},
        {"channels": {"a": []}},
        {"end_joints": [3]},
        {"end_joints": [-1]},
        {"end_joints": ["a"]},
    ],
)
def test_crafted_outlines_are_refused(short, change):
    with pytest.raises(CorruptStream):
        decode(still(short, whole({**OUTLINE, **change})))


@pytest.mark.parametrize("channels", [["Xrotation"] * 3, ["Xrotation"] * 500, ["Xposition"] * 9, ["Zrotation", "Xposition"]])
def test_odd_channels_decode_or_are_refused(short, channels):
    assert_decodes_or_is_refused(still(short, whole({**OUTLINE, "channels": [channels] * 3})))


@pytest.mark.parametrize("text", [b"", b"[]", b"null", b"[" * 10**6, b"{" * 9, b"\xff\xfe", b" " * (1 << 26), b"1" * 10**5])
def test_outlines_that_are_none_are_refused(short, text):
    with pytest.raises(CorruptStream):
        decode(still(short, whole(text)))


def test_bases_that_are_none_are_refused(short):
    good = whole(OUTLINE)
    at = len(good) - len(zlib.compress(bytes([100] * 3 + [0] * 6 + [30] * 3 + [0] * 17), 9, wbits=-15)) - 1
    assert good[at] == 1
    bomb = zlib.compress(bytes(1 << 26), 9, wbits=-15)
    for basis in (b"", b"\x00", varint(4), varint((1 << 35) - 1) + bomb, varint(3) + bomb, varint(1) + b"junk", varint(1)):
        with pytest.raises(CorruptStream):
            decode(still(short, good[:at] + basis))
