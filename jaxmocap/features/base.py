"""What every feature is: an invertible map between a Motion and a matrix of (frames, channels)."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..motion import Motion
from ..skeleton import Skeleton
from .channels import values_of


class AbstractFeature(eqx.Module):
    """Holds what a matrix does not say of its motion. Lengths are in cm, or in file units where `unit_cm` is None."""

    skeleton: eqx.AbstractVar[Skeleton]
    frame_time: eqx.AbstractVar[float]
    unit_cm: eqx.AbstractVar[float | None]

    @abc.abstractmethod
    def to_matrix(self, motion: Motion) -> Float[Array, "frames channels"]:
        """The feature of every frame. Raises ValueError where the motion is of another rig than the feature."""

    @abc.abstractmethod
    def to_motion(self, matrix: Float[Array, "frames channels"]) -> Motion:
        """The motion whose feature the matrix is, or comes closest to."""

    @property
    def scale(self) -> float:
        """The unit of lengths in the matrix over that of the file."""
        return 1.0 if self.unit_cm is None else self.unit_cm

    def check(self, motion: Motion) -> None:
        """Raises ValueError where the motion is of another rig, has other bone lengths or another unit."""
        mine, its = self.skeleton, motion.skeleton
        if not mine.same_rig(its) or not np.array_equal(mine.offsets, its.offsets) or self.unit_cm != motion.unit_cm:
            raise ValueError("the motion has another skeleton or unit than the feature was made for")

    def motion(
        self, local: Float[np.ndarray, "3 3 joints frames"], translations: Float[np.ndarray, "3 joints frames"]
    ) -> Motion:
        """The motion of local rotations and translations (file units); on the host, where nothing is compiled."""
        values = np.asarray(values_of(self.skeleton, local, translations), np.float64)
        return Motion(self.skeleton, values, self.frame_time, self.unit_cm)
