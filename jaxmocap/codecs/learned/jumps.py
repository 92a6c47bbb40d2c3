"""Jumps of a motion, taken out of it and coded apart: a T-pose before the first frame, a glitch, a cut.

From a jump on, the motion goes on where it was: the shift of all components is a vector of levels of its own, and what
the transform sees is smooth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import CorruptStream
from ..entropy.range_coder import Decoder, Encoder
from .coefficients import Densities, decode_signs, decode_sizes, encode_signs, encode_sizes, tail_frequencies
from .density import tail_rows_of
from .golomb import read_unsigned, write_unsigned
from .spectrum import Spectrum
from .steps import level_of_step

_NEAR = 5  # frames on each side that say what is usual
_LEAST_CM = 3.0
_TIMES_USUAL = 6.0
_GAP_ORDER, _COUNT_ORDER = 6, 0


class Jumps(NamedTuple):
    """`frames` begin after a jump by `levels` steps."""

    frames: Int[np.ndarray, " jumps"]
    levels: Int[np.ndarray, "jumps components"]

    @staticmethod
    def over(y: Float[np.ndarray, "frames components"], frames: Int[np.ndarray, " jumps"], step: float) -> Jumps:
        """The jumps of coefficients to these frames."""
        return Jumps(frames, np.rint((y[frames] - y[frames - 1]) / step).astype(np.int64))

    @staticmethod
    def none(components: int) -> Jumps:
        return Jumps(np.zeros(0, np.int64), np.zeros((0, components), np.int64))

    def shift(self, frames: int, step: float) -> Float[np.ndarray, "frames components"]:
        """What they add to every frame, in cm: nothing at the last."""
        total = np.zeros((frames, self.levels.shape[1]))
        for frame, levels in zip(self.frames, self.levels, strict=True):
            total[:frame] -= levels * step
        return total


def find_jumps(points: Float[np.ndarray, "3 points frames"]) -> Int[np.ndarray, " jumps"]:
    """The frames to which points move by far more than they move nearby."""
    move = np.diff(points, axis=2)
    if not move.shape[2]:
        return np.zeros(0, np.int64)
    near = [np.roll(move, s, axis=2) for s in range(-_NEAR, _NEAR + 1) if s]
    usual = np.median(np.stack(near), axis=0) if move.shape[2] > 2 * _NEAR else np.zeros_like(move)
    odd = np.linalg.norm(move - usual, axis=0).mean(0)
    calm = np.median(np.stack([np.roll(odd, s) for s in range(-_NEAR, _NEAR + 1)]), axis=0)
    return np.flatnonzero((odd > _LEAST_CM) & (odd > _TIMES_USUAL * calm)) + 1


def encode_jumps(encoder: Encoder, jumps: Jumps, spectrum: Spectrum, step_index: int, densities: Densities) -> None:
    write_unsigned(encoder, len(jumps.frames), _COUNT_ORDER)
    before = 0
    for frame, levels in zip(jumps.frames.tolist(), jumps.levels, strict=True):
        write_unsigned(encoder, frame - before - 1, _GAP_ORDER if before else 0)
        encode_sizes(encoder, np.abs(levels), _frequencies(spectrum, step_index, densities))
        encode_signs(encoder, levels[levels != 0])
        before = frame


def decode_jumps(decoder: Decoder, frames: int, spectrum: Spectrum, step_index: int, densities: Densities) -> Jumps:
    """Raises CorruptStream where a jump lies outside the motion."""
    count = read_unsigned(decoder, _COUNT_ORDER)
    if count >= max(frames, 1):
        raise CorruptStream(f"a chunk of {frames} frames has {count} jumps")
    at, rows, before = [], [], 0
    for _ in range(count):
        before += 1 + read_unsigned(decoder, _GAP_ORDER if before else 0)
        if before >= frames:
            raise CorruptStream(f"a jump at frame {before} of {frames}")
        size = decode_sizes(decoder, _frequencies(spectrum, step_index, densities))
        rows.append(decode_signs(decoder, size))
        at.append(before)
    return Jumps(np.array(at, np.int64), np.array(rows, np.int64).reshape(len(at), spectrum.components))


def _frequencies(spectrum: Spectrum, step_index: int, densities: Densities) -> Int[np.ndarray, "components symbols"]:
    """Of a component's sizes: geometric, as far as its constant differs from clip to clip."""
    reach = spectrum.slow[0].astype(np.int64) - level_of_step(step_index)
    return tail_frequencies(densities.tail, tail_rows_of(reach))
