"""Polynomial laws: angles near a polynomial of other angles, in whole numbers."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .law import AbstractLaw, Angles

TERM_BITS, COEFFICIENT_BITS = 20, 4
REACH = 1.5


@dataclass(frozen=True, eq=False)
class Polynomial(AbstractLaw):
    """Targets near a polynomial of other angles, for what has no closed form.

    All sums are of whole numbers that doubles hold exactly, so that their order does not matter. `scales`: the angle (1e-4
    degrees) that becomes 1; `coefficients[term, target]` in 2^-COEFFICIENT_BITS of 1e-4 degrees, for the terms of `monomials`.
    """

    outputs: tuple[int, ...]
    variables: tuple[int, ...]
    scales: tuple[int, ...]
    degree: int
    coefficients: Float[np.ndarray, "terms targets"]
    smooth: ClassVar[bool] = True

    @property
    def targets(self) -> tuple[int, ...]:
        return self.outputs

    @property
    def inputs(self) -> tuple[int, ...]:
        return self.variables

    @property
    def numbers(self) -> tuple[float, ...]:
        return tuple(self.coefficients.ravel().tolist())

    def with_numbers(self, numbers: Sequence[float]) -> Polynomial:
        return replace(self, coefficients=np.array(numbers).reshape(-1, len(self.outputs)))

    def spec(self) -> dict[str, object]:
        return {"targets": self.outputs, "inputs": self.variables, "scales": self.scales, "degree": self.degree}

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        terms = monomials(angles[list(self.variables)], self.scales, self.degree)
        return list(self.coefficients.T @ terms / (1 << TERM_BITS + COEFFICIENT_BITS))


@functools.cache
def recipe(variables: int, degree: int) -> tuple[tuple[int, int], ...]:
    """Every monomial up to the degree but 1, by degree: the variable and the earlier monomial that it is the product of."""
    every = itertools.product(range(degree + 1), repeat=variables)
    ordered = sorted((e for e in every if sum(e) <= degree), key=lambda e: (sum(e), e))
    place = {e: n for n, e in enumerate(ordered)}
    steps = []
    for e in ordered[1:]:
        i = next(k for k, power in enumerate(e) if power)
        steps.append((i, place[*e[:i], e[i] - 1, *e[i + 1 :]]))
    return tuple(steps)


def monomials(
    angles: Float[np.ndarray, "inputs frames"], scales: Sequence[int], degree: int
) -> Float[np.ndarray, "terms frames"]:
    """Whole numbers of 2^-TERM_BITS; an angle beyond REACH scales counts as that."""
    one = float(1 << TERM_BITS)
    units = np.clip(angles / np.array(scales, np.float64)[:, None], -REACH, REACH)
    steps = recipe(len(scales), degree)
    terms = np.empty((1 + len(steps), angles.shape[1]))
    terms[0] = one
    for n, (i, lower) in enumerate(steps, 1):
        np.rint(np.multiply(terms[lower], units[i], out=terms[n]), out=terms[n])
    return terms
