"""The search for the coarsest levels that meet a target: a step is guessed, tried plainly, then optimised for."""

from __future__ import annotations

import math

from ...errors import JaxmocapError
from ..base import Target
from ..quantise import STEPS, step_index
from .attempt import Attempt, Source, index_of, mean_of_step, plain_index, step_of_mean, steps_apart
from .bounded import encode_to_max
from .payload import Coded


def typical_mean(target: Target) -> float:
    """About the mean error that a stream for the target has, in cm."""
    return {"mean": target.cm, "max": target.cm / 4, "step": mean_of_step(target.cm)}[target.kind]


def rough_bytes(source: Source, mean_cm: float) -> float:
    """About what the levels will take for a mean error."""
    return Attempt(source, index_of(step_of_mean(mean_cm))).bits() / 8


def encode_to_mean(source: Source, mean_cm: float) -> tuple[int, Coded]:
    """Step index and levels of a mean error of at most `mean_cm`. Raises JaxmocapError where no step is fine enough."""
    start = index_of(step_of_mean(mean_cm))
    index = plain_index(start, mean_cm, lambda n: Attempt(source, n).mean_error)
    best, too_coarse = None, STEPS
    while 0 <= index < too_coarse:
        attempt = Attempt(source, index)
        met = attempt.refine(mean_cm)
        apart = steps_apart(max(attempt.mean_error, 1e-9) / mean_cm)
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


def encode_to(source: Source, target: Target) -> tuple[int, Coded]:
    """Step index and all integers of a chunk that meets the target, by the metric of the source."""
    if target.kind == "step":
        return encode_to_step(source, target.cm)
    if target.kind == "mean":
        return encode_to_mean(source, target.cm)
    return encode_to_max(source, target.cm)
