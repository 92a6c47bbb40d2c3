"""What the lossless codecs are to an archive: tables of integers in, bytes out, and the same integers back."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int32


@dataclass(frozen=True, eq=False)
class NumberTable:
    """The numbers of a motion text, one row a frame: the text says `integers / 10**decimals`.

    `columns` name what a column is, as `joint channel` ("Hips Xposition", and "lfemur 1" where a file does not say
    which channel). `negative_zeros` marks the zeros that the text writes as "-0.0000".
    """

    columns: tuple[str, ...]
    integers: Int32[np.ndarray, "frames columns"]
    negative_zeros: Bool[np.ndarray, "frames columns"]
    decimals: int


def by_rig(tables: Sequence[NumberTable]) -> dict[tuple[tuple[str, ...], int], list[int]]:
    """The numbers of the tables of each rig; a rig has its columns and decimals."""
    rigs: dict[tuple[tuple[str, ...], int], list[int]] = {}
    for n, table in enumerate(tables):
        rigs.setdefault((table.columns, table.decimals), []).append(n)
    return rigs


class AbstractNumberCodec(eqx.Module):
    """A codec of number tables: what files share is coded once, and every table by itself.

    The bytes depend on the tables and their order alone: not on threads, time or the machine.
    """

    @abc.abstractmethod
    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        """What all need, and one payload a table; tables may be of several rigs, and have few frames or none."""

    @abc.abstractmethod
    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        """The tables of the numbers `which`, of which `payload` gives the bytes, and those of tables they lean on.

        Raises CorruptStream or TruncatedStream.
        """
