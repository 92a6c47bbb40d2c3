"""Heading and place taken out of a motion, and put back; and the closed alignments of one point set with another.

I-C. Lin, J-Y. Peng, C-C. Lin, M-H. Tsai: Adaptive motion data representation with repeated motion analysis. IEEE TVCG
17(4), 2011, section 3. Point sets: L. Kovar, M. Gleicher, F. Pighin: Motion graphs, 2002, about the up axis y; B. Horn:
Closed-form solution of absolute orientation using unit quaternions, 1987, in full.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..rotations import about_axis, apply, from_quaternion, transpose


class HeadingAligned(NamedTuple):
    """R_y, T_x, T_y and T_z of every frame (radians, the unit of the positions), and what is left of the positions."""

    positions: Float[Array, "... frames joints 3"]
    heading: Float[Array, "... frames"]
    translation: Float[Array, "... frames 3"]

    def restored(self) -> Float[Array, "... frames joints 3"]:
        """The positions before the alignment."""
        return _from_frame(self.positions, about_y(self.heading), self.translation)


class RootAligned(NamedTuple):
    """All six degrees of freedom of the root, and the positions in its frame."""

    positions: Float[Array, "... frames joints 3"]
    rotation: Float[Array, "... frames 3 3"]
    translation: Float[Array, "... frames 3"]

    def restored(self) -> Float[Array, "... frames joints 3"]:
        """The positions before the alignment."""
        return _from_frame(self.positions, self.rotation, self.translation)


class Rigid(NamedTuple):
    """The map x -> rotation x + translation of points."""

    rotation: Float[Array, "... 3 3"]
    translation: Float[Array, "... 3"]

    def __call__(self, points: Float[Array, "... points 3"]) -> Float[Array, "... points 3"]:
        return apply(self.rotation[..., None, :, :], points) + self.translation[..., None, :]

    def inverse(self) -> Rigid:
        back = transpose(self.rotation)
        return Rigid(back, -apply(back, self.translation))


def heading(rotation: Float[Array, "... frames 3 3"]) -> Float[Array, "... frames"]:
    """Radians about y of the rotation about y that is nearest to each rotation, unwrapped over the frames.

    A turn of the world about y adds to it exactly. Unlike the angle of a facing direction on the floor it does not
    jump where the figure faces up or down; it has no value only for half turns about a level axis, and is 0 there.
    """
    return jnp.unwrap(_atan2(rotation[..., 0, 2] - rotation[..., 2, 0], rotation[..., 0, 0] + rotation[..., 2, 2]))


def about_y(angle: Float[Array, " *batch"]) -> Float[Array, "*batch 3 3"]:
    """Rotation by `angle` radians about y."""
    return about_axis(jnp.array([0.0, 1.0, 0.0], angle.dtype), angle)


def align_heading(
    positions: Float[Array, "... frames joints 3"], rotation: Float[Array, "... frames 3 3"]
) -> HeadingAligned:
    """Joint 0 is put at the origin and the heading of its global `rotation` at 0, in every frame."""
    angle, place = heading(rotation), positions[..., 0, :]
    return HeadingAligned(_to_frame(positions, about_y(angle), place), angle, place)


def align_root(positions: Float[Array, "... frames joints 3"], rotation: Float[Array, "... frames 3 3"]) -> RootAligned:
    """Positions in the frame of joint 0, whose global `rotation` is given."""
    place = positions[..., 0, :]
    return RootAligned(_to_frame(positions, rotation, place), rotation, place)


def align_points_about_y(source: Float[Array, "... points 3"], target: Float[Array, "... points 3"]) -> Rigid:
    """The rotation about y and the shift over the floor that bring `source` nearest to `target` (least squares).

    Heights stay as they are. Points all above one another leave the rotation open; it is the identity then.
    """
    a, b = source - source.mean(-2, keepdims=True), target - target.mean(-2, keepdims=True)
    sine = (a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]).sum(-1)
    cosine = (a[..., 0] * b[..., 0] + a[..., 2] * b[..., 2]).sum(-1)
    rotation = about_y(_atan2(sine, cosine))
    shift = target.mean(-2) - apply(rotation, source.mean(-2))
    return Rigid(rotation, shift.at[..., 1].set(0.0))


def align_points(source: Float[Array, "... points 3"], target: Float[Array, "... points 3"]) -> Rigid:
    """The rotation and shift that bring `source` nearest to `target` (least squares, Horn 1987)."""
    a, b = source - source.mean(-2, keepdims=True), target - target.mean(-2, keepdims=True)
    s = jnp.swapaxes(a, -1, -2) @ b
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (jnp.moveaxis(s[..., i, :], -1, 0) for i in range(3))
    n = jnp.stack([
        xx + yy + zz, yz - zy, zx - xz, xy - yx,
        yz - zy, xx - yy - zz, xy + yx, zx + xz,
        zx - xz, xy + yx, yy - xx - zz, yz + zy,
        xy - yx, zx + xz, yz + zy, zz - xx - yy,
    ], -1).reshape(*s.shape[:-2], 4, 4)
    rotation = from_quaternion(_top_eigenvector(n))
    return Rigid(rotation, target.mean(-2) - apply(rotation, source.mean(-2)))


def _top_eigenvector(n: Float[Array, "... 4 4"]) -> Float[Array, "... 4"]:
    """Of a symmetric matrix. Its gradient needs only the largest eigenvalue to stand alone, where eigh's needs all."""
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(n))
    gaps = values[..., 3:] - values[..., :3]
    alone = gaps > 1e-6 * jnp.abs(values).max(-1, keepdims=True)
    rest, top = vectors[..., :3], vectors[..., 3]
    # One step of perturbation theory: zero in value, as top is an eigenvector, and the derivative of top in derivative.
    change = jnp.einsum("...ik,...ij,...j->...k", rest, n, top)
    return top + jnp.einsum("...ik,...k->...i", rest, jnp.where(alone, change / jnp.where(alone, gaps, 1.0), 0.0))


def _to_frame(positions: Array, rotation: Array, translation: Array) -> Array:
    return apply(transpose(rotation)[..., None, :, :], positions - translation[..., None, :])


def _from_frame(positions: Array, rotation: Array, translation: Array) -> Array:
    return apply(rotation[..., None, :, :], positions) + translation[..., None, :]


def _atan2(y: Float[Array, " *batch"], x: Float[Array, " *batch"]) -> Float[Array, " *batch"]:
    """atan2 whose gradient at (0, 0) is 0, not NaN."""
    zero = (x == 0) & (y == 0)
    return jnp.where(zero, 0.0, jnp.arctan2(jnp.where(zero, 0.0, y), jnp.where(zero, 1.0, x)))
