"""Channels that come back exactly: those that the whole corpus holds constant, free, and those that are always zero."""

from __future__ import annotations

import zlib

import numpy as np
from jaxtyping import Bool, Float

from ...errors import CorruptStream
from ...motion import Motion

# The value of every channel that is the same in all files of a corpus, NaN for the others.
Constants = Float[np.ndarray, " channels"]


def constants_of(values: Float[np.ndarray, "frames channels"]) -> Constants:
    """Of one motion."""
    return np.where((values == values[:1]).all(0), values[0], np.nan)


def write_constants(motion: Motion, usual: Constants) -> bytes:
    """Nothing where the channels that hold still are the usual ones; else a bit for each that is otherwise, packed."""
    mine = constants_of(motion.values)
    usual = _fitting(usual, len(mine))
    held = np.where(_still(usual), mine == usual, mine == 0)
    other = _still(usual) != held
    return zlib.compress(np.packbits(other).tobytes(), 9, wbits=-15) if other.any() else b""


def with_constants(
    values: Float[np.ndarray, "frames channels"], data: bytes, usual: Constants
) -> Float[np.ndarray, "frames channels"]:
    """The values with all constants put back. Raises CorruptStream."""
    usual = _fitting(usual, values.shape[1])
    still = _still(usual)
    if data:
        still = still ^ _read(data, values.shape[1])
    return np.where(still[None], np.where(np.isnan(usual), 0.0, usual)[None], values)


def _fitting(usual: Constants, channels: int) -> Constants:
    """Those of another rig say nothing."""
    return usual if len(usual) == channels else np.full(channels, np.nan)


def _still(usual: Constants) -> Bool[np.ndarray, " channels"]:
    return ~np.isnan(usual)


def _read(data: bytes, channels: int) -> Bool[np.ndarray, " channels"]:
    size = -(-channels // 8)
    try:
        bits = zlib.decompressobj(wbits=-15).decompress(data, size + 1)
    except zlib.error as error:
        raise CorruptStream(f"the stream's constant channels cannot be unpacked: {error}") from error
    if len(bits) != size:
        raise CorruptStream(f"the stream's constant channels take {len(bits)} bytes, wanted {size}")
    return np.unpackbits(np.frombuffer(bits, np.uint8))[:channels].astype(bool)
