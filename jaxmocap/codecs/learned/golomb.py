"""Small integers of unknown size in raw bits (Exp-Golomb)."""

from __future__ import annotations

from ...errors import CorruptStream
from ..entropy.range_coder import Decoder, Encoder

_MOST_OCTAVES = 24


def write_unsigned(encoder: Encoder, value: int, order: int) -> None:
    """An integer of 0 and more in order + 1 bits or some more."""
    shifted = value + (1 << order)
    extra = shifted.bit_length() - 1 - order
    for _ in range(extra):
        encoder.encode_bits(1, 1)
    encoder.encode_bits(0, 1)
    encoder.encode_bits(shifted - (1 << extra + order), extra + order)


def read_unsigned(decoder: Decoder, order: int) -> int:
    """Raises CorruptStream where it is beyond all measure."""
    extra = 0
    while decoder.decode_bits(1):
        extra += 1
        if extra > _MOST_OCTAVES:
            raise CorruptStream("a chunk counts beyond all measure")
    return (1 << extra + order | decoder.decode_bits(extra + order)) - (1 << order)


def write_signed(encoder: Encoder, value: int, order: int) -> None:
    write_unsigned(encoder, 2 * value - 1 if value > 0 else -2 * value, order)


def read_signed(decoder: Decoder, order: int) -> int:
    unsigned = read_unsigned(decoder, order)
    return (unsigned + 1) // 2 if unsigned & 1 else -(unsigned // 2)
