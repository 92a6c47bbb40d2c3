"""The Karhunen-Loeve transform of poses, weighted by how far they move the figure: Jacobian moments by random probes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from . import virtual_work
from .distortion import Metric
from .pose_vectors import PoseVectors

_SAMPLES = 128
_PROBES = 32
_LEAST_MOVED = 1e-2  # cm^2 per squared radian: what moves joints less is no more precise than this
_NOT_AT_ALL = 1e-6
_NEVER = 1e-10  # squared radians, or cm


def jacobian_moment(
    figure: PoseVectors, metric: Metric, body: Float[np.ndarray, "frames size"]
) -> tuple[Float[np.ndarray, "size size"], float]:
    """The mean over frames of J^T J, over points, and the mean square distance of points from the axis of heading.

    Estimated by random forces v of +-1 at the points: the mean of (J^T v)(J^T v)^T is J^T J (Hutchinson 1989).
    """
    at = body[np.linspace(0, len(body) - 1, _SAMPLES).astype(int)]
    pose = virtual_work.posed(figure, np.zeros((len(at), 3)), at)
    of_joints = metric == "joints"
    points = pose.at if of_joints else virtual_work.shell_points(figure, pose)
    pull = virtual_work.joint_pull if of_joints else virtual_work.shell_pull
    random = np.random.default_rng(0)
    moment = np.zeros((figure.size, figure.size))
    for _ in range(_PROBES):
        _, pulled = pull(figure, pose, random.integers(0, 2, points.shape) * 2.0 - 1)
        moment += pulled.T @ pulled
    return moment / (_PROBES * len(at) * points.shape[1]), float((points[::2] ** 2).sum(0).mean())


def weighted_klt(
    moment: Float[np.ndarray, "size size"], covariance: Float[np.ndarray, "size size"]
) -> Float[np.ndarray, "components size"]:
    """Synthesis rows, largest variance first, whose coefficients move points by their value; none for what moves nothing.

    What the corpus never varied has rows of its own, last: a motion that does not vary it either does not touch them.
    """
    moves = np.diag(moment) > _NOT_AT_ALL
    varies = moves & (np.diag(covariance) > _NEVER)
    m = moment[np.ix_(varies, varies)]
    value, vector = np.linalg.eigh(m + np.diag(np.minimum(np.diag(m), _LEAST_MOVED)))
    value = np.maximum(value, 1e-9)
    root, inverse = vector * np.sqrt(value) @ vector.T, vector / np.sqrt(value) @ vector.T
    variance, rotation = np.linalg.eigh(root @ covariance[np.ix_(varies, varies)] @ root)
    rows = np.zeros((len(m), len(moment)))
    rows[:, varies] = (inverse @ rotation[:, np.argsort(-variance)]).T
    rows *= np.sign(rows[np.arange(len(rows)), np.abs(rows).argmax(1)])[:, None]
    spare = np.flatnonzero(moves & ~varies)
    return np.concatenate([rows, np.eye(len(moment))[spare] / np.sqrt(np.diag(moment)[spare])[:, None]])


def weighted_analysis(
    synthesis: Float[np.ndarray, "components size"], moment: Float[np.ndarray, "size size"]
) -> Float[np.ndarray, "size components"]:
    """Coefficients of the vectors that are nearest where it is seen, for a synthesis that does not reach all vectors."""
    seen = moment + np.diag(np.minimum(np.diag(moment), _LEAST_MOVED))
    return seen @ synthesis.T @ np.linalg.pinv(synthesis @ seen @ synthesis.T, rcond=1e-9, hermitian=True)
