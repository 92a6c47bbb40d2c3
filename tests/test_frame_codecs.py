"""`lsdt-frame` and `dct-frame`: the loop against the paper's equations, bits, real clips, training, golden streams."""

import dataclasses
import hashlib
import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.codecs import decode, load_artifact, lsdt_frame, make
from jaxmocap.codecs.artifact import Artifact
from jaxmocap.codecs.bitstream import BitWriter, varint
from jaxmocap.codecs.container import Stream, read_stream, write_stream
from jaxmocap.codecs.dct_frame import DctFrame, DctTransform
from jaxmocap.codecs.entropy import integers
from jaxmocap.codecs.frame_codec import levels_of
from jaxmocap.codecs.frame_coefficients import FrameCodes, decode_frames, encode_frames, size_in_bits
from jaxmocap.codecs.frame_model import FrameModel
from jaxmocap.codecs.lsdt_frame import LsdtFrame, LsdtTransform
from jaxmocap.codecs.quantise import step_cm
from jaxmocap.codecs.residual_frames import THRESHOLD, analyse, closed_loop, reconstruct, synthesise
from jaxmocap.errors import CorruptStream, FormatError, JaxmocapError
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.kinematics import positions_cm
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.synthesis import walk
from jaxmocap.training import TRAINERS, Corpus, loop
from jaxmocap.transforms import dct_matrix

GOLDEN = Path(__file__).parent / "golden"
UNIT_CM = 5.6444
TRANSFORMS = {"lsdt-frame": LsdtTransform(), "dct-frame": DctTransform()}
CODECS = {"lsdt-frame": LsdtFrame, "dct-frame": DctFrame}

codecs = pytest.mark.parametrize("name", CODECS)


def model_of(name: str) -> FrameModel:
    return FrameModel.load(load_artifact(name), name)


def encoded(name: str, motion: Motion, kind: str = "mean", cm: float = 1.0) -> bytes:
    return make({"codec": name, "target": {"kind": kind, "cm": cm}}).encode(motion)


def mean_cm(source: Motion, decoded: Motion) -> float:
    value = compare(source, decoded)["mean_cm"]
    assert isinstance(value, float)
    return value


# The closed loop.


def published_loop(m: np.ndarray, basis: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Equations (1) to (3) of one coordinate, frame by frame, in positions: levels, and reconstructed frames."""
    levels, reconstructed = [], []
    before = np.zeros(m.shape[1])
    for frame in m:
        c = basis @ (frame - before)
        level = np.array([0 if abs(x) < THRESHOLD * step else round(x / step) for x in c])
        before = before + basis.T @ (level * step)
        levels.append(level)
        reconstructed.append(before)
    return np.array(levels), np.array(reconstructed)


@codecs
@pytest.mark.parametrize("index", [90, 130])
def test_loop_is_that_of_the_paper(data_dir, name, index):
    """In the transform's domain, one loop a coefficient, the same levels come out as from residuals of positions."""
    motion = read_motion(data_dir / "cmu_bvh/09/09_06.bvh", UNIT_CM).frames(1)
    at = np.asarray(positions_cm(motion), np.float64)
    basis = model_of(name).bases.synthesis.astype(np.float64)
    basis = np.stack([u @ vt for u, _, vt in map(np.linalg.svd, basis)])  # orthogonal in doubles, too
    coefficients = np.einsum("tjd,dij->tdi", at, basis)
    levels = closed_loop(coefficients, index, at.shape[1])
    decoded = synthesise(reconstruct(levels), index, basis.astype(np.float32))
    for d in range(3):
        expected, positions = published_loop(at[..., d], basis[d], step_cm(index))
        np.testing.assert_array_equal(levels[:, d], expected)
        np.testing.assert_allclose(decoded[..., d], positions, rtol=0, atol=1e-3)
    np.testing.assert_allclose(analyse(at, basis), coefficients, rtol=0, atol=1e-3)


def wandering(frames: int, components: int = 9) -> np.ndarray:
    return np.cumsum(np.random.default_rng(4).normal(size=(frames, 3, components)), 0) * np.geomspace(3, 0.05, components)


def test_loop_does_not_drift():
    coefficients, index = wandering(5000), 100
    sums = reconstruct(closed_loop(coefficients, index, 9))
    assert np.abs(sums * step_cm(index) - coefficients).max() <= THRESHOLD * step_cm(index)


@pytest.mark.parametrize("most", [0, 1, 3])
def test_bounded_vectors_catch_up(most):
    """The largest go first, and a figure that stands still is reached; with none at all the first frame stays."""
    coefficients = np.concatenate([wandering(50), np.repeat(wandering(50)[-1:], 60, 0)])
    levels = closed_loop(coefficients, 100, most)
    assert (levels[1:] != 0).sum(2).max() == most
    unbounded = closed_loop(coefficients, 100, 9)
    np.testing.assert_array_equal(levels[0], unbounded[0])
    assert most == 0 or np.abs(levels[1]).max() == np.abs(unbounded[1]).max()
    left = np.abs(reconstruct(levels)[-1] * step_cm(100) - coefficients[-1]).max()
    assert (left <= THRESHOLD * step_cm(100)) == (most > 0)


# The bits.


def random_levels(frames: int, components: int, largest: int) -> np.ndarray:
    rng = np.random.default_rng(frames)
    magnitude = np.rint(np.exp(rng.uniform(-2, np.log(largest), (frames, 3, components))))
    return (magnitude * rng.choice([-1, 0, 0, 1], magnitude.shape)).astype(np.int32)


@codecs
@pytest.mark.parametrize(("index", "count_bits"), [(0, 5), (100, 4), (255, 5)])
def test_frames_are_decoded_as_encoded(name, index, count_bits):
    codes = model_of(name).codes
    levels = random_levels(40, 31, integers.LIMIT)
    levels[1:, :, (1 << count_bits) - 1 :] = 0
    levels[3, 1, :2] = (integers.LIMIT, -integers.LIMIT)
    writer = BitWriter()
    encode_frames(levels, codes, index, count_bits, [writer] * len(levels))
    data = writer.to_bytes()
    np.testing.assert_array_equal(decode_frames(data, len(levels), codes, index, count_bits), levels)
    assert len(data) == (size_in_bits(levels, codes, index, count_bits) + 7) // 8


def test_counts_of_no_bits_leave_the_first_frame():
    codes, levels = model_of("lsdt-frame").codes, random_levels(1, 31, 100)
    writer = BitWriter()
    encode_frames(levels, codes, 100, 0, [writer])
    decoded = decode_frames(writer.to_bytes(), 9, codes, 100, 0)
    np.testing.assert_array_equal(decoded[0], levels[0])
    assert not decoded[1:].any()


def test_codes_of_other_components():
    codes = model_of("lsdt-frame").codes.with_positions(np.array([[1], [1], [1]]))
    levels = random_levels(20, 1, 1000)
    writer = BitWriter()
    encode_frames(levels, codes, 100, 1, [writer] * 20)
    np.testing.assert_array_equal(decode_frames(writer.to_bytes(), 20, codes, 100, 1), levels)


def test_impossible_counts_are_refused():
    writer = BitWriter()
    for _ in range(99):
        writer.write(1, 1)
    codes: FrameCodes = model_of("lsdt-frame").codes.with_positions(np.full((3, 5), 3))
    with pytest.raises(CorruptStream, match="says that 7"):
        decode_frames(writer.to_bytes(), 4, codes, 100, 3)


# Streams.


@codecs
@pytest.mark.parametrize("clip", ["09/09_06", "05/05_12"])
def test_real_motion(data_dir, name, clip):
    motion = read_motion(data_dir / "cmu_bvh" / f"{clip}.bvh", UNIT_CM).frames(1, 500)
    for cm in (0.3, 1.0):
        data = encoded(name, motion, "mean", cm)
        assert mean_cm(motion, decode(data)) <= cm
        ratio = motion.frame_count * motion.skeleton.joint_count * 12 / len(data)
        assert ratio > {"lsdt-frame": {0.3: 17, 1.0: 42}, "dct-frame": {0.3: 7, 1.0: 19}}[name][cm]


def test_lsdt_has_less_distortion_than_dct_at_equal_bytes(data_dir):
    motion = read_motion(data_dir / "cmu_bvh/02/02_05.bvh", UNIT_CM).frames(1, 300)
    for cm in (0.2, 1.5):
        rival = encoded("dct-frame", motion, "mean", cm)
        assert len(encoded("lsdt-frame", motion, "mean", 0.7 * cm)) < len(rival)


@codecs
def test_counts_are_as_wide_as_pays(name):
    """For an error, fewer bits than any count may need; for a step, as many as hold the largest."""
    motion = walk(seed=4, seconds=2.0)
    assert read_stream(encoded(name, motion)).header.params[0] < 5
    data = encoded(name, motion, "step", 2.0)
    stream = read_stream(data)
    (levels,) = levels_of(stream, TRANSFORMS[name], None)
    assert stream.header.params[0] == int((levels[1:] != 0).sum(2).max()).bit_length()
    error = np.asarray(positions_cm(decode(data))) - np.asarray(positions_cm(motion))
    assert np.abs(error).max() < 31 * THRESHOLD * 2.0


def test_packets_are_the_chunk_cut_into_frames():
    data = encoded("lsdt-frame", walk(seed=4, seconds=1.5))
    stream = read_stream(data)
    codes = model_of("lsdt-frame").codes
    count_bits, index = stream.header.params
    (levels,) = levels_of(stream, TRANSFORMS["lsdt-frame"], None)
    packets = lsdt_frame.packets(data)
    assert len(packets) == stream.header.frames
    sizes = np.diff([0, *(size_in_bits(levels[: n + 1], codes, index, count_bits) for n in range(len(levels)))])
    bits = "".join(f"{int.from_bytes(p, 'big'):0{8 * len(p)}b}"[:size] for p, size in zip(packets, sizes, strict=True))
    assert [len(p) for p in packets] == [(size + 7) // 8 for size in sizes]
    payload = stream.chunk(0)
    assert bits.ljust(8 * len(payload), "0") == f"{int.from_bytes(payload, 'big'):0{8 * len(payload)}b}"


@codecs
def test_settings_that_no_encoder_wrote_are_refused(name):
    stream = read_stream(encoded(name, walk(seed=4, seconds=0.5)))

    def rewritten(**changes) -> bytes:
        return write_stream(dataclasses.replace(stream.header, **changes), [stream.chunk(0)])

    assert decode(rewritten()).frame_count == 60
    count_bits, index = stream.header.params
    for params in (b"", bytes([count_bits]), bytes([6, index]), bytes([count_bits, index, 0])):
        with pytest.raises(CorruptStream, match="settings|counts of"):
            decode(rewritten(params=params))
    with pytest.raises(JaxmocapError, match="layers|settings"):
        decode(write_stream(dataclasses.replace(stream.header, layers=2), [stream.chunk(0)] * 2))


def swinging(frames: int) -> Motion:
    """A rig of its own: two joints."""
    turns = ROTATION_CHANNELS
    skeleton = Skeleton(["a", "b"], [-1, 0], np.array([[0.0, 0, 0], [20, 5, 0]]), [POSITION_CHANNELS + turns, turns])
    values = 30 * np.sin(np.arange(frames)[:, None] / 120 * np.linspace(0.1, 0.5, skeleton.channel_count))
    return Motion(skeleton, values, 1 / 60, 1.0)


@codecs
def test_bases_that_are_none_are_refused(name):
    stream = read_stream(encoded(name, swinging(50)))
    section = stream.header.skeleton
    own = next(n for n in range(len(section)) if is_own(section[n:], name))
    bomb = zlib.compress(bytes(1 << 26), 9, wbits=-15)
    for basis in (b"", b"\x00", varint(3), varint((1 << 35) - 1) + bomb, varint(2) + bomb, varint(1) + b"junk", varint(1)):
        skeleton = section[:own] + basis
        with pytest.raises(CorruptStream):
            decode(write_stream(dataclasses.replace(stream.header, skeleton=skeleton), [stream.chunk(0)]))


def is_own(data: bytes, name: str) -> bool:
    """Whether this is the own basis of a stream of two joints, to its end."""
    unpacker = zlib.decompressobj(wbits=-15)
    try:
        raw = unpacker.decompress(data[1:])
    except zlib.error:
        return False
    return unpacker.eof and not unpacker.unused_data and len(raw) == 3 * data[0] * (1 + TRANSFORMS[name].columns(2))


def test_the_dct_does_not_travel():
    entries, basis = (TRANSFORMS[name].entries(np.zeros((4, 7, 3))) for name in ("dct-frame", "lsdt-frame"))
    assert entries.size == 0 and basis.shape == (3, 7, 7)
    bases = TRANSFORMS["dct-frame"].bases(entries[:, :4], 7)
    np.testing.assert_allclose(bases.synthesis[1], dct_matrix(7)[:4], atol=1e-7)


@codecs
def test_step_too_fine(name):
    motion = walk(seed=4, seconds=0.5)
    values = motion.values.copy()
    values[:, 0] += 1e5
    with pytest.raises(JaxmocapError, match="too fine"):
        encoded(name, motion.with_values(values), "step", 0.01)


def test_models_are_for_one_codec():
    with pytest.raises(FormatError, match="not for dct-frame"):
        make({"codec": "dct-frame"}, load_artifact("lsdt-frame")).encode(walk(seed=4, seconds=0.1))


# Training.


@pytest.fixture(scope="session")
def corpus(tmp_path_factory) -> Corpus:
    folder = tmp_path_factory.mktemp("frames")
    for seed in (1, 2):
        write_motion(walk(seed=seed, seconds=1.0), folder / f"{seed}.bvh")
    return Corpus.of([folder], UNIT_CM)


@codecs
def test_interrupted_training_ends_in_the_same_model(name, corpus, tmp_path, monkeypatch):
    artifact, report = TRAINERS[name](corpus, tmp_path / "whole")
    assert (report["files"], report["frames"], report["digest"]) == (2, 240, artifact.digest)
    assert report["nonzeros_a_frame"] == sorted(report["nonzeros_a_frame"], reverse=True)
    assert json.loads(json.dumps(report)) == report
    basis = artifact.tensors["basis"]
    np.testing.assert_allclose(basis @ basis.transpose(0, 2, 1), np.tile(np.eye(31), (3, 1, 1)), atol=1e-4)
    assert np.allclose(basis, dct_matrix(31), atol=1e-6) == (name == "dct-frame")
    motion = walk(seed=5, seconds=0.5)
    codec = CODECS[name](artifact)
    assert mean_cm(motion, codec.decode(codec.encode(motion))) < 1.0

    monkeypatch.setattr(loop, "_SAVE_SECONDS", 0.0)
    saved = loop._save

    def interrupting(checkpoint, key, state, stage, item):
        saved(checkpoint, key, state, stage, item)
        if item == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(loop, "_save", interrupting)
    for _ in range(2):  # after the first file; after the first part of a fit, or the first file whose symbols are counted
        with pytest.raises(KeyboardInterrupt):
            TRAINERS[name](corpus, tmp_path / "parts")
    monkeypatch.setattr(loop, "_save", saved)
    assert TRAINERS[name](corpus, tmp_path / "parts")[0].data == artifact.data


# Streams that must decode for ever.


def facts(stream: Stream, name: str, model: Artifact) -> dict:
    """What a golden file says of its stream."""
    motion = decode(stream.data, model)
    at = np.asarray(positions_cm(motion))
    frames, joints = at.shape[:2]
    some = [(t, j) for t in sorted({0, frames // 2, frames - 1}) for j in sorted({0, joints // 2, joints - 1})]
    levels = np.concatenate(levels_of(stream, TRANSFORMS[name], model))
    return {
        "frames": frames,
        "joints": joints,
        "frame_time": motion.frame_time,
        "unit_cm": motion.unit_cm,
        "nonzeros": int((levels != 0).sum()),
        "levels_sha256": hashlib.sha256(levels.astype("<i4").tobytes()).hexdigest(),
        "positions_cm": [[t, j, np.round(at[t, j].astype(float), 5).tolist()] for t, j in some],
    }


@codecs
@pytest.mark.parametrize("stream", ["one-chunk", "fine", "one-frame", "own-rig", "own-rig-two-chunks", "points"])
def test_golden_streams_decode_for_ever(name, stream):
    expected = json.loads((GOLDEN / name / f"{stream}.json").read_text())
    model = load_artifact(GOLDEN / name / expected.pop("model"))
    found = facts(read_stream((GOLDEN / name / f"{stream}.jmc").read_bytes()), name, model)
    for (_, _, place), (_, _, wanted) in zip(found.pop("positions_cm"), expected.pop("positions_cm"), strict=True):
        np.testing.assert_allclose(place, wanted, rtol=0, atol=1e-3)
    assert found == expected
