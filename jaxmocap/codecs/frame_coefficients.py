"""The bits of frame-by-frame coefficients: a fixed-length count a coefficient vector, Huffman positions and values.

Hou et al. 2016, section 3.1: "(1) the locations and values of nonzero elements, which are further entropy-coded using
lossless coding, i.e., Huffman codes; (2) the number of nonzero elements in each coefficient vector, which is encoded
using fixed-length encoding." A coefficient vector holds the components of one coordinate of one frame. Ours: a chunk's
first frame, which nothing predicts, has codes of its own, and values beyond 8 take a code for their size and raw bits.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..errors import CorruptStream
from .bitstream import BitReader, BitWriter
from .entropy import integers
from .entropy.huffman import HuffmanCode
from .quantise import PER_OCTAVE, STEPS

KINDS = 2  # first frames of chunks, and later ones
STEP_CLASSES = STEPS // PER_OCTAVE
VALUE_SYMBOLS = 2 * integers.SYMBOLS


class VectorCode(NamedTuple):
    """What codes the vectors of one coordinate of one kind of frame."""

    position: HuffmanCode
    value: HuffmanCode


@dataclass(frozen=True, eq=False)
class FrameCodes:
    """Code lengths from training, by kind of frame, octave of the quantiser step, and coordinate."""

    position: Int[np.ndarray, "kinds step_classes 3 components"]
    value: Int[np.ndarray, "kinds step_classes 3 symbols"]

    @property
    def components(self) -> int:
        return self.position.shape[-1]

    def of(self, index: int, frame: int) -> list[VectorCode]:
        """The codes of each coordinate for a frame of a chunk, by its number, at a step index."""
        return _vector_codes(self, index // PER_OCTAVE, min(frame, 1))

    def with_positions(self, later: Int[np.ndarray, "3 components"]) -> FrameCodes:
        """The codes for other components: of given lengths in later frames, all of one length in first ones."""
        first = np.full_like(later, max(1, (later.shape[1] - 1).bit_length()))
        both = np.stack([first, later])[:, None]
        return FrameCodes(np.broadcast_to(both, (KINDS, STEP_CLASSES, *later.shape)), self.value)


@functools.lru_cache(maxsize=64)
def _vector_codes(codes: FrameCodes, step_class: int, kind: int) -> list[VectorCode]:
    lengths = zip(codes.position[kind, step_class], codes.value[kind, step_class], strict=True)
    return [VectorCode(HuffmanCode(position), HuffmanCode(value)) for position, value in lengths]


def value_symbol(value: Int[np.ndarray, "*n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The Huffman symbol of nonzero values (size, negative before positive), and their raw bits with their number."""
    size, raw, count = integers.split(np.abs(value) - 1)
    return 2 * size + (np.asarray(value) > 0), raw, count


def encode_frames(
    levels: Int[np.ndarray, "frames 3 components"],
    codes: FrameCodes,
    index: int,
    count_bits: int,
    writers: Iterable[BitWriter],
) -> None:
    """Writes a chunk, each frame to a writer of its own or all to one.

    Counts of later frames take `count_bits` bits, those of the first as many as they may ever need.
    """
    frame, coordinate, position = np.nonzero(levels)
    value = value_symbol(levels[frame, coordinate, position])
    nonzeros = iter(zip(position.tolist(), *(part.tolist() for part in value), strict=True))
    for n, (counts, writer) in enumerate(zip((levels != 0).sum(2).tolist(), writers, strict=False)):
        width = count_bits if n else codes.components.bit_length()
        for count, code in zip(counts, codes.of(index, n), strict=True):
            writer.write(count, width)
            for at, symbol, raw, bits in itertools.islice(nonzeros, count):
                code.position.write(writer, at)
                code.value.write(writer, symbol)
                writer.write(raw, bits)


def decode_frames(
    data: bytes, frames: int, codes: FrameCodes, index: int, count_bits: int
) -> Int[np.ndarray, "frames 3 components"]:
    """The levels of a chunk. Raises CorruptStream where a vector has more nonzeros than components."""
    reader = BitReader(data)
    components = codes.components
    levels = np.zeros((frames, 3, components), np.int32)
    for n in range(frames if count_bits else 1):
        width = count_bits if n else components.bit_length()
        for d, code in enumerate(codes.of(index, n)):
            count = reader.read(width)
            if count > components:
                raise CorruptStream(f"a vector of {components} coefficients says that {count} are not zero")
            for _ in range(count):
                position = code.position.read(reader)
                levels[n, d, position] = _read_value(reader, code.value)
    return levels


def size_in_bits(levels: Int[np.ndarray, "frames 3 components"], codes: FrameCodes, index: int, count_bits: int) -> int:
    """How many bits `encode_frames` writes."""
    total = 3 * (codes.components.bit_length() + (len(levels) - 1) * count_bits)
    for n, frames in enumerate((levels[:1], levels[1:])):
        for d, code in enumerate(codes.of(index, n)):
            nonzero = frames[:, d] != 0
            symbol, _, raw_bits = value_symbol(frames[:, d][nonzero])
            total += int(nonzero.sum(0) @ code.position.lengths + code.value.lengths[symbol].sum() + raw_bits.sum())
    return total


def _read_value(reader: BitReader, code: HuffmanCode) -> int:
    symbol = code.read(reader)
    magnitude = 1 + integers.join(symbol >> 1, reader.read(integers.raw_bits(symbol >> 1)))
    return magnitude if symbol & 1 else -magnitude
