"""What a law of a rig is, and the joints and vectors that laws are made of."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .trigonometry import sine_cosine

Angles = Float[np.ndarray, " frames"]
Rows = list[Angles]  # a vector a frame, by component: (x, y, z)


@dataclass(frozen=True)
class Joint:
    """Three rotation columns, in the order of the file: R = R0 R1 R2 about the axes `axes` (0 x, 1 y, 2 z)."""

    columns: tuple[int, int, int]
    axes: tuple[int, int, int]


class AbstractLaw(abc.ABC):
    """Gives `targets` from `inputs` (columns of the table)."""

    smooth: ClassVar[bool] = False  # what it leaves moves on like a column, instead of being mere rounding

    @property
    @abc.abstractmethod
    def targets(self) -> tuple[int, ...]:
        """The columns that it gives."""

    @property
    @abc.abstractmethod
    def inputs(self) -> tuple[int, ...]:
        """The columns that it has to know."""

    @property
    @abc.abstractmethod
    def numbers(self) -> tuple[float, ...]:
        """The real parameters."""

    @abc.abstractmethod
    def with_numbers(self, numbers: Sequence[float]) -> AbstractLaw:
        """The same law with other real parameters."""

    @abc.abstractmethod
    def spec(self) -> dict[str, object]:
        """All else, for JSON."""

    @abc.abstractmethod
    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        """The targets' values, unrounded, from the rows of `inputs`; all in 1e-4 degrees."""


def listed(joint: Joint) -> list[list[int]]:
    """A joint as JSON."""
    return [list(joint.columns), list(joint.axes)]


def joint_of(pair: list[list[int]]) -> Joint:
    """What `listed` gave."""
    (a, b, c), (i, j, k) = pair
    return Joint((a, b, c), (i, j, k))


def rows(vector: tuple[float, ...], frames: int) -> Rows:
    return [np.full(frames, x) for x in vector]


def dot(a: Rows, b: Rows) -> Angles:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def turned(vector: Rows, axis: int, angle: Angles) -> Rows:
    """Vectors turned about a coordinate axis."""
    sine, cosine = sine_cosine(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    out = list(vector)
    out[j], out[k] = cosine * vector[j] - sine * vector[k], sine * vector[j] + cosine * vector[k]
    return out
