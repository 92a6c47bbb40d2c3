"""The law of a bent chain: where the bone of its third joint points, from those of the two joints before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .law import AbstractLaw, Angles, Joint, Rows, dot, listed, turned
from .polynomials import recipe
from .trigonometry import arc_tangent, sine_cosine


@dataclass(frozen=True, eq=False)
class Bent(AbstractLaw):
    """The first and last angle of a chain's third joint, given its middle one: u3 is along A u0 + B u1 + C u2.

    u_i is where joint i turns the axis of that middle angle to, u0 the axis itself, and A, B, C are polynomials of 1 - u0.u1,
    1 - u1.u2 and 1 - u0.u2, by `coefficients[sheet, A B C, term]`. Solvers of spines and necks keep such a law exactly; some
    keep a second one (a second sheet) where by the first the third joint would bend so little that 1 - u2.u3 < `least`.
    """

    joints: tuple[Joint, Joint, Joint]
    degree: int
    least: float
    coefficients: Float[np.ndarray, "sheets 3 terms"]
    smooth: ClassVar[bool] = True

    @property
    def targets(self) -> tuple[int, ...]:
        return self.joints[2].columns[::2]

    @property
    def inputs(self) -> tuple[int, ...]:
        return (*self.joints[0].columns, *self.joints[1].columns, self.joints[2].columns[1])

    @property
    def numbers(self) -> tuple[float, ...]:
        return (self.least, *self.coefficients.ravel().tolist())

    def with_numbers(self, numbers: Sequence[float]) -> Bent:
        terms = 1 + len(recipe(3, self.degree))
        return replace(self, least=float(numbers[0]), coefficients=np.array(numbers[1:], np.float64).reshape(-1, 3, terms))

    def spec(self) -> dict[str, object]:
        return {"joints": [listed(j) for j in self.joints], "degree": self.degree}

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        third = self.joints[2]
        first, *others = self.aims(angles)
        bend = 1.0 - first[third.axes[1]]
        for other in others:
            first = [np.where(bend < self.least, y, x) for x, y in zip(first, other, strict=True)]
        return _turns(first, third.axes, angles[third.columns[1]])

    def aims(self, angles: Float[np.ndarray, "columns frames"]) -> list[Rows]:
        """Unit vectors u3 by each sheet, in the coordinates of `bones`."""
        arms = bones(self.joints, angles)
        terms = bend_terms(arms, self.degree)
        return [_unit(_combined(arms, [_weighted(terms, row) for row in sheet])) for sheet in self.coefficients.tolist()]


def _weighted(terms: Sequence[Angles], weights: Sequence[float]) -> Angles:
    total = np.zeros_like(terms[0])
    for weight, term in zip(weights, terms, strict=True):
        total += weight * term
    return total


def _combined(vectors: Sequence[Rows], weights: Sequence[Angles]) -> Rows:
    x, y, z = weights
    return [x * a + y * b + z * c for a, b, c in zip(*vectors, strict=True)]


def _unit(vector: Rows) -> Rows:
    length = np.sqrt(dot(vector, vector))
    return [x / np.where(length > 0, length, 1.0) for x in vector]


def bones(joints: tuple[Joint, Joint, Joint], angles: Float[np.ndarray, "columns frames"]) -> list[Rows]:
    """u0, u1 and u2 in the coordinates that the third joint turns from."""
    first, second, third = joints
    still = _middle_axis(third, angles.shape[1])
    u1 = _turned_back(still, second, angles)
    u0 = _turned_back(_turned_back(still, first, angles), second, angles)
    return [u0, u1, still]


def bone(third: Joint, angles: Float[np.ndarray, "columns frames"]) -> Rows:
    """u3 in the same coordinates."""
    vector = _middle_axis(third, angles.shape[1])
    for axis, column in zip(third.axes[::-1], third.columns[::-1], strict=True):
        vector = turned(vector, axis, angles[column])
    return vector


def _middle_axis(joint: Joint, frames: int) -> Rows:
    return [np.full(frames, float(n == joint.axes[1])) for n in range(3)]


def _turned_back(vector: Rows, joint: Joint, angles: Float[np.ndarray, "columns frames"]) -> Rows:
    """R^T v."""
    for axis, column in zip(joint.axes, joint.columns, strict=True):
        vector = turned(vector, axis, -angles[column])
    return vector


def bend_terms(arms: Sequence[Rows], degree: int) -> list[Angles]:
    """Every monomial of the three bends up to the degree."""
    u0, u1, u2 = arms
    bends = [1.0 - dot(u0, u1), 1.0 - dot(u1, u2), 1.0 - dot(u0, u2)]
    terms = [np.ones_like(bends[0])]
    for variable, lower in recipe(3, degree):
        terms.append(terms[lower] * bends[variable])
    return terms


def _turns(aim: Rows, axes: tuple[int, int, int], middle: Angles) -> list[Angles]:
    """The outer angles, the last within a quarter turn, that turn the middle axis into the aim."""
    a, b, c = axes
    sign = 1.0 if (b - a) % 3 == 1 else -1.0
    sine, cosine = sine_cosine(middle)
    last_sine = np.clip(-sign * aim[a] / np.where(np.abs(cosine) > 1e-9, cosine, 1e-9), -1.0, 1.0)
    last_cosine = np.sqrt(1.0 - last_sine * last_sine)
    first = arc_tangent(sign * aim[c], aim[b]) - arc_tangent(sign * last_sine * sine, last_cosine)
    return [first, arc_tangent(last_sine, last_cosine)]
