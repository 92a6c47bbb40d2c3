"""Adaptive binary range coding: chances begin at a two-sided geometric law and learn as they go, so nothing is trained.

One walk serves both ways: it hands every bit or integer to a coder, which gives it back. A writer codes what it is given;
a reader takes no notice of it, and gives what it reads. Chances are integers, so that both see the same.
"""

from __future__ import annotations

import functools
import math
from typing import Protocol

import numpy as np

from . import integers
from .range_coder import RangeDecoder, RangeEncoder
from .tables import TABLE_BITS, TOTAL, FrequencyTable

_CELL_BITS = 6  # chances are told apart in parts of 1024
_LEAST = 48
_PATIENCE, _MOST_PATIENT = 12, 64
SIXTEENTHS = 16


class Coder(Protocol):
    """Takes and gives bits: `chance` is that of a one, in parts of 65,536, when its context is met first."""

    def bit(self, context: int, chance: int, value: int) -> int: ...
    def raw(self, count: int, value: int) -> int: ...


class _Chance:
    """The chance of a one in a context."""

    __slots__ = ("one", "patience")

    def __init__(self, one: int):
        self.one, self.patience = one, _PATIENCE

    def learn(self, bit: int) -> None:
        one = self.one + ((TOTAL if bit else 0) - self.one) // self.patience
        self.one = min(max(one, _LEAST), TOTAL - _LEAST)
        if self.patience < _MOST_PATIENT:
            self.patience += 1


class Writer:
    """Codes what it is given."""

    def __init__(self) -> None:
        self._coder, self._chances = RangeEncoder(), dict[int, _Chance]()

    def bit(self, context: int, chance: int, value: int) -> int:
        now = self._chances.get(context) or self._chances.setdefault(context, _Chance(chance))
        self._coder.encode(value, _table(now.one >> _CELL_BITS))
        now.learn(value)
        return value

    def raw(self, count: int, value: int) -> int:
        self._coder.encode_bits(value, count)
        return value

    def finish(self) -> bytes:
        return self._coder.finish()


class Reader:
    """Gives what a writer was given. Raises CorruptStream where no writer wrote such bytes."""

    def __init__(self, data: bytes):
        self._coder, self._chances = RangeDecoder(data), dict[int, _Chance]()

    def bit(self, context: int, chance: int, value: int) -> int:
        now = self._chances.get(context) or self._chances.setdefault(context, _Chance(chance))
        value = self._coder.decode(_table(now.one >> _CELL_BITS))
        now.learn(value)
        return value

    def raw(self, count: int, value: int) -> int:
        return self._coder.decode_bits(count)


def code_unsigned(coder: Coder, context: int, law: tuple[int, ...], value: int) -> int:
    """An integer of 0 and more: its symbol (integers.py) in unary, then its raw bits. Contexts are numbered as callers like."""
    symbol, raw = _split(value)
    at = 0
    while at < integers.SYMBOLS - 1 and coder.bit(context * integers.SYMBOLS + at, law[at], int(symbol > at)):
        at += 1
    bits = integers.raw_bits(at)
    return integers.join(at, coder.raw(bits, raw)) if bits else at


def code_signed(coder: Coder, context: int, law: tuple[int, ...], value: int) -> int:
    """Its magnitude, then a bit for its sign."""
    magnitude = code_unsigned(coder, context, law, abs(value))
    return magnitude and (-magnitude if coder.raw(1, int(value < 0)) else magnitude)


@functools.cache
def law(mean: int) -> tuple[int, ...]:
    """For each symbol the chance that a magnitude goes beyond it, given that it comes so far, in parts of 65,536.

    Of the two-sided geometric law whose mean magnitude is `mean` sixteenths, at least one; by integers alone.
    """
    # theta, the ratio of neighbouring chances, solves mean = 2 theta / (1 - theta^2).
    root = math.isqrt((SIXTEENTHS**2 + mean**2) << 2 * TABLE_BITS)
    theta = (root - (SIXTEENTHS << TABLE_BITS)) // mean
    chances = [2 * theta * TOTAL // (TOTAL + theta)]
    for symbol in range(1, integers.SYMBOLS):
        beyond = TOTAL
        for _ in range(integers.raw_bits(symbol)):
            beyond = beyond * beyond // TOTAL if beyond < TOTAL else theta * theta // TOTAL
        chances.append(theta if beyond == TOTAL else beyond)
    return tuple(min(max(c, _LEAST), TOTAL - _LEAST) for c in chances)


def _split(value: int) -> tuple[int, int]:
    """Symbol and raw bits of one integer, as integers.split gives them for many."""
    if value < 8:
        return value, 0
    octave = value.bit_length() - 1
    return 8 + 2 * (octave - 3) + (value >> octave - 1 & 1), value & (1 << octave - 1) - 1


@functools.cache
def _table(cell: int) -> FrequencyTable:
    """The table of a bit whose chance lies in a cell."""
    one = (2 * cell + 1) << _CELL_BITS - 1
    return FrequencyTable(np.array([TOTAL - one, one]))
