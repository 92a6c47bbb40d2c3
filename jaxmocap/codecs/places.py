"""The places that joints are at: joints on top of their parent share one, and what is shared is coded once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..skeleton import POSITION_CHANNELS, Skeleton


@dataclass(frozen=True)
class Places:
    """`first[p]` is the first joint at place p, `parents[p]` the place of its parent or -1, `counts[p]` how many joints
    are there; `of_joint[j]` is the place of joint j."""

    first: Int[np.ndarray, " places"]
    parents: Int[np.ndarray, " places"]
    counts: Int[np.ndarray, " places"]
    of_joint: Int[np.ndarray, " joints"]

    @property
    def count(self) -> int:
        return len(self.first)

    @staticmethod
    def of(skeleton: Skeleton) -> Places:
        """Joints that nothing can move away from their parent are at its place."""
        first: list[int] = []
        of_joint: list[int] = []
        for j, parent in enumerate(skeleton.parents):
            moves = bool(np.any(skeleton.offsets[j] != 0)) or bool(set(POSITION_CHANNELS) & set(skeleton.channels[j]))
            if parent < 0 or moves:
                first.append(j)
                of_joint.append(len(first) - 1)
            else:
                of_joint.append(of_joint[parent])
        parents = [of_joint[skeleton.parents[j]] if skeleton.parents[j] >= 0 else -1 for j in first]
        return Places(np.array(first), np.array(parents), np.bincount(of_joint), np.array(of_joint))

    def gather(self, positions: Float[np.ndarray, "frames joints 3"]) -> Float[np.ndarray, "frames places 3"]:
        return positions[:, self.first]

    def spread(self, positions: Float[np.ndarray, "frames places 3"]) -> Float[np.ndarray, "frames joints 3"]:
        return positions[:, self.of_joint]
