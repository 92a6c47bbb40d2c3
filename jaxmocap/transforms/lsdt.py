"""LSDT, the learned spatial decorrelation transform (Hou et al. 2016, section 4).

J. Hou, L.-P. Chau, N. Magnenat-Thalmann, Y. He: Low-latency compression of mocap data using learned spatial
decorrelation transform. Computer Aided Geometric Design 43, 2016. Algorithm 1 as printed; sample weights and the
growing schedule of P are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .base import AbstractTransform


class Lsdt(AbstractTransform):
    """An orthogonal basis for each group of channels: one a coordinate in the paper, or one over all 3J channels.

    `basis[g]` holds one basis vector a row. Signals have shape (..., groups, frames, channels).
    """

    basis: Float[Array, "groups channels channels"]

    def forward(self, x: Float[Array, "... groups frames channels"]) -> Float[Array, "... groups frames channels"]:
        """C = B M (eq. 5), with time along rows."""
        return x @ jnp.swapaxes(self.basis, -1, -2)

    def inverse(self, y: Float[Array, "... groups frames channels"]) -> Float[Array, "... groups frames channels"]:
        """M = B^T C."""
        return y @ self.basis


class LsdtFit(NamedTuple):
    """The transform, and the objective (6) of every group before each iteration and after the last."""

    transform: Lsdt
    objective: Float[Array, "iterations+1 groups"]


def constant(sparsity: int, iterations: int = 300) -> Int[np.ndarray, " iterations"]:
    """The schedule of the paper: P is the same in every iteration."""
    return np.full(iterations, sparsity, np.int32)


def growing(sparsity: int, iterations: int = 300) -> Int[np.ndarray, " iterations"]:
    """A schedule that holds P at 1 for three tenths, lets it grow over four, and holds it at `sparsity` for the rest.

    With a constant P Algorithm 1 stops in local minima that depend on the initial basis, some percent apart on the CMU data.
    What one nonzero a sample can say leaves few of them, and from there the ends are mostly within a tenth of a percent,
    and a fifth to a half lower (docs/methods.md).
    """
    at = np.arange(iterations) / max(iterations, 1)
    ramp = 2 + np.floor((at - 0.3) / 0.4 * (sparsity - 1))
    return np.where(at < 0.3, 1, np.clip(ramp, 1, sparsity)).astype(np.int32)


def keep_largest(g: Float[Array, "channels samples"], count: Int[Array, ""]) -> Float[Array, "channels samples"]:
    """Every column's `count` entries of largest magnitude, the others 0 (eq. 8).

    Takes the maximum below the last one `count` times, as plain loops over contiguous samples: on a CPU ten times faster
    or more than `lax.top_k`. The last bits of each magnitude give way to its channel, so that no two are ever equal.
    """
    channels = g.shape[0]
    integer = jnp.int32 if g.dtype == jnp.float32 else jnp.int64
    low_bits = (1 << (channels - 1).bit_length()) - 1
    magnitude = jax.lax.bitcast_convert_type(jnp.abs(g), integer)
    keys = (magnitude & ~low_bits) | (channels - 1 - jnp.arange(channels, dtype=integer))[:, None]

    def next_largest(_, last):
        return _largest([jnp.where(row < last, row, -1) for row in keys])

    above_all = jnp.full(g.shape[1:], jnp.iinfo(integer).max, integer)
    return jnp.where(keys >= jax.lax.fori_loop(0, count, next_largest, above_all)[None], g, 0.0)


def _largest(rows: list[Array]) -> Array:
    """The elementwise maximum as a tree of pairs, which compiles to one vectorised loop; a reduction does not."""
    while len(rows) > 1:
        rows = [jnp.maximum(*rows[i : i + 2]) if i + 1 < len(rows) else rows[i] for i in range(0, len(rows), 2)]
    return rows[0]


@eqx.filter_jit
def fit_lsdt(
    samples: Float[Array, "groups samples channels"],
    initial: Float[Array, "channels channels"],
    schedule: Int[Array | np.ndarray, " iterations"],
    weights: Float[Array, " samples"] | None = None,
) -> LsdtFit:
    """Algorithm 1: alternate the sparse codes (8) and the orthogonal matrix (11), from an orthogonal `initial` basis.

    `schedule` gives P, the nonzeros allowed a sample, for every iteration: `constant(8)` in the paper, `growing(8)`
    for an end that hardly depends on the beginning. `weights` scale each sample's squared error. The initial
    basis is `dct_matrix(channels)` or `haar_matrix(channels)` in the paper.
    """
    if initial.shape != (samples.shape[-1],) * 2:
        raise ValueError(f"initial has shape {initial.shape}, wanted ({samples.shape[-1]}, {samples.shape[-1]})")
    scaled = samples if weights is None else samples * jnp.sqrt(weights)[None, :, None]
    schedule = jnp.asarray(schedule)
    basis, objective = jax.vmap(lambda m: _algorithm_1(m.T, initial.astype(m.dtype), schedule))(scaled)
    return LsdtFit(Lsdt(basis), objective.T)


def _algorithm_1(m: Array, basis: Array, schedule: Array) -> tuple[Array, Array]:
    def codes(basis, sparsity):
        g = basis @ m
        e = keep_largest(g, sparsity)
        return e, ((g - e) ** 2).sum()

    def iterate(basis, sparsity):
        e, objective = codes(basis, sparsity)
        u, _, vt = jnp.linalg.svd(m @ e.T, full_matrices=False)
        return (u @ vt).T, objective

    basis, objective = jax.lax.scan(iterate, basis, schedule)
    return basis, jnp.append(objective, codes(basis, schedule[-1])[1])
