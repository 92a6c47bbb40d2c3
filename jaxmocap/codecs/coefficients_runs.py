"""LSDT coefficients by run lengths: one count a coordinate and clip, then runs of zeros and nonzero values.

Our strongest reading of "the locations and values of nonzero elements, further entropy-coded" (Hou et al. 2016,
section 3.1): coefficients are scanned from the largest expected magnitude down, an order that training gives by
component and frequency band, and coded under frequency tables chosen by integers that the decoder has, too.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..errors import CorruptStream
from .entropy import integers
from .entropy.range_coder import Decoder, RangeDecoder, RangeEncoder
from .entropy.tables import FrequencyTable
from .quantise import PER_OCTAVE

BANDS = 17
CONTEXTS = 16
COUNT_CONTEXTS = 1 + integers.SYMBOLS // 2
_FINEST = 7 * PER_OCTAVE


@dataclass(frozen=True)
class RunTables:
    """Integers from training. `scale[d, b, i]` is the mean magnitude of component i of coordinate d in band b, as
    16 log2 of centimetres; the tables are those of counts, runs and values, one a context."""

    scale: Int[np.ndarray, "3 bands components"]
    count: list[FrequencyTable]
    run: list[FrequencyTable]
    value: list[FrequencyTable]


def bands(length: int, frame_rate: int) -> Int[np.ndarray, " frequencies"]:
    """The band of every DCT frequency of a clip: 0 for the constant, then half octaves from 1/4 Hz up."""
    k = np.arange(length)
    eighths = np.maximum(k * frame_rate * 4 // length, 1).astype(np.float64)
    half_octaves = np.frexp(eighths * eighths)[1] - 1
    return np.where(k == 0, 0, 1 + np.clip(half_octaves - 2, 0, BANDS - 2))


def frame_rate(frame_time: float) -> int:
    """Whole frames a second, at least one: what the bands go by."""
    return max(1, round(1 / frame_time))


class Scan(NamedTuple):
    """The order in which a clip's coefficients of one coordinate are coded, and the scale of each in that order."""

    order: Int[np.ndarray, " coefficients"]
    scale: Int[np.ndarray, " coefficients"]


def scans(scale: Int[np.ndarray, "3 bands components"], length: int, frame_rate: int) -> list[Scan]:
    """Of every coordinate: large expected magnitudes first; of equal ones, low frequencies first."""
    return _scans(scale.astype(np.int64).tobytes(), scale.shape, length, frame_rate)


@functools.lru_cache(maxsize=32)
def _scans(scale: bytes, shape: tuple[int, ...], length: int, frame_rate: int) -> list[Scan]:
    result = []
    for of_coordinate in np.frombuffer(scale, np.int64).reshape(shape):
        flat = of_coordinate[bands(length, frame_rate)].ravel()
        order = np.argsort(-flat, kind="stable")
        result.append(Scan(order, flat[order]))
    return result


class Symbols(NamedTuple):
    """What is coded of one coordinate of one clip: contexts and integers, nonzero by nonzero."""

    nonzeros: int
    run_context: np.ndarray
    run: np.ndarray
    value_context: np.ndarray
    value: np.ndarray  # magnitude less one
    negative: np.ndarray


def symbols(levels: Int[np.ndarray, "frequencies components"], scan: Scan, step_index: int) -> Symbols:
    """The runs and values of one coordinate of one clip."""
    scanned = levels.ravel()[scan.order].astype(np.int64)
    at = np.flatnonzero(scanned)
    start = np.concatenate([[0], at[:-1] + 1]) if len(at) else at
    values = scanned[at]
    return Symbols(
        len(at), _run_context(start, len(at)), at - start,
        _value_context(scan.scale[at], step_index), np.abs(values) - 1, values < 0,
    )


def _run_context(start, count: int):
    """How far the scan has come against the number of nonzeros in all, in half octaves."""
    ratio = ((start + 1) ** 2 << 8) // (count + 1) ** 2
    return np.clip(np.frexp(np.asarray(ratio, np.float64))[1] - 1, 0, CONTEXTS - 1)


def _value_context(scale, step_index: int):
    """The expected magnitude against the step, in two thirds of an octave."""
    return np.clip(((scale - step_index + _FINEST) * 3 >> 5) + 6, 0, CONTEXTS - 1)


def count_context(previous: int | None) -> int:
    """By the count of the same coordinate in the clip before, where the chunk has one."""
    return 0 if previous is None else 1 + int(integers.split(np.array([previous]))[0][0]) // 2


def encode_clips(
    clips: list[Int[np.ndarray, "3 frequencies components"]], tables: list[RunTables], step_index: int, frame_rate: int
) -> bytes:
    """One chunk: its clips in order, three coordinates each; every clip has the tables for its length."""
    coder = RangeEncoder()

    def put(table: FrequencyTable, symbol: int, raw: int, bits: int) -> None:
        coder.encode(symbol, table)
        if bits:
            coder.encode_bits(raw, bits)

    previous: list[int | None] = [None, None, None]
    for levels, t in zip(clips, tables, strict=True):
        for d, scan in enumerate(scans(t.scale, levels.shape[1], frame_rate)):
            s = symbols(levels[d], scan, step_index)
            symbol, raw, bits = (int(a[0]) for a in integers.split(np.array([s.nonzeros])))
            put(t.count[count_context(previous[d])], symbol, raw, bits)
            previous[d] = s.nonzeros
            runs = zip(s.run_context.tolist(), *(a.tolist() for a in integers.split(s.run)), strict=True)
            values = zip(s.value_context.tolist(), *(a.tolist() for a in integers.split(s.value)), strict=True)
            for run, value, negative in zip(runs, values, s.negative.tolist(), strict=True):
                put(t.run[run[0]], *run[1:])
                put(t.value[value[0]], *value[1:])
                coder.encode_bits(int(negative), 1)
    return coder.finish()


def decode_clips(
    data: bytes, lengths: list[int], components: int, tables: list[RunTables], step_index: int, frame_rate: int
) -> list[Int[np.ndarray, "3 frequencies components"]]:
    """The clips of a chunk. Raises CorruptStream where a run leads out of its clip."""
    coder = RangeDecoder(data)
    previous: list[int | None] = [None, None, None]
    clips = []
    for length, t in zip(lengths, tables, strict=True):
        size = length * components
        levels = np.zeros((3, size), np.int32)
        for d, scan in enumerate(scans(t.scale, length, frame_rate)):
            count = _get(coder, t.count[count_context(previous[d])])
            if count > size:
                raise CorruptStream(f"a clip of {size} coefficients says that {count} are not zero")
            previous[d] = count
            at, found = _decode_coordinate(coder, count, scan, t, step_index)
            levels[d, scan.order[at]] = found
        clips.append(levels.reshape(3, length, components))
    return clips


def _decode_coordinate(
    coder: Decoder, count: int, scan: Scan, tables: RunTables, step_index: int
) -> tuple[list[int], list[int]]:
    contexts = _value_context(scan.scale, step_index).tolist()
    places, values = [], []
    start, square = 0, (count + 1) ** 2
    for _ in range(count):
        ratio = ((start + 1) ** 2 << 8) // square
        at = start + _get(coder, tables.run[min(max(ratio.bit_length() - 1, 0), CONTEXTS - 1)])
        if at >= len(contexts):
            raise CorruptStream("a run of zeros leads out of its clip")
        value = _get(coder, tables.value[contexts[at]]) + 1
        values.append(-value if coder.decode_bits(1) else value)
        places.append(at)
        start = at + 1
    return places, values


def _get(coder: Decoder, table: FrequencyTable) -> int:
    symbol = coder.decode(table)
    bits = integers.raw_bits(symbol)
    return integers.join(symbol, coder.decode_bits(bits)) if bits else symbol
