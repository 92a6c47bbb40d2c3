"""Quantiser steps of `learned`, sixteen an octave: fine enough for a hundredth of a centimetre, and for rigs in metres."""

from __future__ import annotations

import math

from ...errors import JaxmocapError
from .contexts import OCTAVE

STEP_BITS = 9
STEPS = 1 << STEP_BITS
_FINEST_OCTAVE = -14


def step_cm(index: int) -> float:
    """The step in cm: from 2^-14 cm to 2^18 cm."""
    return 2.0 ** (level_of_step(index) / OCTAVE)


def level_of_step(index: int) -> int:
    """16 log2 of the step in cm."""
    return index + OCTAVE * _FINEST_OCTAVE


def index_of(step: float) -> int:
    """The index nearest to a step in cm."""
    return min(max(round(OCTAVE * (math.log2(step) - _FINEST_OCTAVE)), 0), STEPS - 1)


def coarsest_within(cm: float) -> int:
    """The index of the coarsest step that is not above `cm`. Raises JaxmocapError below the finest."""
    index = math.floor(OCTAVE * (math.log2(cm) - _FINEST_OCTAVE) + 1e-9) if cm > 0 else -1
    if index < 0:
        raise JaxmocapError(f"the step is {cm} cm, wanted {step_cm(0):.2g} cm or more")
    return min(index, STEPS - 1)
