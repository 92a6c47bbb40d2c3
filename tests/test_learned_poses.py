"""Motions as free vectors and back, on rigs of every kind; and the pull of points on these vectors, held to JAX's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.spatial.transform import Rotation

from jaxmocap.codecs.learned.basis import Basis
from jaxmocap.codecs.learned.distortion import METRICS, Metric, decoded_points, points_of
from jaxmocap.codecs.learned.figure import in_cm
from jaxmocap.codecs.learned.pose_vectors import PoseVectors
from jaxmocap.codecs.learned.spectrum import Spectrum
from jaxmocap.codecs.learned.virtual_work import joint_pull, posed, shell_pull
from jaxmocap.formats import read_motion
from jaxmocap.kinematics import pose
from jaxmocap.metrics import shell_points
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.synthesis import walk

FRAMES = 50
TURN, SIX = ROTATION_CHANNELS, POSITION_CHANNELS + ROTATION_CHANNELS


def rig(parents: list[int], channels: list[tuple[str, ...]], turned: bool = False) -> Motion:
    """Bones at random, an end site on every leaf, and channels that swing widely; `turned`: joints have frames of their own."""
    random = np.random.default_rng(len(parents))
    offsets = random.normal(scale=15, size=(len(parents), 3))
    leaves = sorted(set(range(len(parents))) - set(parents))
    axes = Rotation.from_rotvec(random.normal(size=offsets.shape)).as_matrix() if turned else None
    names = [f"j{n}" for n in range(len(parents))]
    skeleton = Skeleton(names, parents, offsets, channels, leaves, offsets[leaves] / 2, axes)
    rate, phase = random.uniform(0.5, 3, (2, 1, skeleton.channel_count))
    return Motion(skeleton, 70 * np.sin(np.arange(FRAMES)[:, None] / 20 * rate + phase), 1 / 60, 2.5)


RIGS = {
    "walk": walk(seed=1, seconds=0.4),
    "one joint": rig([-1], [SIX]),
    "sliding": rig([-1, 0, 1, 2], [SIX, SIX, TURN, ("Xposition", "Zrotation")]),
    "several roots": rig([-1, 0, -1, 2, -1], [SIX, TURN, SIX, TURN[::-1], POSITION_CHANNELS]),
    "limits": rig([-1, 0, 1, 2, 0], [SIX, ("Xrotation",), ("Xrotation", "Zrotation"), (), TURN], turned=True),
    "no heading": rig([-1, 0, 1], [(*POSITION_CHANNELS, "Xrotation"), TURN, TURN]),
    "no place": rig([-1, 0, 1], [TURN, TURN[1:] + TURN[:1], TURN]),
    "points": rig([-1, 0, 0], [POSITION_CHANNELS] * 3),
    "a root that slides on one axis": rig([-1, 0, -1], [SIX, TURN, ("Yposition", *TURN)]),
}
rigs = pytest.mark.parametrize("motion", RIGS.values(), ids=RIGS)
metrics = pytest.mark.parametrize("metric", METRICS)


def figure_of(motion: Motion, means: bool = True) -> PoseVectors:
    joints = motion.skeleton.joint_count
    about = np.random.default_rng(2).normal(size=(joints, 3)) * means
    return PoseVectors(in_cm(motion.skeleton, motion.scale), Rotation.from_rotvec(about).as_matrix())


@rigs
def test_values_return(motion: Motion):
    figure = figure_of(motion)
    path, body = figure.analyse(motion, motion.scale)
    assert path.shape == (motion.frame_count, 3) and body.shape == (motion.frame_count, figure.size)
    back = figure.values(path, body, motion.scale)
    both = motion.with_values(np.concatenate([motion.values, back]))
    plain = figure_of(motion, means=False)
    for metric in METRICS:
        seen = points_of(plain, metric, *plain.analyse(both, motion.scale))
        np.testing.assert_allclose(seen[..., : motion.frame_count], seen[..., motion.frame_count :], atol=1e-7)
        again = points_of(figure, metric, path, body)
        np.testing.assert_allclose(again, seen[..., : motion.frame_count], atol=1e-7)


@pytest.mark.parametrize("name", ["walk", "several roots", "limits"])
def test_points_are_those_of_forward_kinematics(name: str):
    motion = RIGS[name]
    figure, at = figure_of(motion), pose(motion)
    found = points_of(figure, "joints", *figure.analyse(motion, motion.scale)).transpose(2, 1, 0)
    np.testing.assert_allclose(found, at.positions * motion.scale, atol=1e-3)
    found = points_of(figure, "shell", *figure.analyse(motion, motion.scale)).transpose(2, 1, 0)
    np.testing.assert_allclose(found, shell_points(at, motion.skeleton.end_joints, motion.scale), atol=1e-3)


@pytest.mark.parametrize("file", ["cmu_amc", "cmu_bvh", "cmu_daz"])
def test_values_of_real_motion_return(file: str, data_dir):
    found = sorted(f for f in (data_dir / file).rglob("*") if f.suffix in (".amc", ".bvh"))[0]
    motion = read_motion(found, 5.6444).frames(1, 200)
    figure = figure_of(motion)
    back = motion.with_values(figure.values(*figure.analyse(motion, motion.scale), motion.scale))
    turned = (back.values - motion.values + 180) % 360 - 180  # Euler angles are not unique, but these are
    assert np.abs(turned).max() < 1e-5


@rigs
def test_vectors_do_not_jump(motion: Motion):
    _, body = figure_of(motion).analyse(motion, motion.scale)
    moved = np.abs(np.diff(body, axis=0)).max(0)
    turns = slice(1, 1 + 3 * len(figure_of(motion).turning))
    assert moved[turns].size == 0 or moved[turns].max() < 1.5


@metrics
@pytest.mark.parametrize("name", ["sliding", "several roots", "limits"])
def test_pulls_are_gradients(name: str, metric: Metric):
    """The gradient of (points . force) in the coefficients of a basis that mixes all vectors."""
    motion = RIGS[name]
    figure = figure_of(motion)
    random = np.random.default_rng(0)
    path, body = (x[:6] for x in figure.analyse(motion, motion.scale))
    nothing = np.zeros((1, 3 + figure.size), np.int64)
    basis = Basis(body.mean(0), random.normal(size=(figure.size, figure.size)), 30.0, Spectrum(nothing, nothing))
    y, direction = basis.coefficients(path, body, 5), 5
    at = points_of(figure, metric, path, body)
    force = random.normal(size=at.shape)

    @jax.jit
    def both(y: Array, force: Array) -> tuple[Array, Array]:
        points, pull_back = jax.vjp(lambda y: decoded_points(figure, basis, metric, y, direction), y)
        return points, pull_back(force)[0]

    points, wanted = both(jnp.asarray(y, jnp.float32), jnp.asarray(force.transpose(2, 1, 0), jnp.float32))
    pull = joint_pull if metric == "joints" else shell_pull
    found = basis.pull(*pull(figure, posed(figure, path, body), force), direction)
    np.testing.assert_allclose(at, points.transpose(2, 1, 0), atol=1e-2)
    np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())


@rigs
@metrics
def test_pulls_are_differences(motion: Motion, metric: Metric):
    """In double precision."""
    figure = figure_of(motion)
    path, body = (x[:3] for x in figure.analyse(motion, motion.scale))
    random = np.random.default_rng(0)
    step_path, step_body = random.normal(size=path.shape), random.normal(size=body.shape)
    force = random.normal(size=points_of(figure, metric, path, body).shape)
    pull = joint_pull if metric == "joints" else shell_pull
    of_path, of_body = pull(figure, posed(figure, path, body), force)
    small = 1e-5
    ahead, behind = (points_of(figure, metric, path + s * step_path, body + s * step_body) for s in (small, -small))
    slope = (force * (ahead - behind)).sum((0, 1)) / (2 * small)
    np.testing.assert_allclose((of_path * step_path).sum(1) + (of_body * step_body).sum(1), slope, rtol=1e-5, atol=1e-5)
