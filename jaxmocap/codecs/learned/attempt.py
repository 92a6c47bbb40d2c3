"""One try at encoding: a chunk of motion at one step, quantised plainly, then optimally."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..quantise import PER_OCTAVE, STEPS, step_cm
from .basis import Basis, direction_of
from .coefficients import Densities, level_bits
from .distortion import Distortion, Metric
from .jumps import Jumps, find_jumps
from .optimise import WEIGHT, Optimiser
from .payload import Coded
from .pose_vectors import PoseVectors

_POWER, _MEAN_AT_1_CM = 0.73, 0.59  # the mean error is about 0.59 step^0.73, both in cm
_GAIN = 0.885  # what optimising leaves of the mean error of plain rounding

_ROUNDS = 20
_SETTLING = 10  # rounds in which the weight of errors rises to its own
_MORE_ROUNDS = 8
_WEIGHTS = (0.6, 1.1)
_AIM, _CLOSE, _HOPELESS = 0.997, 0.99, 1.05


@dataclass(frozen=True, eq=False)
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

    @functools.cached_property
    def coefficients(self) -> np.ndarray:
        """In cm, (frames, components)."""
        return self.basis.coefficients(self.path, self.body, self.direction)

    @functools.cached_property
    def distortion(self) -> Distortion:
        return Distortion(self.decoding, self.basis, self.metric, self.direction, self.original, self.path, self.body)

    @functools.cached_property
    def curvatures(self) -> np.ndarray:
        return self.distortion.curvatures(self.coefficients)

    @functools.cached_property
    def jump_frames(self) -> np.ndarray:
        return find_jumps(self.distortion.target)

    def errors(self, coded: Coded, index: int) -> np.ndarray:
        """Of every point and frame, in cm."""
        return self.distortion.errors(coded.coefficients(step_cm(index)))


class Attempt:
    """One step, plainly quantised at first; `refine` makes it optimal."""

    def __init__(self, source: Source, index: int):
        self.source, self.index, self.step = source, index, step_cm(index)
        self.jumps = Jumps.over(source.coefficients, source.jump_frames, self.step)
        shift = self.jumps.shift(len(source.coefficients), self.step)
        self.optimiser = Optimiser(
            source.coefficients - shift, shift, source.octaves, source.distortion, source.curvatures,
            source.basis.spectrum, source.densities, index, self.step,
        )  # fmt: skip

    @property
    def mean_error(self) -> float:
        return float(self.optimiser.errors().mean())

    def coded(self) -> Coded:
        return Coded(self.source.direction, self.jumps, self.optimiser.levels)

    def bits(self) -> float:
        return level_bits(self.optimiser.levels, self.source.basis.spectrum, self.index, self.source.densities)

    def refine(self, mean_cm: float | None) -> bool:
        """Rounds of moves; with `mean_cm`, the weight of errors is steered to meet it closely. True where it is met."""
        weight, best = WEIGHT, None
        for n in range(_ROUNDS + (_MORE_ROUNDS if mean_cm else 0)):
            settled = n >= _SETTLING
            error = float(self.optimiser.round(weight if settled else WEIGHT * (0.7 + 0.3 * n / _SETTLING)).mean())
            if mean_cm is None or not settled:
                continue
            weight = float(np.clip(weight * (error / (_AIM * mean_cm)) ** 2, *_WEIGHTS))
            if n >= _ROUNDS - 1:
                now = self.mean_error
                if now <= mean_cm:
                    bits = self.bits()
                    best = (bits, self.optimiser.levels) if best is None or bits < best[0] else best
                    if now >= _CLOSE * mean_cm:
                        break
                elif now > _HOPELESS * mean_cm:
                    break
        if best is not None:
            self.optimiser.levels = best[1]
        return best is not None or mean_cm is None


def steps_apart(ratio: float) -> float:
    """How many steps finer the quantiser must be for errors so many times smaller."""
    return PER_OCTAVE * math.log2(ratio) / _POWER


def mean_of_step(step: float) -> float:
    """About the mean error that a step leaves; both in cm."""
    return _MEAN_AT_1_CM * step**_POWER


def step_of_mean(mean_cm: float) -> float:
    """The step that leaves about this mean error."""
    return (mean_cm / _MEAN_AT_1_CM) ** (1 / _POWER)


def index_of(step: float) -> int:
    """The index nearest to a step in cm."""
    return min(max(round((math.log2(step) + 7) * PER_OCTAVE), 0), STEPS - 1)


def plain_index(start: int, wanted: float, error: Callable[[int], float]) -> int:
    """The index near `start` whose `error`, when quantised plainly, leaves about what is wanted once it is optimised."""
    index = start
    for _ in range(3):
        apart = round(steps_apart(_GAIN * error(index) / wanted))
        index = min(max(index - apart, 0), STEPS - 1)
        if abs(apart) <= 1:
            break
    return index
