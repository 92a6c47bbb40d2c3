"""The choice of levels, frame by frame: uniform quantisation with a dead zone, of what the outlook leaves."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ..learned.density import FrozenDensity
from .tracker import Outlook, Prior, State, advance, advance_told, look, place_of, refreshed, step_units

# A level is rounded up from this fraction of a step on: what is thresholded may still come right by itself, and what
# does not is coded a frame later.
ROUNDING = 0.4
_OF_PACKETS = 0.45  # a packet that has no level takes whole bytes all the same


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


def encode_packet(
    wanted: Int[np.ndarray, " components"], number: int, state: State, prior: Prior, network: FrozenDensity, step_index: int
) -> tuple[Int[np.ndarray, " components"], Int[np.ndarray, " refreshed"], State]:
    """Levels, places in steps of those whose turn it is, and the state after the frame of this number."""
    turn = refreshed(number, len(wanted))
    outlook = look(state, prior, network, step_index)
    levels = choose_levels(wanted, outlook, step_index, _OF_PACKETS)
    levels[turn] = 0
    places = whole_steps(wanted[turn], step_index)
    return levels, places, advance_told(state, outlook, levels, turn, places, step_index)


def whole_steps(places: Int[np.ndarray, " places"], step_index: int) -> Int[np.ndarray, " places"]:
    """The nearest."""
    return np.rint(places / step_units(step_index)).astype(np.int64)
