"""What the basis is made of: second moments of pose vectors, and of the Jacobian of forward kinematics."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...codecs.learned.distortion import Metric, points
from ...codecs.learned.pose_vectors import PoseVectors
from ...skeleton import Skeleton

_SAMPLES = 64
_LEAST_MOVED = 1e-2  # cm^2 per squared radian: what moves joints less is no more precise than this
_NOT_AT_ALL = 1e-6


def jacobian_moment(
    figure: PoseVectors, metric: Metric, body: Float[np.ndarray, "frames size"]
) -> tuple[Float[np.ndarray, "size size"], float]:
    """The mean over frames of J^T J, over points, and the mean square distance of points from the axis of heading."""
    at = body[np.linspace(0, len(body) - 1, _SAMPLES).astype(int)]
    moment, radius = _moment(figure.skeleton, figure.mean, metric, jnp.asarray(at, jnp.float32))
    return np.asarray(moment, np.float64), float(radius)


@eqx.filter_jit
def _moment(skeleton: Skeleton, mean: np.ndarray, metric: Metric, body: Float[Array, "samples size"]) -> tuple[Array, Array]:
    figure = PoseVectors(skeleton, mean)

    def of(vector: Array) -> Array:
        pose = figure.pose(jnp.zeros((1, 3)), vector[None])
        return points(pose, skeleton.end_joints, metric)[0]

    jacobian = jax.lax.map(jax.jacfwd(of), body)
    moment = jnp.einsum("spca,spcb->ab", jacobian, jacobian) / (jacobian.shape[0] * jacobian.shape[1])
    at = jax.vmap(of)(body)
    return moment, (at[..., 0] ** 2 + at[..., 2] ** 2).mean()


def weighted_klt(
    moment: Float[np.ndarray, "size size"], covariance: Float[np.ndarray, "size size"]
) -> Float[np.ndarray, "components size"]:
    """Synthesis rows, largest variance first, whose coefficients move points by their value; none for what moves nothing."""
    moves = np.diag(moment) > _NOT_AT_ALL
    m = moment[np.ix_(moves, moves)]
    value, vector = np.linalg.eigh(m + np.diag(np.minimum(np.diag(m), _LEAST_MOVED)))
    value = np.maximum(value, 1e-9)
    root, inverse = vector * np.sqrt(value) @ vector.T, vector / np.sqrt(value) @ vector.T
    variance, rotation = np.linalg.eigh(root @ covariance[np.ix_(moves, moves)] @ root)
    rows = np.zeros((len(m), len(moment)))
    rows[:, moves] = (inverse @ rotation[:, np.argsort(-variance)]).T
    return rows * np.sign(rows[np.arange(len(rows)), np.abs(rows).argmax(1)])[:, None]
