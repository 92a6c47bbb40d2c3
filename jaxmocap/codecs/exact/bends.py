"""The law of a bent chain: where the bone of its third joint points, from those of the two joints before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .law import AbstractLaw, Angles, Joint, Rows, dot, listed, turned
from .polynomials import recipe
from .trigonometry import arc_tangent, sine_cosine


@dataclass(frozen=True, eq=False)
class Bent(AbstractLaw):
    """The first and last angle of a chain's third joint, given its middle one: u3 is along A u0 + B u1 + C u2.

    u_i is where joint i turns the axis of that middle angle to, u0 the axis itself, and A, B, C are polynomials of 1 - u0.u1,
    1 - u1.u2 and 1 - u0.u2, by `coefficients[A B C, term]`. Solvers of spines and necks keep such a law exactly.
    """

    joints: tuple[Joint, Joint, Joint]
    degree: int
    coefficients: Float[np.ndarray, "3 terms"]
    smooth: bool = True

    @property
    def targets(self) -> tuple[int, ...]:
        return self.joints[2].columns[::2]

    @property
    def inputs(self) -> tuple[int, ...]:
        return (*self.joints[0].columns, *self.joints[1].columns, self.joints[2].columns[1])

    @property
    def numbers(self) -> tuple[float, ...]:
        return tuple(self.coefficients.ravel().tolist())

    def with_numbers(self, numbers: Sequence[float]) -> Bent:
        return replace(self, coefficients=np.array(numbers, np.float64).reshape(3, -1))

    def spec(self) -> dict[str, object]:
        return {"joints": [listed(j) for j in self.joints], "degree": self.degree}

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        arms = bones(self.joints, angles)
        terms = bend_terms(arms, self.degree)
        aim = [np.zeros(angles.shape[1]) for _ in range(3)]
        for arm, row in zip(arms, self.coefficients, strict=True):
            weight = np.zeros(angles.shape[1])
            for coefficient, term in zip(row.tolist(), terms, strict=True):
                weight = weight + coefficient * term
            aim = [a + weight * b for a, b in zip(aim, arm, strict=True)]
        return _aimed(aim, self.joints[2].axes, angles[self.joints[2].columns[1]])


def bones(joints: tuple[Joint, Joint, Joint], angles: Float[np.ndarray, "columns frames"]) -> list[Rows]:
    """u0, u1 and u2 as the second joint's child sees them."""
    frames, bone = angles.shape[1], joints[2].axes[1]
    still = [np.full(frames, float(n == bone)) for n in range(3)]
    second = _undone(still, joints[1], angles)
    return [_undone(_undone(still, joints[0], angles), joints[1], angles), second, still]


def _undone(vector: Rows, joint: Joint, angles: Float[np.ndarray, "columns frames"]) -> Rows:
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


def _aimed(aim: Rows, axes: tuple[int, int, int], middle: Angles) -> list[Angles]:
    """The outer angles, the last within a quarter turn, that turn the middle axis into the aim."""
    a, b, c = axes
    sign = 1.0 if (b - a) % 3 == 1 else -1.0
    sine, cosine = sine_cosine(middle)
    shares = np.sqrt(dot(aim, aim)) * cosine
    last_sine = np.clip(-sign * aim[a] / np.where(np.abs(shares) > 1e-9, shares, 1e-9), -1.0, 1.0)
    last_cosine = np.sqrt(1.0 - last_sine * last_sine)
    first = arc_tangent(sign * aim[c], aim[b]) - arc_tangent(sign * last_sine * sine, last_cosine)
    return [first, arc_tangent(last_sine, last_cosine)]
