"""A forest of similar segments, with paths as connection agents (Wang et al. 2020, section III-C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .paths import Paths


@dataclass(frozen=True, eq=False)
class Forest:
    """Segments in the order of the sequence, each with the number of its tree, and its parent or -1 for a root.

    Parents come before their children in the sequence.
    """

    starts: Int[np.ndarray, " segments"]
    ends: Int[np.ndarray, " segments"]
    tree: Int[np.ndarray, " segments"]
    parent: Int[np.ndarray, " segments"]


def build_forest(
    starts: Int[np.ndarray, " segments"], ends: Int[np.ndarray, " segments"], paths: Paths, threshold: float
) -> Forest:
    """Trees of the segments starts..ends, both included; `threshold` is IoUThr.

    The longest segment is the first root. Of the others, in the order of the sequence, each goes to the tree that holds
    the segment most similar to it, or begins a tree; at the end, trees with similar segments are merged. A tree says
    what belongs together; within one, the parent of a segment is the most similar of those before it.
    """
    similarity = _similarities(starts, ends, paths)
    count = len(starts)
    tree = np.full(count, -1)
    longest = int(np.argmax(ends - starts)) if count else 0
    for n, s in enumerate([longest, *(i for i in range(count) if i != longest)][:count]):
        best = int(np.argmax(np.where(tree >= 0, similarity[s], -1))) if n else s
        tree[s] = tree[best] if n and similarity[s, best] >= threshold else n
    for a, b in np.argwhere(np.triu(similarity > threshold, 1)):
        tree[tree == tree[b]] = tree[a]
    parent = np.full(count, -1)
    for s in range(1, count):
        within = np.where(tree[:s] == tree[s], similarity[s, :s], -1)
        if within.max() >= threshold:
            parent[s] = np.argmax(within)
    return Forest(starts, ends, np.unique(tree, return_inverse=True)[1], parent)


def iou(
    starts: Int[np.ndarray, "*a"], ends: Int[np.ndarray, "*a"], starts2: Int[np.ndarray, "*b"], ends2: Int[np.ndarray, "*b"]
) -> Float[np.ndarray, "..."]:
    """(6): shared frames over all frames of two segments."""
    overlap = np.maximum(np.minimum(ends, ends2) - np.maximum(starts, starts2) + 1, 0)
    return overlap / (ends - starts + 1 + ends2 - starts2 + 1 - overlap)


def _similarities(
    starts: Int[np.ndarray, " segments"], ends: Int[np.ndarray, " segments"], paths: Paths
) -> Float[np.ndarray, "segments segments"]:
    """Of every pair of segments the IoU of their counterparts: the v-segments of the h-segments that fit them best.

    Where the counterpart of one overlaps the other itself, that IoU counts if it is larger: else a motion that comes just
    twice would find no likeness, as each is the other's counterpart.
    """
    count = len(starts)
    if not len(paths):
        return np.zeros((count, count))
    v, has = np.zeros((count, 2), int), np.zeros(count, bool)
    for s in range(count):
        fit = iou(paths.h[:, 0], paths.h[:, 1], starts[s], ends[s])
        v[s], has[s] = paths.v[np.argmax(fit)], fit.max() > 0
    indirect = np.where(has, iou(v[:, None, 0], v[:, None, 1], v[:, 0], v[:, 1]), 0.0)
    direct = iou(v[:, None, 0], v[:, None, 1], starts, ends)
    one_way = np.where(has[:, None], np.maximum(indirect, direct), 0.0)
    return np.maximum(one_way, one_way.T)
