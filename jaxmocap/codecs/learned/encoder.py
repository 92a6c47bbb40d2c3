"""The search for the coarsest levels that meet a target: a step is guessed, tried plainly, then optimised for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import JaxmocapError
from ..base import Target
from ..quantise import PER_OCTAVE, STEPS, step_cm, step_index
from . import bands
from .basis import Basis, direction_of
from .coefficients import Densities, level_bits
from .distortion import Distortion, Metric
from .jumps import Jumps, find_jumps
from .optimise import Optimiser
from .payload import Coded
from .pose_vectors import PoseVectors

_ROUNDS = 14
_MORE_ROUNDS = 10
_GAIN = 0.87  # what optimising leaves of the mean error of plain rounding
_POWER = 0.73  # the mean error grows so with the step
_WEIGHT = 0.5
_WEIGHTS = (0.25, 1.5)
_CLOSE = 0.99


@dataclass(frozen=True)
class Source:
    """A chunk of motion made ready to be encoded at one step after another. `decoding` is the figure that decodes."""

    original: PoseVectors
    decoding: PoseVectors
    path: np.ndarray
    body: np.ndarray
    octaves: int
    basis: Basis
    metric: Metric
    densities: Densities

    @property
    def direction(self) -> int:
        return direction_of(self.path)

    def attempt(self, index: int) -> Attempt:
        return Attempt(self, index)

    def errors(self, coded: Coded, index: int) -> np.ndarray:
        """Of every point and frame, in cm."""
        return self.distortion().errors(coded.coefficients(step_cm(index)))

    def distortion(self) -> Distortion:
        return Distortion(self.decoding, self.basis, self.metric, self.direction, self.original, self.path, self.body)


class Attempt:
    """One step, plainly quantised at first; `refine` makes it optimal."""

    def __init__(self, source: Source, index: int):
        self.source, self.index, self.step = source, index, step_cm(index)
        y = source.basis.coefficients(source.path, source.body, source.direction)
        distortion = source.distortion()
        self.jumps: Jumps = find_jumps(y, distortion.target, self.step)
        shift = self.jumps.shift(len(y), self.step)
        distortion.shift = shift
        self.optimiser = Optimiser(
            y - shift, source.octaves, distortion, source.basis.spectrum, source.densities, index, self.step
        )

    @property
    def mean_error(self) -> float:
        return float(self.optimiser.errors().mean())

    def coded(self) -> Coded:
        return Coded(self.source.direction, self.jumps, self.optimiser.levels)

    def bits(self) -> float:
        return level_bits(self.optimiser.levels, self.source.basis.spectrum, self.index, self.source.densities)

    def refine(self, mean_cm: float | None) -> bool:
        """Rounds of moves; with `mean_cm`, the weight of errors is steered to meet it closely. True where it is met."""
        weight, best = _WEIGHT, None
        for n in range(_ROUNDS + (_MORE_ROUNDS if mean_cm else 0)):
            error = float(self.optimiser.round(weight).mean())
            if mean_cm is None or n < 3:
                continue
            weight = float(np.clip(weight * (error / (mean_cm * 0.998)) ** 1.5, *_WEIGHTS))
            if n >= _ROUNDS - 1:
                now = self.mean_error
                if now <= mean_cm:
                    bits = self.bits()
                    if best is None or bits < best[0]:
                        best = (bits, self.optimiser.levels)
                    if now >= _CLOSE * mean_cm:
                        break
        if mean_cm is None:
            return True
        if best is not None:
            self.optimiser.levels = best[1]
        return best is not None


def encode_to_mean(source: Source, mean_cm: float) -> tuple[int, Coded]:
    """Step index and levels of a mean error of at most `mean_cm`. Raises JaxmocapError where no step is fine enough."""
    index = _index_of((mean_cm / 0.59) ** (1 / _POWER))
    for _ in range(3):
        attempt = source.attempt(index)
        change = round(PER_OCTAVE * math.log2(mean_cm / (_GAIN * attempt.mean_error)) / _POWER)
        if abs(change) <= 1:
            break
        index = min(max(index + change, 0), STEPS - 1)
    while index >= 0:
        attempt = source.attempt(index)
        if attempt.refine(mean_cm):
            return index, attempt.coded()
        index -= 2
    raise JaxmocapError(f"a mean error of {mean_cm:g} cm is out of this codec's reach on this motion")


def encode_to_step(source: Source, cm: float) -> tuple[int, Coded]:
    attempt = source.attempt(step_index(cm))
    attempt.refine(None)
    return attempt.index, attempt.coded()


def _index_of(step: float) -> int:
    return min(max(round((math.log2(step) + 7) * PER_OCTAVE), 0), STEPS - 1)


def encode_to(source: Source, target: Target) -> tuple[int, Coded]:
    """Step index and all integers of a chunk that meets the target, by the metric of the source."""
    if target.kind == "step":
        return encode_to_step(source, target.cm)
    if target.kind == "mean":
        return encode_to_mean(source, target.cm)
    return encode_to_max(source, target.cm)


def encode_to_max(source: Source, cm: float) -> tuple[int, Coded]:
    """No point of any frame is off by more than `cm`."""
    mean = cm / 4
    while True:
        index, coded = encode_to_mean(source, mean)
        most = float(source.errors(coded, index).max())
        if most <= cm:
            return index, coded
        mean *= min(max(cm / most, 0.5), 0.95)
