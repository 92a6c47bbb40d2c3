"""Forward kinematics: channel values to global joint positions and rotations, jit-compiled and differentiable.

But for `pose`, which is compiled, the functions take numpy arrays as well as JAX's, and give back the same.
"""

from __future__ import annotations

import math
from typing import Generic, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import components
from .components import A, namespace
from .motion import Motion
from .skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton


class Pose(NamedTuple, Generic[A]):
    """Global joint positions in file units, global rotations, and the positions of the end sites."""

    positions: Float[A, "... joints 3"]
    rotations: Float[A, "... joints 3 3"]
    ends: Float[A, "... ends 3"]


def local_rotations(skeleton: Skeleton, values: Float[A, "... channels"]) -> Float[A, "... joints 3 3"]:
    """Rotation of every joint in its parent's frame; identity where it has no rotation channel."""
    return _outward(_local_rotations(skeleton, namespace(values).moveaxis(values, -1, 0)), 2)


def forward(skeleton: Skeleton, values: Float[A, "... channels"]) -> Pose:
    """Pose of every frame. Differentiable in the values and in the skeleton's offsets."""
    columns = namespace(values).moveaxis(values, -1, 0)
    return _compose(skeleton, _local_rotations(skeleton, columns), _local_translations(skeleton, columns))


def compose(
    skeleton: Skeleton, rotation: Float[Array, "... joints 3 3"], translation: Float[Array, "... joints 3"]
) -> Pose:
    """Global pose from local rotations and translations."""
    return _compose(skeleton, _inward(rotation, 2), _inward(translation, 1))


# Inside, components and joints lead and frames trail, (3, 3, joints, ...): see components.py.


def _inward(x: A, count: int) -> A:
    """From (..., joints, components) to (components, joints, ...)."""
    return namespace(x).moveaxis(components.first(x, count), -1, count)


def _outward(x: A, count: int) -> A:
    """From (components, joints, ...) to (..., joints, components)."""
    return components.last(namespace(x).moveaxis(x, count, -1), count)


def _local_rotations(skeleton: Skeleton, columns: Float[A, "channels ..."]) -> Float[A, "3 3 joints ..."]:
    xp = namespace(columns)
    column, axis, used = _rotation_columns(skeleton)
    frames = columns.shape[1:]
    result: A = components.identity((skeleton.joint_count, *frames), columns)
    for n in range(column.shape[1] if skeleton.has_rotations else 0):
        present = used[:, n].reshape(-1, *[1] * len(frames))
        about = xp.asarray(axis[:, n].T.reshape(3, -1, *[1] * len(frames)), columns.dtype)
        factor: A = components.about_axis(about, xp.where(present, xp.deg2rad(columns[column[:, n]]), 0.0))
        result = components.multiply(result, factor) if n else factor
    if not skeleton.has_axes:
        return result
    axes: A = xp.asarray(skeleton.axes, columns.dtype).transpose(1, 2, 0).reshape(3, 3, -1, *[1] * len(frames))
    return components.multiply(components.multiply(axes, result), components.transpose(axes))


def _local_translations(skeleton: Skeleton, columns: Float[A, "channels ..."]) -> Float[A, "3 joints ..."]:
    """Every joint's offset, replaced where it has a position channel."""
    xp = namespace(columns)
    column, used = _position_columns(skeleton)
    trailing = [1] * (columns.ndim - 1)
    offsets = xp.asarray(skeleton.offsets, columns.dtype).T.reshape(3, -1, *trailing)
    return xp.where(used.T.reshape(3, -1, *trailing), columns[column.T], offsets)


def _compose(skeleton: Skeleton, g: Float[A, "3 3 joints ..."], t: Float[A, "3 joints ..."]) -> Pose:
    """Every joint is carried to its parent's frame, then to that of its grandparent, then four up: the logarithm of
    the depth in steps, each over all joints at once, where a walk down the tree would take one a joint."""
    joints, xp = skeleton.joint_count, namespace(g)
    g = xp.concatenate([g, components.identity((1, *g.shape[3:]), g)], 2)
    t = xp.concatenate([t, xp.zeros_like(t[:, :1])], 1)
    ancestor = np.append(np.where(np.array(skeleton.parents) < 0, joints, skeleton.parents), joints)
    for _ in range(math.ceil(math.log2(max(_depth(skeleton), 2)))):
        up = g[:, :, ancestor]
        t = t[:, ancestor] + components.apply(up, t)
        g = components.multiply(up, g)
        ancestor = ancestor[ancestor]
    t, g = t[:, :joints], g[:, :, :joints]
    at = np.array(skeleton.end_joints, int)
    offsets = xp.asarray(skeleton.end_offsets, g.dtype).T.reshape(3, -1, *[1] * (t.ndim - 2))
    ends = t[:, at] + components.apply(g[:, :, at], offsets)
    return Pose(_outward(t, 1), _outward(g, 2), _outward(ends, 1))


_forward_jit = eqx.filter_jit(forward)


def pose(motion: Motion) -> Pose:
    """Pose of every frame of a motion, in file units.

    Frames go through in blocks of few lengths, so that all motions of a rig share the same compiled programs.
    """
    blocks = [_pose_of_block(motion, start) for start in range(0, motion.frame_count, _BLOCK)]
    return blocks[0] if len(blocks) == 1 else Pose(*(jnp.concatenate(parts) for parts in zip(*blocks, strict=True)))


_BLOCK = 1024


def _pose_of_block(motion: Motion, start: int) -> Pose:
    values = motion.values[start : start + _BLOCK]
    frames = len(values)
    padded = np.zeros((max(64, 1 << (frames - 1).bit_length()), values.shape[1]))
    padded[:frames] = values
    return Pose(*(x[:frames] for x in _forward_jit(motion.skeleton, jnp.asarray(padded))))


def positions_cm(motion: Motion) -> Float[Array, "frames joints 3"]:
    """Global joint positions in centimetres (in file units where the unit is unknown)."""
    return pose(motion).positions * motion.scale


def _depth(skeleton: Skeleton) -> int:
    depth = [0] * skeleton.joint_count
    for j, parent in enumerate(skeleton.parents):
        depth[j] = 1 if parent < 0 else depth[parent] + 1
    return max(depth)


def _rotation_columns(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column, axis and use of the n-th rotation channel of each joint, padded to the joint that has most."""
    per_joint = [
        [(start + n, c) for n, c in enumerate(channels) if c in ROTATION_CHANNELS]
        for start, channels in zip(skeleton.first_column, skeleton.channels, strict=True)
    ]
    width = max(1, max(len(p) for p in per_joint))
    column = np.zeros((skeleton.joint_count, width), np.int32)
    axis = np.zeros((skeleton.joint_count, width, 3))
    used = np.zeros((skeleton.joint_count, width), bool)
    for j, found in enumerate(per_joint):
        for n, (at, name) in enumerate(found):
            column[j, n], used[j, n] = at, True
            axis[j, n, ROTATION_CHANNELS.index(name)] = 1.0
    return column, axis, used


def _position_columns(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    column = np.zeros((skeleton.joint_count, 3), np.int32)
    used = np.zeros((skeleton.joint_count, 3), bool)
    for j, (start, channels) in enumerate(zip(skeleton.first_column, skeleton.channels, strict=True)):
        for n, name in enumerate(channels):
            if name in POSITION_CHANNELS:
                k = POSITION_CHANNELS.index(name)
                column[j, k], used[j, k] = start + n, True
    return column, used


