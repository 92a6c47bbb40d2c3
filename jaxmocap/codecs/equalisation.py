"""Lagrange equalisation (Vasa and Brunnett 2014): scales for joints at which an error in each is worth the same bits.

With q[j] the error allowed to place j, bits go as -3 sum log2 q[j]. Fewest for a distortion D(q) means that the gradients
are in line: q[j] dD/dq[j] is the same for all j, and 1 / q[j] is the scale. Where D is the mean of the joints' errors,
and these go as q, this is q[j] ~ 1 / (number of joints at place j); a mean of squares would ask for its root. What
decodes has exact bones, however, which take away the part of an error that lies along them: so the derivatives are
measured, on the motion that decodes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ..features.recovery import recover, recoverable
from ..skeleton import Skeleton
from .places import Places

PER_OCTAVE = 4
MOST = 40  # quarter octaves
_FRAMES, _ROUNDS, _CHANGE, _DAMPING = 48, 3, 1.1, 0.7
_MOST_PLACES = 64  # of more, derivatives would take long to measure


def equalise(
    skeleton: Skeleton,
    places: Places,
    positions: Float[np.ndarray, "frames joints 3"],
    expected: Float[np.ndarray, "joints 3 3"] | None,
    error: float,
) -> Int[np.ndarray, " places"]:
    """Scales of all places, in quarter octaves; `positions` and the `error` at which to measure are in file
    units, `expected` are the rotations that the decoder assumes (features/recovery.py)."""
    chosen = positions[np.linspace(0, len(positions) - 1, _FRAMES).astype(int)]
    allowed = 1.0 / places.counts
    if recoverable(skeleton) and places.count <= _MOST_PLACES:
        noise = np.random.default_rng(0).normal(size=(_FRAMES, places.count, 3))
        for _ in range(_ROUNDS):
            effect = sensitivity(skeleton, places, chosen, expected, noise * error, allowed)
            allowed = allowed * (effect.mean() / np.maximum(effect, effect.mean() / 16)) ** _DAMPING
    return np.clip(np.rint(-PER_OCTAVE * np.log2(allowed)), -MOST, MOST).astype(np.int64)


def sensitivity(
    skeleton: Skeleton,
    places: Places,
    positions: Float[np.ndarray, "frames joints 3"],
    expected: Float[np.ndarray, "joints 3 3"] | None,
    noise: Float[np.ndarray, "frames places 3"],
    allowed: Float[np.ndarray, " places"],
) -> Float[np.ndarray, " places"]:
    """q[j] dD/dq[j] of every place, by differences: how the mean joint error grows with the error allowed there."""
    changed = np.repeat(allowed[None], 2 * places.count, 0)
    each = np.arange(places.count)
    changed[each, each] *= _CHANGE
    changed[each + places.count, each] /= _CHANGE
    moved = positions + (noise * changed[:, None, :, None])[:, :, places.of_joint]
    made = recover(skeleton, moved.reshape(-1, *positions.shape[1:]), expected).positions.reshape(moved.shape)
    distortion = np.linalg.norm(made - positions, axis=-1).mean((1, 2))
    return (distortion[each] - distortion[each + places.count]) / (2 * np.log(_CHANGE))
