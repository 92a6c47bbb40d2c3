"""Range coding of symbols under frequency tables, and of raw bits, with the shortest ending that still decodes.

The stream is that of constriction's RangeEncoder (32-bit words, 64-bit state, 24-bit probabilities), most significant
byte first. Where constriction has no wheel, `PythonEncoder` and `PythonDecoder` write and read the same bytes.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ...errors import CorruptStream
from .tables import TABLE_BITS, FrequencyTable

try:
    from constriction import stream as constriction  # pyright: ignore[reportAttributeAccessIssue]
except ImportError:  # Linux on Arm has no wheel
    constriction: Any = None

_PRECISION = 24
_MASK = (1 << 64) - 1
_RAW_BITS = 12


class Encoder(Protocol):
    """Takes symbols and raw bits in order; `finish` gives the bytes.

    `encode_each` takes many symbols, each with frequencies of its own: a row of (symbols, alphabet) that sums to 65,536.
    """

    def encode(self, symbol: int, table: FrequencyTable) -> None: ...
    def encode_bits(self, value: int, count: int) -> None: ...
    def encode_each(self, symbols: np.ndarray, frequencies: np.ndarray) -> None: ...
    def finish(self) -> bytes: ...


class Decoder(Protocol):
    """Gives symbols and raw bits back in order; raises CorruptStream where no encoder wrote such bytes."""

    def decode(self, table: FrequencyTable) -> int: ...
    def decode_bits(self, count: int) -> int: ...
    def decode_each(self, frequencies: np.ndarray) -> np.ndarray: ...


class PythonEncoder:
    """The range encoder in plain integers."""

    def __init__(self) -> None:
        self._words: list[int] = []
        self._low, self._range = 0, _MASK

    def encode(self, symbol: int, table: FrequencyTable) -> None:
        starts = table.starts
        self._narrow(starts[symbol], starts[symbol + 1], TABLE_BITS)

    def encode_bits(self, value: int, count: int) -> None:
        for part_bits, part in _raw_parts(value, count):
            self._narrow(part, part + 1, part_bits)

    def encode_each(self, symbols: np.ndarray, frequencies: np.ndarray) -> None:
        for symbol, row in zip(symbols.tolist(), frequencies, strict=True):
            start = int(row[:symbol].sum())
            self._narrow(start, start + int(row[symbol]), TABLE_BITS)

    def _narrow(self, start: int, stop: int, bits: int) -> None:
        scale = self._range >> _PRECISION
        shift = _PRECISION - bits
        low = self._low + scale * (start << shift)
        self._range = scale * ((stop - start) << shift)
        if low > _MASK:
            at = len(self._words) - 1
            while self._words[at] == 0xFFFFFFFF:
                self._words[at] = 0
                at -= 1
            self._words[at] += 1
            low &= _MASK
        if self._range < 1 << 32:
            self._words.append(low >> 32)
            low = low << 32 & _MASK
            self._range <<= 32
        self._low = low

    def finish(self) -> bytes:
        words = int.from_bytes(b"".join(w.to_bytes(4, "big") for w in self._words), "big")
        return _shortest((words << 64) + self._low, self._range, 4 * len(self._words) + 8)


class PythonDecoder:
    """The range decoder in plain integers."""

    def __init__(self, data: bytes):
        padded = data + bytes(8 + -len(data) % 4)
        self._words = np.frombuffer(padded, ">u4").tolist()
        self._next = 2
        self._low, self._range = 0, _MASK
        self._point = self._words[0] << 32 | self._words[1]

    def decode(self, table: FrequencyTable) -> int:
        starts = table.starts
        quantile = self._quantile(TABLE_BITS)
        low, high = 0, len(starts) - 1
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if starts[middle] <= quantile else (low, middle)
        self._narrow(starts[low], starts[low + 1], TABLE_BITS)
        return low

    def decode_bits(self, count: int) -> int:
        value = 0
        for part_bits, _ in _raw_parts(0, count):
            part = self._quantile(part_bits)
            self._narrow(part, part + 1, part_bits)
            value = value << part_bits | part
        return value

    def decode_each(self, frequencies: np.ndarray) -> np.ndarray:
        symbols = []
        for stops in np.cumsum(frequencies, 1):
            symbol = int(np.searchsorted(stops, self._quantile(TABLE_BITS), "right"))
            self._narrow(int(stops[symbol - 1]) if symbol else 0, int(stops[symbol]), TABLE_BITS)
            symbols.append(symbol)
        return np.array(symbols, np.int64)

    def _quantile(self, bits: int) -> int:
        quantile = (self._point - self._low & _MASK) // (self._range >> _PRECISION)
        if quantile >> _PRECISION:
            raise CorruptStream("a chunk holds bytes that no encoder wrote")
        return quantile >> (_PRECISION - bits)

    def _narrow(self, start: int, stop: int, bits: int) -> None:
        scale = self._range >> _PRECISION
        shift = _PRECISION - bits
        self._low = self._low + scale * (start << shift) & _MASK
        self._range = scale * ((stop - start) << shift)
        if self._range < 1 << 32:
            self._low = self._low << 32 & _MASK
            self._range <<= 32
            word = self._words[self._next] if self._next < len(self._words) else 0
            self._point = self._point << 32 & _MASK | word
            self._next += 1


class ConstrictionEncoder:
    """The same by constriction, some ten times faster."""

    def __init__(self) -> None:
        self._coder = constriction.queue.RangeEncoder()

    def encode(self, symbol: int, table: FrequencyTable) -> None:
        self._coder.encode(symbol, _constriction_model(table))

    def encode_bits(self, value: int, count: int) -> None:
        for part_bits, part in _raw_parts(value, count):
            self._coder.encode(part, _UNIFORM[part_bits])

    def encode_each(self, symbols: np.ndarray, frequencies: np.ndarray) -> None:
        self._coder.encode(symbols.astype(np.int32), _EACH, _weights(frequencies))

    def finish(self) -> bytes:
        size = 4 * (self._coder.pos()[0] + 2)
        low, width = self._coder.pos()[1]
        # The words that constriction ends with lie inside the final interval, whose start is known modulo 2^64.
        words = np.asarray(self._coder.get_compressed()).astype(">u4").tobytes()
        inside = int.from_bytes(words.ljust(size, b"\0")[:size], "big")
        return _shortest(inside - (inside - low & _MASK), width, size)


class ConstrictionDecoder:
    """The same by constriction, some ten times faster."""

    def __init__(self, data: bytes):
        padded = data + bytes(8 + -len(data) % 4)
        self._coder = constriction.queue.RangeDecoder(np.frombuffer(padded, ">u4").astype(np.uint32))

    def decode(self, table: FrequencyTable) -> int:
        return self._decode(_constriction_model(table))

    def decode_bits(self, count: int) -> int:
        value = 0
        for part_bits, _ in _raw_parts(0, count):
            value = value << part_bits | self._decode(_UNIFORM[part_bits])
        return value

    def decode_each(self, frequencies: np.ndarray) -> np.ndarray:
        try:
            return self._coder.decode(_EACH, _weights(frequencies)).astype(np.int64)
        except AssertionError as error:
            raise CorruptStream("a chunk holds bytes that no encoder wrote") from error

    def _decode(self, model) -> int:
        try:
            return int(self._coder.decode(model))
        except AssertionError as error:
            raise CorruptStream("a chunk holds bytes that no encoder wrote") from error


def _raw_parts(value: int, count: int) -> list[tuple[int, int]]:
    """Raw bits in parts of at most 12, high ones first."""
    parts = []
    while count:
        bits = min(count, _RAW_BITS)
        count -= bits
        parts.append((bits, value >> count & ((1 << bits) - 1)))
    return parts


def _shortest(low: int, width: int, size: int) -> bytes:
    """The fewest bytes whose number, followed by zeros up to `size` bytes, lies in [low, low + width)."""
    for zeros in range(min(size, 8), -1, -1):
        unit = 1 << 8 * zeros
        point = -(-low // unit) * unit
        if point < low + width:
            return point.to_bytes(size, "big").rstrip(b"\0")
    raise AssertionError("an interval of a range coder is never empty")


def _constriction_model(table: FrequencyTable):
    """constriction's model with exactly the table's frequencies, made once a table.

    Its fast quantiser gives symbol i the probability floor(p_i * scale) + 1 with scale = (2^24 - n) / sum(p); weights
    that are whole numbers and sum to 2^24 - n make that exact in any float arithmetic.
    """
    model = table.__dict__.get("_constriction")
    if model is None:
        model = constriction.model.Categorical(_weights(table.frequencies), perfect=False)
        table.__dict__["_constriction"] = model
    return model


def _weights(frequencies: np.ndarray) -> np.ndarray:
    return ((frequencies << (_PRECISION - TABLE_BITS)) - 1).astype(np.float64)


if constriction is None:
    RangeEncoder: type[Encoder] = PythonEncoder
    RangeDecoder: type[PythonDecoder] | type[ConstrictionDecoder] = PythonDecoder
else:
    RangeEncoder = ConstrictionEncoder
    RangeDecoder = ConstrictionDecoder
    _EACH = constriction.model.Categorical(perfect=False)
    _UNIFORM = [None] + [constriction.model.Uniform(1 << bits) for bits in range(1, _RAW_BITS + 1)]
