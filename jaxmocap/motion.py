"""A Motion: a skeleton and what its channels did, as the file said it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .skeleton import POSITION_CHANNELS, Skeleton


class SourceText(Protocol):
    """The text that a motion was read from; writers return it unchanged where the values are still the same."""

    @property
    def format(self) -> str: ...


class Motion(eqx.Module):
    """`values[f, c]` is channel `c` of the skeleton in frame `f`: degrees and file units, float64, on the host.

    `frame_time` is in seconds. `unit_cm` is centimetres per file unit, or None where nobody has said: BVH has no unit.
    A motion of which only positions are known is a motion whose joints have position channels and no rotations.
    """

    skeleton: Skeleton
    values: Float[np.ndarray, "frames channels"]
    frame_time: float = eqx.field(static=True)
    unit_cm: float | None = eqx.field(static=True)
    source: SourceText | None = eqx.field(static=True)

    def __init__(
        self,
        skeleton: Skeleton,
        values: Float[np.ndarray, "frames channels"],
        frame_time: float,
        unit_cm: float | None = None,
        source: SourceText | None = None,
    ):
        """Raises ValueError when the values do not fit the skeleton or the frame time is not positive."""
        self.skeleton = skeleton
        self.values = values if not isinstance(values, Sequence) else np.asarray(values, np.float64)
        self.frame_time = frame_time
        self.unit_cm = unit_cm
        self.source = source
        if isinstance(self.values, np.ndarray) and self.values.shape[1:] != (skeleton.channel_count,):
            raise ValueError(f"values have shape {self.values.shape}, wanted (frames, {skeleton.channel_count})")
        if not frame_time > 0:
            raise ValueError(f"frame_time is {frame_time}, wanted seconds above 0")
        if unit_cm is not None and not unit_cm > 0:
            raise ValueError(f"unit_cm is {unit_cm}, wanted centimetres per file unit above 0")

    @property
    def frame_count(self) -> int:
        return len(self.values)

    @property
    def scale(self) -> float:
        """Centimetres per file unit, 1 where the unit is unknown: errors are then in file units."""
        return 1.0 if self.unit_cm is None else self.unit_cm

    def frames(self, start: int, stop: int | None = None) -> Motion:
        """Frames `start:stop`, as Python slices them."""
        return Motion(self.skeleton, self.values[start:stop], self.frame_time, self.unit_cm)

    def with_values(self, values: Float[np.ndarray, "frames channels"]) -> Motion:
        """The same motion with other values; the text of what did not change is kept."""
        return Motion(self.skeleton, values, self.frame_time, self.unit_cm, self.source)

    @staticmethod
    def from_positions(
        positions: Float[np.ndarray, "frames joints 3"],
        names: Sequence[str],
        frame_time: float,
        parents: Sequence[int] | None = None,
        unit_cm: float | None = None,
    ) -> Motion:
        """A positions-only motion from global positions in file units; every joint gets three position channels."""
        positions = np.asarray(positions, np.float64)
        joints = len(names)
        parents = [-1] * joints if parents is None else list(parents)
        has_parent = np.array(parents) >= 0
        local = positions - np.where(has_parent[:, None], positions[:, np.maximum(parents, 0)], 0.0)
        skeleton = Skeleton(names, parents, np.zeros((joints, 3)), [POSITION_CHANNELS] * joints)
        return Motion(skeleton, local.reshape(len(positions), -1), frame_time, unit_cm)
