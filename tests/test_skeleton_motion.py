"""Skeletons and motions say what they hold, and refuse what cannot be."""

import jax
import numpy as np
import pytest

from jaxmocap import Motion, Skeleton
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS


def build(**changes) -> Skeleton:
    arguments = {
        "names": ["root", "a", "b", "b", "prop"],
        "parents": [-1, 0, 1, 0, -1],
        "offsets": np.array([[0, 0, 0], [0, 3, 0], [0, 4, 0], [2, 0, 0], [0, 0, 0]], float),
        "channels": [POSITION_CHANNELS + ROTATION_CHANNELS, ("Zrotation",), (), ("Xrotation", "Yrotation"), ()],
        "end_joints": [2, 3],
        "end_offsets": np.array([[0, 1, 0], [1, 0, 0]], float),
    }
    return Skeleton(**(arguments | changes))


def test_what_a_skeleton_says_of_itself():
    skeleton = build()
    assert (skeleton.joint_count, skeleton.channel_count) == (5, 9)
    assert skeleton.roots == (0, 4)
    assert skeleton.children == ((1, 3), (2,), (), (), ())
    assert skeleton.first_column == (0, 6, 7, 7, 9)
    assert skeleton.has_rotations and skeleton.is_rigid and not skeleton.has_axes
    assert skeleton.height() == 8.0
    np.testing.assert_array_equal(skeleton.axes, np.tile(np.eye(3), (5, 1, 1)))


def test_inner_position_channels_make_bones_stretch():
    channels = [(), ("Yposition",), (), (), ()]
    assert not build(channels=channels).is_rigid
    assert not build(channels=channels).has_rotations
    assert build(channels=[(), (), (), (), POSITION_CHANNELS]).is_rigid


def test_same_rig_is_about_the_rig_not_the_person():
    skeleton = build()
    assert skeleton.same_rig(build(offsets=skeleton.offsets * 1.1))
    turned = skeleton.axes.copy()
    turned[1] = np.diag([1, -1, -1])
    assert build(axes=turned).has_axes
    for other in (
        build(names=["root", "a", "b", "c", "prop"]),
        build(parents=[-1, 0, 1, 1, -1]),
        build(channels=[ROTATION_CHANNELS, (), (), (), ()]),
        build(end_joints=[2, 2]),
        build(axes=turned),
    ):
        assert not skeleton.same_rig(other)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"names": ["root", "a"]}, "agree in length"),
        ({"channels": [()] * 4}, "agree in length"),
        ({"offsets": np.zeros((4, 3))}, "agree in length"),
        ({"axes": np.tile(np.eye(3), (4, 1, 1))}, "agree in length"),
        ({"parents": [-1, 0, 3, 0, -1]}, r"parents\[2\] = 3"),
        ({"parents": [-1, 1, 0, 0, -1]}, r"parents\[1\] = 1"),
        ({"parents": [-1, -2, 0, 0, -1]}, r"parents\[1\] = -2"),
        ({"channels": [("Wrotation",), (), (), (), ()]}, r"channels\[0\] has \['Wrotation'\]"),
        ({"end_joints": [2]}, "end_joints"),
        ({"end_joints": [2, 5]}, "end_joints"),
        ({"end_joints": [2, -1]}, "end_joints"),
    ],
)
def test_a_broken_skeleton_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        build(**changes)


def test_no_joint_is_refused():
    with pytest.raises(ValueError, match="agree in length"):
        Skeleton([], [], np.zeros((0, 3)), [])


def test_a_skeleton_is_a_pytree_of_its_numbers():
    skeleton = build()
    leaves = jax.tree.leaves(skeleton)
    assert {leaf.shape for leaf in leaves} == {(5, 3), (2, 3), (5, 3, 3)}
    doubled = jax.tree.map(lambda x: 2 * x, skeleton)
    np.testing.assert_array_equal(doubled.offsets, 2 * skeleton.offsets)
    assert doubled.names == skeleton.names


def test_what_a_motion_says_of_itself():
    values = np.arange(36.0).reshape(4, 9)
    motion = Motion(build(), values, 0.01, 2.5)
    assert (motion.frame_count, motion.scale, Motion(build(), values, 0.01).scale) == (4, 2.5, 1.0)
    some = motion.frames(1, 3)
    np.testing.assert_array_equal(some.values, values[1:3])
    np.testing.assert_array_equal(motion.frames(-1).values, values[-1:])
    assert (some.frame_time, some.unit_cm, some.skeleton) == (0.01, 2.5, motion.skeleton)
    other = motion.with_values(values + 1)
    np.testing.assert_array_equal(other.values, values + 1)
    assert (other.frame_time, other.unit_cm) == (0.01, 2.5)
    assert motion.frames(0, 0).frame_count == 0


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((np.zeros((4, 8)), 0.01), r"shape \(4, 8\), wanted \(frames, 9\)"),
        ((np.zeros(9), 0.01), r"shape \(9,\)"),
        ((np.zeros((4, 9)), 0.0), "frame_time is 0.0"),
        ((np.zeros((4, 9)), float("nan")), "frame_time is nan"),
        ((np.zeros((4, 9)), 0.01, 0.0), "unit_cm is 0.0"),
        ((np.zeros((4, 9)), 0.01, -1.0), "unit_cm is -1.0"),
    ],
)
def test_a_broken_motion_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Motion(build(), *arguments)


def test_motion_from_positions_keeps_the_tree():
    positions = np.array([[[1.0, 2, 3], [1, 5, 3], [9, 9, 9]]])
    motion = Motion.from_positions(positions, ["hip", "knee", "prop"], 0.02, [-1, 0, -1], unit_cm=100.0)
    assert motion.skeleton.parents == (-1, 0, -1)
    assert not motion.skeleton.has_rotations
    np.testing.assert_array_equal(motion.values, [[1, 2, 3, 0, 3, 0, 9, 9, 9]])
    assert motion.unit_cm == 100.0
