"""How points of the figure pull on its pose vectors: the gradient of forward kinematics by forces and torques.

A joint feels the sum of all forces below it, and their torque about itself (the principle of virtual work). On the host:
differentiating the same through XLA takes ten times as long, and seconds to compile, before a clip is encoded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ... import components as rot
from ...metrics import SHELL_CM
from .pose_vectors import PoseVectors


class Posed(NamedTuple):
    """Global rotations and joints of every frame in cm, and the vectors that made them."""

    rotations: Float[np.ndarray, "3 3 joints frames"]
    at: Float[np.ndarray, "3 joints frames"]
    vectors: Float[np.ndarray, "3 turning frames"]


def posed(figure: PoseVectors, path: Float[np.ndarray, "frames 3"], body: Float[np.ndarray, "frames size"]) -> Posed:
    """Forward kinematics, in the precision of `body`."""
    local, place = figure.local(path, body)
    rotations, at = local.copy(), place.copy()
    parents = np.array(figure.skeleton.parents)
    for joints in _by_depth(parents):
        up = rotations[:, :, parents[joints]]
        at[:, joints] = at[:, parents[joints]] + rot.apply(up, place[:, joints])
        rotations[:, :, joints] = rot.multiply(up, local[:, :, joints])
    count = len(figure.turning)
    return Posed(rotations, at, body[:, 1 : 1 + 3 * count].reshape(len(body), count, 3).transpose(2, 1, 0))


def joint_pull(figure: PoseVectors, pose: Posed, force: Float[np.ndarray, "3 joints frames"]) -> tuple[np.ndarray, np.ndarray]:
    """What forces at the joints are to path (frames, 3) and body (frames, size)."""
    return _pull(figure, pose, force, rot.cross(pose.at, force))


def shell_points(figure: PoseVectors, pose: Posed) -> Float[np.ndarray, "3 points frames"]:
    """Three points around every joint, then around every end site, as `metrics.shell_points` has them."""
    centre, frame = _shells(figure, pose)
    around = centre[:, :, None] + SHELL_CM * frame.transpose(0, 2, 1, 3)
    return around.reshape(3, -1, centre.shape[-1])


def shell_pull(figure: PoseVectors, pose: Posed, force: Float[np.ndarray, "3 points frames"]) -> tuple[np.ndarray, np.ndarray]:
    """What forces at the shell points are to path and body."""
    joints = pose.at.shape[1]
    moment = rot.cross(shell_points(figure, pose), force)
    by_shell = (x.reshape(3, -1, 3, x.shape[-1]).sum(2) for x in (force, moment))
    totals = []
    for x in by_shell:
        total = x[:, :joints].copy()
        for n, j in enumerate(figure.skeleton.end_joints):
            total[:, j] += x[:, joints + n]
        totals.append(total)
    return _pull(figure, pose, *totals)


def _shells(figure: PoseVectors, pose: Posed) -> tuple[np.ndarray, np.ndarray]:
    ends = np.array(figure.skeleton.end_joints, int)
    offsets = figure.skeleton.end_offsets.T.astype(pose.at.dtype)[..., None]
    tips = pose.at[:, ends] + rot.apply(pose.rotations[:, :, ends], offsets)
    return np.concatenate([pose.at, tips], 1), np.concatenate([pose.rotations, pose.rotations[:, :, ends]], 2)


def _pull(figure: PoseVectors, pose: Posed, force: np.ndarray, moment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the force at every joint, and its moment about the origin."""
    parents = figure.skeleton.parents
    force, moment = force.copy(), moment.copy()
    for j in range(len(parents) - 1, 0, -1):
        if parents[j] >= 0:
            force[:, parents[j]] += force[:, j]
            moment[:, parents[j]] += moment[:, j]
    torque = moment - rot.cross(pose.at, force)
    turning = figure.turning
    inward = rot.apply(rot.transpose(pose.rotations[:, :, turning]), torque[:, turning])
    vectors = _left_jacobian(pose.vectors, inward).transpose(2, 1, 0)
    frames = len(vectors)
    slid, floor = _slide(figure, pose, force)
    path = np.stack([floor[0], floor[1], torque[1, 0] if figure.has_heading else np.zeros(frames)], 1)
    return path, np.concatenate([force[1, 0][:, None], vectors.reshape(frames, -1), slid], 1)


def _slide(figure: PoseVectors, pose: Posed, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pull on joints that slide, and on the floor: roots stand over joint 0, and move with it."""
    floor = force[::2, 0].copy()
    slid = []
    for j in figure.sliding:
        parent = figure.skeleton.parents[j]
        slid.append(rot.apply(rot.transpose(pose.rotations[:, :, parent]), force[:, j]) if parent >= 0 else force[:, j])
        floor += force[::2, j] if parent < 0 else 0.0
    return (np.concatenate(slid).T if slid else np.zeros((floor.shape[1], 0))), floor


def _left_jacobian(v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """J(v) u, with J(v) the derivative of the exponential map at v: u + b v x u + c v x (v x u)."""
    angle2 = rot.dot(v, v)
    small = angle2 < 1e-6
    safe = np.where(small, 1.0, angle2)
    angle = np.sqrt(safe)
    b = np.where(small, 0.5, (1 - np.cos(angle)) / safe)
    c = np.where(small, 1 / 6, (angle - np.sin(angle)) / (safe * angle))
    across = rot.cross(v, u)
    return u + b * across + c * rot.cross(v, across)


def _by_depth(parents: np.ndarray) -> list[np.ndarray]:
    depth = np.zeros(len(parents), int)
    for j, parent in enumerate(parents):
        depth[j] = depth[parent] + 1 if parent >= 0 else 0
    return [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
