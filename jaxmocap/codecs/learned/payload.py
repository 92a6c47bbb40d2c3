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
from .spectrum import Expectation
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


def expectation_after(coded: Coded, before: Expectation, basis: Basis, densities: Densities) -> Expectation:
    """Of the next layer's levels, where `before` was that of this layer's."""
    return leftover(coded.levels, before, basis.spectrum, coded.step_index, densities)


def write_layers(layers: Sequence[Coded], basis: Basis, densities: Densities) -> list[bytes]:
    """Of a chunk, from coarse to fine. Raises JaxmocapError where levels are too large to be coded."""
    payloads: list[bytes] = []
    expectation: Expectation = basis.spectrum
    for n, coded in enumerate(layers):
        expectation = expectation_after(layers[n - 1], expectation, basis, densities) if n else expectation
        payloads.append(_write(coded, n == 0, expectation, basis, densities))
    return payloads


def read_layers(
    payloads: Sequence[bytes], frames: int, octaves: int, basis: Basis, densities: Densities
) -> list[Coded]:
    """All integers of a chunk, from coarse to fine. Raises CorruptStream where no encoder wrote such bytes."""
    layers: list[Coded] = []
    expectation: Expectation = basis.spectrum
    for payload in payloads:
        expectation = expectation_after(layers[-1], expectation, basis, densities) if layers else expectation
        layers.append(_read(payload, layers[0] if layers else None, expectation, frames, octaves, basis, densities))
    return layers


def _write(coded: Coded, first: bool, expectation: Expectation, basis: Basis, densities: Densities) -> bytes:
    if max(np.abs(x).max(initial=0) for x in (*coded.levels, coded.jumps.levels)) >= integers.LIMIT:
        raise JaxmocapError("the motion goes too far for so small an error: it is out of this codec's reach")
    encoder = RangeEncoder()
    encoder.encode_bits(coded.step_index, STEP_BITS)
    if first:
        encoder.encode_bits(coded.direction, _DIRECTION_BITS)
        encode_jumps(encoder, coded.jumps, basis.spectrum, coded.step_index, densities)
    encode_levels(encoder, coded.levels, expectation, coded.step_index, densities)
    frames, octaves = sum(len(band) for band in coded.levels), len(coded.levels) - 1
    encode_corrections(encoder, coded.corrections, frames, octaves, basis.components)
    return encoder.finish()


def _read(
    data: bytes, first: Coded | None, expectation: Expectation, frames: int, octaves: int, basis: Basis, densities: Densities
) -> Coded:
    decoder = RangeDecoder(data)
    step_index = decoder.decode_bits(STEP_BITS)
    if first is None:
        direction = decoder.decode_bits(_DIRECTION_BITS)
        jumps = decode_jumps(decoder, frames, basis.spectrum, step_index, densities)
    else:
        direction, jumps = first.direction, Jumps.none(basis.components)
    levels = decode_levels(decoder, frames, octaves, expectation, step_index, densities)
    corrections = decode_corrections(decoder, frames, octaves, basis.components)
    return Coded(step_index, direction, jumps, levels, corrections)
