"""A basis fitted to the motion itself, on rigs of every kind: its bytes, its precision, and what decodes with it."""

import itertools

import numpy as np
import pytest

from jaxmocap.codecs.artifact import load_artifact
from jaxmocap.codecs.base import Target
from jaxmocap.codecs.learned import bands
from jaxmocap.codecs.learned.basis import Basis
from jaxmocap.codecs.learned.distortion import METRICS, Metric, points_of
from jaxmocap.codecs.learned.encoder import Source, encode_to
from jaxmocap.codecs.learned.figure import in_cm
from jaxmocap.codecs.learned.klt import weighted_analysis
from jaxmocap.codecs.learned.model import LearnedModel
from jaxmocap.codecs.learned.own import OwnBasis, lever_arms, plain, read_own, write_own
from jaxmocap.codecs.learned.own_fit import fit_own
from jaxmocap.codecs.learned.payload import read_layers, write_layers
from jaxmocap.codecs.learned.pose_vectors import PoseVectors
from jaxmocap.codecs.learned.virtual_work import posed
from jaxmocap.errors import CorruptStream
from jaxmocap.formats import read_motion
from jaxmocap.kinematics import pose
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.synthesis import walk

MODEL = LearnedModel.load(load_artifact("learned"))
TAIL = MODEL.densities.tail
FREE = (*POSITION_CHANNELS, *ROTATION_CHANNELS)
ROUGH = 25.0  # degrees, and cm


def wavy(channels: list[tuple[str, ...]], frames: int, seed: int = 0) -> Motion:
    """A chain of joints 20 cm apart whose channels all swing slowly."""
    random = np.random.default_rng(seed)
    joints = len(channels)
    skeleton = Skeleton(
        [f"j{n}" for n in range(joints)], range(-1, joints - 1), np.tile([20.0, 5.0, 0.0], (joints, 1)), channels
    )
    time = np.arange(frames)[:, None] / 60
    rate, phase, size = random.uniform(0.2, 1.0, (3, 1, skeleton.channel_count))
    return Motion(skeleton, ROUGH * size * np.sin(6 * rate * time + 6 * phase) + ROUGH * phase, 1 / 60, 1.0)


def positions_only() -> Motion:
    motion = walk(1, 2.0, 60.0)
    s = motion.skeleton
    return Motion.from_positions(np.asarray(pose(motion).positions) * motion.scale, s.names, 1 / 60, s.parents, 1.0)


TURN = ROTATION_CHANNELS
MOTIONS = {
    "walk": walk(0, 2.0, 60.0),
    "one joint": wavy([FREE], 90),
    "still": Motion(wavy([FREE, TURN], 1).skeleton, np.full((40, 9), 7.0), 1 / 60, 1.0),
    "one frame": wavy([FREE, TURN, TURN], 1),
    "two frames": wavy([FREE, TURN, TURN], 2),
    "few channels": wavy([FREE, TURN[:1], TURN[1:], (), TURN], 120),
    "no heading": wavy([(*POSITION_CHANNELS, "Xrotation"), TURN, TURN], 120),
    "sliding": wavy([FREE, FREE, ("Yposition", *TURN), TURN], 120),
    "positions only": positions_only(),
}


def fitted(motion: Motion, metric: Metric, mean_cm: float = 1.0):
    return fit_own(motion, in_cm(motion.skeleton, motion.scale), motion.scale, metric, MODEL, mean_cm)


def source_of(motion: Motion, own: OwnBasis, basis: Basis, metric: Metric) -> Source:
    skeleton = in_cm(motion.skeleton, motion.scale)
    figure = PoseVectors(skeleton, own.mean_pose(skeleton))
    path, body = figure.analyse(motion, motion.scale)
    octaves = bands.octave_count(motion.frame_time)
    return Source(figure, figure, path, body, octaves, basis, metric, MODEL.densities)


@pytest.mark.parametrize(("name", "metric"), [*zip(MOTIONS, itertools.cycle(METRICS), strict=False)])
def test_what_is_read_is_what_was_written_and_decodes_to_the_target(name: str, metric: Metric):
    motion = MOTIONS[name]
    skeleton = in_cm(motion.skeleton, motion.scale)
    own, basis = fitted(motion, metric)
    read = read_own(write_own(own, TAIL), skeleton, TAIL)
    assert (read.fineness, read.turn) == (own.fineness, own.turn)
    for field in ("levels", "rows", "means"):
        np.testing.assert_array_equal(getattr(read, field), getattr(own, field))
    source = source_of(motion, own, basis, metric)
    coded = encode_to(source, Target("mean", 1.0))
    data = write_layers([coded], basis, MODEL.densities)
    decoding = read.basis(skeleton, MODEL, metric)
    (coded,) = read_layers(data, motion.frame_count, source.octaves, decoding, MODEL.densities)
    y = coded.coefficients().astype(np.float32)
    figure = PoseVectors(skeleton, read.mean_pose(skeleton))
    decoded = points_of(figure, metric, *decoding.vectors(y, coded.direction))
    wanted = points_of(figure, metric, source.path, source.body)
    assert np.linalg.norm(decoded - wanted, axis=0).mean() <= 1.001


@pytest.mark.parametrize("name", ["walk", "positions only"])
def test_bytes_that_nobody_wrote_are_a_basis_or_refused(name: str):
    motion = MOTIONS[name]
    skeleton = in_cm(motion.skeleton, motion.scale)
    data = write_own(fitted(motion, "shell")[0], TAIL)
    random = np.random.default_rng(0)
    damaged = [data[:n] for n in range(0, len(data), 7)] + [random.bytes(n) for n in range(60)] + [b"\xff" * 99]
    for at in random.integers(0, len(data), 60):
        damaged.append(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :])
    refused = 0
    for bad in damaged:
        try:
            own = read_own(bad, skeleton, TAIL)
        except CorruptStream:
            refused += 1
            continue
        assert own.rows.shape == (len(own.levels) - 3, own.means.size)
        assert np.isfinite(own.basis(skeleton, MODEL, "shell").synthesis).all()
        assert np.isfinite(own.mean_pose(skeleton)).all()
    assert refused


def test_finer_targets_take_more_precise_bases():
    coarse, fine = (fitted(MOTIONS["walk"], "joints", cm)[0] for cm in (2.0, 0.2))
    assert fine.fineness < coarse.fineness and len(fine.rows) > len(coarse.rows)
    assert len(write_own(coarse, TAIL)) < len(write_own(fine, TAIL))


def test_the_mean_pose_is_as_precise_as_it_is_seen():
    motion = MOTIONS["sliding"]
    skeleton = in_cm(motion.skeleton, motion.scale)
    own, _ = fitted(motion, "joints", 0.05)
    path, body = PoseVectors(skeleton, own.mean_pose(skeleton)).analyse(motion, motion.scale)
    body[:, 0] -= own.basis(skeleton, MODEL, "joints").mean[0]
    body[:, 13:] -= own.basis(skeleton, MODEL, "joints").mean[13:]
    assert np.abs(body.mean(0) * own.arms(skeleton)).max() < 0.1 * np.abs(body * own.arms(skeleton)[None]).max()


def test_lever_arms_are_how_far_turns_move_joints_at_rest():
    motion = MOTIONS["walk"]
    skeleton = in_cm(motion.skeleton, motion.scale)
    figure = plain(skeleton)
    small = 1e-4
    bodies = np.concatenate([np.zeros((1, figure.size)), small * np.eye(figure.size)])
    at = posed(figure, np.zeros((len(bodies), 3)), bodies).at
    square = (((at[..., 1:] - at[..., :1]) / small) ** 2).sum(0).mean(0)
    arms = lever_arms(figure, np.zeros((0, 3)))
    assert square[0] == pytest.approx(arms[0] ** 2)
    by_axis = square[1:].reshape(-1, 3).sum(1)  # about three axes a joint moves by twice its distance, squared
    np.testing.assert_allclose(by_axis, 2 * (arms[1::3] ** 2 - 4), rtol=1e-3, atol=1e-2)


def test_weighted_analysis_is_the_nearest_as_it_is_seen():
    random = np.random.default_rng(0)
    root = random.normal(size=(9, 9))
    synthesis, x = random.normal(size=(4, 9)), random.normal(size=(5, 9))
    wanted = np.linalg.lstsq(root @ synthesis.T, root @ x.T)[0].T
    np.testing.assert_allclose(x @ weighted_analysis(synthesis, root.T @ root), wanted, atol=0.05)
    np.testing.assert_allclose(synthesis @ weighted_analysis(synthesis, root.T @ root), np.eye(4), atol=1e-6)


def test_a_basis_without_components_is_whole():
    skeleton = MOTIONS["one joint"].skeleton
    own = OwnBasis(40, 3, np.array([1, -2, 3]), np.zeros((0, 4), np.int64), np.array([5, 0, -7, 100]))
    read = read_own(write_own(own, TAIL), skeleton, TAIL)
    assert read.means.tolist() == [5, 0, -7, 100] and read.levels.tolist() == [1, -2, 3]
    assert read.basis(skeleton, MODEL, "joints").synthesis.shape == (0, 4)


def test_martial_arts_of_another_rig_are_small(data_dir):
    motion = read_motion(data_dir / "cmu_daz" / "martial" / "04.bvh", 1.0)
    own, basis = fitted(motion, "joints")
    coded = encode_to(source_of(motion, own, basis, "joints"), Target("mean", 1.0))
    (levels,) = write_layers([coded], basis, MODEL.densities)
    assert len(write_own(own, TAIL)) + len(levels) < 1050  # quantise, delta, xz: 3387, SZ3: 4704, without a skeleton
