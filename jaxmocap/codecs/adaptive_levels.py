"""Quantised coefficients coded by their surroundings: what was coded nearby says how large a coefficient is likely to be.

A plane holds the levels of a clip, by rows (frequencies) and components; planes of a chunk follow each other in time.
No table is trained or sent: see entropy/adaptive.py. The same walk writes and reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..errors import CorruptStream
from .entropy.adaptive import SIXTEENTHS, Coder, code_signed, code_unsigned, law


class Neighbour(NamedTuple):
    """A coefficient coded before: so many planes and rows back, in the component so far on, and how much it counts."""

    planes: int
    rows: int
    components: int
    weight: int


class Surroundings(NamedTuple):
    """Whom a coefficient is compared with. Row 0 follows row 0 of the plane `period` back: by `halves` of it, that number
    of them that would have been best so far, at first the one named first."""

    period: int
    halves: tuple[int, ...]
    neighbours: tuple[Neighbour, ...]


Plane = Int[np.ndarray, "rows components"]
_MARGIN = 6  # rows and components beyond the first and the last, which are zero
_KINDS = 64  # contexts of a kind
_FIRST, _AC, _EARLY_AC, _QUIET, _USED, _EARLY_USED = (n * _KINDS for n in range(6))
_LIKELY_FIRST, _LIKELY_USED, _LIKELY_CHANGE = 256 * SIXTEENTHS, 20 * SIXTEENTHS, 4 * SIXTEENTHS
_LEAST_MEAN = 1  # sixteenths: where all neighbours are zero


def code_levels(coder: Coder, planes: Sequence[Plane], around: Surroundings) -> list[Plane]:
    """The planes of a chunk; a reader fills planes of the same shapes. Raises CorruptStream where rows do not fit."""
    walk = _Walk(coder, around, max(p.shape[0] for p in planes), max(p.shape[1] for p in planes))
    return [walk.plane(levels) for levels in planes]


class _FirstRow:
    """Row 0 of the planes of one coordinate."""

    def __init__(self, coder: Coder, halves: tuple[int, ...], components: int):
        self._coder, self._halves = coder, halves
        self._before: list[int] | None = None
        self._sizes: list[int] = []
        self._misses = [[0] * len(halves) for _ in range(components)]

    def code(self, levels: list[int]) -> list[int]:
        found, sizes = [], []
        for i, level in enumerate(levels):
            guesses = [half * self._before[i] // 2 if self._before else 0 for half in self._halves]
            misses = self._misses[i]
            guess = guesses[misses.index(min(misses))]
            context, mean = self._expected(i, sizes)
            miss = code_signed(self._coder, _FIRST + context, law(_rounded(mean)), level - guess)
            found.append(guess + miss)
            sizes.append((abs(miss) + self._sizes[i] + 1) // 2 if self._before else abs(miss))
            if self._before:
                self._misses[i] = [(3 * m >> 2) + 4 * abs(found[i] - g) for m, g in zip(misses, guesses, strict=True)]
        self._before, self._sizes = found, sizes
        return found

    def _expected(self, i: int, sizes: list[int]) -> tuple[int, int]:
        """Context and mean magnitude: by this component before and the one coded last."""
        if not self._before:
            return min(i, 3), max(_LIKELY_FIRST >> 2 * min(i, 3), SIXTEENTHS)
        near = self._sizes[i] + (sizes[i - 1] if i else self._sizes[i])
        return 4 + _half_octaves(near), max(near * SIXTEENTHS // 2, 4)


class _Walk:
    def __init__(self, coder: Coder, around: Surroundings, rows: int, components: int):
        self._coder, self._period = coder, around.period
        self._width = components + _MARGIN
        self._size = (rows + _MARGIN) * self._width
        self._depth = max(n.planes for n in around.neighbours)
        self._seen: list[int] = [0] * (self._depth * self._size)  # magnitudes of the last planes, and of this one
        self._first_rows = [_FirstRow(coder, around.halves, components) for _ in range(around.period)]
        self._used: list[int] = []
        offsets = [(-n.planes * self._size - n.rows * self._width + n.components, n.weight) for n in around.neighbours]
        self._offsets = offsets
        self._laws = [_laws(around.neighbours, early) for early in (False, True)]

    def plane(self, levels: Plane) -> Plane:
        rows = len(levels)
        found = np.zeros_like(levels)
        found[0] = self._first_rows[len(self._used) % self._period].code(levels[0].tolist())
        used = self._rows_used(levels)
        if not 0 <= used < rows:
            raise CorruptStream(f"a clip of {rows} frequencies says that {used} are in use beyond the first")
        self._seen = self._seen[-self._depth * self._size :] if self._depth else []
        base = len(self._seen)
        self._seen += [0] * self._size
        for f in range(1, used + 1):
            found[f] = self._row(levels[f].tolist(), f, base + (f + _MARGIN // 2) * self._width + _MARGIN // 2)
        return found

    def _rows_used(self, levels: Plane) -> int:
        """How many rows beyond the first lead to the last that holds anything."""
        nonzero = np.flatnonzero(levels.any(1))
        used = int(nonzero[-1]) if len(nonzero) else 0
        n, period = len(self._used), self._period
        if n < period:
            used = code_unsigned(self._coder, _EARLY_USED, law(_LIKELY_USED), used)
        else:
            used = self._used[n - period] + code_signed(self._coder, _USED, law(_LIKELY_CHANGE), used - self._used[n - period])
        self._used.append(used)
        return used

    def _row(self, levels: list[int], f: int, at: int) -> list[int]:
        early = len(self._used) <= self._depth
        kind, laws = (_EARLY_AC if early else _AC), self._laws[early]
        seen, offsets, coder = self._seen, self._offsets, self._coder
        quiet = _QUIET + min(f.bit_length(), 7) * 2 + early
        found = []
        for level in levels:
            near = 0
            for offset, weight in offsets:
                near += weight * seen[at + offset]
            half = _half_octaves(near)
            value = code_signed(coder, kind + half if near else quiet, laws[half], level)
            seen[at] = abs(value)
            found.append(value)
            at += 1
        return found


def _half_octaves(near: int) -> int:
    """2 log2 of one more, as an integer."""
    return min(((near + 1) * (near + 1)).bit_length() - 1, _KINDS - 10)


def _laws(neighbours: Sequence[Neighbour], early: bool) -> list[tuple[int, ...]]:
    """The law for each number of half octaves; early planes have no others behind them to count."""
    weight = sum(n.weight for n in neighbours if not (early and n.planes))
    return [law(max((math.isqrt(1 << h + 8) - SIXTEENTHS // 2) // weight, _LEAST_MEAN)) for h in range(_KINDS)]


def _rounded(mean: int) -> int:
    """The mean with two significant bits, so that few laws are made."""
    shift = max(mean.bit_length() - 2, 0)
    return max(mean >> shift << shift, 1)
