"""Forward kinematics against a plain walk down the tree, against pybvh, and its gradients against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pybvh import read_bvh_file
from scipy.spatial.transform import Rotation

from jaxmocap import Motion, Skeleton
from jaxmocap.formats.bvh import read_bvh
from jaxmocap.kinematics import compose, forward, local_rotations, pose, positions_cm
from jaxmocap.skeleton import POSITION_CHANNELS
from jaxmocap.synthesis import walk

XYZ, ZYX = ("Xrotation", "Yrotation", "Zrotation"), ("Zrotation", "Yrotation", "Xrotation")


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def walk_down(skeleton: Skeleton, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, rotations and end sites of one frame, joint by joint as a textbook has it."""
    positions, turns = [], []
    column = 0
    for j, parent in enumerate(skeleton.parents):
        place, turn = skeleton.offsets[j].copy(), np.eye(3)
        for channel in skeleton.channels[j]:
            axis = "XYZ".index(channel[0])
            if channel.endswith("position"):
                place[axis] = frame[column]
            else:
                turn = turn @ Rotation.from_rotvec(np.eye(3)[axis] * frame[column], degrees=True).as_matrix()
            column += 1
        turn = skeleton.axes[j] @ turn @ skeleton.axes[j].T
        positions.append(place if parent < 0 else positions[parent] + turns[parent] @ place)
        turns.append(turn if parent < 0 else turns[parent] @ turn)
    ends = [positions[j] + turns[j] @ o for j, o in zip(skeleton.end_joints, skeleton.end_offsets, strict=True)]
    return np.array(positions), np.array(turns), np.array(ends).reshape(-1, 3)


def two_figures() -> Skeleton:
    """Two roots; 0 to 6 channels a joint, interleaved and in many orders; end sites on inner joints; frames C."""
    channels = [
        (*POSITION_CHANNELS, *ZYX), (), ("Yrotation",), ("Xrotation", "Zrotation"), XYZ,
        (*XYZ, "Zposition", "Xposition"), ("Yposition", "Zrotation", "Xposition", "Yrotation", "Zposition"),
        POSITION_CHANNELS, ("Xposition",), ("Yrotation", "Xrotation", "Yrotation"), ("Zrotation",),
    ]
    parents = [-1, 0, 1, 2, 3, 1, -1, 6, 6, 8, 4]
    rng = np.random.default_rng(5)
    axes = Rotation.random(len(parents), rng=rng).as_matrix()
    axes[::3] = np.eye(3)
    names = [f"joint{n % 4}" for n in range(len(parents))]  # names may repeat
    offsets, ends = rng.normal(size=(len(parents), 3)), rng.normal(size=(4, 3))
    return Skeleton(names, parents, offsets, channels, (10, 4, 4, 7), ends, axes)


def chain(joints: int) -> Skeleton:
    return Skeleton(
        [str(n) for n in range(joints)], range(-1, joints - 1), np.tile([0.0, 1.0, 0.1], (joints, 1)), [XYZ] * joints
    )


def lone_point() -> Skeleton:
    return Skeleton(["marker"], [-1], np.ones((1, 3)), [POSITION_CHANNELS])


@pytest.mark.parametrize("skeleton", [two_figures(), chain(9), lone_point()], ids=["two", "chain", "point"])
def test_forward_is_the_walk_down_the_tree(skeleton):
    values = np.random.default_rng(6).uniform(-200, 200, (5, skeleton.channel_count))
    seen = jax.jit(lambda v: forward(skeleton, v))(jnp.asarray(values))
    expected = [np.stack(x) for x in zip(*(walk_down(skeleton, v) for v in values), strict=True)]
    for got, wanted in zip(seen, expected, strict=True):
        assert got.shape == wanted.shape
        np.testing.assert_allclose(got, wanted, atol=1e-10)


def test_every_bone_count_up_to_a_deep_chain_closes():
    """The doubling of strides must reach the root whatever the depth."""
    for joints in (2, 5, 17):
        skeleton = chain(joints)
        straight = jax.jit(lambda v, skeleton=skeleton: forward(skeleton, v).positions)(jnp.zeros(3 * joints))
        np.testing.assert_allclose(straight, np.arange(1, joints + 1)[:, None] * [0.0, 1.0, 0.1], atol=1e-12)


def test_pybvh_agrees_on_a_file(data_dir):
    path = data_dir / "cmu_bvh" / "09" / "09_06.bvh"
    motion, oracle = read_bvh(path), read_bvh_file(str(path))
    seen = pose(motion)
    theirs = oracle.node_positions()
    assert seen.positions.shape == (142, 31, 3)
    for j, name in enumerate(motion.skeleton.names):
        np.testing.assert_allclose(seen.positions[:, j], theirs[:, oracle.node_index[name]], atol=1e-9)
    is_end = np.array([node.is_end_site() for node in oracle.nodes])
    np.testing.assert_allclose(seen.ends, theirs[:, is_end], atol=1e-9)


@pytest.mark.parametrize("frames", [1, 65])
def test_pose_is_forward_for_any_number_of_frames(frames):
    motion = walk(0, 1.0).frames(0, frames)
    seen = pose(motion)
    assert [len(x) for x in seen] == [frames] * 3
    positions, rotations, ends = walk_down(motion.skeleton, motion.values[-1])
    np.testing.assert_allclose(seen.positions[-1], positions, atol=1e-10)
    np.testing.assert_allclose(seen.rotations[-1], rotations, atol=1e-12)
    np.testing.assert_allclose(seen.ends[-1], ends, atol=1e-10)
    np.testing.assert_allclose(positions_cm(motion)[-1], positions * 5.6444, atol=1e-9)


def test_positions_only_motion_stands_where_it_was_put():
    positions = np.random.default_rng(7).normal(size=(4, 3, 3)) * 50
    for parents in (None, [-1, 0, 1]):
        motion = Motion.from_positions(positions, ["a", "b", "c"], 0.01, parents)
        np.testing.assert_allclose(pose(motion).positions, positions, atol=1e-12)
        np.testing.assert_array_equal(pose(motion).rotations, np.broadcast_to(np.eye(3), (4, 3, 3, 3)))


def test_compiled_batched_and_single_frames_agree():
    skeleton = chain(3)
    values = jnp.asarray(np.random.default_rng(8).uniform(-90, 90, (4, skeleton.channel_count)))
    whole = forward(skeleton, values)
    single = jax.jit(lambda v: forward(skeleton, v))
    for function, x in ((jax.vmap(single), values), (single, values), (single, values.reshape(2, 2, -1))):
        for got, wanted in zip(function(x), whole, strict=True):
            np.testing.assert_allclose(got.reshape(wanted.shape), wanted, atol=1e-12)


def test_compose_joins_local_rotations_and_translations():
    skeleton = chain(4)
    values = np.random.default_rng(9).uniform(-90, 90, (2, 12))
    moved = np.random.default_rng(11).normal(size=(2, 4, 3))
    joined = jax.jit(lambda v, t: compose(skeleton, local_rotations(skeleton, v), t))
    seen = joined(values, moved)
    for n in range(2):
        stretched = Skeleton(skeleton.names, skeleton.parents, moved[n], skeleton.channels)
        positions, turns, _ = walk_down(stretched, values[n])
        np.testing.assert_allclose(seen.positions[n], positions, atol=1e-12)
        np.testing.assert_allclose(seen.rotations[n], turns, atol=1e-12)


def test_gradient_agrees_with_finite_differences():
    """In the values and in the offsets, of a figure with every kind of joint."""
    skeleton = two_figures()
    rng = np.random.default_rng(10)
    values = jnp.asarray(rng.uniform(-90, 90, skeleton.channel_count))
    weights = [jnp.asarray(rng.normal(size=s)) for s in ((11, 3), (11, 3, 3), (4, 3))]

    def scalar(offsets, ends, v):
        bent = eqx.tree_at(lambda s: (s.offsets, s.end_offsets), skeleton, (offsets, ends))
        return sum((w * x).sum() for w, x in zip(weights, forward(bent, v), strict=True))

    at = (jnp.asarray(skeleton.offsets), jnp.asarray(skeleton.end_offsets), values)
    value = jax.jit(scalar)
    slopes = jax.jit(jax.grad(scalar, (0, 1, 2)))(*at)
    for n, slope in enumerate(slopes):
        direction = jnp.asarray(rng.normal(size=slope.shape))
        step = [a + 1e-5 * direction if n == m else a for m, a in enumerate(at)]
        back = [a - 1e-5 * direction if n == m else a for m, a in enumerate(at)]
        np.testing.assert_allclose((slope * direction).sum(), (value(*step) - value(*back)) / 2e-5, rtol=1e-6)


def test_gradient_in_the_rest_pose_is_the_lever_arm():
    skeleton = chain(3)
    slope = jax.jit(jax.jacrev(lambda v: forward(skeleton, v).positions[-1]))(jnp.zeros(9))
    # A turn of a joint by w moves what hangs 2, 1, 0 bones below it by w x r.
    below = np.arange(2, -1, -1)[:, None] * [0.0, 1.0, 0.1]
    expected = np.cross(np.eye(3), below[:, None]) * np.pi / 180
    np.testing.assert_allclose(slope, expected.reshape(9, 3).T, atol=1e-15)
