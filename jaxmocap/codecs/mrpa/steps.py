"""Prediction of `mrpa`: the steps that a segment takes from its parent's motion, and what of the forest pays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32

from ...segmentation.forest import Forest
from . import float_streams
from .float_streams import ORDER, Steps, expected_step
from .forest_index import SHARES, Links, without_loners

_LINK_BITS = 120  # about what the index spends on a link besides ...
_SHARE_BITS = 1  # ... every channel that takes a share
_TRIAL_SHARE = 2
_WINDOW = 24  # frames
_FIT_ROUNDS = 6


def first_frames(frames: Sequence[int]) -> list[int]:
    """Where every table begins in the sequence of all."""
    return [0, *np.cumsum(frames).tolist()[:-1]]


def inner_frames(frames: Sequence[int]) -> Bool[np.ndarray, " frames"]:
    """Frames of the sequence whose step from the frame before is a motion's."""
    return np.concatenate([float_streams.inner_frames(n) for n in frames])


def steps(
    known: Int32[np.ndarray, "frames lanes"], links: Links, inner: Bool[np.ndarray, " frames"], first: int, stop: int
) -> Steps:
    """How the frames first..stop-1 are predicted, all that they lean on being known."""
    source = links.source(len(known))[first:stop]
    at = np.maximum(source, 0)
    linked = ((source > 0) & inner[at])[:, None]
    other = np.where(linked, known[at] - known[at - 1], 0)
    weight = np.where(linked, links.weight(np.arange(first, stop)), 0)
    return Steps(other, weight.astype(np.uint8), inner[first:stop])


def fit_coefficients(
    steps: Int32[np.ndarray, "frames lanes"], past: Int32[np.ndarray, "order frames lanes"]
) -> Int8[np.ndarray, "order lanes"]:
    """Linear prediction of every channel's steps, for about the fewest bits: least squares, weighted by 1 / error.

    A channel for which that does worse goes on with its last step, or stands still.
    """
    past64, target = past.astype(np.float64), steps.astype(np.float64)
    beta = np.zeros((ORDER, steps.shape[1]))
    beta[0] = 1
    for _ in range(_FIT_ROUNDS):
        weight = 1 / (8 + abs(target - (beta[:, None] * past64).sum(0)))
        normal = np.stack([[(a * b * weight).sum(0) for a in past64] for b in past64]).transpose(2, 0, 1)
        right = np.stack([(a * target * weight).sum(0) for a in past64], 1)
        beta = np.linalg.solve(normal + 1e-3 * np.eye(ORDER), right[..., None])[..., 0].T
    fits = [np.rint(32 * beta).clip(-128, 127), np.eye(ORDER, 1) * np.full(len(beta[0]), 32), 0 * beta]
    bits = np.stack([cost(steps, expected_step(past, f.astype(np.int32)[:, None])) for f in fits])
    return np.choose(bits.argmin(0), fits).astype(np.int8)


def choose_links(
    steps: Int32[np.ndarray, "frames lanes"], own: Int32[np.ndarray, "frames lanes"], forest: Forest
) -> Links:
    """Where in its parent's motion a segment finds itself, which channels take how much of its steps, and which links
    pay for their place in the index. `own` are the steps that the channels' own past lets expect."""
    count = len(forest.starts)
    parent, back = np.full(count, -1), np.zeros(count, int)
    shares = np.zeros((count, steps.shape[1]), np.uint8)
    for s in np.flatnonzero(forest.parent >= 0).tolist():
        found, saved = _best_link(steps, own, forest, s)
        if saved.max(0).sum() > _LINK_BITS:
            parent[s], back[s], shares[s] = forest.parent[s], found, saved.argmax(0)
    return without_loners(Links(forest.starts, parent, back, shares))


def _best_link(
    steps: Int32[np.ndarray, "frames lanes"], own: Int32[np.ndarray, "frames lanes"], forest: Forest, s: int
) -> tuple[int, Float32[np.ndarray, "shares lanes"]]:
    """How many frames back the parent's motion helps a segment most, and what every share of it saves, in bits."""
    start, length, p = int(forest.starts[s]), int(forest.ends[s] - forest.starts[s]) + 1, forest.parent[s]
    actual, expected = steps[start : start + length], own[start : start + length]
    alone = cost(actual, expected)
    places = range(max(0, forest.starts[p] - length // 2), min(start - 1, forest.ends[p] - length // 2) + 1)

    def saved(place: int, share: int) -> Float32[np.ndarray, " lanes"]:
        return alone - cost(actual, _blend(expected, steps[place : place + length], share)) - _SHARE_BITS * (share > 0)

    gains = [np.maximum(saved(place, _TRIAL_SHARE), 0).sum() for place in places]
    if not gains:
        return 0, np.zeros((1, len(alone)), np.float32)
    place = places[int(np.argmax(gains))]
    return start - place, np.stack([saved(place, int(share)) for share in SHARES])


def _blend(own: Int32[np.ndarray, "n lanes"], other: Int32[np.ndarray, "n lanes"], share: int) -> Int32[np.ndarray, "n lanes"]:
    return (8 - share) * own + share * other + 4 >> 3


def cost(actual: Int32[np.ndarray, "n lanes"], expected: Int32[np.ndarray, "n lanes"]) -> Float32[np.ndarray, " lanes"]:
    """About what a coder that adapts to the size of corrections pays for them, in bits."""
    error = abs(actual - expected).astype(np.float32)
    begins = np.arange(0, len(error), _WINDOW)
    lengths = np.diff(begins, append=len(error)).astype(np.float32)[:, None]
    return (lengths * np.log2(1 + np.add.reduceat(error, begins) / lengths)).sum(0)
