"""Joint positions as a feature: what LSDT, Gu and the repeated motion analysis code."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import positions_cm
from ..motion import Motion
from ..skeleton import Skeleton
from .base import AbstractFeature
from .recovery import recover, recoverable


class Positions(AbstractFeature):
    """Global joint positions, x y z of the first joint first, in cm (in file units where the unit is unknown).

    On the way back rotations are recovered from the positions where the skeleton allows it; then twists of leaves and
    of single bones, which no position shows, are those of the rest pose. Else the motion keeps positions only.
    """

    skeleton: Skeleton
    frame_time: float = eqx.field(static=True)
    unit_cm: float | None = eqx.field(static=True)

    @staticmethod
    def of(motion: Motion) -> Positions:
        return Positions(motion.skeleton, motion.frame_time, motion.unit_cm)

    def to_matrix(self, motion: Motion) -> Float[Array, "frames channels"]:
        self.check(motion)
        return positions_cm(motion).reshape(motion.frame_count, -1)

    def to_motion(self, matrix: Float[Array, "frames channels"]) -> Motion:
        """Raises ValueError where the matrix has not three columns a joint."""
        columns = 3 * self.skeleton.joint_count
        if matrix.shape[1:] != (columns,):
            raise ValueError(f"matrix has shape {matrix.shape}, wanted (frames, {columns})")
        positions = np.asarray(matrix).reshape(len(matrix), -1, 3) / self.scale
        if recoverable(self.skeleton) and self.skeleton.has_rotations:
            values = np.asarray(recover(self.skeleton, positions).values, np.float64)
            return Motion(self.skeleton, values, self.frame_time, self.unit_cm)
        names, parents = self.skeleton.names, self.skeleton.parents
        return Motion.from_positions(positions, names, self.frame_time, parents, self.unit_cm)
