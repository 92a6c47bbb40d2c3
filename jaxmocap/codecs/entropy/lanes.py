"""rANS in lanes (Duda 2013; Giesen 2014): many states advance together, so that a step of decoding is vector arithmetic.

Every lane has a 32-bit state, and all lanes take 16-bit words from one stream, in lane order. All functions work on
NumPy and, inside `lax.scan`, on JAX arrays: `xp` is the module. Everything is uint32, so that all machines agree.
"""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Int32, UInt16, UInt32

from ...errors import CorruptStream
from ..bitstream import ByteReader

PROBABILITY_BITS = 14
TOTAL = 1 << PROBABILITY_BITS
_LOWEST = 1 << 16  # states lie in [_LOWEST, 2^32) between symbols
U32 = np.uint32

Lanes32 = UInt32[np.ndarray, " lanes"] | UInt32[Array, " lanes"]


class Decoding(NamedTuple):
    """States of all lanes, and how many words have been taken."""

    states: Lanes32
    at: Int32[np.ndarray, ""] | Int32[Array, ""]


def slots(d: Decoding) -> Lanes32:
    """For every lane the point of [0, TOTAL) that its next symbol's interval holds."""
    return d.states & U32(TOTAL - 1)


def advance(xp: ModuleType, d: Decoding, words: Array | np.ndarray, start: Lanes32, frequency: Lanes32) -> Decoding:
    """Takes one symbol off every lane, given its interval; a frequency of TOTAL leaves a lane as it is.

    `words` (uint32, each below 2^16) must hold as many spare words behind its end as there are lanes.
    """
    states = (d.states >> U32(PROBABILITY_BITS)) * frequency + slots(d) - start
    short = states < U32(_LOWEST)
    place = prefix_sums(xp, short)
    taken = words[xp.minimum(d.at + place - 1, np.int32(len(words) - 1))]
    return Decoding(xp.where(short, states << U32(16) | taken, states), d.at + place[-1])


def take_bits(xp: ModuleType, at, words: Array | np.ndarray, count):
    """Reads `count` (int32, 0..28) plain bits for every lane from a bit stream that has come to bit `at`.

    `words` (uint32, the lowest bit first) must hold one spare word a lane behind its end. Gives the bits, and the new place.
    """
    ends = at + prefix_sums(xp, count)
    begins = ends - count
    place = xp.minimum(begins >> 5, np.int32(len(words) - 2))
    inside = (begins & 31).astype(np.uint32)
    window = words[place] >> inside | words[place + 1] << U32(1) << (U32(31) - inside)
    return window & ((U32(1) << count.astype(np.uint32)) - U32(1)), ends[-1]


def prefix_sums(xp: ModuleType, x):
    """Sums of the first 1, 2, ... lanes (int32, below 2^24); a product with a triangle, which XLA runs faster than its scan."""
    if xp is np:
        return np.cumsum(x, dtype=np.int32)
    triangle = np.tril(np.ones((len(x), len(x)), np.float32))
    return jax.lax.dot(triangle, x.astype(np.float32), precision="highest").astype(np.int32)


def encode(
    starts: UInt16[np.ndarray, "symbols lanes"],
    frequencies: UInt16[np.ndarray, "symbols lanes"],
    rest: UInt16[np.ndarray, " lanes"],
) -> tuple[UInt32[np.ndarray, " lanes"], UInt16[np.ndarray, " words"]]:
    """The states that decoding begins with, and the words, of symbols whose intervals are given in parts of TOTAL.

    A frequency of TOTAL codes nothing. `rest` are 16 bits a lane that decoding ends with: else they would be wasted.
    """
    states = rest + U32(_LOWEST)
    words = np.zeros(starts.shape, np.uint16)
    given = np.zeros(starts.shape, bool)
    for n in range(len(starts) - 1, -1, -1):
        frequency = frequencies[n].astype(np.uint32)
        full = states >> U32(32 - PROBABILITY_BITS) >= frequency
        given[n] = full
        words[n] = states & U32(0xFFFF)
        states = np.where(full, states >> U32(16), states)
        quotient = states // frequency
        states = (quotient << U32(PROBABILITY_BITS)) + (states - quotient * frequency) + starts[n]
    return states, words[given]


def rest(d: Decoding) -> UInt16[np.ndarray, " lanes"]:
    """The 16 bits a lane that the encoder put where it began. Raises CorruptStream where it cannot have ended so."""
    states = np.asarray(d.states) - U32(_LOWEST)
    if (states > 0xFFFF).any():
        raise CorruptStream("the lanes of a payload do not end where an encoder begins")
    return states.astype(np.uint16)


def pack_states(states: UInt32[np.ndarray, " lanes"]) -> bytes:
    """Four bits a lane for the place of the state's highest bit, then all bits below it."""
    lengths = np.frexp(states.astype(np.float64))[1].astype(np.int32) - 1
    return pack_bits(lengths - 16, np.full(len(states), 4)) + pack_bits(states - (U32(1) << lengths.astype(np.uint32)), lengths)


def unpack_states(reader: ByteReader, lanes: int) -> UInt32[np.ndarray, " lanes"]:
    """The states from where the reader is. Raises TruncatedStream."""
    fours = reader.take(-(-4 * lanes // 8))
    lengths = unpack_bits(fours, np.full(lanes, 4)) + U32(16)
    below = reader.take(-(-int(lengths.sum()) // 8))
    return unpack_bits(below, lengths.astype(np.int64)) + (U32(1) << lengths)


def pack_bits(values: np.ndarray, counts: np.ndarray) -> bytes:
    """The `counts` (0..32) low bits of every value, one after the other, the lowest bit first."""
    counts = counts.astype(np.int64)
    owner = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]
    bits = values.astype(np.uint32)[owner] >> place.astype(np.uint32) & U32(1)
    return np.packbits(bits.astype(np.uint8), bitorder="little").tobytes()


def unpack_bits(data: bytes, counts: np.ndarray) -> UInt32[np.ndarray, " n"]:
    """What `pack_bits` packed."""
    words = np.frombuffer(data + bytes(-len(data) % 4 + 8), "<u4").astype(np.uint32)
    begins = np.cumsum(counts) - counts
    inside = (begins & 31).astype(np.uint32)
    window = words[begins >> 5] >> inside | words[(begins >> 5) + 1] << U32(1) << (U32(31) - inside)
    return window & (U32(0xFFFFFFFF) >> (32 - counts).astype(np.uint32))
