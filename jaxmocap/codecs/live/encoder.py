"""The choice of levels, frame by frame: uniform quantisation with a dead zone, of what the outlook leaves."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ..learned.density import FrozenDensity
from .tracker import Outlook, Prior, State, advance, look, place_of, step_units

# A level is rounded up from this fraction of a step on: what is thresholded may still come right by itself, and what
# does not is coded a frame later.
ROUNDING = 0.4


def choose_levels(
    wanted: Int[np.ndarray, " components"], outlook: Outlook, step_index: int, rounding: float = ROUNDING
) -> Int[np.ndarray, " components"]:
    """For places wanted, in 2^-14 cm."""
    step, off = step_units(step_index), wanted - outlook.place
    return np.sign(off) * ((np.abs(off) + int(step * rounding)) // step)


def encode_frames(
    wanted: Int[np.ndarray, "frames components"], prior: Prior, network: FrozenDensity, step_index: int
) -> tuple[Int[np.ndarray, "frames components"], Int[np.ndarray, "frames components"]]:
    """Levels, the first frame's absolute, and decoded places."""
    step = step_units(step_index)
    levels, places = np.zeros_like(wanted), np.zeros_like(wanted)
    levels[0] = (wanted[0] + step // 2) // step
    places[0] = levels[0] * step
    state = State.at(places[0])
    for n in range(1, len(wanted)):
        outlook = look(state, prior, network, step_index)
        levels[n] = choose_levels(wanted[n], outlook, step_index)
        places[n] = place_of(outlook, levels[n], step_index)
        state = advance(state, places[n], levels[n])
    return levels, places
