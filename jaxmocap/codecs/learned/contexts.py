"""What the coder knows of a level before it reads it: magnitudes already decoded nearby, and what the corpus expects.

All of it is integers, in sixteenths of an octave, so that encoder and decoder agree on every machine. Levels are read in
groups, none of which takes its contexts from within itself: in the lowest band along diagonals, so that a level knows
both lower frequencies of its own component and all larger components; in the octaves a whole component at a time.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Generic

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


def expected(prior: A) -> A:
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


@dataclass(frozen=True, eq=False)
class BandContexts(Generic[A]):
    """Of a band whose priors are `prior`, clipped, and `expected` as magnitudes: both (rows, components).

    `parents` are the magnitudes of the octave below, or of the lowest band over time; the lowest band has none. `octave`
    0 is the lowest octave, `quarter` a quarter of 16 log2 of the step in cm.
    """

    prior: A
    quarter: int | Array
    octave: int = 0
    parents: A | None = None

    @property
    def slow(self) -> bool:
        return self.parents is None

    @functools.cached_property
    def neighbours(self) -> Neighbours:
        return Neighbours.of(*self.prior.shape)

    @functools.cached_property
    def expected(self) -> A:
        return expected(self.prior)

    @functools.cached_property
    def fixed(self) -> A:
        """The inputs that are known before the band: (places, inputs)."""
        return self._fixed_at(slice(None))

    def inputs(self, own: A, excess: A, where: np.ndarray | slice) -> A:
        """The network's inputs at these places; `own` and `excess` are the padded magnitudes, plain and less expected."""
        return self._inputs(self.fixed[where], own, excess, where)

    def inputs_of(self, magnitudes: A, where: np.ndarray | None = None) -> A:
        """The inputs of these places, or of all, once all magnitudes are known: (places, inputs)."""
        n = self.neighbours
        fixed = self.fixed if where is None else self._fixed_at(where)
        own, excess = n.padded(magnitudes), n.padded(magnitudes - self.expected)
        return self._inputs(fixed, own, excess, slice(None) if where is None else where)

    def smooth_inputs(self, magnitudes: Float[Array, "rows components"]) -> Float[Array, "places inputs"]:
        """The same of all places, for gradients."""
        n = self.neighbours
        near = n.around(magnitudes - self.expected, SLOW_OTHERS if self.slow else FAST_OTHERS)
        parts = [n.around(magnitudes, SLOW_OWN), near] if self.slow else [near]
        return jnp.concatenate([self.fixed, *(x.reshape(-1, x.shape[-1]) for x in parts)], 1)

    def _inputs(self, fixed: A, own: A, excess: A, where: np.ndarray | slice) -> A:
        base = self.neighbours.base[where][:, None]
        parts = [fixed, excess[base + self.neighbours.steps(SLOW_OTHERS if self.slow else FAST_OTHERS)]]
        if self.slow:
            parts.insert(1, own[base + self.neighbours.steps(SLOW_OWN)])
        return namespace(own).concatenate(parts, 1)

    def _fixed_at(self, where: np.ndarray | slice) -> A:
        rows, components = self.prior.shape
        row, component = np.divmod(np.arange(rows * components)[where], max(components, 1))
        of_row = [magnitude(row) // 2, np.full_like(row, magnitude(np.array(rows)) // 2)]
        if not self.slow:
            of_row = [np.full_like(row, OCTAVE * self.octave), OCTAVE * (row % 2)]
        of_path = [OCTAVE * (component < n) for n in ((PATH, PATH - 1) if self.slow else (PATH,))]
        xp = namespace(self.prior if self.parents is None else self.parents)
        own = [self.prior.reshape(-1)[where], component, *of_path, *of_row, xp.broadcast_to(self.quarter, row.shape)]
        inputs = xp.stack([xp.asarray(x) for x in own], -1)
        return inputs if self.parents is None else xp.concatenate([inputs, *self._of_parents(where, row, component)], 1)

    def _of_parents(self, where: np.ndarray | slice, row: np.ndarray, component: np.ndarray) -> list[A]:
        """Magnitudes around the parent of every place, (places, neighbours), and the mean of all of its component."""
        parents, (of_rows, of_components) = self.parents, self.prior.shape
        assert parents is not None
        rows, components = parents.shape
        n = Neighbours.of(rows, components)
        same_rate = rows >= of_rows  # the lowest band over time has the rows of the lowest octave, others have half as many
        parent = np.minimum(row if same_rate else row // 2, rows - 1)
        if isinstance(parents, np.ndarray):
            base = n.base[parent * components + component][:, None]
            return [n.padded(parents)[base + n.steps(PARENTS)], (parents.sum(0) // rows)[component][:, None]]
        first = np.flatnonzero(component == 0)  # all places: rows by a matrix, as others by slices
        chosen = jnp.asarray(parent[first][:, None] == np.arange(rows)[None], parents.dtype)
        near = n.around(parents, PARENTS)[:, :of_components]
        mean = jnp.broadcast_to(parents.mean(0)[:of_components][None], self.prior.shape)
        return [(chosen @ near.reshape(rows, -1)).reshape(-1, len(PARENTS)), mean.reshape(-1, 1)]


def slow_contexts(prior: Int[A, "rows components"], step_level: int | Array) -> BandContexts[A]:
    """Of the lowest band; `prior` is 16 log2 of what is expected, in steps, `step_level` that of the step in cm."""
    return BandContexts(clipped(prior), _quarter(step_level))


def fast_contexts(prior: Int[A, "rows components"], step_level: int | Array, octave: int, parents: A) -> BandContexts[A]:
    """Of an octave (0: the lowest); `parents` are the magnitudes of the octave below, or of the lowest band over time."""
    return BandContexts(clipped(prior), _quarter(step_level), octave, parents)


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
