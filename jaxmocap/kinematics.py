"""Forward kinematics: channel values to global joint positions and rotations, jit-compiled and differentiable."""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import rotations
from .motion import Motion
from .skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton


class Pose(NamedTuple):
    """Global joint positions in file units, global rotations, and the positions of the end sites."""

    positions: Float[Array, "... joints 3"]
    rotations: Float[Array, "... joints 3 3"]
    ends: Float[Array, "... ends 3"]


def local_rotations(skeleton: Skeleton, values: Float[Array, "... channels"]) -> Float[Array, "... joints 3 3"]:
    """Rotation of every joint in its parent's frame; identity where it has no rotation channel."""
    column, axis, used = _rotation_columns(skeleton)
    angles = jnp.where(used, jnp.deg2rad(values[..., column]), 0.0)
    factors = rotations.about_axis(jnp.asarray(axis, angles.dtype), angles)
    result = factors[..., 0, :, :]
    for n in range(1, column.shape[1]):
        result = rotations.multiply(result, factors[..., n, :, :])
    if not skeleton.has_axes:
        return result
    axes = jnp.asarray(skeleton.axes, angles.dtype)
    return rotations.multiply(rotations.multiply(axes, result), rotations.transpose(axes))


def local_translations(skeleton: Skeleton, values: Float[Array, "... channels"]) -> Float[Array, "... joints 3"]:
    """Position of every joint in its parent's frame: its offset, replaced where it has a position channel."""
    column, used = _position_columns(skeleton)
    return jnp.where(used, values[..., column], jnp.asarray(skeleton.offsets, values.dtype))


def forward(skeleton: Skeleton, values: Float[Array, "... channels"]) -> Pose:
    """Pose of every frame. Differentiable in the values and in the skeleton's offsets."""
    return compose(skeleton, local_rotations(skeleton, values), local_translations(skeleton, values))


def compose(
    skeleton: Skeleton, rotation: Float[Array, "... joints 3 3"], translation: Float[Array, "... joints 3"]
) -> Pose:
    """Global pose from local rotations and translations.

    Every joint is carried to its parent's frame, then to that of its grandparent, then four up: the logarithm of the
    depth in steps, each over all joints at once, where a walk down the tree would take one a joint.
    """
    joints = skeleton.joint_count
    eye = jnp.broadcast_to(jnp.eye(3, dtype=rotation.dtype), (*rotation.shape[:-3], 1, 3, 3))
    g = jnp.concatenate([rotation, eye], -3)
    t = jnp.concatenate([translation, jnp.zeros_like(translation[..., :1, :])], -2)
    ancestor = np.append(np.where(np.array(skeleton.parents) < 0, joints, skeleton.parents), joints)
    for _ in range(math.ceil(math.log2(max(_depth(skeleton), 2)))):
        up = g[..., ancestor, :, :]
        t = t[..., ancestor, :] + rotations.apply(up, t)
        g = rotations.multiply(up, g)
        ancestor = ancestor[ancestor]
    positions, world = t[..., :joints, :], g[..., :joints, :, :]
    at = list(skeleton.end_joints)
    offsets = jnp.asarray(skeleton.end_offsets, rotation.dtype)
    ends = positions[..., at, :] + rotations.apply(world[..., at, :, :], offsets)
    return Pose(positions, world, ends)


_forward_jit = eqx.filter_jit(forward)


def pose(motion: Motion) -> Pose:
    """Pose of every frame of a motion, in file units.

    Frames are padded to a power of two, so that motions of a rig share few compiled programs.
    """
    frames = motion.frame_count
    values = np.zeros((max(64, 1 << (frames - 1).bit_length()), motion.skeleton.channel_count))
    values[:frames] = motion.values
    return Pose(*(x[:frames] for x in _forward_jit(motion.skeleton, jnp.asarray(values))))


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


