"""Segmentation of a sequence by a self-organising map (Wang et al. 2020, section III-B, (4)-(7)).

The h-segments of all paths are the input layer; an even segmentation is the output layer. Every h-segment pulls the
segment that overlaps it best, and what the pull leaves of the neighbours becomes a segment or joins the next one.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int, Int32


def som_segments(
    h: Int[np.ndarray, "paths 2"], length: int, shortest: int, rounds: int = 10
) -> Int[np.ndarray, " segments"]:
    """First frames of the segments, ascending from 0, of a sequence of `length` frames.

    `h` are first and last frames, `shortest` is LengthThr. The learning rate falls from 1/2 to 0 in even steps, one a
    round over all h-segments. Raises ValueError for an h-segment outside the sequence.
    """
    if length < 1 or not len(h):
        return np.zeros(min(length, 1), int)
    if h.min() < 0 or h.max() >= length:
        raise ValueError(f"h-segments must lie in 0..{length - 1}, got {h.min()}..{h.max()}")
    capacity = 4 + 2 * len(h) + length // max(1, min(shortest, int((h[:, 1] - h[:, 0] + 1).max())))
    starts = _refine(jnp.asarray(h, jnp.int32), jnp.asarray(even_starts(h, length, capacity)), length, shortest, rounds)
    starts = np.asarray(starts)
    return starts[starts < length].astype(int)


def even_starts(h: Int[np.ndarray, "paths 2"], length: int, capacity: int) -> Int32[np.ndarray, " capacity"]:
    """(4), (5): equal segments, as many as the longest h-segment goes into the sequence; filled up with `length`."""
    count = -(-length // int((h[:, 1] - h[:, 0] + 1).max()))
    starts = np.full(capacity, length, np.int32)
    starts[:count] = np.arange(count) * length // count
    return starts


@partial(jax.jit, static_argnames="rounds")
def _refine(
    h: Int32[Array, "paths 2"], starts: Int32[Array, " capacity"], length: int, shortest: int, rounds: int
) -> Int32[Array, " capacity"]:
    def pull(starts: Int32[Array, " capacity"], x: tuple[Array, Array]) -> tuple[Int32[Array, " capacity"], None]:
        segment, rate = x
        ends = jnp.append(starts[1:], length) - 1
        j = jnp.argmax(_iou(segment, starts, ends))
        first = starts[j] + _share(segment[0] - starts[j], rate, 2 * rounds)
        last = ends[j] + _share(segment[1] - ends[j], rate, 2 * rounds)
        return _place(starts, first, last, length, shortest), None

    rates = jnp.repeat(jnp.arange(rounds, 0, -1), len(h), total_repeat_length=rounds * len(h))
    return lax.scan(pull, starts, (jnp.tile(h, (rounds, 1)), rates))[0]


def _share(distance: Int32[Array, ""], rate: Int32[Array, ""], whole: int) -> Int32[Array, ""]:
    """(7): k times a distance, to the nearest frame; k = rate / whole."""
    return (2 * distance * rate + whole) // (2 * whole)


def _iou(
    segment: Int32[Array, "2"], starts: Int32[Array, " capacity"], ends: Int32[Array, " capacity"]
) -> Array:
    """(6), with every segment; behind the last one it is 0 or less."""
    overlap = jnp.minimum(segment[1], ends) - jnp.maximum(segment[0], starts) + 1
    overlap = jnp.where(starts > ends, 0, jnp.maximum(overlap, 0))
    return overlap / (segment[1] - segment[0] + ends - starts + 2 - overlap)


def _place(
    starts: Int32[Array, " capacity"], first: Int32[Array, ""], last: Int32[Array, ""], length: int, shortest: int
) -> Int32[Array, " capacity"]:
    """The segmentation with the segment first..last in it, and no piece beside it shorter than `shortest`."""
    before = jnp.searchsorted(starts, first, side="left")  # how many segments begin before it
    after = jnp.searchsorted(starts, last + 1, side="right")  # those from here on begin behind last + 1
    short = (before > 0) & (first - starts[jnp.maximum(before - 1, 0)] < shortest)
    before = jnp.where(short, before - 1, before)
    first = jnp.where(short & (before == 0), 0, first)
    follower = starts[jnp.minimum(after, len(starts) - 1)]
    short = (last + 1 < length) & (follower - last - 1 < shortest)
    last = jnp.where(short & (follower >= length), length - 1, last)
    after = jnp.where(short, after + 1, after)
    k = jnp.arange(len(starts))
    moved = starts[jnp.clip(k - before - 2 + after, 0, len(starts) - 1)]
    return jnp.where(k < before, starts, jnp.where(k == before, first, jnp.where(k == before + 1, last + 1, moved)))
