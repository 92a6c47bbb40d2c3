"""What the people of a corpus have in common: the rig that a model stores once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..codecs.rig import Rig, bones_of
from ..skeleton import Skeleton

_NEVER_LESS = 0.05  # cm: no bone is so alike in a corpus that the next person's could not differ


def fit_rig(
    skeletons: list[Skeleton], rotation_sum: Float[np.ndarray, "joints 3 3"], unit_cm: float, frame_time: float
) -> Rig:
    """The rig of skeletons that share one, each person's once; `rotation_sum` is over all local rotations of each joint."""
    people = np.unique(np.stack([bones_of(s) for s in skeletons]), axis=0) * unit_cm
    lengths = np.linalg.norm(people, axis=2)
    directions = (people / np.maximum(lengths, 1e-9)[..., None]).mean(0)
    norms = np.linalg.norm(directions, axis=1, keepdims=True)
    bones = np.where(norms > 0, directions / np.maximum(norms, 1e-9), 0.0) * lengths.mean(0)[:, None]
    first = skeletons[0]
    mean = Skeleton(
        first.names, first.parents, bones[: first.joint_count], first.channels,
        first.end_joints, bones[first.joint_count :], first.axes,
    )
    used = lengths.mean(0) > 0
    partner, spread = _partners(lengths[:, used])
    fixed = np.rint(spread * 65536).astype(np.int64)
    mean_lengths = np.rint(lengths.mean(0)[used] * 65536).astype(np.int64)
    return Rig(mean, _mean_rotations(rotation_sum), mean_lengths, fixed, partner, unit_cm, frame_time)


def _partners(lengths: Float[np.ndarray, "people bones"]) -> tuple[np.ndarray, np.ndarray]:
    """For every bone the earlier one that strays alike, and how far it strays from that prediction."""
    mean = lengths.mean(0)
    size = np.median(lengths / mean, axis=1, keepdims=True)
    residual = lengths - size * mean
    partner = np.full(len(mean), -1, np.int64)
    spread = np.abs(residual).mean(0)
    for b in range(1, len(mean)):
        apart = np.abs(residual[:, b : b + 1] - residual[:, :b]).mean(0)
        best = int(np.argmin(apart))
        if apart[best] < 0.7 * spread[b]:
            partner[b], spread[b] = best, apart[best]
    return partner, np.maximum(spread, _NEVER_LESS)


def _mean_rotations(total: Float[np.ndarray, "joints 3 3"]) -> Float[np.ndarray, "joints 3 3"]:
    """The rotation nearest to each sum."""
    u, _, vt = np.linalg.svd(total)
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
