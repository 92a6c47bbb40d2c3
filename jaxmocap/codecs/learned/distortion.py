"""What the encoder is after: errors of decoded points, how they change with coefficients, and how steeply."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...kinematics import Pose
from ...metrics import shell_points
from . import virtual_work
from .basis import Basis
from .pose_vectors import PoseVectors
from .virtual_work import Posed, posed

Metric = Literal["joints", "shell"]
METRICS: tuple[Metric, ...] = ("joints", "shell")
_PROBES = 4


def points(pose: Pose, end_joints: tuple[int, ...], metric: Metric) -> Float[Array, "frames points 3"]:
    """What the metric looks at, in cm; differentiable."""
    return pose.positions if metric == "joints" else shell_points(pose, end_joints, 1.0)


class Distortion:
    """Of one motion. `figure` is the one that decodes; `path` and `body` are of the original in the figure `original`.

    `target` are the points of the original.
    """

    def __init__(
        self, figure: PoseVectors, basis: Basis, metric: Metric, direction: int,
        original: PoseVectors, path: np.ndarray, body: np.ndarray,
    ):  # fmt: skip
        self._figure, self._basis, self._direction = figure, basis, direction
        self._metric: Metric = metric
        self.target = points_of(original, metric, path.astype(np.float32), body.astype(np.float32))

    def gradient(
        self, y: Float[np.ndarray, "frames components"], softening: float
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Errors (points, frames) in cm, the gradient of every frame's mean error in y, and its mean curvature.

        Errors below `softening` count as squares, so that the curvature stays bounded.
        """
        pose = self._posed(y)
        difference = _points(self._figure, self._metric, pose) - self.target
        error = np.sqrt((difference**2).sum(0))
        factor = 1 / (error + np.float32(softening))
        return error, self._pull(pose, difference * factor), float(factor.mean())

    def curvatures(self, y: np.ndarray) -> Float[np.ndarray, " components"]:
        """How far each component moves the points of this motion, squared: 1 as in the corpus (Hutchinson's estimate)."""
        random = np.random.default_rng(0)
        pose = self._posed(y)
        total = np.zeros(y.shape[1])
        for _ in range(_PROBES):
            probe = random.integers(0, 2, self.target.shape).astype(np.float32) * 2 - 1
            total += (self._pull(pose, probe) ** 2).mean(0)
        return total * self.target.shape[1] / _PROBES

    def errors(self, y: np.ndarray) -> Float[np.ndarray, "points frames"]:
        difference = _points(self._figure, self._metric, self._posed(y)) - self.target
        return np.sqrt((difference**2).sum(0))

    def _posed(self, y: np.ndarray) -> Posed:
        return posed(self._figure, *self._basis.vectors(y.astype(np.float32), self._direction))

    def _pull(self, pose: Posed, force: np.ndarray) -> Float[np.ndarray, "frames components"]:
        pull = virtual_work.joint_pull if self._metric == "joints" else virtual_work.shell_pull
        path, body = pull(self._figure, pose, force / self.target.shape[1])
        return self._basis.pull(path, body, self._direction)


def points_of(
    figure: PoseVectors, metric: Metric, path: np.ndarray, body: np.ndarray
) -> Float[np.ndarray, "3 points frames"]:
    """What the metric looks at, in cm, of path and body; on the host, in their precision."""
    return _points(figure, metric, posed(figure, path, body))


def _points(figure: PoseVectors, metric: Metric, pose: Posed) -> Float[np.ndarray, "3 points frames"]:
    return pose.at if metric == "joints" else virtual_work.shell_points(figure, pose)


def decoded_points(
    figure: PoseVectors, basis: Basis, metric: Metric, y: Float[Array, "frames components"], direction: Array | int
) -> Float[Array, "frames points 3"]:
    """Points in cm of coefficients; differentiable in them."""
    return points(figure.pose(*basis.vectors(jnp.asarray(y), direction)), figure.skeleton.end_joints, metric)
