"""The coded motion of a chunk: its step, its direction, jumps, levels and corrections, in one range-coded string."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import JaxmocapError
from ..entropy import integers
from ..entropy.range_coder import RangeDecoder, RangeEncoder
from . import bands
from .basis import DIRECTIONS, Basis
from .coefficients import Densities, Levels, decode_levels, encode_levels
from .corrections import NO_CORRECTIONS, Corrections, decode_corrections, encode_corrections
from .jumps import Jumps, decode_jumps, encode_jumps

_STEP_BITS = 8
_DIRECTION_BITS = DIRECTIONS.bit_length() - 1


class Coded(NamedTuple):
    """All integers of a chunk: what the encoder chose, and what the decoder reads."""

    direction: int
    jumps: Jumps
    levels: Levels
    corrections: Corrections = NO_CORRECTIONS

    def coefficients(self, step: float) -> Float[np.ndarray, "frames components"]:
        """In cm, jumps and all."""
        y = bands.inverse([band * step for band in self.levels])
        if len(self.jumps.frames):
            y = y + self.jumps.shift(len(y), step)
        if len(self.corrections.level):
            y = y + self.corrections.shift(len(y), len(self.levels) - 1, y.shape[1], step)
        return y


def write_payload(coded: Coded, step_index: int, basis: Basis, densities: Densities) -> bytes:
    """Raises JaxmocapError where levels are too large to be coded."""
    if max(np.abs(x).max(initial=0) for x in (*coded.levels, coded.jumps.levels)) >= integers.LIMIT:
        raise JaxmocapError("the motion goes too far for so small an error: it is out of this codec's reach")
    encoder = RangeEncoder()
    encoder.encode_bits(step_index, _STEP_BITS)
    encoder.encode_bits(coded.direction, _DIRECTION_BITS)
    encode_jumps(encoder, coded.jumps, basis.spectrum, step_index, densities)
    encode_levels(encoder, coded.levels, basis.spectrum, step_index, densities)
    frames, octaves = sum(len(band) for band in coded.levels), len(coded.levels) - 1
    encode_corrections(encoder, coded.corrections, frames, octaves, basis.components)
    return encoder.finish()


def read_payload(data: bytes, frames: int, octaves: int, basis: Basis, densities: Densities) -> tuple[int, Coded]:
    """The step's index, and all integers. Raises CorruptStream where no encoder wrote such bytes."""
    decoder = RangeDecoder(data)
    step_index = decoder.decode_bits(_STEP_BITS)
    direction = decoder.decode_bits(_DIRECTION_BITS)
    jumps = decode_jumps(decoder, frames, basis.spectrum, step_index, densities)
    levels = decode_levels(decoder, frames, octaves, basis.spectrum, step_index, densities)
    corrections = decode_corrections(decoder, frames, octaves, basis.components)
    return step_index, Coded(direction, jumps, levels, corrections)
