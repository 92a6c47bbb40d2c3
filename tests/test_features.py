"""Features: exact round trips on real and random rigs, alignment, and rotations recovered from positions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmocap import Motion, Skeleton
from jaxmocap.features import (
    Markers,
    Positions,
    Rigid,
    RotationVectors,
    align_heading,
    align_points,
    align_points_about_y,
    align_root,
    heading,
    mean_rotation,
    recover,
    recoverable,
)
from jaxmocap.features.markers import layout, place_markers, read_markers
from jaxmocap.formats import read_motion
from jaxmocap.kinematics import forward, pose
from jaxmocap.metrics import mean_error
from jaxmocap.rotations import about_axis, from_rotation_vector
from jaxmocap.skeleton import POSITION_CHANNELS
from jaxmocap.synthesis import walk

CLIPS = ("cmu_bvh/05/05_02.bvh", "cmu_amc/02/02_01.amc", "cmu_daz/martial/03.bvh")
ZYX = ("Zrotation", "Yrotation", "Xrotation")
UP = jnp.array([0.0, 1.0, 0.0])
heading_aligned, root_aligned = jax.jit(align_heading), jax.jit(align_root)
posed = eqx.filter_jit(forward)


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=CLIPS)
def clip(request, data_dir) -> Motion:
    """A hundred frames, with the jump after the T-pose among them."""
    return read_motion(data_dir / request.param, unit_cm=2.54 / 0.45).frames(0, 100)


def error(a: Motion, b: Motion) -> tuple[float, float]:
    """The largest difference of a position (file units) and of an entry of a global rotation."""
    p, q = pose(a), pose(b)
    return float(jnp.abs(p.positions - q.positions).max()), float(jnp.abs(p.rotations - q.rotations).max())


def random_motion(seed: int, frames: int = 5, least: int = 0, slide: bool = False) -> Motion:
    """Several trees, zero-length bones, joints with `least` to 3 rotation channels of any order, frames C; if `slide`,
    joints that move along their bones too."""
    rng = np.random.default_rng(seed)
    joints = 30
    parents = [-1] + [int(rng.integers(max(j - 4, 0), j)) if rng.uniform() < 0.85 else -1 for j in range(1, joints)]
    offsets = rng.normal(size=(joints, 3)) * (rng.uniform(size=(joints, 1)) < 0.7)
    channels = []
    for j in range(joints):
        count = int(rng.integers(least, 4))
        order = ["XYZ"[n] + "rotation" for n in rng.permutation(3)[:count]]
        if count == 3 and rng.uniform() < 0.3:
            order[2] = order[0]
        slides = parents[j] < 0 or (slide and rng.uniform() < 0.3)
        channels.append((*(POSITION_CHANNELS if slides else ()), *order))
    axes = Rotation.random(joints, rng=rng).as_matrix()
    axes[::2] = np.eye(3)
    skeleton = Skeleton([f"j{n}" for n in range(joints)], parents, offsets, channels, (4,), np.ones((1, 3)), axes)
    values = rng.uniform(-170, 170, (frames, skeleton.channel_count))
    return Motion(skeleton, values, 1 / 120, 2.0)


def small_rig(offsets: np.ndarray, parents: list[int], channels: list | None = None) -> Skeleton:
    plain = [(*POSITION_CHANNELS, *ZYX) if p < 0 else ZYX for p in parents]
    return Skeleton([f"j{n}" for n in range(len(parents))], parents, offsets, channels or plain)


# Round trips


@pytest.mark.parametrize("feature", [Markers, RotationVectors])
def test_real_clips_come_back_whole_in_single_precision(feature, clip):
    made = feature.of(clip)
    back = made.to_motion(made.to_matrix(clip))
    assert back.unit_cm == clip.unit_cm and back.frame_time == clip.frame_time
    position, rotation = error(clip, back)
    assert position < 1e-4 and rotation < 1e-4


def test_the_positions_of_real_clips_come_back(clip):
    made = Positions.of(clip)
    matrix = made.to_matrix(clip)
    back = made.to_motion(matrix)
    assert back.skeleton.has_rotations == recoverable(clip.skeleton) and back.skeleton.names == clip.skeleton.names
    assert error(clip, back)[0] < 1e-3
    np.testing.assert_allclose(matrix, pose(clip).positions.reshape(100, -1) * 2.54 / 0.45, rtol=1e-6)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=2, deadline=None, database=None)
def test_random_rigs_come_back(seed):
    with jax.enable_x64(True):
        motion = random_motion(seed)
        for feature in (Markers, RotationVectors):
            made = feature.of(motion)
            matrix = made.to_matrix(motion)
            back = made.to_motion(matrix)
            assert max(error(motion, back)) < 1e-9
            np.testing.assert_allclose(made.to_matrix(back), matrix, atol=1e-7)  # half turns may change sign


def test_markers_bring_back_joints_that_slide(double):
    motion = random_motion(3, slide=True)
    made = Markers.of(motion)
    assert not motion.skeleton.is_rigid and max(error(motion, made.to_motion(made.to_matrix(motion)))) < 1e-9


def test_positions_of_a_motion_without_rotations_come_back():
    places = np.random.default_rng(0).normal(size=(4, 3, 3))
    motion = Motion.from_positions(places, ["a", "b", "c"], 0.01, [-1, 0, 1])
    made = Positions.of(motion)
    back = made.to_motion(made.to_matrix(motion))
    assert back.skeleton.same_rig(motion.skeleton)
    np.testing.assert_allclose(back.values, motion.values, atol=1e-6)


def test_positions_of_joints_that_slide_keep_names_and_parents(double):
    motion = random_motion(3, slide=True)
    made = Positions.of(motion)
    back = made.to_motion(made.to_matrix(motion))
    assert back.skeleton.names == motion.skeleton.names and back.skeleton.parents == motion.skeleton.parents
    assert error(motion, back)[0] < 1e-9


@pytest.mark.parametrize("feature", [Positions, Markers, RotationVectors])
def test_a_feature_refuses_another_rig_and_another_width(feature):
    made = feature.of(walk(0, 0.3))
    with pytest.raises(ValueError, match="another skeleton"):
        made.to_matrix(walk(1, 0.3))
    with pytest.raises(ValueError, match="wanted"):
        made.to_motion(jnp.zeros((4, 5)))


# Markers


def test_markers_shared_by_parent_and_child_are_stored_once(data_dir):
    skeleton = read_motion(data_dir / CLIPS[0]).skeleton
    of = layout(skeleton, skeleton.height() / 10)
    assert len(of.first_joint) == 21  # of 31 joints
    without_a_bone = len(of.beside) - 31  # each joint has c, and these have b
    assert of.marker_count == 21 + 31 + without_a_bone < 3 * 31
    long = np.linalg.norm(skeleton.offsets, axis=1) >= skeleton.height() / 20
    assert without_a_bone == sum(not any(long[c] for c in children) for children in skeleton.children)


def test_a_joint_without_rotations_has_no_marker_but_its_place():
    rig = small_rig(
        np.array([[0.0, 0, 0], [0, 2, 0], [0, 2, 0]]), [-1, 0, 1], [(*POSITION_CHANNELS, *ZYX), (), ("Xrotation",)]
    )
    of = layout(rig, 1.0)
    assert of.beside.tolist() == [0, 2, 2]  # c of the root; b and c of the leaf
    assert of.along[0] == of.of_joint[2]  # the farthest joint that the root holds fast


def test_noisy_markers_give_rotations_and_keep_the_bone_lengths():
    motion = walk(0, 0.3)
    made = Markers.of(motion)
    matrix = made.to_matrix(motion)
    noisy = matrix + np.random.default_rng(0).normal(0, 0.5, matrix.shape)
    _, rotations = read_markers(made.layout, noisy.reshape(len(noisy), -1, 3))
    product = rotations @ jnp.swapaxes(rotations, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)
    np.testing.assert_allclose(jnp.linalg.det(rotations), 1, atol=1e-5)
    back = made.to_motion(noisy)
    assert mean_error(pose(back).positions, pose(motion).positions) * made.scale < 2.0


def test_marker_functions_are_alike_compiled_and_have_finite_gradients():
    motion = walk(0, 0.3)
    of = layout(motion.skeleton, 1.0)
    p = posed(motion.skeleton, jnp.zeros((36, motion.skeleton.channel_count)))  # every rotation is the identity
    markers = place_markers(of, p.positions, p.rotations)
    with jax.disable_jit():
        for eager, compiled in zip(read_markers(of, markers), jax.jit(read_markers)(of, markers), strict=True):
            np.testing.assert_allclose(eager, compiled, atol=1e-6)
    gradient = jax.jit(jax.grad(lambda m: (read_markers(of, m)[1] ** 3).sum()))(markers)
    assert jnp.isfinite(gradient).all() and jnp.abs(gradient).max() > 0


# Rotation vectors


def test_any_matrix_keeps_the_bone_lengths():
    motion = walk(0, 0.3)
    made = RotationVectors.of(motion)
    matrix = made.to_matrix(motion)
    p = pose(made.to_motion(matrix + np.random.default_rng(0).normal(0, 1, matrix.shape))).positions
    child = np.arange(1, 31)
    bones = jnp.linalg.norm(p[:, child] - p[:, np.array(motion.skeleton.parents)[child]], axis=-1)
    expected = np.linalg.norm(motion.skeleton.offsets[child], axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(expected, bones.shape), atol=1e-4)


def test_the_mean_pose_is_scipys_mean_and_its_vectors_are_zero(double):
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.7, (50, 3)))
    np.testing.assert_allclose(mean_rotation(jnp.asarray(turns.as_matrix())), turns.mean().as_matrix(), atol=1e-12)
    motion = walk(0, 0.3)
    still = motion.with_values(np.tile(motion.values[:1], (36, 1)))
    np.testing.assert_allclose(RotationVectors.of(still).to_matrix(still)[:, 3:], 0, atol=1e-7)


def test_rotation_vectors_refuse_joints_that_slide_and_empty_motions():
    with pytest.raises(ValueError, match="position channels"):
        RotationVectors.of(random_motion(3, slide=True))
    with pytest.raises(ValueError, match="no frames"):
        RotationVectors.of(walk(0, 0.3).frames(0, 0))


# Alignment


def figure() -> tuple[jax.Array, jax.Array]:
    p = pose(walk(0, 0.3))
    return p.positions, p.rotations[:, 0]


def moved(positions: jax.Array, rotation: jax.Array, angle: float, shift: tuple) -> tuple[jax.Array, jax.Array]:
    turn = Rigid(about_axis(UP.astype(positions.dtype), jnp.asarray(angle, positions.dtype)), jnp.array(shift))
    return turn(positions.reshape(-1, 3)).reshape(positions.shape), turn.rotation[None] @ rotation


def test_alignment_removes_heading_and_place(double):
    positions, rotation = figure()
    again = moved(positions, rotation, 2.5, (3.0, 1.0, -7.0))
    a, b = heading_aligned(positions, rotation), heading_aligned(*again)
    np.testing.assert_allclose(a.positions, b.positions, atol=1e-12)
    np.testing.assert_allclose(jnp.sin(b.heading - a.heading), jnp.sin(2.5), atol=1e-12)
    np.testing.assert_allclose(jnp.cos(b.heading - a.heading), jnp.cos(2.5), atol=1e-12)
    np.testing.assert_allclose(root_aligned(positions, rotation).positions, root_aligned(*again).positions, atol=1e-12)
    np.testing.assert_allclose(a.positions[:, 0], 0, atol=0)
    assert float(jnp.abs(positions[:, :, 1] - positions[:, :1, 1] - a.positions[:, :, 1]).max()) < 1e-12


@pytest.mark.parametrize("align", [heading_aligned, root_aligned])
def test_alignment_is_undone_exactly(align, double):
    positions, rotation = figure()
    np.testing.assert_allclose(align(positions, rotation).restored(), positions, atol=1e-12)


def test_the_heading_turns_on_past_half_turns_and_is_steady_where_the_figure_faces_up(double):
    angles = jnp.linspace(0.3, 15.0, 200)
    tilt = about_axis(jnp.array([1.0, 0.0, 0.0]), jnp.linspace(-1.9, 1.9, 200))  # through straight up and down
    np.testing.assert_allclose(heading(about_axis(UP, angles) @ tilt), angles, atol=1e-12)


@pytest.mark.parametrize("align", [align_heading, align_root])
def test_alignment_compiled_batched_and_differentiated(align):
    positions, rotation = figure()
    eager = align(positions, rotation)
    batch = jax.jit(jax.vmap(align))(jnp.stack([positions, 2 * positions]), jnp.stack([rotation, rotation]))
    for one, compiled, two in zip(eager, jax.jit(align)(positions, rotation), batch, strict=True):
        np.testing.assert_allclose(compiled, one, atol=1e-4)
        np.testing.assert_allclose(two[0], one, atol=1e-4)
    still = jnp.tile(jnp.eye(3), (len(rotation), 1, 1))
    gradients = jax.jit(jax.grad(lambda p, r: sum((x**2).sum() for x in align(p, r)), (0, 1)))(positions, still)
    assert all(jnp.isfinite(g).all() for g in gradients)


def point_sets(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(20, 3))
    turn = Rotation.random(rng=rng).as_matrix()
    return source, source @ turn.T + rng.normal(size=3) + rng.normal(0, 0.1, source.shape)


@pytest.mark.parametrize("seed", range(3))
def test_horns_alignment_agrees_with_scipy(seed, double):
    source, target = point_sets(seed)
    expected = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))[0]
    rigid = jax.jit(align_points)(jnp.asarray(source), jnp.asarray(target))
    np.testing.assert_allclose(rigid.rotation, expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(rigid(jnp.asarray(source)).mean(0), target.mean(0), atol=1e-12)
    np.testing.assert_allclose(rigid.inverse()(rigid(jnp.asarray(source))), source, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_alignment_about_y_is_the_best_of_all_angles_and_shifts(seed, double):
    source, target = point_sets(seed)
    rigid = align_points_about_y(jnp.asarray(source), jnp.asarray(target))
    np.testing.assert_allclose(rigid.rotation @ UP, UP, atol=1e-12)
    assert rigid.translation[1] == 0

    def cost(angle: float, shift: np.ndarray) -> float:
        placed = Rotation.from_rotvec([0, angle, 0]).apply(source) + shift
        return float(((placed - target)[:, [0, 2]] ** 2).sum())

    best = cost(float(jnp.arctan2(rigid.rotation[0, 2], rigid.rotation[0, 0])), np.asarray(rigid.translation))
    shifts = [np.asarray(rigid.translation) + d for d in ((0.01, 0, 0), (-0.01, 0, 0), (0, 0, 0.01), (0, 0, -0.01))]
    angle = float(jnp.arctan2(rigid.rotation[0, 2], rigid.rotation[0, 0]))
    assert all(best < cost(angle, shift) for shift in shifts)
    for other in np.linspace(-np.pi, np.pi, 60):
        turned = Rotation.from_rotvec([0, other, 0]).apply(source)
        assert best <= cost(other, (target - turned).mean(0)) + 1e-12


@pytest.mark.parametrize("align", [align_points, align_points_about_y])
def test_point_alignment_gradients_agree_with_differences_and_are_finite_at_the_identity(align, double):
    source, target = map(jnp.asarray, point_sets(0))
    align = jax.jit(align)
    loss = jax.jit(lambda a, b: (align(a, b).rotation * jnp.arange(9.0).reshape(3, 3)).sum())
    grad = jax.jit(jax.grad(loss))
    step = jnp.asarray(np.random.default_rng(1).normal(size=source.shape))
    slope = (loss(source + 1e-6 * step, target) - loss(source - 1e-6 * step, target)) / 2e-6
    np.testing.assert_allclose((grad(source, target) * step).sum(), slope, rtol=1e-6)
    corners = [(x, y, z) for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]
    cube = jnp.array((corners * 3)[:20])  # eigenvalues coincide or nearly
    np.testing.assert_allclose(align(cube, cube).rotation, np.eye(3), atol=1e-12)
    assert jnp.isfinite(grad(cube, cube)).all()
    one_place = jnp.zeros((20, 3))
    assert jnp.isfinite(align(one_place, one_place).rotation).all()
    assert jnp.isfinite(grad(one_place, one_place)).all()


# Recovery


@given(seed=st.integers(0, 10**6))
@settings(max_examples=2, deadline=None, database=None)
def test_recovery_is_exact_where_the_positions_come_from_the_skeleton(seed):
    with jax.enable_x64(True):
        motion = random_motion(seed, least=3)
        offsets = motion.skeleton.offsets + 0.5 * np.eye(3)[np.arange(30) % 3]  # no joint on another
        skeleton = Skeleton(
            motion.skeleton.names, motion.skeleton.parents, offsets, motion.skeleton.channels,
            axes=motion.skeleton.axes,
        )
        positions = posed(skeleton, jnp.asarray(motion.values)).positions
        found = recover(skeleton, np.asarray(positions))
        np.testing.assert_allclose(found.positions, positions, atol=1e-9)
        np.testing.assert_allclose(posed(skeleton, jnp.asarray(found.values)).positions, positions, atol=1e-9)


def test_noise_of_half_a_centimetre_costs_little_and_bones_keep_their_lengths(data_dir):
    motion = read_motion(data_dir / CLIPS[0], unit_cm=5.6444).frames(1, 300)
    positions = np.asarray(pose(motion).positions)
    noise = np.random.default_rng(0).normal(0, 0.5 / np.sqrt(3) / 5.6444, positions.shape)  # 0.5 cm long, rms
    found = recover(motion.skeleton, positions + noise)
    assert float(mean_error(jnp.asarray(found.positions), jnp.asarray(positions))) * 5.6444 < 1.0
    back = pose(Motion(motion.skeleton, np.asarray(found.values, np.float64), motion.frame_time)).positions
    np.testing.assert_allclose(back, found.positions, atol=1e-3)
    child, parent = np.arange(1, 31), np.array(motion.skeleton.parents)[1:]
    lengths = np.linalg.norm(found.positions[:, child] - found.positions[:, parent], axis=-1)
    expected = np.linalg.norm(motion.skeleton.offsets[1:], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(expected, lengths.shape), atol=1e-9)


def test_a_hip_of_three_bones_is_turned_as_scipy_turns_it(double):
    rng = np.random.default_rng(2)
    offsets = np.array([[0.0, 0, 0], [1, -0.5, 0.1], [-1, -0.6, 0], [0, 1, 0.3]])
    skeleton = small_rig(offsets, [-1, 0, 0, 0])
    turns = Rotation.random(20, rng=rng)
    bones = np.stack([t.apply(offsets[1:]) for t in turns]) + rng.normal(0, 0.1, (20, 3, 3))
    positions = np.concatenate([np.zeros((20, 1, 3)), bones], 1) + rng.normal(size=(20, 1, 3))
    found = recover(skeleton, positions)
    rotation = posed(skeleton, jnp.asarray(found.values)).rotations[:, 0]
    expected = [Rotation.align_vectors(b, offsets[1:])[0].as_matrix() for b in bones]
    np.testing.assert_allclose(rotation, expected, atol=1e-9)


def test_a_single_bone_swings_by_the_smallest_angle(double):
    skeleton = small_rig(np.array([[0.0, 0, 0], [0, 2, 0]]), [-1, 0])
    bones = np.random.default_rng(0).normal(size=(50, 3))
    bones *= 2 / np.linalg.norm(bones, axis=-1, keepdims=True)
    found = recover(skeleton, np.stack([np.zeros_like(bones), bones], 1))
    rotation = Rotation.from_matrix(posed(skeleton, jnp.asarray(found.values)).rotations[:, 0])
    np.testing.assert_allclose(rotation.apply([0.0, 2, 0]), bones, atol=1e-12)
    np.testing.assert_allclose(rotation.magnitude(), np.arccos(bones[:, 1] / 2), atol=1e-7)


def test_recovery_starts_from_the_expected_pose(double):
    motion = walk(0, 0.3)
    expected = from_rotation_vector(jnp.asarray(np.random.default_rng(0).normal(0, 0.3, (31, 3))))
    leaves = [j for j, children in enumerate(motion.skeleton.children) if not children]
    found = recover(motion.skeleton, np.asarray(pose(motion).positions), np.asarray(expected))
    turned = pose(motion.with_values(found.values)).rotations
    for j in leaves:
        local = jnp.swapaxes(turned[:, motion.skeleton.parents[j]], -1, -2) @ turned[:, j]
        np.testing.assert_allclose(local, np.broadcast_to(expected[j], local.shape), atol=1e-9)


def test_recovery_looks_through_zero_length_bones_and_at_every_root(double):
    rng = np.random.default_rng(0)
    # Hips, then two joints on top of them, each with a thigh; and a second figure.
    offsets = np.array([[0.0, 0, 0], [0, 0, 0], [1, -1, 0], [0, 0, 0], [-1, -1, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    skeleton = small_rig(offsets, [-1, 0, 1, 0, 3, -1, 5, 5])
    values = rng.uniform(-60, 60, (10, skeleton.channel_count))
    for between in (1, 3):  # stay at rest, as the recovery assumes
        values[:, skeleton.first_column[between] :][:, :3] = 0
    p = posed(skeleton, jnp.asarray(values))
    found = recover(skeleton, np.asarray(p.positions))
    q = posed(skeleton, jnp.asarray(found.values))
    np.testing.assert_allclose(q.positions, p.positions, atol=1e-9)
    np.testing.assert_allclose(q.rotations[:, [0, 5]], p.rotations[:, [0, 5]], atol=1e-9)


@pytest.mark.parametrize(
    "channels",
    [
        [(*POSITION_CHANNELS, *ZYX), (*POSITION_CHANNELS, *ZYX)],  # slides along its bone
        [ZYX, ZYX],  # the root cannot move
        [(*POSITION_CHANNELS, *ZYX), (*ZYX, "Yrotation")],  # four angles
        [(*POSITION_CHANNELS, *ZYX), ("Xrotation", "Xrotation")],  # no order
        [(*POSITION_CHANNELS, "Xrotation"), ZYX],  # a hinge that turns a bone
    ],
)
def test_what_positions_do_not_determine_is_refused(channels):
    skeleton = small_rig(np.eye(3)[:2], [-1, 0], channels)
    assert not recoverable(skeleton)
    with pytest.raises(ValueError, match="recoverable"):
        recover(skeleton, np.zeros((2, 2, 3)))
    if len(channels[1]) in (2, 4):
        with pytest.raises(ValueError, match="rotation channels"):
            Markers.of(Motion(skeleton, np.zeros((1, skeleton.channel_count)), 0.01))
