"""Canonical Huffman codes: the code lengths alone are the model."""

from __future__ import annotations

import functools
import heapq

import numpy as np

from ...errors import CorruptStream
from ..bitstream import BitReader, BitWriter

MAX_LENGTH = 16


def code_lengths(counts: np.ndarray) -> np.ndarray:
    """Length in bits of every symbol's Huffman code, at most 16; a symbol never seen counts as one sight in many."""
    weights = np.asarray(counts, np.int64) + 1
    while True:
        lengths = _lengths(weights)
        if lengths.max() <= MAX_LENGTH:
            return lengths.astype(np.uint8)
        weights = (weights + 1) // 2


def _lengths(weights: np.ndarray) -> np.ndarray:
    if len(weights) == 1:
        return np.ones(1, np.int64)
    heap: list[tuple[int, int, tuple[int, ...]]] = [(int(w), n, (n,)) for n, w in enumerate(weights)]
    heapq.heapify(heap)
    lengths = np.zeros(len(weights), np.int64)
    while len(heap) > 1:
        a, b = heapq.heappop(heap), heapq.heappop(heap)
        lengths[list(a[2] + b[2])] += 1
        heapq.heappush(heap, (a[0] + b[0], min(a[1], b[1]), a[2] + b[2]))
    return lengths


class HuffmanCode:
    """A canonical code: shorter codes first, symbols in order within a length."""

    def __init__(self, lengths: np.ndarray):
        """Raises ValueError where the lengths make no prefix code."""
        self.lengths = np.asarray(lengths, np.int64)
        kraft = (2.0 ** -self.lengths).sum()
        if (self.lengths < 1).any() or (self.lengths > MAX_LENGTH).any() or kraft > 1:
            raise ValueError(f"code lengths must lie in 1..{MAX_LENGTH} and satisfy Kraft's inequality, sum {kraft}")
        self.codes = np.zeros(len(self.lengths), np.int64)
        code, previous = 0, 0
        for symbol in np.lexsort((np.arange(len(self.lengths)), self.lengths)).tolist():
            code <<= int(self.lengths[symbol]) - previous
            previous = int(self.lengths[symbol])
            self.codes[symbol] = code
            code += 1

    def write(self, writer: BitWriter, symbol: int) -> None:
        writer.write(*self._words[symbol])

    def read(self, reader: BitReader) -> int:
        """The next symbol; raises CorruptStream where the bits begin no code."""
        symbols, lengths = self._lookup_table
        window = reader.peek(self._longest)
        length = lengths[window]
        if not length:
            raise CorruptStream("a chunk holds a code that no encoder wrote")
        reader.skip(length)
        return symbols[window]

    @functools.cached_property
    def _words(self) -> list[tuple[int, int]]:
        return list(zip(self.codes.tolist(), self.lengths.tolist(), strict=True))

    @functools.cached_property
    def _longest(self) -> int:
        return int(self.lengths.max())

    @functools.cached_property
    def _lookup_table(self) -> tuple[list[int], list[int]]:
        """Symbol and length for every window of the longest code's length; length 0 where no code begins so."""
        symbols = np.zeros(1 << self._longest, np.int64)
        lengths = np.zeros(1 << self._longest, np.int64)
        for symbol, (code, length) in enumerate(zip(self.codes, self.lengths, strict=True)):
            spare = self._longest - int(length)
            symbols[int(code) << spare : int(code) + 1 << spare] = symbol
            lengths[int(code) << spare : int(code) + 1 << spare] = length
        return symbols.tolist(), lengths.tolist()
