"""What the coder knows of a level before it reads it: magnitudes already decoded nearby, and what the corpus expects.

All of it is integers, in sixteenths of an octave, so that encoder and decoder agree on every machine. Levels are read in
groups, none of which takes its contexts from within itself: in the lowest band along diagonals, so that a level knows
both lower frequencies of its own component and all larger components; in the octaves a whole component at a time.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...components import A, namespace

OCTAVE = 16
PATH = 3  # the first components are the path: x, z and heading
_EXACT = 4096
_SHIFT = 6
_PRIOR_RANGE = (-8 * OCTAVE, 16 * OCTAVE)
_SKEW = 2
# (rows, components) away, in the order of the network's inputs. In the lowest band row + 2 component must be less.
SLOW_OWN = ((-1, 0), (-2, 0), (-3, 0), (-4, 0))
SLOW_OTHERS = (
    (1, -1), (0, -1), (-1, -1), (-2, -1), (3, -2), (2, -2), (1, -2), (0, -2), (-1, -2), (0, -3), (1, -3), (0, -4), (1, -4),
    (0, -5), (0, -6), (0, -7), (0, -8), (-3, 1), (-4, 1), (-5, 2),
)  # fmt: skip
FAST_OTHERS = (
    (0, -1), (1, -1), (-1, -1), (2, -1), (-2, -1), (0, -2), (1, -2), (-1, -2), (0, -3), (1, -3), (-1, -3), (0, -4),
    (0, -5), (0, -6), (0, -7), (0, -8),
)  # fmt: skip
PARENTS = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (0, 2), (0, -2), (0, 3), (0, 4))
SLOW_INPUTS = 7 + len(SLOW_OWN) + len(SLOW_OTHERS)
FAST_INPUTS = 6 + len(PARENTS) + 1 + len(FAST_OTHERS)


def magnitude(levels: Int[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """16 log2(1 + |level|), rounded: by table, and above 4095 by the level's high bits."""
    size = np.abs(levels)
    high = size >= _EXACT
    reduced = np.where(high, np.minimum((size >> _SHIFT) - 1, _EXACT - 1), size)
    return _magnitudes()[reduced] + np.where(high, _SHIFT * OCTAVE, 0)


@functools.cache
def _magnitudes() -> np.ndarray:
    # In whole numbers: floor(16 log2(n) + 1/2) is half the logarithm of 2 n^32.
    return np.array([((2 * n**32).bit_length() - 1) // 2 for n in range(1, _EXACT + 1)], np.int64)


def smooth_magnitude(levels: Float[Array, "..."]) -> Float[Array, "..."]:
    """The same of any real levels, for gradients."""
    return OCTAVE * jnp.log2(1 + jnp.abs(levels))


def expected(prior: np.ndarray | Array) -> np.ndarray | Array:
    """About the magnitude of a level whose scale is 2^(prior / 16) steps; of JAX's priors with no jumps."""
    if isinstance(prior, np.ndarray):
        return np.maximum(prior, 0) + (OCTAVE >> np.minimum(np.abs(prior) // OCTAVE, 5))
    return jnp.maximum(prior, 0) + OCTAVE * jnp.minimum(jnp.exp2(0.5 - jnp.abs(prior) / OCTAVE), 1)


def clipped(prior: A) -> A:
    return namespace(prior).clip(prior, *_PRIOR_RANGE)


@dataclass(frozen=True)
class Neighbours:
    """Where the neighbours of every place of a band lie in its flattened, zero-padded form."""

    rows: int
    components: int
    margins: tuple[int, int, int, int]
    base: Int[np.ndarray, " places"]

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of(rows: int, components: int) -> Neighbours:
        margins = (5, 3, 8, 4)  # rows before and after, components before and after
        width = components + margins[2] + margins[3]
        base = (np.arange(rows)[:, None] + margins[0]) * width + np.arange(components)[None, :] + margins[2]
        return Neighbours(rows, components, margins, base.ravel())

    @property
    def width(self) -> int:
        return self.components + self.margins[2] + self.margins[3]

    def padded(self, values: A) -> A:
        before, after, left, right = self.margins
        return namespace(values).pad(values, ((before, after), (left, right))).reshape(-1)

    def around(self, values: Array, offsets: tuple[tuple[int, int], ...]) -> Array:
        """(rows, components, offsets): neighbours by slices, since the gradient of a gather is a scatter, which is slow."""
        before, after, left, right = self.margins
        x = jnp.pad(values, ((before, after), (left, right)))
        return jnp.stack([
            x[before + dt : before + dt + self.rows, left + dk : left + dk + self.components] for dt, dk in offsets
        ], -1)  # fmt: skip

    def steps(self, offsets: tuple[tuple[int, int], ...]) -> np.ndarray:
        return np.array([dt * self.width + dk for dt, dk in offsets])


@functools.lru_cache(maxsize=64)
def groups(rows: int, components: int, slow: bool) -> tuple[np.ndarray, ...]:
    """Places (row x components + component) in the order of decoding, a group an array."""
    row, component = np.divmod(np.arange(rows * components), max(components, 1))
    key = row + _SKEW * component if slow else component
    order = np.argsort(key, kind="stable")
    return tuple(np.split(order, np.flatnonzero(np.diff(key[order])) + 1)) if len(order) else ()


@dataclass(frozen=True)
class BandContexts:
    """`fixed` holds the inputs that are known before the band: (places, inputs). `expected` is (rows, components)."""

    slow: bool
    fixed: np.ndarray | Array
    expected: np.ndarray | Array
    neighbours: Neighbours

    def inputs(self, own: A, excess: A, where: np.ndarray | slice) -> A:
        """The network's inputs at these places; `own` and `excess` are the padded magnitudes, plain and less expected."""
        n = self.neighbours
        base = n.base[where][:, None]
        parts = [self.fixed[where], excess[base + n.steps(SLOW_OTHERS if self.slow else FAST_OTHERS)]]
        if self.slow:
            parts.insert(1, own[base + n.steps(SLOW_OWN)])
        return namespace(own).concatenate(parts, 1)

    def inputs_of(self, magnitudes: A, where: np.ndarray | slice = slice(None)) -> A:
        """The inputs of these places, once all magnitudes are known: (places, inputs)."""
        n = self.neighbours
        return self.inputs(n.padded(magnitudes), n.padded(magnitudes - self.expected), where)

    def smooth_inputs(self, magnitudes: Float[Array, "rows components"]) -> Float[Array, "places inputs"]:
        """The same of all places, for gradients."""
        n = self.neighbours
        near = n.around(magnitudes - self.expected, SLOW_OTHERS if self.slow else FAST_OTHERS)
        parts = [n.around(magnitudes, SLOW_OWN), near] if self.slow else [near]
        return jnp.concatenate([self.fixed, *(x.reshape(-1, x.shape[-1]) for x in parts)], 1)


def slow_contexts(prior: Int[A, "rows components"], step_level: int | Array) -> BandContexts:
    """Of the lowest band; `prior` is 16 log2 of what is expected, in steps, `step_level` that of the step in cm."""
    rows, components = prior.shape
    xp = namespace(prior)
    prior = clipped(prior)
    row, component = np.meshgrid(np.arange(rows), np.arange(components), indexing="ij")
    fixed = xp.stack([
        prior, component, OCTAVE * (component < PATH), OCTAVE * (component < PATH - 1), magnitude(row) // 2,
        np.full_like(row, magnitude(np.array(rows)) // 2), xp.broadcast_to(_quarter(step_level), row.shape),
    ], -1)  # fmt: skip
    fixed = fixed.reshape(rows * components, fixed.shape[-1])
    return BandContexts(True, fixed, expected(prior), Neighbours.of(rows, components))


def fast_contexts(
    prior: Int[A, "rows components"], step_level: int | Array, octave: int, parents: A
) -> BandContexts:
    """Of an octave (0: the lowest); `parents` are the magnitudes of the octave below, or of the lowest band over time."""
    rows, components = prior.shape
    xp = namespace(parents)
    prior = clipped(prior)
    row, component = np.meshgrid(np.arange(rows), np.arange(components), indexing="ij")
    near = _near_parents(parents, row, component)
    mean = parents.sum(0)[:components] // len(parents) if xp is np else parents.mean(0)[:components]
    mean = xp.broadcast_to(mean[None], (rows, components)).reshape(-1, 1)
    fixed = xp.stack([
        prior, component, OCTAVE * (component < PATH), np.full_like(row, OCTAVE * octave), OCTAVE * (row % 2),
        xp.broadcast_to(_quarter(step_level), row.shape),
    ], -1)  # fmt: skip
    whole = xp.concatenate([xp.asarray(fixed.reshape(rows * components, fixed.shape[-1])), near, mean], 1)
    return BandContexts(False, whole, expected(prior), Neighbours.of(rows, components))


def _near_parents(parents: np.ndarray | Array, row: np.ndarray, component: np.ndarray) -> np.ndarray | Array:
    """Magnitudes around the parent of every place: (places, neighbours)."""
    rows, components = parents.shape
    n = Neighbours.of(rows, components)
    same_rate = rows >= len(row)  # the lowest band over time has the rows of the lowest octave, others have half as many
    parent = np.minimum(row if same_rate else row // 2, rows - 1)
    if isinstance(parents, np.ndarray):
        base = n.base[(parent * components + component).ravel()][:, None]
        return n.padded(parents)[base + n.steps(PARENTS)]
    chosen = jnp.asarray(parent[:, :1] == np.arange(rows)[None], parents.dtype)  # rows by a matrix, as others by slices
    near = n.around(parents, PARENTS)[:, : row.shape[1]]
    return (chosen @ near.reshape(rows, -1)).reshape(-1, len(PARENTS))


def _quarter(level: int | Array) -> int | Array:
    return level / 4 if isinstance(level, Array) else level // 4


def slow_activity(levels: Int[np.ndarray, "rows components"]) -> Int[np.ndarray, "rows components"]:
    """How lively every component of the lowest band is over time: its faster half brought back to time, as levels.

    By whole numbers: cosines in 64ths, which no rounding can divide.
    """
    cosines, scale = _integer_cosines(len(levels))
    return cosines @ levels * scale >> 16


def smooth_activity(levels: Float[Array, "rows components"]) -> Float[Array, "rows components"]:
    """The same of any real levels, for gradients."""
    cosines, scale = _integer_cosines(len(levels))
    return jnp.asarray(cosines * (scale / 65536), levels.dtype) @ levels


@functools.lru_cache(maxsize=16)
def _integer_cosines(rows: int) -> tuple[np.ndarray, int]:
    frequency, row = np.arange(rows)[None, :], np.arange(rows)[:, None]
    turns = np.pi * (2 * row + 1) * frequency / (2 * rows)
    rising = frequency / rows  # what moves faster weighs more
    cosines = np.rint(64 * np.cos(turns)).astype(np.int64) * np.rint(16 * rising).astype(np.int64)
    root = int(np.sqrt(2.0 * (1 << 40) / rows))
    return cosines, root >> 14
