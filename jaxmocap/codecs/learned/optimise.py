"""Quantisation that is optimal in rate and distortion: levels are moved until no move pays, error by error as it is seen.

The mean of distances is no sum of squares, and a step of one coefficient moves other joints in other poses. So the
encoder looks at what decodes: it pulls every coefficient down the gradient of the true error, weighs each candidate level
by its curvature against its bits in context, and lets a random third of all coefficients move at a time, since moves
that are good alone may be bad together. The decoder knows nothing of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from . import bands
from .coefficients import Densities, Levels, active_components, band_contexts
from .contexts import magnitude
from .density import bits
from .distortion import Distortion
from .spectrum import Expectation
from .steps import step_cm

_FINE_SLOPE = 6 / np.log(2)  # bits per squared step at high rate: d rate / d (step^2 / 12)
WEIGHT = 0.85  # of distortion against rate, where 1 is the slope of high rates
_SHARE = 0.3
_LEAST_CURVATURE = 0.3
_SOFT = 0.27
STILL = 1e-4  # cm: components that the motion does not use at all stay unused, so that constant channels do
_BOLDNESS = 0.8
_TOO_FAR, _TIMID, _BOLD = 1.01, 0.6, 1.05


class _Seen(NamedTuple):
    """Levels that were looked at, their mean error, its gradient in coefficients, and its mean curvature."""

    mean: float
    levels: Levels
    pull: np.ndarray
    curvature: float


class Optimiser:
    """Of one motion at one step; `levels` are changed round by round, a look and a move each."""

    def __init__(
        self, y: Float[np.ndarray, "frames components"], shift: np.ndarray | float, octaves: int, distortion: Distortion,
        curvatures: Float[np.ndarray, " components"], expectation: Expectation, densities: Densities, step_index: int,
    ):  # fmt: skip
        self.octaves, self.distortion, self.expectation, self.densities = octaves, distortion, expectation, densities
        self.step_index, self.step, self.shift = step_index, step_cm(step_index), np.asarray(shift, np.float32)
        self.curvature = np.maximum(_BOLDNESS * curvatures, _LEAST_CURVATURE).astype(np.float32)
        self._random = np.random.default_rng(0)
        self._moves = np.abs(y).max(0) > STILL
        wanted = bands.forward(y, octaves)
        self.levels: Levels = [np.rint(w / self.step).astype(np.int64) for w in wanted]
        self.levels = self.requantised(wanted, 0.5, np.ones(y.shape[1]))
        self._seen: _Seen | None = None
        self._timid = 1.0

    def reconstruction(self) -> Float[np.ndarray, "frames components"]:
        """All coefficients as they decode, in cm; `shift` is what jumps add to those of the levels."""
        return bands.inverse([band.astype(np.float32) * np.float32(self.step) for band in self.levels]) + self.shift

    def errors(self) -> Float[np.ndarray, "points frames"]:
        return self.distortion.errors(self.reconstruction())

    def look(self) -> float:
        """The mean error of the levels as they are, in cm; where they are far worse than those before, of those."""
        error, pull, curvature = self.distortion.gradient(self.reconstruction(), _SOFT * self.step)
        mean = float(error.mean())
        if self._seen is not None and mean > _TOO_FAR * self._seen.mean:  # moves upset each other: back, and fewer
            self.levels, self._timid = self._seen.levels, self._timid * _TIMID
        else:
            self._seen, self._timid = _Seen(mean, self.levels, pull, curvature), min(self._timid * _BOLD, 1.0)
        return self._seen.mean

    def move(self, weight: float) -> None:
        """A round of moves, after a look."""
        if self._seen is None:
            raise ValueError("a move must follow a look")
        change = self._seen.pull / (self._seen.curvature * self.curvature)[None]
        newton = bands.forward(np.where(self._moves, change, np.float32(0)), self.octaves)
        wanted = [band.astype(np.float32) * np.float32(self.step) - n for band, n in zip(self.levels, newton, strict=True)]
        moved = self.requantised(wanted, weight, self.curvature)
        self.levels = [
            np.where(self._random.random(a.shape) < _SHARE * self._timid, b, a) for a, b in zip(self.levels, moved, strict=True)
        ]

    def requantised(self, wanted: list[np.ndarray], weight: float, curvature: np.ndarray) -> Levels:
        """For every coefficient the level of least bits + weight x error: rounded, one nearer to zero, or zero."""
        nearest = [np.rint(np.abs(w) / self.step).astype(np.int64) for w in wanted]
        counts = active_components(nearest)
        known = [np.where(np.arange(n.shape[1]) < c, n, 0) for n, c in zip(self.levels, counts, strict=True)]
        moved = [np.zeros_like(n) for n in nearest]
        contexts = band_contexts(known, self.expectation, self.step_index, counts)
        for band, context, w, top, level, count in zip(moved, contexts, wanted, nearest, known, counts, strict=False):
            where = np.flatnonzero(top[:, :count])  # what rounds to zero stays there
            logits = self.densities.of(context).logits(context.inputs_of(magnitude(level[:, :count]), where))
            row, component = np.divmod(where, max(count, 1))
            size = np.abs(w[row, component]) / self.step
            steepness = weight * _FINE_SLOPE * curvature[component]
            candidates = np.stack([top[row, component], top[row, component] - 1, np.zeros_like(row)])
            cost = np.stack([bits(logits, c) + steepness * (size - c) ** 2 for c in candidates])
            best = candidates[cost.argmin(0), np.arange(len(row))]
            band[row, component] = np.where(w[row, component] < 0, -best, best)
        return moved
