"""The coarsest quantiser step that meets a target, found in a few trials."""

from __future__ import annotations

import math
from collections.abc import Callable

from ..errors import JaxmocapError
from .base import Target
from .quantise import PER_OCTAVE, STEPS

KINDS = ("mean", "max")
Distortion = Callable[[int], tuple[float, float]]


def coarsest(distortion: Distortion, target: Target, start: int = STEPS // 2) -> int:
    """The step index for a target, looked for from `start`. `distortion(index)` gives mean and maximum error in cm.

    Distortion grows with the step but for small wobbles, so what is found meets the target, though now and then a
    coarser step would, too. Raises JaxmocapError where even the finest step does not meet it.
    """
    low, high = -1, STEPS  # low meets the target, high does not
    index, error = start, (math.inf, math.inf)
    while high - low > 1:
        error = distortion(index)
        low, high = (index, high) if meets(error, target) else (low, index)
        # Distortion goes about as the step to the power 0.8: aim there, inside the bracket.
        ratio = target.cm / max(error[KINDS.index(target.kind)], 1e-9)
        aim = index + math.floor(PER_OCTAVE * math.log2(ratio) / 0.8)
        index = min(max(aim, low + 1), high - 1)
    if low < 0:
        raise out_of_reach(error, target)
    return low


def out_of_reach(error: tuple[float, float], target: Target) -> JaxmocapError:
    """The error for a target that the finest step misses, by how much."""
    return JaxmocapError(
        f"a {target.kind} error of {target.cm:g} cm is out of this codec's reach on this motion: "
        f"its finest step leaves mean {error[0]:.4g} and max {error[1]:.4g} cm"
    )


def meets(error: tuple[float, float], target: Target) -> bool:
    """True when the mean and maximum error hold what the target asks."""
    return target.kind == "step" or error[KINDS.index(target.kind)] <= target.cm
