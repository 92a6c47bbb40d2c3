"""The signs of zeros: "-0.0000" says no more than "0.0000", and yet must come back.

Each column that holds zeros has a plane of bits, one a zero. A plane is constant, or that of an earlier column, or a few runs,
or plain bits; which of them is usual for a column, the rig model knows.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint

PLUS, MINUS, RUNS, BITS, FIRST_COPY = 0, 1, 2, 3, 4  # FIRST_COPY + n: the plane of column n
Modes = list[int]


def modes(zeros: Bool[np.ndarray, "frames columns"], negative: Bool[np.ndarray, "frames columns"]) -> Modes:
    """How each column's plane is best said; PLUS for a column without zeros."""
    return [_mode(c, zeros, negative) for c in range(zeros.shape[1])]


def encode(zeros: np.ndarray, negative: np.ndarray, usual: Sequence[int]) -> bytes:
    """The signs of all zeros: the columns whose mode is not the usual one, then their planes."""
    own = modes(zeros, negative)
    for c, mode in enumerate(usual):
        if _holds(mode, c, zeros, negative):  # what holds by itself costs nothing
            own[c] = mode
    changed = [c for c, mode in enumerate(own) if mode != usual[c]]
    out = [varint(len(changed))]
    for before, c in itertools.pairwise([-1, *changed]):
        out += [varint(c - before - 1), varint(own[c])]
    for c, mode in enumerate(own):
        if mode in (RUNS, BITS):
            out.append(_plane(mode, negative[zeros[:, c], c]))
    return b"".join(out)


def decode(reader: ByteReader, zeros: Bool[np.ndarray, "frames columns"], usual: Sequence[int]) -> np.ndarray:
    """What `encode` wrote. Raises TruncatedStream and CorruptStream."""
    own, at = list(usual), -1
    for _ in range(reader.varint()):
        at += reader.varint() + 1
        if at >= len(own):
            raise CorruptStream("the signs of zeros name a column that is none")
        own[at] = reader.varint()
    negative = np.zeros(zeros.shape, bool)
    for c, mode in enumerate(own):
        where = zeros[:, c]
        if mode >= FIRST_COPY:
            if mode - FIRST_COPY >= c:
                raise CorruptStream("the signs of a column are said to be those of a later one")
            negative[:, c] = negative[:, mode - FIRST_COPY] & where
        elif mode == MINUS:
            negative[:, c] = where
        elif mode == BITS:
            count = int(where.sum())
            packed = np.frombuffer(reader.take(-(-count // 8)), np.uint8)
            negative[where, c] = np.unpackbits(packed, count=count, bitorder="little")
        elif mode == RUNS:
            negative[where, c] = _from_runs(reader, int(where.sum()))
    return negative


def _holds(mode: int, c: int, zeros: np.ndarray, negative: np.ndarray) -> bool:
    where = zeros[:, c]
    if mode in (PLUS, MINUS):
        return bool((negative[where, c] == (mode == MINUS)).all())
    n = mode - FIRST_COPY
    return 0 <= n < c and bool((negative[:, c] == (negative[:, n] & where)).all())


def _mode(c: int, zeros: np.ndarray, negative: np.ndarray) -> int:
    if _holds(PLUS, c, zeros, negative):
        return PLUS
    if _holds(MINUS, c, zeros, negative):
        return MINUS
    for n in range(c):
        if zeros[:, n].any() and _holds(FIRST_COPY + n, c, zeros, negative):
            return FIRST_COPY + n
    plane = negative[zeros[:, c], c]
    return min((RUNS, BITS), key=lambda mode: len(_plane(mode, plane)))


def _plane(mode: int, plane: Bool[np.ndarray, " zeros"]) -> bytes:
    if mode == BITS:
        return np.packbits(plane, bitorder="little").tobytes()
    ends = np.flatnonzero(np.diff(plane, prepend=False, append=not plane[-1]))  # runs begin with plus
    return varint(len(ends)) + b"".join(varint(int(n)) for n in np.diff(ends, prepend=0))


def _from_runs(reader: ByteReader, count: int) -> Bool[np.ndarray, " zeros"]:
    if (runs := reader.varint()) > reader.left:
        reader.take(runs)  # says how many bytes are missing
    lengths = [reader.varint() for _ in range(runs)]
    if sum(lengths) != count:
        raise CorruptStream(f"the runs of signs cover {sum(lengths)} zeros of {count}")
    return np.repeat(np.arange(runs) % 2 == 1, np.array(lengths, np.int64))
