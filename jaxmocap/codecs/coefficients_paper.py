"""LSDT coefficients as the paper words it: a fixed-length count a coefficient vector, Huffman positions and values.

Hou et al. 2016, section 3.1: "(1) the locations and values of nonzero elements, which are further entropy-coded using
lossless coding, i.e., Huffman codes; (2) the number of nonzero elements in each coefficient vector, which is encoded
using fixed-length encoding." A coefficient vector is the J components of one coordinate at one DCT frequency.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ..errors import CorruptStream
from .bitstream import BitReader, BitWriter
from .entropy import integers
from .entropy.huffman import HuffmanCode
from .quantise import PER_OCTAVE, STEPS

# Values -15..15 without 0 have a code each; the last symbol escapes to larger ones.
_LARGEST = 15
VALUE_SYMBOLS = 2 * _LARGEST + 1
STEP_CLASSES = STEPS // PER_OCTAVE


@dataclass(frozen=True)
class PaperCodes:
    """Code lengths from training: of positions for each coordinate, of values for each octave of the quantiser step."""

    position: Int[np.ndarray, "3 components"]
    value: Int[np.ndarray, "step_classes symbols"]

    @functools.cached_property
    def position_codes(self) -> list[HuffmanCode]:
        return [HuffmanCode(lengths) for lengths in self.position]

    @functools.cached_property
    def value_codes(self) -> list[HuffmanCode]:
        return [HuffmanCode(lengths) for lengths in self.value]


def value_symbol(value: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """The Huffman symbol of a nonzero value: magnitudes in order, negative before positive, then the escape."""
    magnitude = np.abs(value)
    return np.where(magnitude > _LARGEST, VALUE_SYMBOLS - 1, 2 * (magnitude - 1) + (np.asarray(value) > 0))


def encode_clips(
    clips: list[Int[np.ndarray, "3 frequencies components"]], codes: list[PaperCodes], step_index: int
) -> bytes:
    """One chunk: its clips in order, three coordinates each, one coefficient vector after another."""
    writer = BitWriter()
    for levels, c in zip(clips, codes, strict=True):
        value_code = c.value_codes[step_index // PER_OCTAVE]
        count_bits = levels.shape[2].bit_length()
        for d, position_code in enumerate(c.position_codes):
            frequency, position = np.nonzero(levels[d])
            value = levels[d][frequency, position]
            nonzeros = iter(zip(position.tolist(), value_symbol(value).tolist(), value.tolist(), strict=True))
            for count in np.bincount(frequency, minlength=levels.shape[1]).tolist():
                writer.write(count, count_bits)
                for at, symbol, level in itertools.islice(nonzeros, count):
                    position_code.write(writer, at)
                    value_code.write(writer, symbol)
                    _write_escaped(writer, level)
    return writer.to_bytes()


def decode_clips(
    data: bytes, lengths: list[int], components: int, codes: list[PaperCodes], step_index: int
) -> list[Int[np.ndarray, "3 frequencies components"]]:
    """The clips of a chunk. Raises CorruptStream where a vector has more nonzeros than components."""
    reader = BitReader(data)
    count_bits = components.bit_length()
    clips = []
    for length, c in zip(lengths, codes, strict=True):
        value_code = c.value_codes[step_index // PER_OCTAVE]
        levels = np.zeros((3, length, components), np.int32)
        for d, position_code in enumerate(c.position_codes):
            for k in range(length):
                count = reader.read(count_bits)
                if count > components:
                    raise CorruptStream(f"a vector of {components} coefficients says that {count} are not zero")
                for _ in range(count):
                    position = position_code.read(reader)
                    levels[d, k, position] = _read_value(reader, value_code)
        clips.append(levels)
    return clips


def _write_escaped(writer: BitWriter, value: int) -> None:
    """What follows the escape symbol; nothing where the value has a code of its own."""
    beyond = abs(value) - _LARGEST - 1
    if beyond >= 0:
        symbol, raw, bits = (int(a) for a in integers.split(np.array(beyond)))
        writer.write(symbol, 6)
        writer.write(raw, bits)
        writer.write(int(value < 0), 1)


def _read_value(reader: BitReader, code: HuffmanCode) -> int:
    symbol = code.read(reader)
    if symbol < VALUE_SYMBOLS - 1:
        magnitude = symbol // 2 + 1
        return magnitude if symbol & 1 else -magnitude
    symbol = reader.read(6)
    if symbol >= integers.SYMBOLS:
        raise CorruptStream("a chunk holds a value that no encoder wrote")
    magnitude = integers.join(symbol, reader.read(integers.raw_bits(symbol))) + _LARGEST + 1
    return -magnitude if reader.read(1) else magnitude
