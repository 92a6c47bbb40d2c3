"""The alpha parallelogram predictor: Wang, Pan, Zhang, Lau, Song, Information Sciences 232, 2013. The comparator of `mrpa`.

A degree of freedom moves with one that is already known in the frame, its neighbour in the same joint or a joint before
it: x(t) = x(t-1) + alpha (y(t) - y(t-1)), where y and alpha, out of a table, are chosen for every channel. The float
coder and its tables are those of `mrpa`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int, Int32

from ..errors import CorruptStream
from . import float_coding, float_streams, float_tables, number_groups
from .bitstream import ByteReader
from .entropy import lanes
from .float_coding import LIMIT, Floats, no_floats
from .lossless import AbstractNumberCodec, NumberTable
from .number_groups import Group

ALPHAS = np.arange(-16, 17)  # eighths
_SELF = 0  # a neighbour so many channels back: none


class App(AbstractNumberCodec):
    """The codec; `neighbours` tells how many joints before its own a channel may move with: 1, its parent in most files."""

    neighbours: int = 1

    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        return number_groups.encode(tables, self._encode_group)

    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        return number_groups.decode(shared, payload, which, _decode_group)
