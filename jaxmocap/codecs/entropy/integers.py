"""Unsigned integers of any size as a symbol of a small alphabet and a few raw bits (Exp-Golomb with half octaves)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

EXACT = 8  # below, a value is its own symbol
SYMBOLS = 48
LIMIT = 1 << 23  # the first integer with no symbol


def split(values: Int[np.ndarray, "*n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbol, raw bits and their number. Below 8 a value is its own symbol, above it two symbols an octave.

    Raises ValueError for values of 2^23 and more.
    """
    values = np.asarray(values, np.int64)
    if values.size and (values.min() < 0 or values.max() >= LIMIT):
        raise ValueError(f"integers must lie in 0..{LIMIT - 1}, got {values.min()}..{values.max()}")
    octave = np.frexp(np.maximum(values, 1).astype(np.float64))[1] - 1
    large = values >= EXACT
    count = np.where(large, octave - 1, 0)
    symbol = np.where(large, EXACT + 2 * (octave - 3) + (values >> np.maximum(octave - 1, 0) & 1), values)
    return symbol, np.where(large, values & ((1 << count) - 1), 0), count


def raw_bits(symbol: int) -> int:
    """How many raw bits follow the symbol."""
    return 0 if symbol < EXACT else (symbol - EXACT) // 2 + 2


def join(symbol: int, raw: int) -> int:
    """The integer of a symbol and its raw bits."""
    if symbol < EXACT:
        return symbol
    octave = (symbol - EXACT) // 2 + 3
    return (2 + (symbol & 1) << octave - 1) + raw
