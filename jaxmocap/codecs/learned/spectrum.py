"""How large every component is expected to be in every band: what the corpus knows of its motion's spectrum."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .contexts import OCTAVE, magnitude

SLOW_BINS = 19  # the constant, then half octaves of frequency up
FAST_OCTAVES = 5
_FIRST_BIN = 9 * OCTAVE  # log2 of how many half cycles of 1/7.5 s the slowest bin's end has


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

    def slow_prior(self, rows: int, step_index: int) -> Int[np.ndarray, "rows components"]:
        """In 16ths of an octave of the step. The constant grows with the root of the length."""
        prior = self.slow[slow_bins(rows)].astype(np.int64)
        prior[0] += magnitude(np.array(rows - 1)) // 2
        return prior - level_of_step(step_index)

    def fast_prior(self, rows: int, octave: int, step_index: int) -> Int[np.ndarray, "rows components"]:
        at = self.fast[min(octave, len(self.fast) - 1)].astype(np.int64)
        return np.broadcast_to(at - level_of_step(step_index), (rows, self.components))


def level_of_step(step_index: int) -> int:
    """16 log2 of the step in cm."""
    return step_index - 7 * OCTAVE


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
