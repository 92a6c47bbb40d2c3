"""How the bones of people stray from their mean."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ...codecs.learned.bones import MOST_PEOPLE, BoneModel

_NEVER_LESS = 0.02  # cm: no bone is so alike in a corpus that the next person's could not differ
_ALIKE = 0.7
_MIRRORS = np.array([[1, 1, 1], [-1, 1, 1]])


def fit_bones(people: Float[np.ndarray, "people bones 3"]) -> BoneModel:
    """Of every person's bones in cm, each person's once."""
    mean = people.mean(0)
    length, mean_length = np.linalg.norm(people, axis=2), np.linalg.norm(mean, axis=1)
    used = mean_length > 0
    size = np.median(length[:, used] / mean_length[used], axis=1) if used.any() else np.ones(len(people))
    strayed = people - size[:, None, None] * mean
    spread = np.abs(strayed).mean(0)
    partner, mirror = np.full(len(mean), -1), np.ones((len(mean), 3), int)
    for b in range(1, len(mean)):
        apart = np.abs(strayed[:, b, None, None] - _MIRRORS * strayed[:, :b, None]).mean(0)
        best, m = np.unravel_index(apart.sum(-1).argmin(), apart.shape[:2])
        if apart[best, m].sum() < _ALIKE * spread[b].sum():
            partner[b], mirror[b], spread[b] = best, _MIRRORS[m], apart[best, m]
    levels = np.rint(16 * np.log2(np.maximum(spread, _NEVER_LESS))).astype(np.int64)
    known = np.rint(people[:MOST_PEOPLE] * 65536).astype(np.int64)
    return BoneModel(np.rint(mean * 65536).astype(np.int64), levels, partner, mirror, known)
