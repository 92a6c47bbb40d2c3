"""Levels and their contexts as training rows for the densities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...codecs.learned.coefficients import Levels, active_components, band_contexts
from ...codecs.learned.contexts import FAST_INPUTS, SLOW_INPUTS, magnitude
from ...codecs.learned.spectrum import Spectrum

_MOST_A_BAND = 6000


class Rows(NamedTuple):
    """Contexts (rows, inputs) in 16ths of an octave, and sizes of levels."""

    contexts: np.ndarray
    sizes: np.ndarray


def rows_of(levels: Levels, spectrum: Spectrum, step_index: int, random: np.random.Generator) -> tuple[Rows, Rows]:
    """Of the lowest band and of the octaves; at most 6,000 a band, drawn at random."""
    slow, fast = [empty(SLOW_INPUTS)], [empty(FAST_INPUTS)]
    counts = active_components(levels)
    for band, count, contexts in zip(levels, counts, band_contexts(levels, spectrum, step_index, counts), strict=False):
        x = contexts.inputs_of(magnitude(band[:, :count]))
        chosen = random.permutation(len(x))[:_MOST_A_BAND]
        rows = Rows(x[chosen].astype(np.int16), np.abs(band[:, :count]).ravel()[chosen].astype(np.float32))
        (slow if contexts.slow else fast).append(rows)
    return joined(slow), joined(fast)


def empty(inputs: int) -> Rows:
    return Rows(np.zeros((0, inputs), np.int16), np.zeros(0, np.float32))


def joined(parts: list[Rows]) -> Rows:
    return Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))
