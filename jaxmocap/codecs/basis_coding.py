"""Orthonormal bases as they travel in a stream: quantised as coarsely as their coefficients allow, and predicted.

After Vasa and Skala 2009 ("Cobra: compression of the basis for PCA represented animations"): an entry is predicted from
a neighbour's, and a vector is kept the finer the more its coefficients weigh. Ours: each vector is written in coordinates
of the space orthogonal to those before it, by Householder reflections, so that what decodes is orthonormal and the i-th
of n vectors takes n - i entries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .entropy import integers
from .entropy.adaptive import SIXTEENTHS, Coder, code_signed, code_unsigned, law

COARSEST, FINEST = 3, 44  # half octaves of entries a unit
_KINDS = 128  # contexts of a kind of entries
_EXPONENT, _FIRST_EXPONENT, _PREDICTED, _ENTRY = 0, 1, 2, 8
OTHER_ENTRIES, OTHER = _ENTRY + 2 * _KINDS, _ENTRY + 3 * _KINDS  # contexts for whom else a coder serves


@dataclass(frozen=True)
class Coordinates:
    """How entries lie to each other: each is predicted from that of an earlier `parent` (-1: none), `squares` being
    the squares of the scales of their coordinates."""

    parents: Int[np.ndarray, " n"]
    squares: Int[np.ndarray, " n"]

    @property
    def count(self) -> int:
        return len(self.parents)


@dataclass(frozen=True)
class CodedBasis:
    """Entry j of vector i, j < n - i, is a multiple of 2^(-exponents[i] / 2) before the vector is made a unit; those beyond
    are zero, and entry n - 1 - i, the last, is never negative."""

    exponents: Int[np.ndarray, " vectors"]
    entries: Int[np.ndarray, "vectors n"]

    @property
    def count(self) -> int:
        return len(self.exponents)

    def first(self, count: int) -> CodedBasis:
        """The first vectors alone."""
        return CodedBasis(self.exponents[:count], self.entries[:count])

    @staticmethod
    def blank(count: int, n: int) -> CodedBasis:
        """What a reader fills."""
        return CodedBasis(np.zeros(count, np.int64), np.zeros((count, n), np.int64))

    def rows(self) -> Float[np.ndarray, "vectors n"]:
        """The orthonormal vectors."""
        count, n = self.entries.shape
        rows = -np.eye(count, n)[:, ::-1]
        for i in range(count - 1, -1, -1):
            rows = _reflect(rows, _mirror(self.entries[i], n - 1 - i))
        return rows


def precision(weight: Float[np.ndarray, " vectors"], step: float) -> Int[np.ndarray, " vectors"]:
    """Exponents at which an error in an entry does as much harm as one of `step` in a coefficient.

    `weight` is the root of the energy of each vector's coefficients.
    """
    with np.errstate(divide="ignore"):
        exponents = np.floor(2 * np.log2(weight / step))
    return np.clip(exponents, COARSEST, FINEST).astype(np.int64)


def quantise_basis(vectors: Float[np.ndarray, "vectors n"], exponents: Int[np.ndarray, " vectors"]) -> CodedBasis:
    """The nearest basis that can be coded; of each vector either sign will do."""
    local = vectors.copy()
    entries = np.zeros(vectors.shape, np.int64)
    for i, exponent in enumerate(exponents.tolist()):
        last = vectors.shape[1] - 1 - i
        rest = local[i, : last + 1]
        length = np.linalg.norm(rest)
        rest = rest / (length if length > 0 else 1.0) * (-1.0 if rest[-1] < 0 else 1.0)
        entries[i, : last + 1] = np.clip(np.rint(rest * 2.0 ** (exponent / 2)), 1 - integers.LIMIT // 4, integers.LIMIT // 4)
        local = _reflect(local, _mirror(entries[i], last))
    return CodedBasis(exponents, entries)


def code_basis(coder: Coder, basis: CodedBasis, space: Coordinates) -> CodedBasis:
    """Codes a basis; a reader fills one of the same shape."""
    exponents: list[int] = []
    entries = np.zeros_like(basis.entries)
    for i, exponent in enumerate(basis.exponents.tolist()):
        if i:
            change = code_signed(coder, _EXPONENT, law(2 * SIXTEENTHS), exponents[-1] - exponent)
            exponents.append(min(max(exponents[-1] - change, COARSEST), FINEST))
        else:
            above = code_unsigned(coder, _FIRST_EXPONENT, law(12 * SIXTEENTHS), exponent - COARSEST)
            exponents.append(min(COARSEST + above, FINEST))
        entries[i] = _code_vector(coder, basis.entries[i].tolist(), i, exponents[-1], space)
    return CodedBasis(np.array(exponents, np.int64), entries)


def cost(basis: CodedBasis, space: Coordinates) -> Float[np.ndarray, " vectors"]:
    """About how many bits each vector takes."""
    bits = []
    for i, entries in enumerate(basis.entries):
        residual = [_residuals(entries.tolist(), i, space, p) for p in (True, False)]
        bits.append(2 + min(_size(r) for r in residual))
    return np.array(bits)


def code_entries(
    coder: Coder, entries: list[int], space: Coordinates, expected: int, context: int, predicted: bool
) -> list[int]:
    """The first entries of a vector, each under a law for its size: at first `expected` sixteenths, then what was near."""
    found: list[int] = []
    near = expected
    for j, entry in enumerate(entries):
        guess = _predict(found, j, space) if predicted else 0
        mean = max((3 * expected + near) // 4, 4)
        half = (mean * mean).bit_length()
        change = code_signed(coder, context + half, law(math.isqrt(1 << half - 1)), entry - guess)
        found.append(min(max(guess + change, -integers.LIMIT), integers.LIMIT))
        near = (near + SIXTEENTHS * abs(change)) // 2
    return found


def _code_vector(coder: Coder, entries: list[int], i: int, exponent: int, space: Coordinates) -> list[int]:
    sizes = [_size(_residuals(entries, i, space, p)) for p in (False, True)]
    predicted = coder.bit(_PREDICTED * integers.SYMBOLS + min(i, 3), 1 << 15, int(sizes[1] < sizes[0]))
    free = space.count - i
    expected = math.isqrt((SIXTEENTHS**2 << exponent) // free) >> predicted
    found = code_entries(coder, entries[:free], space, expected, _ENTRY + _KINDS * predicted, bool(predicted))
    return found[:-1] + [abs(found[-1])] + [0] * i


def _residuals(entries: list[int], i: int, space: Coordinates, predicted: bool) -> list[int]:
    return [entries[j] - (_predict(entries, j, space) if predicted else 0) for j in range(space.count - i)]


def _predict(entries: list[int], j: int, space: Coordinates) -> int:
    """The parent's entry in the scale of this one, by integers alone."""
    parent = int(space.parents[j])
    if parent < 0:
        return 0
    entry = entries[parent]
    size = math.isqrt(entry * entry * int(space.squares[j]) // int(space.squares[parent]))
    return size if entry >= 0 else -size


def _size(residuals: list[int]) -> float:
    """About the bits of integers."""
    mean = sum(map(abs, residuals)) / len(residuals)
    return len(residuals) * math.log2(1 + 2 * math.e * mean)


def _mirror(entries: Int[np.ndarray, " n"], axis: int) -> Float[np.ndarray, " n"]:
    """The normal of the reflection that takes the unit vector along the entries to minus an axis."""
    length = np.linalg.norm(entries.astype(np.float64))
    normal = entries / (length if length > 0 else 1.0)
    normal[axis] += 1.0
    return normal


def _reflect(rows: Float[np.ndarray, "rows n"], normal: Float[np.ndarray, " n"]) -> Float[np.ndarray, "rows n"]:
    return rows - np.outer(rows @ normal, normal) * (2 / (normal @ normal))
