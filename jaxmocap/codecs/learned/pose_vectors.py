"""A motion as vectors with no constraint left: a path over the floor, and how every joint turns about the mean pose.

The path is x, z and heading of joint 0. The body, seen from there, is the height of joint 0, the rotation vectors of all
joints that turn, and the shifts of joints that slide; bones keep their lengths whatever becomes of the vectors.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ... import components as rot
from ...components import A, namespace
from ...features.channels import rotation_order, values_of
from ...kinematics import Pose, compose
from ...motion import Motion
from ...skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton


@dataclass(frozen=True, eq=False)
class PoseVectors:
    """`skeleton` is in cm; `mean` holds the mean local rotation of every joint, that of joint 0 less its heading."""

    skeleton: Skeleton
    mean: Float[np.ndarray, "joints 3 3"]

    @functools.cached_property
    def turning(self) -> np.ndarray:
        return np.array([j for j, channels in enumerate(self.skeleton.channels) if rotation_order(channels)], int)

    @functools.cached_property
    def sliding(self) -> np.ndarray:
        """Joints besides joint 0 that have position channels."""
        channels = self.skeleton.channels
        return np.array([j for j, cs in enumerate(channels) if j and set(cs) & set(POSITION_CHANNELS)], int)

    @property
    def has_heading(self) -> bool:
        return len(rotation_order(self.skeleton.channels[0])) == 3

    @property
    def size(self) -> int:
        return 1 + 3 * len(self.turning) + 3 * len(self.sliding)

    def analyse(self, motion: Motion, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Path (frames, 3) in cm and radians, and body (frames, size), of a motion whose unit is `scale` cm."""
        local = local_rotations(motion)
        place = np.asarray(_translations(motion), np.float64) * scale
        turn = _heading(local[:, 0]) if self.has_heading else np.zeros(len(local))
        local[:, 0] = np.einsum("fji,fjk->fik", np.moveaxis(_about_y(turn), -1, 0), local[:, 0])
        relative = np.swapaxes(self.mean[self.turning], -1, -2)[None] @ local[:, self.turning]
        shifts = self.shifts(place)
        path = np.stack([place[:, 0, 0], place[:, 0, 2], turn], 1)
        vectors = _continuous_vectors(relative).reshape(len(local), -1)
        return path, np.concatenate([place[:, 0, 1:2], vectors, shifts.reshape(len(local), -1)], 1)

    def shifts(self, place: A) -> A:
        """Of sliding joints: from where their bone ends, or from under joint 0 for further roots."""
        return place[:, self.sliding] - self._rest(place)

    def _rest(self, place: A) -> A:
        xp = namespace(place)
        is_root = np.array([self.skeleton.parents[j] < 0 for j in self.sliding], bool)[None, :, None]
        under = place[:, :1] * np.array([1.0, 0.0, 1.0], np.float32)[None, None]
        return xp.where(is_root, under, xp.asarray(self.skeleton.offsets[self.sliding], place.dtype)[None])

    def local(self, path: Float[A, "frames 3"], body: Float[A, "frames size"]) -> tuple[A, A]:
        """Local rotations (3, 3, joints, frames), with the heading, and translations (3, joints, frames) in cm."""
        xp = namespace(body)
        frames, joints, turns = len(body), self.skeleton.joint_count, len(self.turning)
        vectors = body[:, 1 : 1 + 3 * turns].reshape(frames, turns, 3).transpose(2, 1, 0)
        mean = xp.asarray(self.mean[self.turning], body.dtype).transpose(1, 2, 0)[..., None]
        turned: Any = rot.multiply(mean, rot.from_rotation_vector(vectors))
        if self.has_heading:
            first = rot.multiply(_about_y(path[:, 2]), turned[:, :, 0])[:, :, None]
            turned = xp.concatenate([first, turned[:, :, 1:]], 2)
        rotations = _spread(turned, self.turning, rot.identity((frames,), turned), joints)
        root = xp.stack([path[:, 0], body[:, 0], path[:, 1]], 1)[:, None]
        bones = xp.broadcast_to(xp.asarray(self.skeleton.offsets[1:], body.dtype)[None], (frames, joints - 1, 3))
        place = xp.concatenate([root, bones], 1)
        if len(self.sliding):
            slid = self._rest(place) + body[:, 1 + 3 * turns :].reshape(frames, -1, 3)
            place = xp.stack([
                slid[:, np.flatnonzero(self.sliding == j)[0]] if j in self.sliding else place[:, j] for j in range(joints)
            ], 1)  # fmt: skip
        return rotations, place.transpose(2, 1, 0)

    def pose(self, path: Float[Array, "frames 3"], body: Float[Array, "frames size"]) -> Pose:
        """Global pose in cm; differentiable."""
        local, place = self.local(path, body)
        return compose(self.skeleton, local.transpose(3, 2, 0, 1), place.transpose(2, 1, 0))

    def values(self, path: np.ndarray, body: np.ndarray, scale: float) -> Float[np.ndarray, "frames channels"]:
        """Channel values in degrees and file units; on the host, where nothing need be compiled."""
        rotations, place = self.local(path, body)
        return np.asarray(values_of(self.skeleton, rotations, place / scale), np.float64)


def _spread(turned: A, turning: np.ndarray, still: A, joints: int) -> A:
    """Rotations of all joints; by slices, since the gradient of a gather is a scatter, which is slow."""
    if len(turning) == joints:
        return turned
    of = {j: n for n, j in enumerate(turning.tolist())}
    return namespace(turned).stack([turned[:, :, of[j]] if j in of else still for j in range(joints)], 2)


def _continuous_vectors(rotations: Float[np.ndarray, "frames joints 3 3"]) -> Float[np.ndarray, "frames joints 3"]:
    """Rotation vectors that do not jump from frame to frame, up to a length of a whole turn."""
    q = quaternions(rotations)
    turned = np.cumprod(np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0), 0)
    q[1:] *= turned[..., None]
    q *= np.where(q[..., 0].sum(0) < 0, -1.0, 1.0)[None, :, None]
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(sine, q[..., 0])
    factor = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
    return q[..., 1:] * factor[..., None]


def _about_y(angle: A) -> A:
    xp = namespace(angle)
    axis = xp.asarray(np.array([0.0, 1.0, 0.0]), angle.dtype).reshape(3, *[1] * angle.ndim)
    return rot.about_axis(axis, angle)


def local_rotations(motion: Motion) -> Float[np.ndarray, "frames joints 3 3"]:
    """Of every joint in its parent's frame; on the host, as `kinematics.local_rotations` has them."""
    s = motion.skeleton
    angles = np.deg2rad(motion.values)
    local = np.tile(np.eye(3)[..., None, None], (1, 1, s.joint_count, len(angles)))
    for order, joints, columns in angle_columns(s.channels):
        local[:, :, joints] = rot.from_euler(angles[:, columns].transpose(2, 1, 0), order)
    if s.has_axes:
        axes = s.axes.transpose(1, 2, 0)[..., None]
        local = rot.multiply(rot.multiply(axes, local), rot.transpose(axes))
    return local.transpose(3, 2, 0, 1)


@functools.lru_cache(maxsize=64)
def angle_columns(channels: tuple[tuple[str, ...], ...]) -> list[tuple[str, list[int], np.ndarray]]:
    """Of every rotation order: its joints, and the columns of their angles, (joints, angles)."""
    first = np.cumsum([0, *map(len, channels)]).tolist()
    orders = [rotation_order(of_joint) for of_joint in channels]
    found = []
    for order in sorted(set(orders) - {""}):
        joints = [j for j, o in enumerate(orders) if o == order]
        columns = [[first[j] + n for n, c in enumerate(channels[j]) if c in ROTATION_CHANNELS] for j in joints]
        found.append((order, joints, np.array(columns)))
    return found


def _heading(rotations: Float[np.ndarray, "frames 3 3"]) -> Float[np.ndarray, " frames"]:
    """As `features.alignment.heading`."""
    r = rotations
    return np.unwrap(np.arctan2(r[:, 0, 2] - r[:, 2, 0], r[:, 0, 0] + r[:, 2, 2]))


def quaternions(rotations: Float[np.ndarray, "frames joints 3 3"]) -> Float[np.ndarray, "frames joints 4"]:
    """w, x, y, z."""
    from scipy.spatial.transform import Rotation  # which decoders need not wait for

    q = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return q.reshape(*rotations.shape[:2], 4)


def _translations(motion: Motion) -> Float[np.ndarray, "frames joints 3"]:
    """Of every joint in its parent's frame, in file units."""
    s = motion.skeleton
    place = np.tile(s.offsets, (motion.frame_count, 1, 1))
    for j, (start, channels) in enumerate(zip(s.first_column, s.channels, strict=True)):
        for n, name in enumerate(channels):
            if name in POSITION_CHANNELS:
                place[:, j, POSITION_CHANNELS.index(name)] = motion.values[:, start + n]
    return place
