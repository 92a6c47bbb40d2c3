"""What a motion text has beside its template and its table, in few bytes: exceptions, line numbers, further digits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, Int64, UInt64

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..lossless import NumberTable
from ..squeeze import expand, squeeze
from .rule import POWERS, NumberRule, Numbers, extra_counts

_PACK = 12  # digits in 5 bytes: 10^12 < 2^40
_SAMPLE = 256  # rows by which a column chooses what to follow
# What the tiny numbers of a column are differences from: itself a number earlier, or the column `code - _BACK` to the left,
# which is 0 for none.
_NOTHING, _ITSELF, _BACK = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Layout:
    """The rest of a motion text.

    `cut` bytes are missing at the end. `trimmed` rows (start, stop) leave zeros at the end of their numbers away though
    the rule does not. `counts` are the rows at which the number of a row is not that of the row above plus one, and that
    number. `patches` are places and texts: place `row * (columns + 2)` stands before the row, the next one
    replaces it, and the others replace a number each. `extra` and `tiny`: see `Numbers`.
    """

    cut: int
    trimmed: tuple[tuple[int, int], ...]
    counts: tuple[tuple[int, int], ...]
    patches: tuple[tuple[int, bytes], ...]
    extra: UInt64[np.ndarray, "rows columns"]
    tiny: Int64[np.ndarray, "rows columns"]

    def pack(self, rule: NumberRule, table: NumberTable) -> bytes:
        """The bytes that `unpack` takes back: a bit for every part that there is, and those parts."""
        rows, places = [row for row, _ in self.counts], [place for place, _ in self.patches]
        tiny = _pack_tiny(self.tiny, table.integers == 0)
        parts = (
            (self.cut, varint(self.cut)),
            (self.trimmed, _pack_steps([edge for span in self.trimmed for edge in span])),
            (rows, _pack_steps(rows) + b"".join(varint(number) for _, number in self.counts)),
            (places, _pack_steps(places) + b"".join(varint(len(text)) + text for _, text in self.patches)),
            (tiny, varint(len(tiny)) + tiny),
        )
        flags = sum(1 << bit for bit, (there, _) in enumerate(parts) if there)
        extra = _pack_extra(self.extra, extra_counts(rule, table.decimals, table.integers))
        return bytes([flags]) + b"".join(part for there, part in parts if there) + extra

    @staticmethod
    def unpack(data: bytes, rule: NumberRule, table: NumberTable) -> Layout:
        """Raises CorruptStream or TruncatedStream."""
        if not 0 <= table.decimals <= rule.digits:
            raise CorruptStream(f"a table of {table.decimals} decimals for numbers of {rule.digits} digits")
        reader = ByteReader(data)
        flags = reader.byte()
        if flags > 31:
            raise CorruptStream(f"the layout of a motion text has parts {flags:#x}, wanted 0 to 0x1f")
        cut = reader.varint() if flags & 1 else 0
        edges = _read_steps(reader) if flags & 2 else []
        counts = tuple((row, reader.varint()) for row in _read_steps(reader)) if flags & 4 else ()
        patches = tuple((place, reader.take(reader.varint())) for place in _read_steps(reader)) if flags & 8 else ()
        tiny = _unpack_tiny(reader.take(reader.varint()) if flags & 16 else b"", table.integers == 0)
        extra = _unpack_extra(reader, extra_counts(rule, table.decimals, table.integers))
        if reader.left or len(edges) % 2:
            raise CorruptStream("the layout of a motion text does not end where it should")
        return Layout(cut, tuple(zip(edges[::2], edges[1::2], strict=True)), counts, patches, extra, tiny)

    def rows(self, table: NumberTable, rows: slice | np.ndarray) -> Numbers:
        """The numbers of some rows."""
        integers = table.integers[rows]
        negative = (integers < 0) | table.negative_zeros[rows]
        return Numbers(integers, negative, self.extra[rows], self.tiny[rows])


def _pack_steps(values: Iterable[int]) -> bytes:
    """A list of integers that grow."""
    values = list(values)
    return varint(len(values)) + b"".join(varint(b - a) for a, b in zip([0, *values], values, strict=False))


def _read_steps(reader: ByteReader) -> list[int]:
    count = reader.varint()
    if count > reader.left:
        reader.take(count)  # a byte each, at least: says how many are missing
    return np.cumsum([reader.varint() for _ in range(count)], dtype=np.int64).tolist()


def _pack_tiny(tiny: Int64[np.ndarray, "rows columns"], zero: Bool[np.ndarray, "rows columns"]) -> bytes:
    """The tiny numbers, column by column, as differences from what each column follows best."""
    used = np.flatnonzero(tiny.any(axis=0)).tolist() if tiny.any() else []
    if not used:
        return b""
    follows = np.full(tiny.shape[1], _NOTHING)
    follows[used] = [_followed(tiny[:_SAMPLE], zero[:_SAMPLE], column) for column in used]
    residual = np.concatenate([_differences(tiny, zero, c, int(follows[c])) for c in used])
    zigzag = (residual << 1 ^ residual >> 63).astype("<i8")
    planes = -(-int(zigzag.max()).bit_length() // 8)
    data = zigzag.view(np.uint8).reshape(-1, 8)[:, :planes].T.tobytes()
    return bytes([planes, *follows.tolist()]) + squeeze(data)


def _unpack_tiny(data: bytes, zero: Bool[np.ndarray, "rows columns"]) -> Int64[np.ndarray, "rows columns"]:
    if not data:
        return np.broadcast_to(np.int64(0), zero.shape)
    reader = ByteReader(data)
    planes, follows = reader.byte(), reader.take(zero.shape[1])
    sizes = np.where(np.frombuffer(follows, np.uint8) != _NOTHING, zero.sum(axis=0), 0)
    if planes > 6 or any(code > _BACK + c for c, code in enumerate(follows)):
        raise CorruptStream("the tiny numbers of a motion text follow columns that are none")
    rows = np.frombuffer(expand(reader.take(reader.left), int(sizes.sum()) * planes), np.uint8).reshape(planes, -1)
    zigzag = np.zeros((int(sizes.sum()), 8), np.uint8)
    zigzag[:, :planes] = rows.T
    values = zigzag.view("<i8")[:, 0].astype(np.int64)
    residual = np.split(values >> 1 ^ -(values & 1), np.cumsum(sizes)[:-1])
    tiny = np.zeros(zero.shape, np.int64)
    for c, code in enumerate(follows):
        if code == _ITSELF:
            tiny[zero[:, c], c] = np.cumsum(residual[c])
        elif code != _NOTHING:
            tiny[zero[:, c], c] = residual[c] + (tiny[zero[:, c], c - (code - _BACK)] if code > _BACK else 0)
    return tiny


def _followed(tiny: np.ndarray, zero: np.ndarray, column: int) -> int:
    """The code that makes the differences of a column smallest."""
    codes = range(_ITSELF, _BACK + min(column, 255 - _BACK) + 1)
    costs = []
    for code in codes:
        differences = _differences(tiny, zero, column, code).astype(np.float64)
        centre = np.median(differences) if code == _BACK and len(differences) else 0.0
        costs.append(np.log2(1 + np.abs(differences - centre)).sum())
    return codes[int(np.argmin(costs))]


def _differences(tiny: np.ndarray, zero: np.ndarray, column: int, code: int) -> Int64[np.ndarray, " n"]:
    rows = zero[:, column]
    own = tiny[rows, column]
    if code == _ITSELF:
        return np.diff(own, prepend=0)
    return own - tiny[rows, column - (code - _BACK)] if code > _BACK else own


def _pack_extra(extra: UInt64[np.ndarray, "rows columns"], counts: Int[np.ndarray, "rows columns"]) -> bytes:
    """A bit a column that repeats itself, and the digits of the others and of their first row, twelve in five bytes."""
    if not counts.any():
        return b""
    still = (extra == extra[:1]).all(axis=0) & (counts == counts[:1]).all(axis=0)
    values, lengths = _without_still(extra, still), _without_still(counts, still)
    ends = np.cumsum(lengths)
    digits = np.zeros(-(-int(ends[-1]) // _PACK) * _PACK, np.uint64)
    for place in range(int(lengths.max())):
        has = lengths > place
        digits[ends[has] - 1 - place] = values[has] // POWERS[place] % np.uint64(10)
    words = (digits.reshape(-1, _PACK) * POWERS[_PACK - 1 :: -1]).sum(axis=1, dtype=np.uint64)
    return np.packbits(still).tobytes() + words.astype(">u8").view(np.uint8).reshape(-1, 8)[:, 3:].tobytes()


def _unpack_extra(reader: ByteReader, counts: Int[np.ndarray, "rows columns"]) -> UInt64[np.ndarray, "rows columns"]:
    if not counts.any():
        return np.broadcast_to(np.uint64(0), counts.shape)
    columns = counts.shape[1]
    still = np.unpackbits(np.frombuffer(reader.take(-(-columns // 8)), np.uint8), count=columns).astype(bool)
    lengths = _without_still(counts, still)
    ends = np.cumsum(lengths)
    groups = -(-int(ends[-1]) // _PACK)
    words = np.zeros((groups, 8), np.uint8)
    words[:, 3:] = np.frombuffer(reader.take(groups * 5), np.uint8).reshape(groups, 5)
    words = words.view(">u8").astype(np.uint64)
    digits = (words // POWERS[_PACK - 1 :: -1] % np.uint64(10)).ravel()
    values = np.zeros(len(lengths), np.uint64)
    for place in range(int(lengths.max())):
        has = lengths > place
        values[has] += digits[ends[has] - 1 - place] * POWERS[place]
    extra = np.empty(counts.shape, np.uint64)
    extra[0] = values[:columns]
    extra[1:, ~still] = values[columns:].reshape(int((~still).sum()), len(counts) - 1).T
    extra[1:, still] = extra[0, still]
    return extra


def _without_still(table: np.ndarray, still: Bool[np.ndarray, " columns"]) -> np.ndarray:
    """The first row, and then the columns of the others that do not repeat it, one by one."""
    return np.concatenate([table[0], table[1:, ~still].T.ravel()])
