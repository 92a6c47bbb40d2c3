"""The search for the coarsest levels that meet a target: a step is guessed, tried plainly, then optimised for."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from ...errors import JaxmocapError
from ..base import Target
from ..quantise import PER_OCTAVE, STEPS, step_cm, step_index
from .basis import Basis, direction_of
from .coefficients import Densities, level_bits
from .distortion import Distortion, Metric
from .jumps import Jumps, find_jumps
from .optimise import WEIGHT, Optimiser
from .payload import Coded
from .pose_vectors import PoseVectors

_ROUNDS = 16
_MORE_ROUNDS = 8
_GAIN = 0.885  # what optimising leaves of the mean error of plain rounding
_POWER = 0.73  # the mean error grows so with the step

_WEIGHTS = (0.6, 1.1)
_MOST_BY_MEAN = 4.0
_BOUND_ROUNDS, _BOUND_AIM, _BOUND_POWER = 30, 0.8, 0.6
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
            error = float(self.optimiser.round(weight).mean())
            if mean_cm is None or n < _ROUNDS // 2:
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

    def bound(self, most_cm: float) -> float:
        """Rounds of moves until no error is above `most_cm`, or they are used up; gives the largest error."""
        weight = np.ones(self.source.distortion.target.shape[1:], np.float32)
        largest = math.inf
        for n in range(_BOUND_ROUNDS):
            error = self.optimiser.round(WEIGHT, of_points=weight)
            largest = float(error.max())
            if n and largest <= most_cm:
                break
            weight = np.clip(weight * (error / np.float32(_BOUND_AIM * most_cm)) ** _BOUND_POWER, 0.3, 100.0)
        return float(self.optimiser.errors().max())


def typical_mean(target: Target) -> float:
    """About the mean error that a stream for the target has, in cm."""
    return {"mean": target.cm, "max": target.cm / 4, "step": 0.59 * target.cm**_POWER}[target.kind]


def rough_bytes(source: Source, mean_cm: float) -> float:
    """About what the levels will take for a mean error."""
    return Attempt(source, _index_of((mean_cm / 0.59) ** (1 / _POWER))).bits() / 8


def encode_to_mean(source: Source, mean_cm: float) -> tuple[int, Coded]:
    """Step index and levels of a mean error of at most `mean_cm`. Raises JaxmocapError where no step is fine enough."""
    index = _index_of((mean_cm / 0.59) ** (1 / _POWER))
    for _ in range(3):
        apart = round(_steps_apart(_GAIN * Attempt(source, index).mean_error / mean_cm))
        index = min(max(index - apart, 0), STEPS - 1)
        if abs(apart) <= 1:
            break
    best, too_coarse = None, STEPS
    while 0 <= index < too_coarse:
        attempt = Attempt(source, index)
        met = attempt.refine(mean_cm)
        apart = _steps_apart(max(attempt.mean_error, 1e-9) / mean_cm)
        if met and (best is None or attempt.bits() < best[0]):
            best = (attempt.bits(), index, attempt.coded())
        elif best is not None:
            break
        if met and apart > -1:
            break
        too_coarse = too_coarse if met else index
        index += max(math.floor(-apart), 1) if met else -max(math.ceil(apart), 1)
    if best is None:
        raise JaxmocapError(f"a mean error of {mean_cm:g} cm is out of this codec's reach on this motion")
    return best[1:]


def encode_to_step(source: Source, cm: float) -> tuple[int, Coded]:
    attempt = Attempt(source, step_index(cm))
    attempt.refine(None)
    return attempt.index, attempt.coded()


def _steps_apart(ratio: float) -> float:
    """How many steps finer the quantiser must be for a mean error so many times smaller."""
    return PER_OCTAVE * math.log2(ratio) / _POWER


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
    """No point of any frame is off by more than `cm`: errors weigh more the longer they are too large.

    The weights are the multipliers of a bound on every point of every frame, found while the levels are.
    """
    index, best, too_coarse = _index_of((cm / _MOST_BY_MEAN / 0.59) ** (1 / _POWER)), None, STEPS
    while 0 <= index < too_coarse:
        attempt = Attempt(source, index)
        most = attempt.bound(cm)
        if most <= cm:
            best = (index, attempt.coded())
            index += 4
        elif best is not None:
            break
        else:
            too_coarse = index
            index -= max(round(_steps_apart(most / cm)), 2)
    if best is None:
        raise JaxmocapError(f"a maximum error of {cm:g} cm is out of this codec's reach on this motion")
    return best
