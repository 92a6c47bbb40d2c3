"""Rotation matrices with their components in front, (3, 3, ...): each component is then one long array.

On a CPU this is five times faster than a batched dot over trailing (3, 3), which is why kinematics and recovery work this
way inside. Everybody else uses `rotations`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

Matrix = Float[Array, "3 3 ..."]
Vector = Float[Array, "3 ..."]


def first(x: Array, count: int) -> Array:
    """The last `count` axes brought to the front."""
    return jnp.moveaxis(x, tuple(range(-count, 0)), tuple(range(count)))


def last(x: Array, count: int) -> Array:
    """The first `count` axes brought to the back."""
    return jnp.moveaxis(x, tuple(range(count)), tuple(range(-count, 0)))


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """The matrix product a b."""
    rows = [jnp.stack([a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j] for j in range(3)]) for i in range(3)]
    return jnp.stack(rows)


def apply(a: Matrix, v: Vector) -> Vector:
    """The rotated vector a v."""
    return jnp.stack([a[i, 0] * v[0] + a[i, 1] * v[1] + a[i, 2] * v[2] for i in range(3)])


def transpose(a: Matrix) -> Matrix:
    """The inverse rotation."""
    return jnp.swapaxes(a, 0, 1)


def identity(shape: tuple[int, ...], dtype: jnp.dtype) -> Matrix:
    return jnp.broadcast_to(jnp.eye(3, dtype=dtype).reshape(3, 3, *[1] * len(shape)), (3, 3, *shape))


def about_axis(axis: Vector, angle: Float[Array, "..."]) -> Matrix:
    """Rotation by `angle` radians about the unit vector `axis` (Rodrigues)."""
    s, c = jnp.sin(angle), jnp.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    t = 1.0 - c
    rows = [
        [c + t * (x * x), t * (x * y) - s * z, t * (x * z) + s * y],
        [t * (y * x) + s * z, c + t * (y * y), t * (y * z) - s * x],
        [t * (z * x) - s * y, t * (z * y) + s * x, c + t * (z * z)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def dot(a: Vector, b: Vector) -> Float[Array, "..."]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def normalise(v: Vector) -> Vector:
    """v / |v|; the zero vector stays zero."""
    n2 = dot(v, v)
    return jnp.where(n2 == 0, 0.0, v / jnp.sqrt(jnp.where(n2 == 0, 1.0, n2)))


def swing(a: Vector, b: Vector) -> Matrix:
    """The smallest rotation that turns the direction of `a` into that of `b`; the identity where either is zero.

    Opposite directions are half a turn apart about an axis across `a`.
    """
    a, b = normalise(a), normalise(b)
    shape = jnp.broadcast_shapes(a.shape, b.shape)
    a, b = jnp.broadcast_to(a, shape), jnp.broadcast_to(b, shape)
    along = dot(a, b)
    defined = (dot(a, a) > 0) & (dot(b, b) > 0)
    opposite = defined & (along < -0.999999)
    plain = defined & ~opposite
    v = cross(a, b)
    f = 1.0 / jnp.where(plain, 1.0 + along, 1.0)
    zero = jnp.zeros_like(along)
    k = [[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]]
    # I + [v] + [v]^2 / (1 + a.b), with [v]^2 = v v^T - |v|^2 I
    square = dot(v, v)
    rows = [
        jnp.stack([k[i][j] + f * v[i] * v[j] + (1.0 - f * square if i == j else 0.0) for j in range(3)]) for i in range(3)
    ]
    turn = jnp.stack(rows)
    across = normalise(cross(a, jnp.where(jnp.abs(a[0]) < 0.6, _unit(0, a), _unit(1, a))))
    half = 2 * across[:, None] * across[None, :] - identity(along.shape, a.dtype)
    return jnp.where(opposite, half, jnp.where(defined, turn, identity(along.shape, a.dtype)))


def _unit(axis: int, like: Vector) -> Vector:
    return jnp.stack([jnp.full(like.shape[1:], float(n == axis), like.dtype) for n in range(3)])
