"""The search for the coarsest levels that meet a target: a step is guessed, tried plainly, then optimised for."""

from __future__ import annotations

from dataclasses import replace

from ...errors import JaxmocapError
from ..base import Target
from .attempt import Attempt, Source, mean_of_step, plain_index, step_of_mean
from .bounded import encode_to_max
from .payload import Coded
from .steps import STEPS, coarsest_within, index_of

QUALITIES_APART = 2.2  # times the error: a beginning of half the length then holds the quality before the last


def typical_mean(target: Target) -> float:
    """About the mean error that a stream for the target has, in cm."""
    return {"mean": target.cm, "max": target.cm / 4, "step": mean_of_step(target.cm)}[target.kind]


def rough_bytes(source: Source, mean_cm: float) -> float:
    """About what the levels will take for a mean error."""
    return Attempt(source, index_of(step_of_mean(mean_cm))).bits() / 8


def encode_to_mean(source: Source, mean_cm: float) -> Coded:
    """All integers for a mean error of at most `mean_cm`. Raises JaxmocapError where no step is fine enough."""
    index = plain_index(index_of(step_of_mean(mean_cm)), mean_cm, lambda n: Attempt(source, n).mean_error)
    tried: set[int] = set()
    while True:
        attempt = Attempt(source, index)
        coded = attempt.refine_to(mean_cm, patiently=index in tried)
        if coded is not None:
            return coded
        if not index and index in tried:
            raise JaxmocapError(f"a mean error of {mean_cm:g} cm is out of this codec's reach on this motion")
        finer = max(round(attempt.finer), 1) if index in tried else round(attempt.finer) or 1
        tried.add(index)
        index = min(max(index - finer, 0), STEPS - 1)


def encode_to_step(source: Source, cm: float) -> Coded:
    attempt = Attempt(source, coarsest_within(cm))
    attempt.refine()
    return attempt.coded()


def encode_to(source: Source, target: Target) -> Coded:
    """All integers of a layer that meets the target, by the metric of the source."""
    if target.kind == "step":
        return encode_to_step(source, target.cm)
    if target.kind == "mean":
        return encode_to_mean(source, target.cm)
    return encode_to_max(source, target.cm)


def encode_in_layers(source: Source, target: Target, qualities: int) -> tuple[Coded, ...]:
    """The target's layer comes last; each before it is for a larger error than the next, and takes about half of the bytes."""
    for n in reversed(range(qualities)):
        here = target
        if n:
            kind = "step" if target.kind == "step" else "mean"
            here = Target(kind, (target.cm if kind == target.kind else typical_mean(target)) * QUALITIES_APART**n)
        source = replace(source, coarser=(*source.coarser, encode_to(source, here)))
    return source.coarser
