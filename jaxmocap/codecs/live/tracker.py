"""What both ends of a live stream know of a motion: where every component is, how it came there, how busy it was.

All of it is integers, so that encoder and decoder never part. Places are in 2^-14 cm. A small network looks at this and
says how likely every level of the next frame is, and where the component will be if no level moves it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..learned.contexts import magnitude
from ..learned.density import STOPS, FrozenDensity
from ..learned.steps import level_of_step

UNITS = 1 << 14  # a centimetre
REFRESH_FRAMES = 54  # within which every component is told anew
FINEST_STEP = 48  # 2^-11 cm: below, a step has too few units
FOLLOWING = (1, 2, 3, 4)  # averages of places over 2, 4, 8, 16 frames: what a lost packet leaves in them is soon gone
BUSY = (2, 3, 5)  # averages of levels over 4, 8, 32 frames
EMBEDDING = 4
INPUTS = 2 * len(FOLLOWING) + 2 * len(BUSY) + 3 + EMBEDDING
SIGN, GAIN, SHRINK = range(STOPS + 1, STOPS + 4)  # outputs beyond those of a density
OUTPUTS = STOPS + 4
GAIN_SHIFT, SHRINK_SHIFT = 4, 3  # a whole logit is 2^-4 of what was gone of late, 2^-3 steps of shrinking
# In logits. With a gain of a third a component would go on for ever; with a quarter it comes to rest by itself, and two ends
# that lost sight of each other come together again.
MOST_GAIN, MOST_SHRINK = 4, 3
_LOGIT_BITS = 5
_MOST_PRIOR = 12 * 16  # sixteenths of an octave from the step
_REACH = 128  # signed contexts: 8 steps
_BUSY_BITS = 8
_MOST_LEVEL = 255
_FAST = 4  # steps, gone of late
SWIFT = 1  # which average says how fast a component moves


class State(NamedTuple):
    """Of all components: places, their averages (each the longer the later), and averages of levels in 2^-8."""

    place: Int[np.ndarray, " components"]
    average: Int[np.ndarray, "following components"]
    busy: Int[np.ndarray, "busy components"]

    @staticmethod
    def at(place: Int[np.ndarray, " components"]) -> State:
        """At rest."""
        return State(place, np.tile(place, (len(FOLLOWING), 1)), np.zeros((len(BUSY), len(place)), np.int64))


class Outlook(NamedTuple):
    """What is expected of the next frame: the network's outputs, the side that signs are relative to, and places."""

    outputs: Int[np.ndarray, "components outputs"]
    side: Int[np.ndarray, " components"]
    place: Int[np.ndarray, " components"]

    def sign_outputs(self) -> Int[np.ndarray, " components"]:
        """In 32nds of a logit, that a level is positive."""
        return self.side * self.outputs[:, SIGN]


@dataclass(frozen=True, eq=False)
class Prior:
    """What the corpus knows of components: 16 log2 of how fast (cm a frame) and how far (cm) they go, and an embedding."""

    speed: Int[np.ndarray, " components"]
    spread: Int[np.ndarray, " components"]
    embedding: Int[np.ndarray, "components 4"]
    _known: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    def contexts(self, step_index: int) -> Int[np.ndarray, "components still"]:
        """Inputs of networks that no motion changes, in sixteenths: speed, spread, the step itself, the embedding."""
        if step_index not in self._known:
            level = level_of_step(step_index)
            columns = [np.clip(prior - level, -_MOST_PRIOR, _MOST_PRIOR) >> 1 for prior in (self.speed, self.spread)]
            self._known[step_index] = np.column_stack([*columns, np.full(len(self.speed), level >> 1), self.embedding])
        return self._known[step_index]


def step_units(step_index: int) -> int:
    """The step in 2^-14 cm, a whole number."""
    return round(2.0 ** (step_index / 16))


def contexts(state: State, prior: Prior, step_index: int) -> tuple[Int[np.ndarray, "components inputs"], np.ndarray]:
    """The network's inputs, in sixteenths, and the side to which each component went of late (1 or -1)."""
    gone = np.clip((state.place - state.average) * 16 // step_units(step_index), -(1 << 20), 1 << 20)
    side = np.where(3 * gone[1] + gone[3] >= 0, 1, -1)
    signed = np.clip(side * gone, -_REACH, _REACH) >> 1
    found = np.empty((len(side), INPUTS), np.int64)
    f, b = len(FOLLOWING), len(BUSY)
    found[:, :f] = signed.T
    found[:, f : 2 * f] = magnitude(gone).T >> 1
    found[:, 2 * f : 2 * f + b] = magnitude(state.busy >> 2).T >> 1
    found[:, 2 * f + b : 2 * (f + b)] = magnitude(state.busy.sum(1) >> 4)[None] >> 1
    found[:, 2 * (f + b) :] = prior.contexts(step_index)
    return found, side


def look(state: State, prior: Prior, network: FrozenDensity, step_index: int) -> Outlook:
    """What is expected of the frame after this state."""
    inputs, side = contexts(state, prior, step_index)
    outputs = network(inputs)
    gain = np.clip(outputs[:, GAIN], 0, MOST_GAIN << _LOGIT_BITS)
    drift = gain * (state.place - state.average[SWIFT]) >> _LOGIT_BITS + GAIN_SHIFT
    return Outlook(outputs, side, state.place + drift)


def place_of(outlook: Outlook, levels: Int[np.ndarray, " components"], step_index: int) -> Int[np.ndarray, " components"]:
    """Where components are when these levels have moved them; a level of one is a little less than a step, or more."""
    step, most = step_units(step_index), MOST_SHRINK << _LOGIT_BITS
    shrink = np.clip(outlook.outputs[:, SHRINK], -most, most) * step >> _LOGIT_BITS + SHRINK_SHIFT
    return outlook.place + levels * step - np.where(np.abs(levels) == 1, levels * shrink, 0)


def concealed(state: State, outlook: Outlook, step_index: int) -> Int[np.ndarray, " components"]:
    """Where components are when a frame is lost: what went fast goes on as fast, since its levels would have said so."""
    gone = state.place - state.average[SWIFT]
    return np.where(np.abs(gone) >= _FAST * step_units(step_index), state.place + gone // 3, outlook.place)


def advance(state: State, place: Int[np.ndarray, " components"], levels: Int[np.ndarray, " components"]) -> State:
    """The state after a frame."""
    shifts = np.array(FOLLOWING)[:, None]
    average = state.average + (place[None] - state.average >> shifts)
    busy = np.minimum(np.abs(levels), _MOST_LEVEL) << _BUSY_BITS
    return State(place, average, state.busy + (busy[None] - state.busy >> np.array(BUSY)[:, None]))


def refreshed(number: int, components: int) -> Int[np.ndarray, " refreshed"]:
    """Whose turn it is to be told anew, in the packet of this number."""
    turn = number % REFRESH_FRAMES
    return np.arange(turn * components // REFRESH_FRAMES, (turn + 1) * components // REFRESH_FRAMES)


def advance_told(
    state: State,
    outlook: Outlook,
    levels: Int[np.ndarray, " components"],
    turn: Int[np.ndarray, " refreshed"],
    places: Int[np.ndarray, " refreshed"],
    step_index: int,
) -> State:
    """The state after a frame in which some components were told anew, in steps.

    They are taken to be at rest: what a receiver had wrong of where they were, and of how fast they went, is gone.
    """
    place, average = place_of(outlook, levels, step_index), state.average.copy()
    place[turn] = average[:, turn] = places * step_units(step_index)
    return advance(state._replace(average=average), place, levels)


def to_units(coefficients: np.ndarray) -> np.ndarray:
    """Centimetres to 2^-14 cm."""
    return np.rint(coefficients * np.float64(UNITS)).astype(np.int64)


def to_cm(places: np.ndarray) -> np.ndarray:
    """2^-14 cm to centimetres."""
    return places / UNITS
