"""The coded motion of a chunk: its step, its direction, jumps, levels and corrections, in one range-coded string.

A chunk may come in layers, from coarse to fine, each a string of its own that holds what those before it left over.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import JaxmocapError
from ..entropy import integers
from ..entropy.range_coder import RangeDecoder, RangeEncoder
from . import bands
from .basis import DIRECTIONS, Basis
from .coefficients import Densities, Levels, decode_levels, encode_levels, leftover
from .corrections import NO_CORRECTIONS, Corrections, decode_corrections, encode_corrections
from .jumps import Jumps, decode_jumps, encode_jumps
from .spectrum import Expectation, Spectrum
from .steps import STEP_BITS, step_cm

_DIRECTION_BITS = DIRECTIONS.bit_length() - 1


class Coded(NamedTuple):
    """All integers of a layer: what the encoder chose, and what the decoder reads."""

    step_index: int
    direction: int
    jumps: Jumps
    levels: Levels
    corrections: Corrections = NO_CORRECTIONS

    @property
    def step(self) -> float:
        """In cm."""
        return step_cm(self.step_index)

    def coefficients(self) -> Float[np.ndarray, "frames components"]:
        """In cm, jumps and all."""
        y = bands.inverse([band * self.step for band in self.levels])
        if len(self.jumps.frames):
            y = y + self.jumps.shift(len(y), self.step)
        if len(self.corrections.level):
            y = y + self.corrections.shift(len(y), len(self.levels) - 1, y.shape[1], self.step)
        return y


def coefficients_of(layers: Sequence[Coded]) -> Float[np.ndarray, "frames components"] | float:
    """Of all layers together, in cm."""
    return sum((layer.coefficients() for layer in layers), 0.0)


def expectation_of(spectrum: Spectrum, coarser: Sequence[Coded], densities: Densities) -> Expectation:
    """Of a layer's levels, once all coarser layers are known."""
    expectation: Expectation = spectrum
    for layer in coarser:
        expectation = leftover(layer.levels, expectation, spectrum, layer.step_index, densities)
    return expectation


def write_payload(coded: Coded, coarser: Sequence[Coded], basis: Basis, densities: Densities) -> bytes:
    """Raises JaxmocapError where levels are too large to be coded."""
    if max(np.abs(x).max(initial=0) for x in (*coded.levels, coded.jumps.levels)) >= integers.LIMIT:
        raise JaxmocapError("the motion goes too far for so small an error: it is out of this codec's reach")
    encoder = RangeEncoder()
    encoder.encode_bits(coded.step_index, STEP_BITS)
    if not coarser:
        encoder.encode_bits(coded.direction, _DIRECTION_BITS)
        encode_jumps(encoder, coded.jumps, basis.spectrum, coded.step_index, densities)
    expectation = expectation_of(basis.spectrum, coarser, densities)
    encode_levels(encoder, coded.levels, expectation, coded.step_index, densities)
    frames, octaves = sum(len(band) for band in coded.levels), len(coded.levels) - 1
    encode_corrections(encoder, coded.corrections, frames, octaves, basis.components)
    return encoder.finish()


def read_payload(
    data: bytes, coarser: Sequence[Coded], frames: int, octaves: int, basis: Basis, densities: Densities
) -> Coded:
    """All integers of a layer. Raises CorruptStream where no encoder wrote such bytes."""
    decoder = RangeDecoder(data)
    step_index = decoder.decode_bits(STEP_BITS)
    if coarser:
        direction, jumps = coarser[0].direction, Jumps.none(basis.components)
    else:
        direction = decoder.decode_bits(_DIRECTION_BITS)
        jumps = decode_jumps(decoder, frames, basis.spectrum, step_index, densities)
    expectation = expectation_of(basis.spectrum, coarser, densities)
    levels = decode_levels(decoder, frames, octaves, expectation, step_index, densities)
    corrections = decode_corrections(decoder, frames, octaves, basis.components)
    return Coded(step_index, direction, jumps, levels, corrections)
