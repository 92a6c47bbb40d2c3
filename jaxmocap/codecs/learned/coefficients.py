"""Levels of a clip as bytes and back: bands from coarse to fine, each in groups under the densities of its contexts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ...errors import CorruptStream
from ..entropy import integers
from ..entropy.range_coder import Decoder, Encoder
from ..entropy.tables import TOTAL
from .bands import band_rows
from .contexts import OCTAVE, PATH, BandContexts, fast_contexts, groups, magnitude, slow_activity, slow_contexts
from .density import FrozenDensity, bits, stop_frequencies, tail_rows
from .golomb import read_signed, write_signed
from .spectrum import Expectation, Leftover, Spectrum
from .steps import level_of_step

_COUNT_ORDER = 2
_LEFT_OF_NONZERO, _LEFT_OF_ZERO, _LAPLACE = -24, -24, 56  # in sixteenths of an octave of the step
_LIKELY = -32  # components expected to reach a quarter of a step are expected to be there at all


class Densities(NamedTuple):
    """The frozen networks of the lowest band and of the octaves, and the tables that turn outputs into frequencies."""

    slow: FrozenDensity
    fast: FrozenDensity
    logistic: np.ndarray
    tail: np.ndarray

    def of(self, contexts: BandContexts) -> FrozenDensity:
        return self.slow if contexts.slow else self.fast


Levels = list[Int[np.ndarray, "rows components"]]


def active_components(levels: Levels) -> list[int]:
    """How many components every band needs: the path always, and never more than the band below has."""
    counts = []
    for band in reversed(levels):
        last = np.flatnonzero(band.any(0))
        needed = int(last[-1]) + 1 if len(last) else 0
        counts.append(max(needed, counts[-1] if counts else 0))
    return counts[::-1]


def band_contexts(levels: Levels, expectation: Expectation, step_index: int, counts: list[int]) -> Iterator[BandContexts]:
    """The contexts of one band after another; a band is read from `levels` only when the next is asked for."""
    level = level_of_step(step_index)
    yield slow_contexts(expectation.slow_prior(len(levels[0]), level)[:, : counts[0]], level)
    for octave, count in enumerate(counts[1:]):
        prior = expectation.fast_prior(len(levels[octave + 1]), octave, level)[:, :count]
        yield fast_contexts(prior, level, octave, _parents(levels, octave))


def _parents(levels: Levels, octave: int) -> Int[np.ndarray, "rows components"]:
    """Short clips have nothing in their coarsest octaves, but have in finer ones."""
    for band in reversed(levels[1 : octave + 1]):
        if len(band):
            return magnitude(band)
    return magnitude(slow_activity(levels[0]))


def leftover(levels: Levels, before: Expectation, spectrum: Spectrum, step_index: int, densities: Densities) -> Leftover:
    """What these levels leave over, where `before` was expected of them.

    Of what is not zero about as much as of uniform noise; of a zero the less, the surer it was to be one.
    """
    counts, sizes, step = active_components(levels), [], level_of_step(step_index)
    for band, count, contexts in zip(levels, counts, band_contexts(levels, before, step_index, counts), strict=True):
        outputs = densities.of(contexts)(contexts.inputs_of(magnitude(band[:, :count])))
        nonzero = TOTAL - stop_frequencies(outputs, densities.logistic)[:, 0]
        octaves = OCTAVE * 16 - magnitude(nonzero - 1)  # of its chance, in sixteenths; a Laplacian's, it is that over its size
        of_zero = np.full(band.shape, _LEFT_OF_ZERO - magnitude(np.array(16 * OCTAVE)))
        of_zero[:, :count] = np.minimum(_LEFT_OF_ZERO, _LAPLACE - magnitude(octaves)).reshape(len(band), count)
        sizes.append(step + np.where(band != 0, _LEFT_OF_NONZERO, of_zero))
    return Leftover(spectrum, sizes)


def level_bits(levels: Levels, expectation: Expectation, step_index: int, densities: Densities) -> float:
    """About what the levels will take, in bits, without coding them."""
    total, counts = 0.0, active_components(levels)
    for band, count, contexts in zip(levels, counts, band_contexts(levels, expectation, step_index, counts), strict=True):
        outputs = densities.of(contexts).logits(contexts.inputs_of(magnitude(band[:, :count])))
        total += float(bits(outputs, np.abs(band[:, :count]).ravel()).sum())
    return total


def encode_levels(encoder: Encoder, levels: Levels, expectation: Expectation, step_index: int, densities: Densities) -> None:
    counts = active_components(levels)
    _write_counts(encoder, counts, expectation, step_index)
    for band, count, contexts in zip(levels, counts, band_contexts(levels, expectation, step_index, counts), strict=True):
        flat = band[:, :count].ravel().astype(np.int64)
        outputs = densities.of(contexts)(contexts.inputs_of(magnitude(band[:, :count])))
        for group in groups(len(band), count, contexts.slow):
            _encode_group(encoder, flat[group], outputs[group], densities)


def decode_levels(
    decoder: Decoder, frames: int, octaves: int, expectation: Expectation, step_index: int, densities: Densities
) -> Levels:
    """Raises CorruptStream where no encoder wrote such bytes."""
    rows = band_rows(frames, octaves)
    counts = _read_counts(decoder, len(rows), expectation, step_index)
    levels = [np.zeros((n, expectation.components), np.int64) for n in rows]
    for band, count, contexts in zip(levels, counts, band_contexts(levels, expectation, step_index, counts), strict=True):
        n = contexts.neighbours
        own = n.padded(np.zeros((len(band), count), np.int64))
        excess, expected = own.copy(), contexts.expected.ravel()
        flat = np.zeros(len(band) * count, np.int64)
        density = densities.of(contexts)
        for group in groups(len(band), count, contexts.slow):
            decoded = _decode_group(decoder, density(contexts.inputs(own, excess, group)), densities)
            flat[group] = decoded
            at = n.base[group]
            own[at] = magnitude(decoded)
            excess[at] = own[at] - expected[group]
        band[:, :count] = flat.reshape(len(band), count)
    return levels


def _encode_group(encoder: Encoder, levels: np.ndarray, outputs: np.ndarray, densities: Densities) -> None:
    size = np.abs(levels)
    encoder.encode_each(np.minimum(size, 3), stop_frequencies(outputs, densities.logistic))
    beyond = size >= 3
    if beyond.any():
        encode_sizes(encoder, size[beyond] - 3, tail_frequencies(densities.tail, tail_rows(outputs[beyond])))
    encode_signs(encoder, levels[size > 0])


def _decode_group(decoder: Decoder, outputs: np.ndarray, densities: Densities) -> np.ndarray:
    size = decoder.decode_each(stop_frequencies(outputs, densities.logistic))
    beyond = np.flatnonzero(size == 3)
    if len(beyond):
        size[beyond] = 3 + decode_sizes(decoder, tail_frequencies(densities.tail, tail_rows(outputs[beyond])))
    return decode_signs(decoder, size)


def tail_frequencies(tail: np.ndarray, rows: Int[np.ndarray, " places"]) -> Int[np.ndarray, "places symbols"]:
    """Of the symbols of sizes under the geometric laws of these rows of the tail's table."""
    return tail[rows].astype(np.int64) + 1


def encode_sizes(encoder: Encoder, sizes: Int[np.ndarray, " places"], frequencies: Int[np.ndarray, "places symbols"]) -> None:
    """Integers of 0 and more: all symbols, then all raw bits."""
    symbol, raw, count = integers.split(sizes)
    encoder.encode_each(symbol, frequencies)
    for value, n in zip(raw.tolist(), count.tolist(), strict=True):
        encoder.encode_bits(value, n)


def decode_sizes(decoder: Decoder, frequencies: Int[np.ndarray, "places symbols"]) -> Int[np.ndarray, " places"]:
    symbols = decoder.decode_each(frequencies).tolist()
    return np.array([integers.join(s, decoder.decode_bits(integers.raw_bits(s))) for s in symbols], np.int64)


def encode_signs(encoder: Encoder, nonzeros: Int[np.ndarray, " nonzeros"]) -> None:
    encoder.encode_each((nonzeros < 0).astype(np.int64), _even(len(nonzeros)))


def decode_signs(decoder: Decoder, sizes: Int[np.ndarray, " places"]) -> Int[np.ndarray, " places"]:
    """The levels of sizes, signs of all that are not zero read."""
    nonzero = np.flatnonzero(sizes)
    if len(nonzero):
        sizes[nonzero[decoder.decode_each(_even(len(nonzero))) == 1]] *= -1
    return sizes


def _even(count: int) -> np.ndarray:
    return np.full((count, 2), 1 << 15, np.int64)


def _expected_counts(band_count: int, expectation: Expectation, step_index: int) -> Iterator[int]:
    for prior in expectation.typical(band_count - 1, level_of_step(step_index)):
        likely = np.flatnonzero((prior > _LIKELY).any(0))
        yield int(likely[-1]) + 1 if len(likely) else PATH


def _write_counts(encoder: Encoder, counts: list[int], expectation: Expectation, step_index: int) -> None:
    previous = expectation.components
    for count, likely in zip(counts, _expected_counts(len(counts), expectation, step_index), strict=True):
        if previous == 0:
            return
        write_signed(encoder, count - min(likely, previous), _COUNT_ORDER)
        previous = count


def _read_counts(decoder: Decoder, band_count: int, expectation: Expectation, step_index: int) -> list[int]:
    counts: list[int] = []
    previous = expectation.components
    for likely in _expected_counts(band_count, expectation, step_index):
        count = read_signed(decoder, _COUNT_ORDER) + min(likely, previous) if previous else 0
        if not 0 <= count <= previous:
            raise CorruptStream(f"a band has {count} components, where {previous} are the most")
        counts.append(count)
        previous = count
    return counts
