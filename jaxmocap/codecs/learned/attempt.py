"""One try at encoding: a chunk of motion at one step, quantised plainly, then optimally."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .basis import Basis, direction_of
from .coefficients import Densities, level_bits
from .contexts import OCTAVE
from .distortion import Distortion, Metric
from .jumps import Jumps, find_jumps
from .optimise import WEIGHT, Optimiser
from .payload import Coded, coefficients_of, expectation_after
from .pose_vectors import PoseVectors
from .spectrum import Expectation
from .steps import STEPS, step_cm

POWER, MEAN_AT_1_CM = 0.73, 0.59  # the mean error is about 0.59 step^0.73, both in cm
_GAIN = 0.885  # what optimising leaves of the mean error of plain rounding

ROUNDS = 20
_SETTLING = 10  # rounds in which the weight of errors rises to its own
_DOUBTS, _TOO_FAR_OFF = 12, 1.2  # the round after which a step may be given up, if it is off by so many steps
_LAST_ROUND = 36
_WEIGHTS, _PROMPT = (0.5, 1.3), 10  # bounds of the weight, and how strongly it answers to the last error
_AIM, _CLOSE = 0.997, 0.994
_FALL = 0.003  # of the error, in a round, once weights are settled


@dataclass(frozen=True, eq=False)
class Source:
    """A chunk of motion made ready to be encoded at one step after another. `decoding` is the figure that decodes.

    `coarser` are the layers that are already coded.
    """

    original: PoseVectors
    decoding: PoseVectors
    path: np.ndarray
    body: np.ndarray
    octaves: int
    basis: Basis
    metric: Metric
    densities: Densities
    coarser: tuple[Coded, ...] = ()

    @property
    def direction(self) -> int:
        return direction_of(self.path)

    @functools.cached_property
    def coefficients(self) -> Float[np.ndarray, "frames components"]:
        """In cm."""
        return self.basis.coefficients(self.path, self.body, self.direction)

    @functools.cached_property
    def known(self) -> Float[np.ndarray, "frames components"]:
        """What coarser layers decode to, in cm."""
        return coefficients_of(self.coarser) + np.zeros_like(self.coefficients)

    @functools.cached_property
    def expectation(self) -> Expectation:
        expectation: Expectation = self.basis.spectrum
        for coded in self.coarser:
            expectation = expectation_after(coded, expectation, self.basis, self.densities)
        return expectation

    @functools.cached_property
    def distortion(self) -> Distortion:
        return Distortion(self.decoding, self.basis, self.metric, self.direction, self.original, self.path, self.body)

    @functools.cached_property
    def curvatures(self) -> Float[np.ndarray, " components"]:
        return self.distortion.curvatures(self.coefficients)

    @functools.cached_property
    def jump_frames(self) -> np.ndarray:
        """None where coarser layers have taken them out."""
        return np.zeros(0, np.int64) if self.coarser else find_jumps(self.distortion.target)


class Attempt:
    """At one step, plainly quantised at first; rounds make it optimal."""

    def __init__(self, source: Source, index: int):
        self.source, self.index, self.step = source, index, step_cm(index)
        self.finer = 0.0
        left = source.coefficients - source.known
        self.jumps = Jumps.over(left, source.jump_frames, self.step)
        shift = self.jumps.shift(len(left), self.step)
        self.optimiser = Optimiser(
            left - shift, source.known + shift, source.octaves, source.distortion, source.curvatures,
            source.expectation, source.densities, index,
        )  # fmt: skip

    @property
    def mean_error(self) -> float:
        return float(self.optimiser.errors().mean())

    def coded(self) -> Coded:
        return Coded(self.index, self.source.direction, self.jumps, self.optimiser.levels)

    def bits(self) -> float:
        return level_bits(self.optimiser.levels, self.source.expectation, self.index, self.source.densities)

    def refine(self) -> None:
        """Rounds of moves at this step."""
        for n in range(ROUNDS):
            self.optimiser.look()
            self.optimiser.move(_settled(WEIGHT, n))

    def refine_to(self, mean_cm: float, patiently: bool) -> Coded | None:
        """Rounds of moves, in which the weight of errors is steered to the mean error; None where they do not come to it.

        A step that is clearly the wrong one is given up after some rounds, unless `patiently`; `finer` then says by how much.
        """
        weight = steady = WEIGHT
        met = None
        for n in range(_LAST_ROUND):
            error = self.optimiser.look() / mean_cm
            self.finer = steps_apart(error * _to_come(n) / _AIM)
            if n == _DOUBTS and not patiently and abs(self.finer) > _TOO_FAR_OFF:
                return None
            if n >= ROUNDS and error <= 1 and (met is None or error > met[0]):
                met = error, self.coded()
            if met is not None and met[0] > _CLOSE:
                break
            if n >= _SETTLING:
                off = error * _to_come(n) / _AIM
                steady = float(np.clip(steady * off, *_WEIGHTS))
                weight = float(np.clip(steady * off**_PROMPT, *_WEIGHTS))
            self.optimiser.move(_settled(weight, n))
        return None if met is None else met[1]


def _to_come(n: int) -> float:
    """What is left of the error after round n when all rounds are done."""
    return 1 - _FALL * max(ROUNDS - n, 0)


def _settled(weight: float, n: int) -> float:
    """In the first rounds errors weigh less, since what is zero at first rarely comes to be more."""
    return weight * min(0.7 + 0.3 * n / _SETTLING, 1.0)


def steps_apart(ratio: float) -> float:
    """How many steps finer the quantiser must be for errors so many times smaller."""
    return OCTAVE * math.log2(max(ratio, 1e-9)) / POWER


def mean_of_step(step: float) -> float:
    """About the mean error that a step leaves; both in cm."""
    return MEAN_AT_1_CM * step**POWER


def step_of_mean(mean_cm: float) -> float:
    """The step that leaves about this mean error."""
    return (mean_cm / MEAN_AT_1_CM) ** (1 / POWER)


def plain_index(start: int, wanted: float, error: Callable[[int], float]) -> int:
    """The index near `start` whose `error`, when quantised plainly, leaves about what is wanted once it is optimised."""
    index = start
    for _ in range(3):
        apart = round(steps_apart(_GAIN * error(index) / wanted))
        index = min(max(index - apart, 0), STEPS - 1)
        if abs(apart) <= 1:
            break
    return index
