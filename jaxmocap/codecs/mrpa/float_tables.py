"""The frequency tables of the float coder: learned from what is to be coded, and written in few bytes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, UInt8, UInt32

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..entropy.lanes import TOTAL
from ..entropy.range_coder import RangeDecoder, RangeEncoder
from ..entropy.tables import FrequencyTable
from .float_coding import CLASS_CONTEXTS, CLASSES, MANTISSA_CONTEXTS, TOKENS, Symbols, Tables

_LEVELS = 72  # 0: never; then quarter octaves of frequency
_SHAPES = ((CLASS_CONTEXTS, CLASSES), (MANTISSA_CONTEXTS, TOKENS))


def learn(coded: Sequence[Symbols]) -> bytes:
    """The bytes of the tables that fit these symbols."""
    pairs = ([(s.class_context, s.group) for s in coded], [(s.mantissa_context, s.token) for s in coded])
    return _pack([_levels(_count(pair, shape)) for pair, shape in zip(pairs, _SHAPES, strict=True)])


def read(data: bytes) -> Tables:
    """Raises CorruptStream or TruncatedStream."""
    return Tables.of(*map(_frequencies, _unpack(data)))


def _count(pairs: Sequence[tuple[np.ndarray, np.ndarray]], shape: tuple[int, int]) -> Int[np.ndarray, "contexts symbols"]:
    counts = np.zeros(shape[0] * shape[1], np.int64)
    for context, symbol in pairs:
        counts += np.bincount((context * shape[1] + symbol).ravel(), minlength=len(counts))
    return counts.reshape(shape)


def _levels(counts: Int[np.ndarray, "contexts symbols"]) -> UInt8[np.ndarray, "contexts symbols"]:
    """Frequencies on a logarithmic scale, by integers, so that every machine finds the same."""
    share = np.maximum((counts << 16) // np.maximum(counts.sum(1, keepdims=True), 1), 1)
    octave = np.frexp(share.astype(np.float64))[1] - 1
    quarter = (share << 2 >> octave) & 3
    return np.where(counts > 0, 1 + 4 * octave + quarter, 0).astype(np.uint8)


def _frequencies(levels: UInt8[np.ndarray, "contexts symbols"]) -> UInt32[np.ndarray, "contexts symbols"]:
    """Frequencies that sum to TOTAL; a context that never came has its first symbol alone."""
    octave, quarter = np.divmod(levels.astype(np.int64) - 1, 4)
    weights = np.where(levels > 0, 2 * quarter + 9 << np.maximum(octave, 0), 0)
    weights[:, 0] += levels.sum(1) == 0
    frequencies = np.where(weights > 0, np.maximum(weights * TOTAL // weights.sum(1, keepdims=True), 1), 0)
    rows = np.arange(len(levels))
    frequencies[rows, frequencies.argmax(1)] += TOTAL - frequencies.sum(1)
    return frequencies.astype(np.uint32)


def _differences(levels: UInt8[np.ndarray, "contexts symbols"]) -> Int[np.ndarray, "contexts symbols"]:
    """Each level less that of the context before it."""
    return np.diff(levels.astype(np.int64), axis=0, prepend=0) % _LEVELS


def _pack(levels: Sequence[UInt8[np.ndarray, "contexts symbols"]]) -> bytes:
    symbols = np.concatenate([_differences(a).ravel() for a in levels])
    counts = np.bincount(symbols, minlength=_LEVELS)
    table = FrequencyTable.from_counts(counts)
    encoder = RangeEncoder()
    for symbol in symbols.tolist():
        encoder.encode(symbol, table)
    body = encoder.finish()
    return b"".join(map(varint, counts.tolist())) + varint(len(body)) + body


def _unpack(data: bytes) -> list[UInt8[np.ndarray, "contexts symbols"]]:
    reader = ByteReader(data)
    table = FrequencyTable.from_counts(np.array([reader.varint() for _ in range(_LEVELS)]))
    decoder = RangeDecoder(reader.take(reader.varint()))
    if reader.left:
        raise CorruptStream(f"{reader.left} bytes follow the float coder's tables")
    return [_read_levels(decoder, table, shape) for shape in _SHAPES]


def _read_levels(decoder, table: FrequencyTable, shape: tuple[int, int]) -> UInt8[np.ndarray, "contexts symbols"]:
    differences = np.array([decoder.decode(table) for _ in range(shape[0] * shape[1])]).reshape(shape)
    return (np.cumsum(differences, 0) % _LEVELS).astype(np.uint8)
