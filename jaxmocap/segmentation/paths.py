"""Paths of similar postures through a matching trellis (Wang et al. 2020, section III-A).

The trellis' top row is the sequence; the column under a frame holds the frames that match it. A path steps one frame
along the top row and 0, 1 or 2 frames down its columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float32, Int, Int32

INTERVAL = 2


@dataclass(frozen=True, eq=False)
class Paths:
    """Matched segments, sorted by h: first and last frame along the top row, the same in the columns, mean distance."""

    h: Int[np.ndarray, "paths 2"]
    v: Int[np.ndarray, "paths 2"]
    distance: Float32[np.ndarray, " paths"]

    def __len__(self) -> int:
        return len(self.h)


class _Column(NamedTuple):
    """Nodes of one column with the path that ends in each: where it began in both rows, its depth and distance."""

    node: Int32[Array, " most"]
    top: Int32[Array, " most"]
    root: Int32[Array, " most"]
    depth: Int32[Array, " most"]
    distance: Float32[Array, " most"]


def grow_paths(
    columns: Int32[np.ndarray, "frames most"], distances: Float32[np.ndarray, "frames most"], shortest: int
) -> Paths:
    """Valid paths: of those that share a root the deepest, then the one of least mean distance.

    A node takes the deepest of the paths that reach it. A path ends before its h- and its v-segment would overlap.
    `shortest` is ValidPathThr, in frames.
    """
    if not len(columns):
        return Paths(np.zeros((0, 2), int), np.zeros((0, 2), int), np.zeros(0, np.float32))
    nodes, tops, roots, depths, sums = map(np.asarray, _grow(jnp.asarray(columns), jnp.asarray(distances)))
    where = np.nonzero((nodes >= 0) & (depths >= shortest))
    at, node, top, root, depth, distance = (where[0], *(a[where] for a in (nodes, tops, roots, depths, sums)))
    mean = distance / np.maximum(depth, 1)
    order = np.lexsort((mean, -depth, root, top))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(top[order]) != 0) | (np.diff(root[order]) != 0)
    best = order[first]
    return Paths(np.stack([top[best], at[best]], 1), np.stack([root[best], node[best]], 1), mean[best])


@jax.jit
def _grow(columns: Int32[Array, "frames most"], distances: Float32[Array, "frames most"]) -> _Column:
    def step(before: _Column, x: tuple[Array, Array, Array]) -> tuple[_Column, _Column]:
        t, node, distance = x
        jump = node[:, None] - before.node[None]
        ahead = before.root > before.top
        apart = (~ahead | (t < before.root))[None] & (ahead[None] | (node[:, None] < before.top[None]))
        fits = (before.node >= 0)[None] & (node[:, None] >= 0) & (jump >= 0) & (jump <= INTERVAL) & apart
        mean = before.distance / jnp.maximum(before.depth, 1)
        share = mean / (1 + jnp.max(mean))  # below 1, so that it decides between equal depths alone
        rank = jnp.where(fits, (before.depth - share)[None], -1.0)
        chosen = jnp.argmax(rank, 1)
        grown = rank[jnp.arange(len(node)), chosen] >= 0
        now = _Column(
            node,
            jnp.where(grown, before.top[chosen], t),
            jnp.where(grown, before.root[chosen], node),
            jnp.where(grown, before.depth[chosen] + 1, 1),
            distance + jnp.where(grown, before.distance[chosen], 0.0),
        )
        return now, now

    most = columns.shape[1]
    empty = jnp.full(most, -1, jnp.int32)
    start = _Column(empty, empty, empty, jnp.zeros(most, jnp.int32), jnp.zeros(most, jnp.float32))
    return lax.scan(step, start, (jnp.arange(len(columns), dtype=jnp.int32), columns, distances))[1]
