"""The codec `learned` beyond the laws of all codecs: short and constant motions, units, rates, long motions, damage."""

import numpy as np
import pytest

from jaxmocap.codecs import decode, load_artifact, make
from jaxmocap.codecs.artifact import make_artifact
from jaxmocap.codecs.container import read_stream
from jaxmocap.codecs.learned.distortion import METRICS, Metric, points_of
from jaxmocap.codecs.learned.figure import in_cm
from jaxmocap.codecs.learned.pose_vectors import PoseVectors
from jaxmocap.errors import FormatError, JaxmocapError
from jaxmocap.formats import read_motion
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.synthesis import walk

TURN, SIX = ROTATION_CHANNELS, POSITION_CHANNELS + ROTATION_CHANNELS
MEAN = {"kind": "mean", "cm": 1.0}


def coded(motion: Motion, metric: Metric = "joints", kind: str = "mean", cm: float = 1.0) -> bytes:
    return make({"codec": "learned", "metric": metric, "target": {"kind": kind, "cm": cm}}).encode(motion)


def measured(motion: Motion, decoded: Motion, metric: Metric = "joints", kind: str = "mean") -> float:
    """In cm. On the host, where nothing is compiled for every length; test_learned_poses holds it to `compare`."""
    upright = np.tile(np.eye(3), (motion.skeleton.joint_count, 1, 1))
    points = []
    for m in (motion, decoded):
        figure = PoseVectors(in_cm(m.skeleton, motion.scale), upright)
        points.append(points_of(figure, metric, *figure.analyse(m, motion.scale)))
    error = np.linalg.norm(points[0] - points[1], axis=0)
    return float(error.mean() if kind == "mean" else error.max())


def swinging(frames: int, frame_time: float = 1 / 60, seed: int = 0) -> Motion:
    """Three joints of a rig that no model knows."""
    skeleton = Skeleton(["a", "b", "c"], [-1, 0, 1], np.array([[0.0, 0, 0], [20, 5, 0], [0, 25, 3]]), [SIX, TURN, TURN])
    rate, phase = np.random.default_rng(seed).uniform(0.2, 3.0, (2, 1, skeleton.channel_count))
    values = 30 * np.sin(np.arange(frames)[:, None] * frame_time * rate + phase)
    return Motion(skeleton, values, frame_time, 1.0)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("frames", [1, 2, 3, 9])
def test_few_frames_of_a_wild_motion(frames: int, metric: Metric):
    """Frames that have nothing to do with each other: no transform helps, and all octaves are used."""
    still = walk(seed=1, seconds=0.1)
    random = np.random.default_rng(frames)
    wild = Motion(still.skeleton, random.uniform(-40, 40, (frames, 96)), still.frame_time, still.unit_cm)
    for motion in (wild, swinging(frames).with_values(random.uniform(-40, 40, (frames, 12)))):
        data = coded(motion, metric)
        decoded = decode(data)
        assert decoded.values.shape == motion.values.shape
        assert measured(motion, decoded, metric) <= 1.0


def test_short_clips_cost_no_more_than_their_whole():
    """Octaves that a short clip does not have are no reason for a finer step."""
    motion = walk(seed=4, seconds=0.5)
    sizes = [len(coded(motion.frames(0, n))) for n in (2, 5, 9, 15)]
    assert max(sizes) <= 1.2 * len(coded(motion))


@pytest.mark.parametrize("motion", [walk(seed=1, seconds=0.1), swinging(9)], ids=["known", "unknown"])
def test_constant_motion_takes_little_more_than_one_frame(motion: Motion):
    still = motion.with_values(np.tile(motion.values[:1], (300, 1)))
    data = coded(still)
    decoded = decode(data)
    assert measured(still, decoded) <= 1.0
    assert np.ptp(decoded.values, 0).max() < 1e-9
    assert len(data) <= len(coded(still.frames(0, 1))) + 25


def test_channels_that_are_zero_stay_zero():
    motion = walk(seed=3, seconds=1.0)
    still = (motion.values == 0).all(0)
    assert 20 < still.sum() < 60
    decoded = decode(coded(motion))
    assert (decoded.values[:, still] == 0).all()
    unknown = swinging(60)
    values = unknown.values.copy()
    values[:, [4, 7, 8]] = 0
    decoded = decode(coded(unknown.with_values(values)))
    assert (decoded.values[:, [4, 7, 8]] == 0).all() and (np.abs(decoded.values).max(0) > 0).sum() == 9


@pytest.mark.parametrize("unit_cm", [None, 1.0, 100.0])
@pytest.mark.parametrize("frame_time", [1 / 30, 1 / 97.3])
def test_units_and_rates(unit_cm: float | None, frame_time: float):
    """Where nobody knows the unit, the target speaks of file units."""
    known = walk(seed=2, seconds=0.5)
    size = known.scale / (unit_cm or known.scale)
    s = known.skeleton
    values = known.values.copy()
    values[:, :3] *= size
    bones = Skeleton(s.names, s.parents, s.offsets * size, s.channels, s.end_joints, s.end_offsets * size)
    unknown = swinging(40)
    for skeleton, at in ((bones, values), (unknown.skeleton, unknown.values)):
        motion = Motion(skeleton, at, frame_time, unit_cm)
        decoded = decode(coded(motion, cm=0.5))
        assert (decoded.unit_cm, decoded.frame_time) == (unit_cm, frame_time)
        assert measured(motion, decoded) <= 0.5


@pytest.mark.parametrize(("frames", "counts"), [(8192, 1), (8193, 2)])
def test_chunks_of_long_motions(frames: int, counts: int):
    motion = swinging(frames, 1 / 120)
    data = coded(motion, "shell")
    assert read_stream(data).header.chunk_count == counts
    whole = decode(data)
    assert measured(motion, whole, "shell") <= 1.0
    for start, stop in ((0, 1), (8000, 8192), (8190, frames), (frames - 1, frames)):
        np.testing.assert_array_equal(decode(data, frames=slice(start, stop)).values, whole.values[start:stop])


@pytest.mark.parametrize("motion", [walk(seed=1, seconds=0.3), swinging(20)], ids=["known", "unknown"])
def test_every_prefix_and_every_flip_is_refused(motion: Motion):
    data = coded(motion)
    assert measured(motion, decode(data)) <= 1.0
    damaged = [data[:n] for n in range(len(data))]
    damaged += [data[:n] + bytes([data[n] ^ 1 << bit]) + data[n + 1 :] for n in range(len(data)) for bit in range(8)]
    for bad in (*damaged, data + b"\0"):
        with pytest.raises(JaxmocapError):
            decode(bad)


def other_rig():
    """The shipped model with another name for a joint: one of another rig, but that nobody trained it."""
    shipped = load_artifact("learned")
    rig = dict(shipped.spec["rig"])
    rig["names"] = [*rig["names"][:-1], "another"]
    return make_artifact({**shipped.spec, "rig": rig}, shipped.tensors)


def test_a_model_of_another_rig_takes_any_rig():
    """What it knows of densities holds; the basis travels along."""
    motion = walk(seed=3, seconds=1.0)
    foreign = make({"codec": "learned", "metric": "joints", "target": MEAN}, other_rig())
    data = foreign.encode(motion)
    decoded = foreign.decode(data)
    assert decoded.skeleton.same_rig(motion.skeleton)
    assert measured(motion, decoded) <= 1.0
    assert len(data) > len(coded(motion))
    embedded = make({"codec": "learned", "metric": "joints", "target": MEAN, "embed": True}, other_rig())
    assert measured(motion, decode(embedded.encode(motion))) <= 1.0


def test_positions_only():
    at = np.cumsum(np.random.default_rng(0).normal(size=(50, 5, 3)), 0)
    for parents in (None, [-1, 0, 1, 1, 0]):
        motion = Motion.from_positions(at, list("abcde"), 1 / 50, parents, 2.0)
        for metric in METRICS:
            decoded = decode(coded(motion, metric, "max"))
            assert measured(motion, decoded, metric, "max") <= 1.0


def test_rotations_with_no_euler_order_are_freed():
    """Four rotation channels on one joint: the decoded rig has other channels, and the same joints at the same places."""
    motion = swinging(30)
    s = motion.skeleton
    crooked = Skeleton(s.names, s.parents, s.offsets, [SIX, (*TURN, "Xrotation"), TURN])
    motion = Motion(crooked, np.concatenate([motion.values, motion.values[:, :1]], 1), 1 / 60, 1.0)
    decoded = decode(coded(motion))
    assert decoded.skeleton.names == s.names and measured(motion, decoded) <= 1.0


@pytest.mark.parametrize("metric", METRICS)
def test_more_error_takes_fewer_bytes(metric: Metric):
    motion = walk(seed=6, seconds=1.0)
    sizes = [len(coded(motion, metric, "mean", cm)) for cm in (0.1, 0.4, 1.6)]
    assert sizes == sorted(sizes, reverse=True) and sizes[2] < sizes[0] / 3


@pytest.mark.parametrize("kind", ["mean", "max", "step"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 1e12])
def test_values_beyond_all_measure_are_refused_or_met(kind: str, value: float):
    for motion in (walk(seed=1, seconds=0.2), swinging(20)):
        values = motion.values.copy()
        values[5, 1] = value
        with pytest.raises(JaxmocapError):
            coded(motion.with_values(values), "joints", kind, 0.1)


def test_settings_and_models_are_checked():
    with pytest.raises(ValueError, match="metric is 'hands', wanted one of"):
        make({"codec": "learned", "metric": "hands"})
    shipped = load_artifact("learned")
    less = make_artifact(shipped.spec, {name: x for name, x in shipped.tensors.items() if name != "logistic"})
    with pytest.raises(FormatError, match="not whole"):
        make({"codec": "learned"}, less).encode(walk(seed=1, seconds=0.1))


def test_real_motion_at_a_centimetre(data_dir):
    """All there is: a conversion of ASF with a T-pose before it, and the angles themselves, of a rig that no model knows."""
    for file, unit_cm in (("cmu_bvh/09/09_06.bvh", 5.6444), ("cmu_amc/16/16_58.amc", None)):
        motion = read_motion(data_dir / file, unit_cm)
        decoded = decode(coded(motion))
        assert measured(motion, decoded) <= 1.0
