"""A few bytes as a fountain of 16-bit symbols: whichever of them arrive, about as many as the bytes need are enough.

Symbol n is the value at n of the polynomial over GF(2^16) whose values at 4096, 4097, ... are the data (Reed and Solomon
1960). The receiver does not know how long the data are: it takes them to be whole when the symbols that came last
foretell one more, and the checksum inside holds.
"""

from __future__ import annotations

import functools
import zlib

import numpy as np

POINTS = 1 << 12  # symbols of numbers below this can be sent
SYMBOL_BITS = 16
_ORDER = (1 << SYMBOL_BITS) - 1
_POLYNOMIAL = 0x1100B
_CHECK_BYTES = 2
MOST_BYTES = 2 * (POINTS // 4) - _CHECK_BYTES


class Fountain:
    """Gives symbols of `data`. Raises ValueError where these are too many bytes."""

    def __init__(self, data: bytes):
        if len(data) > MOST_BYTES:
            raise ValueError(f"{len(data)} bytes are too many for a fountain, which takes {MOST_BYTES}")
        whole = data + _check(data)
        whole += bytes(len(whole) % 2)
        self._values = np.frombuffer(whole, ">u2").astype(np.int64)
        self._points = POINTS + np.arange(len(self._values))

    @property
    def needed(self) -> int:
        """How many symbols a receiver needs, at least."""
        return len(self._values) + 1

    def symbol(self, number: int) -> int:
        return int(_interpolated(self._points, self._values, np.array([number % POINTS]))[0])


class Basin:
    """Gathers symbols until those that came last are whole: one that is false spoils nothing but those before it.

    Kept are Newton's divided differences: one of order k that is zero says that k symbols foretold one more.
    """

    def __init__(self) -> None:
        self._symbols: dict[int, int] = {}
        self._differences: list[int] = []  # over the last symbol, the last two, and so on

    def __len__(self) -> int:
        return len(self._symbols)

    def add(self, number: int, symbol: int) -> bytes | None:
        """The data, as soon as there are enough symbols."""
        if number in self._symbols:
            return None
        if len(self._symbols) == POINTS // 2:
            self.__init__()
        differences = [symbol]
        for point, before in zip(reversed(self._symbols), self._differences, strict=True):
            differences.append(_quotient(differences[-1] ^ before, number ^ point))
        self._symbols[number], self._differences = symbol, differences
        for count in range(1, len(differences)):
            data = self._data(count) if differences[count] == 0 else None
            if data is not None:
                return data
        return None

    def _data(self, count: int) -> bytes | None:
        """What the last `count` symbols say, where the checksum holds."""
        points, values = (np.array(list(x)[-count:], np.int64) for x in (self._symbols, self._symbols.values()))
        whole = _interpolated(points, values, POINTS + np.arange(count)).astype(">u2").tobytes()
        for stop in (len(whole) - _CHECK_BYTES, len(whole) - _CHECK_BYTES - 1):
            if stop >= 0 and whole[stop:].rstrip(b"\0") == _check(whole[:stop]).rstrip(b"\0"):
                return whole[:stop]
        return None


def _quotient(value: int, divisor: int) -> int:
    powers, logarithms = _tables()
    return int(powers[(logarithms[value] - logarithms[divisor]) % _ORDER]) if value else 0


def _check(data: bytes) -> bytes:
    return (zlib.crc32(data) & 0xFFFF).to_bytes(_CHECK_BYTES, "big")


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Powers of the generator, twice over, and logarithms."""
    powers, logarithms, value = np.zeros(2 * _ORDER, np.int64), np.zeros(_ORDER + 1, np.int64), 1
    for n in range(_ORDER):
        powers[n], logarithms[value] = value, n
        value <<= 1
        value ^= _POLYNOMIAL if value > _ORDER else 0
    powers[_ORDER:] = powers[:_ORDER]
    return powers, logarithms


def _interpolated(points: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Lagrange's polynomial through (points, values), which differ, at other points."""
    powers, log = _tables()
    apart = log[points[:, None] ^ points[None]]
    np.fill_diagonal(apart, 0)
    below = apart.sum(1)  # of the product over the other points
    to = log[at[:, None] ^ points[None]]
    above = to.sum(1, keepdims=True) - to
    terms = powers[(log[values][None] + above - below[None]) % _ORDER]
    return np.bitwise_xor.reduce(np.where(values[None] != 0, terms, 0), 1)
