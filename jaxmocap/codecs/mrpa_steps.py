"""Prediction of `mrpa`: the steps that a segment takes from its parent's motion, and what of the forest pays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int, Int8, Int32, UInt8

from ..segmentation.forest import Forest
from . import float_streams
from .float_streams import ORDER, Steps, expected_step
from .forest_index import Links, without_loners

WEIGHTS = 9  # eighths from 0 to 1
_LINK_BITS = 40  # about what the index spends on a link
_ROUNDS = 3
_FIT_ROUNDS = 6


def first_frames(frames: Sequence[int]) -> list[int]:
    """Where every table begins in the sequence of all."""
    return [0, *np.cumsum(frames).tolist()[:-1]]


def inner_frames(frames: Sequence[int]) -> Bool[np.ndarray, " frames"]:
    """Frames of the sequence whose step from the frame before is a motion's."""
    return np.concatenate([float_streams.inner_frames(n) for n in frames])


def steps(
    known: Int32[np.ndarray, "frames lanes"],
    source: Int[np.ndarray, " n"],
    inner: Bool[np.ndarray, " frames"],
    weight: UInt8[np.ndarray, " lanes"],
    first: int,
) -> Steps:
    """How n frames from `first` on are predicted, whose parents' frames are `source` (-1 for none), all of them known."""
    at = np.maximum(source, 1)
    linked = ((source > 0) & inner[at])[:, None]
    other = np.where(linked, known[at] - known[at - 1], 0)
    return Steps(other, np.where(linked, weight, 0).astype(np.uint8), inner[first : first + len(source)])


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
    bits = np.stack([cost(steps, expected_step(past, f.astype(np.int32)[:, None])).sum(0) for f in fits])
    return np.choose(bits.argmin(0), fits).astype(np.int8)


def choose_links(
    steps: Int32[np.ndarray, "frames lanes"], own: Int32[np.ndarray, "frames lanes"], forest: Forest
) -> tuple[Links, UInt8[np.ndarray, " lanes"]]:
    """Where in its parent's motion a segment finds itself, the share of the parent's steps by channel, in eighths, and
    which links pay for their place in the index. `own` are the steps that the channels' own past lets expect."""
    back = np.zeros(len(forest.starts), int)
    for s in np.flatnonzero(forest.parent >= 0):
        back[s] = _align(steps, forest, s)
    segment = np.repeat(np.arange(len(back)), forest.ends - forest.starts + 1)
    weight = np.zeros(steps.shape[1], np.uint8)
    linked = back > 0
    for _ in range(_ROUNDS):
        at = np.flatnonzero(linked[segment])
        bits = np.stack([cost(steps[at], _blend(own[at], steps[at - back[segment[at]]], w)) for w in range(WEIGHTS)])
        weight = bits.sum(1).argmin(0)
        saved = bits[0] - np.take_along_axis(bits, weight[None, None], 0)[0]
        linked &= np.bincount(segment[at], saved.sum(1), len(linked)) > _LINK_BITS
    links = Links(forest.starts, np.where(linked, forest.parent, -1), np.where(linked, back, 0))
    return without_loners(links), weight.astype(np.uint8) * linked.any()


def _blend(own: Int32[np.ndarray, "n lanes"], other: Int32[np.ndarray, "n lanes"], weight: int) -> Int32[np.ndarray, "n lanes"]:
    return (WEIGHTS - 1 - weight) * own + weight * other + WEIGHTS // 2 >> 3


def cost(actual: Int32[np.ndarray, "*n"], expected: Int32[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """About the bits of corrections."""
    return np.log2(8 + abs(actual - expected), dtype=np.float32)


def _align(steps: Int32[np.ndarray, "frames lanes"], forest: Forest, s: int) -> int:
    """How many frames back the parent's motion is most like that of a segment; 0 where there is no room."""
    start, length, p = int(forest.starts[s]), int(forest.ends[s] - forest.starts[s]) + 1, forest.parent[s]
    first = max(2, int(forest.starts[p]) - length // 2)
    last = min(start - 1, int(forest.ends[p]) - length // 2)
    mine = steps[start : start + length]
    costs = [cost(mine, steps[m : m + length]).sum() for m in range(first, last + 1)]
    return start - first - int(np.argmin(costs)) if costs else 0
