"""Frequency tables: the integers that alone steer the entropy coders."""

from __future__ import annotations

import functools

import numpy as np

TABLE_BITS = 16
TOTAL = 1 << TABLE_BITS


class FrequencyTable:
    """How often each symbol comes, in parts of 65,536: `frequencies` are at least 1 and sum to that."""

    def __init__(self, frequencies: np.ndarray):
        """Raises ValueError where the frequencies are not positive integers that sum to 65,536."""
        self.frequencies = np.asarray(frequencies, np.int64)
        if self.frequencies.ndim != 1 or (self.frequencies < 1).any() or self.frequencies.sum() != TOTAL:
            raise ValueError(f"frequencies must be at least 1 and sum to {TOTAL}, got {self.frequencies.sum()}")

    @staticmethod
    def from_counts(counts: np.ndarray) -> FrequencyTable:
        """The table nearest to the counts in which every symbol stays possible."""
        counts = np.asarray(counts, np.int64)
        spare = TOTAL - len(counts)
        frequencies = 1 + counts * spare // max(int(counts.sum()), 1)
        frequencies[np.argmax(frequencies)] += TOTAL - frequencies.sum()
        return FrequencyTable(frequencies)

    @functools.cached_property
    def starts(self) -> list[int]:
        """Cumulative frequency below every symbol, and the total."""
        return [0, *np.cumsum(self.frequencies).tolist()]


def pack_tables(tables: list[FrequencyTable]) -> np.ndarray:
    """Tables of one length as uint16 rows (each frequency less one), for a model file."""
    return np.stack([t.frequencies - 1 for t in tables]).astype(np.uint16)


def unpack_tables(rows: np.ndarray) -> list[FrequencyTable]:
    return [FrequencyTable(row.astype(np.int64) + 1) for row in rows]
