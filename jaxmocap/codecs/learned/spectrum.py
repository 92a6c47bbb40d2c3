"""How large every component is expected to be in every band: what the corpus knows of its motion's spectrum.

Where coarser layers are known, it is what they leave over that is expected.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from .contexts import OCTAVE, magnitude

SLOW_BINS = 19  # the constant, then half octaves of frequency up
FAST_OCTAVES = 5
_TYPICAL_ROWS = 1 << 10  # of the lowest band
_FIRST_BIN = 9 * OCTAVE  # log2 of how many half cycles of 1/7.5 s the slowest bin's end has


class Expectation(Protocol):
    """Priors of levels: 16 log2 of their mean magnitude, where a step of 2^(step_level / 16) cm quantises."""

    @property
    def components(self) -> int: ...
    def slow_prior(self, rows: int, step_level: int) -> Int[np.ndarray, "rows components"]: ...
    def fast_prior(self, rows: int, octave: int, step_level: int) -> Int[np.ndarray, "rows components"]: ...
    def typical(self, octaves: int, step_level: int) -> list[Int[np.ndarray, "rows components"]]: ...


@dataclass(frozen=True, eq=False)
class Spectrum:
    """16 log2 of mean magnitudes in cm, as integers: of the lowest band by bins of frequency, of every octave above it.

    Octaves beyond the last known are taken to be as that.
    """

    slow: Int[np.ndarray, "bins components"]
    fast: Int[np.ndarray, "octaves components"]

    @property
    def components(self) -> int:
        return self.slow.shape[1]

    def slow_prior(self, rows: int, step_level: int) -> Int[np.ndarray, "rows components"]:
        """Of the lowest band. The constant grows with the root of the length."""
        prior = self.slow[slow_bins(rows)].astype(np.int64)
        prior[0] += magnitude(np.array(rows - 1)) // 2
        return prior - step_level

    def fast_prior(self, rows: int, octave: int, step_level: int) -> Int[np.ndarray, "rows components"]:
        at = self.fast[min(octave, len(self.fast) - 1)].astype(np.int64)
        return np.broadcast_to(at - step_level, (rows, self.components))

    def typical(self, octaves: int, step_level: int) -> list[Int[np.ndarray, "rows components"]]:
        """Of all bands of a clip of typical length; of the octaves' rows, which are alike, one."""
        fast = [self.fast_prior(1, octave, step_level) for octave in range(octaves)]
        return [self.slow_prior(_TYPICAL_ROWS, step_level), *fast]


@dataclass(frozen=True, eq=False)
class Leftover:
    """What a layer leaves over of a motion: `sizes` are 16 log2 of mean magnitudes in cm, place by place."""

    before: Spectrum
    sizes: list[Int[np.ndarray, "rows components"]]

    @property
    def components(self) -> int:
        return self.before.components

    def slow_prior(self, rows: int, step_level: int) -> Int[np.ndarray, "rows components"]:
        return self.sizes[0] - step_level

    def fast_prior(self, rows: int, octave: int, step_level: int) -> Int[np.ndarray, "rows components"]:
        return self.sizes[octave + 1] - step_level

    def typical(self, octaves: int, step_level: int) -> list[Int[np.ndarray, "rows components"]]:
        return self.before.typical(octaves, step_level)


@functools.lru_cache(maxsize=64)
def slow_bins(rows: int) -> Int[np.ndarray, " rows"]:
    """The bin of every row of the lowest band: 0 for the constant, then by half octaves of its frequency."""
    half_octaves = (magnitude(np.arange(rows) - 1) - magnitude(np.array(rows - 1)) + _FIRST_BIN) // (OCTAVE // 2)
    bins = np.clip(half_octaves + 1, 1, SLOW_BINS - 1)
    bins[0] = 0
    return bins


def fit_spectrum(clips: list[list[Float[np.ndarray, "rows components"]]]) -> Spectrum:
    """Of the bands of clips, in cm."""
    components = clips[0][0].shape[1]
    slow, count = np.zeros((SLOW_BINS, components)), np.zeros((SLOW_BINS, 1))
    fast, many = np.zeros((FAST_OCTAVES, components)), np.zeros((FAST_OCTAVES, 1))
    for bands in clips:
        size = np.abs(bands[0])
        size[0] /= np.sqrt(len(size))
        np.add.at(slow, slow_bins(len(size)), size)
        np.add.at(count[:, 0], slow_bins(len(size)), 1.0)
        for octave, band in enumerate(bands[1 : FAST_OCTAVES + 1]):
            fast[octave] += np.abs(band).sum(0)
            many[octave] += len(band)
    return Spectrum(_logarithm(_filled(slow, count)), _logarithm(_filled(fast, many)))


def _filled(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Means; rows that nothing was seen of are as the nearest that something was."""
    seen = np.flatnonzero(count[:, 0] > 0)
    nearest = seen[np.abs(np.arange(len(count))[:, None] - seen[None, :]).argmin(1)]
    return total[nearest] / count[nearest]


def _logarithm(mean: np.ndarray) -> np.ndarray:
    return np.rint(OCTAVE * np.log2(np.maximum(mean, 2.0**-12))).astype(np.int16)
