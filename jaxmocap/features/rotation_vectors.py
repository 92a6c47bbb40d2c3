"""Rotation vectors about the mean pose as a feature: bones keep their lengths, whatever happens to the matrix."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import local_rotations, pose
from ..motion import Motion
from ..rotations import from_rotation_vector, multiply, to_rotation_vector, transpose
from ..skeleton import Skeleton
from .base import AbstractFeature
from .channels import has_euler_orders, rotation_order


@eqx.filter_jit
def mean_rotation(rotations: Float[Array, "frames ... 3 3"]) -> Float[Array, "... 3 3"]:
    """The rotation of least summed squared matrix distance to all: their mean, projected (chordal L2 mean)."""
    u, _, vt = jnp.linalg.svd(rotations.mean(0))
    mirror = jnp.linalg.det(u @ vt)[..., None, None]
    return u @ jnp.concatenate([vt[..., :2, :], vt[..., 2:, :] * mirror], -2)


class RotationVectors(AbstractFeature):
    """x y z of every root in cm (in file units where the unit is unknown), then the rotation vectors of the local
    rotations about `mean`, in radians and of length at most pi, for the joints that have rotation channels."""

    skeleton: Skeleton
    frame_time: float = eqx.field(static=True)
    unit_cm: float | None = eqx.field(static=True)
    mean: Float[np.ndarray, "turning 3 3"]

    @staticmethod
    def of(motion: Motion) -> RotationVectors:
        """About the mean pose of this motion.

        Raises ValueError where it has no frames, joints slide along their bones, or rotations have no Euler order.
        """
        skeleton = motion.skeleton
        if not skeleton.is_rigid or not has_euler_orders(skeleton):
            raise ValueError("a joint other than a root has position channels, or its rotations have no Euler order")
        if motion.frame_count == 0:
            raise ValueError("the motion has no frames to take the mean of")
        mean = np.asarray(mean_rotation(_turning_rotations(motion)))
        return RotationVectors(skeleton, motion.frame_time, motion.unit_cm, mean)

    def to_matrix(self, motion: Motion) -> Float[Array, "frames channels"]:
        self.check(motion)
        roots = pose(motion).positions[:, np.array(self.skeleton.roots)] * self.scale
        vectors = _about_mean(self.mean, _turning_rotations(motion))
        return jnp.concatenate([roots, vectors], 1).reshape(motion.frame_count, -1)

    def to_motion(self, matrix: Float[Array, "frames channels"]) -> Motion:
        """Raises ValueError where the matrix has not three columns a root and three a joint that turns."""
        columns = 3 * (len(self.skeleton.roots) + len(self.mean))
        if matrix.shape[1:] != (columns,):
            raise ValueError(f"matrix has shape {matrix.shape}, wanted (frames, {columns})")
        roots = len(self.skeleton.roots)
        triples = jnp.reshape(matrix, (len(matrix), -1, 3))
        turned = np.asarray(_from_mean(self.mean, triples[:, roots:]))
        local = np.tile(np.eye(3, dtype=turned.dtype)[..., None, None], (self.skeleton.joint_count, len(matrix)))
        local[:, :, _turning(self.skeleton)] = turned.transpose(2, 3, 1, 0)
        translations = np.zeros_like(local[0])
        translations[:, np.array(self.skeleton.roots)] = np.asarray(triples[:, :roots]).transpose(2, 1, 0) / self.scale
        return self.motion(local, translations)


def _turning(skeleton: Skeleton) -> np.ndarray:
    return np.array([j for j, channels in enumerate(skeleton.channels) if rotation_order(channels)], int)


def _turning_rotations(motion: Motion) -> Array:
    return _local_rotations(motion.skeleton, jnp.asarray(motion.values))[:, _turning(motion.skeleton)]


_local_rotations = eqx.filter_jit(local_rotations)


@eqx.filter_jit
def _about_mean(mean: np.ndarray, rotations: Array) -> Array:
    return to_rotation_vector(multiply(transpose(jnp.asarray(mean))[None], rotations))


@eqx.filter_jit
def _from_mean(mean: np.ndarray, vectors: Array) -> Array:
    return multiply(jnp.asarray(mean, vectors.dtype)[None], from_rotation_vector(vectors))
