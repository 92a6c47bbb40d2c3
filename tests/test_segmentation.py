"""Recurring patterns: neighbours, paths, the self-organising map against a plain one, and the forest."""

import numpy as np
import pytest

from jaxmocap.segmentation.forest import build_forest, iou
from jaxmocap.segmentation.neighbours import radius_neighbours
from jaxmocap.segmentation.paths import Paths, grow_paths
from jaxmocap.segmentation.som import even_starts, som_segments

WEIGHTS = np.array([0.7, 0.3, 0.7, 0.7, 0.3], np.float32)


def wandering(frames: int, seed: int) -> np.ndarray:
    """A smooth random motion of five joints, degrees."""
    steps = np.random.default_rng(seed).normal(size=(frames + 40, 5, 3))
    return np.stack([np.convolve(c, np.hanning(41), "valid") for c in steps.reshape(len(steps), -1).T], 1).reshape(-1, 5, 3)[
        :frames
    ].astype(np.float32)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float((WEIGHTS * np.sqrt(((a - b) ** 2).sum(-1))).sum())


def test_neighbours_are_those_of_the_distance():
    motion = wandering(500, 0)
    radius = 12.0
    found, distances = radius_neighbours(motion, WEIGHTS, radius, 64, 20, leaf=100)
    true = {(m, n) for m in range(500) for n in range(500) if abs(m - n) >= 20 and distance(motion[m], motion[n]) < radius}
    pairs = {(m, int(n)) for m in range(500) for n in found[m] if n >= 0}
    assert len(true) > 500
    assert pairs <= true
    assert len(pairs) > 0.9 * len(true)  # the trees may miss some
    for m, k in np.argwhere(found >= 0)[::17]:
        assert distances[m, k] == pytest.approx(distance(motion[m], motion[found[m, k]]), abs=1e-2)
    assert np.isinf(distances[found < 0]).all()


def test_a_motion_that_comes_again_is_a_path():
    first, between = wandering(120, 1), wandering(90, 2) + 300
    motion = np.concatenate([first, between, first + 0.01])
    found, distances = radius_neighbours(motion, WEIGHTS, 3.0, 8, 60)
    paths = grow_paths(found, distances, 100)
    spans = {(*h, *v) for h, v in zip(paths.h.tolist(), paths.v.tolist(), strict=True)}
    assert (210, 329, 0, 119) in spans
    assert (0, 119, 210, 329) in spans


def plain_paths(columns, distances, shortest):
    """Every path by name, one node after the other."""
    best, before = {}, []
    for t, (nodes, costs) in enumerate(zip(columns.tolist(), distances.tolist(), strict=True)):
        now = []
        for node, price in zip(nodes, costs, strict=True):
            if node < 0:
                continue
            fits = [
                p for p in before
                if 0 <= node - p["node"] <= 2 and (t < p["root"] if p["root"] > p["top"] else node < p["top"])
            ]
            p = max(fits, key=lambda p: (p["depth"], -p["sum"] / p["depth"]), default=None)
            new = {"top": t, "root": node, "depth": 1, "sum": price}
            if p is not None:
                new = {"top": p["top"], "root": p["root"], "depth": p["depth"] + 1, "sum": p["sum"] + price}
            now.append({**new, "node": node})
            key, rank = (new["top"], new["root"]), (new["depth"], -new["sum"] / new["depth"])
            if new["depth"] >= shortest and (key not in best or rank > best[key][0]):
                best[key] = rank, (new["top"], t), (new["root"], node)
        before = now
    return sorted((h, v) for _, h, v in best.values())


def test_paths_are_those_of_a_plain_search():
    motion = np.concatenate([wandering(150, 3)] * 3) + np.random.default_rng(4).normal(size=(450, 5, 3)).astype(np.float32)
    found, distances = radius_neighbours(motion, WEIGHTS, 25.0, 12, 10)
    paths = grow_paths(found, distances, 10)
    pairs = sorted(zip(map(tuple, paths.h.tolist()), map(tuple, paths.v.tolist()), strict=True))
    assert len(pairs) > 4
    assert pairs == plain_paths(found, distances, 10)
    assert all(h[1] < v[0] or v[1] < h[0] for h, v in pairs)


def plain_som(h, length, shortest, rounds):
    """(4)-(7) on a list of segments."""
    starts = even_starts(h, length, length)
    starts = starts[starts < length].tolist()
    for rate in range(rounds, 0, -1):
        for a, b in h.tolist():
            ends = [s - 1 for s in starts[1:]] + [length - 1]
            j = int(np.argmax(iou(np.array(a), np.array(b), np.array(starts), np.array(ends)).astype(np.float32)))
            first = starts[j] + (2 * (a - starts[j]) * rate + 2 * rounds) // (4 * rounds)
            last = ends[j] + (2 * (b - ends[j]) * rate + 2 * rounds) // (4 * rounds)
            left = [s for s in starts if s < first]
            if left and first - left[-1] < shortest:  # too short a rest joins the segment before it
                left.pop()
                first = first if left else 0
            right = [s for s in starts if s > last + 1]
            end = right[0] if right else length
            if last + 1 < length and end - last - 1 < shortest:  # ... or the one behind it
                if right:
                    right.pop(0)
                else:
                    last = length - 1
            starts = [*left, first, *([last + 1] if last + 1 < length else []), *right]
    return starts


@pytest.mark.parametrize("seed", range(4))
def test_the_map_is_that_of_a_plain_one(seed: int):
    rng = np.random.default_rng(seed)
    first = np.sort(rng.integers(0, 900, 40))
    h = np.stack([first, np.minimum(first + rng.integers(54, 200, 40), 999)], 1)
    segments = som_segments(h, 1000, 30, 10)
    assert segments.tolist() == plain_som(h, 1000, 30, 10)
    assert segments[0] == 0 and (np.diff(segments, append=1000) > 0).all()
    assert len(segments) > 3


def test_the_map_of_nothing():
    none = np.zeros((0, 2), int)
    assert som_segments(none, 500, 30).tolist() == [0]
    assert som_segments(none, 0, 30).tolist() == []
    with pytest.raises(ValueError, match="0..99"):
        som_segments(np.array([[0, 100]]), 100, 30)


def test_segments_with_one_counterpart_are_a_tree():
    h, v = [[0, 99], [200, 299], [400, 499]], [[600, 699], [605, 699], [100, 150]]
    paths = Paths(np.array(h), np.array(v), np.ones(3, np.float32))
    starts = np.array([0, 100, 200, 300, 400, 500])
    forest = build_forest(starts, starts + 99, paths, 0.6)
    assert forest.parent.tolist() == [-1, -1, 0, -1, -1, -1]
    assert forest.tree[0] == forest.tree[2]
    assert len(set(forest.tree.tolist())) == 5
    assert (build_forest(starts, starts + 99, paths, 0.99).parent == -1).all()
