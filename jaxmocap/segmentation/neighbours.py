"""Radius search among frames by a forest of randomised k-d trees (Muja and Lowe, TPAMI 36(11), 2014).

Every tree splits at the median of a dimension drawn from those that vary most, until leaves are small. A frame's
candidates are the frames that share a leaf with it in any tree; the distance itself then decides.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

_VARYING = 5


def radius_neighbours(
    joints: Float32[np.ndarray, "frames joints 3"],
    weights: Float32[np.ndarray, " joints"],
    radius: float,
    most: int,
    apart: int,
    trees: int = 8,
    leaf: int = 128,
) -> tuple[Int32[np.ndarray, "frames most"], Float32[np.ndarray, "frames most"]]:
    """For every frame the frames nearest to it within the radius, by index, and their distances; -1 and inf fill up.

    The distance is equation (2) of Wang et al. 2020: the weighted sum over joints of the lengths of differences.
    Frames less than `apart` frames away do not count, as they are the same piece of motion. Of more neighbours than
    `most` the nearest are kept. The trees are drawn alike in every call.
    """
    count = len(joints)
    weighted = joints * weights[:, None]
    flat = weighted.reshape(count, -1)
    found = np.full((count, most), -1, np.int32)
    distance = np.full((count, most), np.inf, np.float32)
    for seed in range(trees):
        for members in _leaves(flat, np.random.default_rng(seed), leaf):
            near = _distances(weighted[members])
            near[(near >= radius) | (abs(members[:, None] - members) < apart)] = np.inf
            _unite(found, distance, members, near)
    order = np.argsort(np.where(found < 0, count, found), 1)
    return np.take_along_axis(found, order, 1), np.take_along_axis(distance, order, 1)


def _leaves(
    flat: Float[np.ndarray, "frames dimensions"], rng: np.random.Generator, leaf: int
) -> Iterator[Int[np.ndarray, " n"]]:
    """The leaves of one randomised tree, as frame indices."""
    waiting = [np.arange(len(flat))]
    while waiting:
        members = waiting.pop()
        if len(members) <= leaf:
            yield members
            continue
        sample = flat[members[:: max(1, len(members) // 256)]]
        dimension = rng.choice(np.argsort(-sample.var(0))[:_VARYING])
        values = flat[members, dimension]
        order = np.argpartition(values, len(members) // 2)
        waiting += [members[order[: len(members) // 2]], members[order[len(members) // 2 :]]]


def _distances(joints: Float32[np.ndarray, "n joints 3"]) -> Float32[np.ndarray, "n n"]:
    by_joint = joints.transpose(1, 0, 2)
    square = (by_joint**2).sum(2)
    gram = by_joint @ by_joint.transpose(0, 2, 1)
    return np.sqrt(np.maximum(square[:, :, None] + square[:, None, :] - 2 * gram, 0)).sum(0)


def _unite(
    found: Int32[np.ndarray, "frames most"],
    distance: Float32[np.ndarray, "frames most"],
    members: Int[np.ndarray, " n"],
    near: Float32[np.ndarray, "n n"],
) -> None:
    """Puts a leaf's pairs among the nearest that its frames have so far."""
    most = found.shape[1]
    known = found[members]
    seen = np.searchsorted(np.sort(members), known)
    order = np.argsort(members)
    local = order[np.minimum(seen, len(members) - 1)]
    again = (known >= 0) & (members[local] == known)
    near[np.nonzero(again)[0], local[again]] = np.inf
    both = np.concatenate([distance[members], near], 1)
    indices = np.concatenate([known, np.broadcast_to(members.astype(np.int32), near.shape)], 1)
    best = np.argpartition(both, most - 1, 1)[:, :most] if both.shape[1] > most else np.argsort(both, 1)[:, :most]
    distance[members] = np.take_along_axis(both, best, 1)
    found[members] = np.where(np.isfinite(distance[members]), np.take_along_axis(indices, best, 1), -1)
