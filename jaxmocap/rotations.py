"""Rotations as matrices, quaternions (w, x, y, z), rotation vectors (radians), 6D and Euler angles of any order.

Every function maps the last axis (or two) and keeps the leading batch axes. Gradients are finite at the identity.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from . import components


def multiply(a: Float[Array, "... 3 3"], b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """The matrix product a b."""
    a, b = jnp.broadcast_arrays(a, b)
    return components.last(components.multiply(components.first(a, 2), components.first(b, 2)), 2)


def apply(rotation: Float[Array, "... 3 3"], vector: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """The rotated vector."""
    batch = jnp.broadcast_shapes(rotation.shape[:-2], vector.shape[:-1])
    r = components.first(jnp.broadcast_to(rotation, (*batch, 3, 3)), 2)
    v = components.first(jnp.broadcast_to(vector, (*batch, 3)), 1)
    return components.last(components.apply(r, v), 1)


def transpose(rotation: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """The inverse rotation."""
    return jnp.swapaxes(rotation, -1, -2)


def skew(v: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """The matrix of the cross product with `v`."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape, 3)


def about_axis(axis: Float[Array, "... 3"], angle: Float[Array, "..."]) -> Float[Array, "... 3 3"]:
    """Rotation by `angle` radians about the unit vector `axis` (Rodrigues)."""
    batch = jnp.broadcast_shapes(axis.shape[:-1], angle.shape)
    a = components.first(jnp.broadcast_to(axis, (*batch, 3)), 1)
    return components.last(components.about_axis(a, jnp.broadcast_to(angle, batch)), 2)


def from_euler(angles: Float[Array, "... n"], order: str) -> Float[Array, "... 3 3"]:
    """The product, left to right, of rotations by `angles` radians about the axes in `order`, such as "ZYX" or "XYX"."""
    if angles.shape[-1] != len(order):
        raise ValueError(f"angles have {angles.shape[-1]} columns, wanted one for each axis of order {order!r}")
    return components.last(components.from_euler(components.first(angles, 1), order), 2)


def to_euler(rotation: Float[Array, "... 3 3"], order: str) -> Float[Array, "... 3"]:
    """Angles in radians, so that `from_euler(angles, order)` is the rotation.

    `order` names three axes, neighbours different: all 12 orders. At gimbal lock the third angle is 0. Raises
    ValueError for any other order.
    """
    return components.last(components.to_euler(components.first(rotation, 2), order), 1)


def from_quaternion(q: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Matrix of the quaternion (w, x, y, z), which need not be of unit length."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    s = 2.0 / (q * q).sum(-1)
    rows = [
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    ]
    return jnp.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def to_quaternion(rotation: Float[Array, "... 3 3"]) -> Float[Array, "... 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0."""
    r = rotation
    d = jnp.diagonal(r, axis1=-2, axis2=-1)
    xx, yy, zz = d[..., 0], d[..., 1], d[..., 2]
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    # Four times the quaternion's outer product; its row of largest diagonal is the best conditioned.
    outer = jnp.stack([
        1 + xx + yy + zz, wx, wy, wz,
        wx, 1 + xx - yy - zz, xy, xz,
        wy, xy, 1 - xx + yy - zz, yz,
        wz, xz, yz, 1 - xx - yy + zz,
    ], -1).reshape(*r.shape[:-2], 4, 4)
    best = jnp.argmax(jnp.diagonal(outer, axis1=-2, axis2=-1), -1)
    row = jnp.take_along_axis(outer, best[..., None, None], -2)[..., 0, :]
    q = row / jnp.sqrt((row * row).sum(-1, keepdims=True))
    return jnp.where(q[..., :1] < 0, -q, q)


def from_rotation_vector(v: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """Matrix of the rotation by |v| radians about v (exponential map)."""
    angle2 = (v * v).sum(-1)
    small = angle2 < 1e-8
    safe2 = jnp.where(small, 1.0, angle2)
    angle = jnp.sqrt(safe2)
    a = jnp.where(small, 1 - angle2 / 6, jnp.sin(angle) / angle)[..., None, None]
    # 1 - cos loses all digits of a small angle, 2 sin^2 of its half none.
    b = jnp.where(small, 0.5 - angle2 / 24, 2 * jnp.sin(angle / 2) ** 2 / safe2)[..., None, None]
    k = skew(v)
    return jnp.broadcast_to(jnp.eye(3, dtype=v.dtype), k.shape) + a * k + b * multiply(k, k)


def to_rotation_vector(rotation: Float[Array, "... 3 3"]) -> Float[Array, "... 3"]:
    """Rotation vector of length at most pi (logarithm)."""
    q = to_quaternion(rotation)
    w, v = q[..., 0], q[..., 1:]
    s2 = (v * v).sum(-1)
    small = s2 < 1e-10
    s = jnp.sqrt(jnp.where(small, 1.0, s2))
    factor = jnp.where(small, 2.0 + s2 / 3, 2 * jnp.arctan2(s, jnp.where(small, 1.0, w)) / s)
    return v * factor[..., None]


def from_sixd(d: Float[Array, "... 6"]) -> Float[Array, "... 3 3"]:
    """Matrix whose first two columns are Gram-Schmidt of the two 3-vectors in `d` (Zhou et al. 2019)."""
    a, b = d[..., :3], d[..., 3:]
    x = normalise(a)
    y = normalise(b - (x * b).sum(-1, keepdims=True) * x)
    return jnp.stack([x, y, jnp.cross(x, y)], -1)


def to_sixd(rotation: Float[Array, "... 3 3"]) -> Float[Array, "... 6"]:
    """The first two columns, one after the other."""
    return jnp.concatenate([rotation[..., :, 0], rotation[..., :, 1]], -1)


def normalise(v: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """v / |v|; the zero vector stays zero."""
    n2 = (v * v).sum(-1, keepdims=True)
    zero = n2 == 0
    return jnp.where(zero, 0.0, v / jnp.sqrt(jnp.where(zero, 1.0, n2)))


def swing(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """The smallest rotation that turns the direction of `a` into that of `b`; the identity where either is zero.

    Opposite directions are half a turn apart about an axis across `a`.
    """
    a, b = jnp.broadcast_arrays(a, b)
    return components.last(components.swing(components.first(a, 1), components.first(b, 1)), 2)
