"""Laws of a rig: channels that others in the same frame determine, by the geometry of joints.

A joint with fewer than three axes leaves its three Euler angles a law u^T R v = g, which is a sine and a cosine of any one
of them. A joint that aims where another one points has all three. What a law predicts is the same on every machine.
"""

from __future__ import annotations

import abc
import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int32, Int64

from .trigonometry import arc_tangent, sine_cosine

TERM_BITS, COEFFICIENT_BITS = 20, 4
_REACH = 1.5
Angles = Float[np.ndarray, " frames"]
Integers = Int64[np.ndarray, " frames"]
Rows = list[Angles]  # a vector a frame, by component: (x, y, z)


@dataclass(frozen=True)
class Joint:
    """Three rotation columns, in the order of the file: R = R0 R1 R2 about the axes `axes` (0 x, 1 y, 2 z)."""

    columns: tuple[int, int, int]
    axes: tuple[int, int, int]


class AbstractLaw(abc.ABC):
    """Gives `targets` from `inputs` (columns of the table)."""

    targets: tuple[int, ...]
    inputs: tuple[int, ...]
    smooth: bool = False  # what it leaves moves on like a column, instead of being mere rounding

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


@dataclass(frozen=True)
class Constrained(AbstractLaw):
    """One angle of a joint from u^T R v = g. `branch` tells the two solutions apart; 0 takes the turn that aligns them."""

    joint: Joint
    unknown: int  # 0..2: which angle of the joint
    known: tuple[int, ...]  # which angles enter
    u: tuple[float, ...]
    v: tuple[float, ...]
    g: float
    branch: int

    @property
    def targets(self) -> tuple[int, ...]:
        return (self.joint.columns[self.unknown],)

    @property
    def inputs(self) -> tuple[int, ...]:
        return tuple(self.joint.columns[k] for k in self.known)

    @property
    def numbers(self) -> tuple[float, ...]:
        return (*self.u, *self.v, self.g)

    def spec(self) -> dict[str, object]:
        return {"joint": _listed(self.joint), "unknown": self.unknown, "known": list(self.known), "branch": self.branch}

    def with_numbers(self, numbers: Sequence[float]) -> Constrained:
        u, v, (g,) = _parts(numbers, 3, 3, 1)
        return replace(self, u=u, v=v, g=g)

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        frames = angles.shape[1]
        left, right = _rows(self.u, frames), _rows(self.v, frames)
        for k in range(self.unknown):
            if k in self.known:
                left = _turned(left, self.joint.axes[k], -angles[self.joint.columns[k]])
        for k in range(2, self.unknown, -1):
            if k in self.known:
                right = _turned(right, self.joint.axes[k], angles[self.joint.columns[k]])
        return [_solved(left, right, self.joint.axes[self.unknown], self.g, self.branch)]


@dataclass(frozen=True)
class Aimed(AbstractLaw):
    """Two angles of a joint of two axes (u^T R v = g) that points where its neighbour does: R d = R_source k.

    The third, `other`, follows from these two by a `Constrained`, which holds even where the joint does not aim.
    """

    joint: Joint
    source: Joint
    other: int  # 0..2
    d: tuple[float, ...]
    k: tuple[float, ...]
    u: tuple[float, ...]
    v: tuple[float, ...]
    g: float
    branch: int

    @property
    def targets(self) -> tuple[int, ...]:
        return tuple(c for n, c in enumerate(self.joint.columns) if n != self.other)

    @property
    def inputs(self) -> tuple[int, ...]:
        return self.source.columns

    @property
    def numbers(self) -> tuple[float, ...]:
        return (*self.d, *self.k, *self.u, *self.v, self.g)

    def spec(self) -> dict[str, object]:
        return {"joint": _listed(self.joint), "source": _listed(self.source), "other": self.other, "branch": self.branch}

    def with_numbers(self, numbers: Sequence[float]) -> Aimed:
        d, k, u, v, (g,) = _parts(numbers, 3, 3, 3, 3, 1)
        return replace(self, d=d, k=k, u=u, v=v, g=g)

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        """R = Q T: T turns d onto the first axis and then by an angle about it, Q turns the first axis onto the aim."""
        frames = angles.shape[1]
        aim = _rows(self.k, frames)
        for axis, column in zip(self.source.axes[::-1], self.source.columns[::-1], strict=True):
            aim = _turned(aim, axis, angles[column])
        basis = _frame_of(aim)
        own = _frame_of(_rows(self.d, frames))
        left = [_dot(_rows(self.u, frames), b) for b in basis]
        right = [_dot(_rows(self.v, frames), b) for b in own]
        turn = _solved(left, right, 0, self.g, self.branch)
        columns = [_turned([row[n] for row in own], 0, turn) for n in range(3)]  # of T: its image of each unit vector
        matrix = [[_dot([b[r] for b in basis], columns[c]) for c in range(3)] for r in range(3)]
        return [angle for n, angle in enumerate(euler(matrix, self.joint.axes)) if n != self.other]


@dataclass(frozen=True, eq=False)
class Polynomial(AbstractLaw):
    """Targets near a polynomial of other angles, for what has no closed form.

    All sums are of whole numbers that doubles hold exactly, so that their order does not matter. `scales`: the angle (1e-4
    degrees) that becomes 1; `coefficients[term, target]` in 2^-COEFFICIENT_BITS of 1e-4 degrees, for the terms of `monomials`.
    """

    targets: tuple[int, ...]
    inputs: tuple[int, ...]
    scales: tuple[int, ...]
    degree: int
    coefficients: Float[np.ndarray, "terms targets"]
    smooth: bool = True

    @property
    def numbers(self) -> tuple[float, ...]:
        return tuple(self.coefficients.ravel().tolist())

    def with_numbers(self, numbers: Sequence[float]) -> Polynomial:
        return replace(self, coefficients=np.array(numbers).reshape(-1, len(self.targets)))

    def spec(self) -> dict[str, object]:
        return {"targets": self.targets, "inputs": self.inputs, "scales": self.scales, "degree": self.degree}

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        terms = monomials(angles[list(self.inputs)], self.scales, self.degree)
        return list(self.coefficients.T @ terms / (1 << TERM_BITS + COEFFICIENT_BITS))


@functools.cache
def _recipe(variables: int, degree: int) -> tuple[tuple[int, int], ...]:
    """Every monomial up to the degree but 1, by degree: the variable and the earlier monomial that it is the product of."""
    every = itertools.product(range(degree + 1), repeat=variables)
    ordered = sorted((e for e in every if sum(e) <= degree), key=lambda e: (sum(e), e))
    place = {e: n for n, e in enumerate(ordered)}
    recipe = []
    for e in ordered[1:]:
        i = next(k for k, power in enumerate(e) if power)
        recipe.append((i, place[*e[:i], e[i] - 1, *e[i + 1 :]]))
    return tuple(recipe)


def monomials(angles: Float[np.ndarray, "inputs frames"], scales: Sequence[int], degree: int) -> Float[np.ndarray, "terms frames"]:
    """Whole numbers of 2^-TERM_BITS; an angle beyond _REACH scales counts as that."""
    one = float(1 << TERM_BITS)
    units = np.clip(angles / np.array(scales, np.float64)[:, None], -_REACH, _REACH)
    recipe = _recipe(len(scales), degree)
    terms = np.empty((1 + len(recipe), angles.shape[1]))
    terms[0] = one
    for n, (i, lower) in enumerate(recipe, 1):
        np.rint(np.multiply(terms[lower], units[i], out=terms[n]), out=terms[n])
    return terms


def residuals(law: AbstractLaw, table: Int32[np.ndarray, "frames columns"], decimals: int) -> list[Integers]:
    """What the law leaves of its targets, in [-180, 180) degrees, as integers of 10^-decimals."""
    return [wrapped(table[:, t] - p, decimals) for t, p in zip(law.targets, _rounded(law, table, decimals), strict=True)]


def restored(
    law: AbstractLaw, table: Int32[np.ndarray, "frames columns"], left: Sequence[Integers], decimals: int
) -> list[Integers]:
    """The targets, given what the law left of them; columns of the table besides the law's inputs do not matter."""
    return [wrapped(p + x, decimals) for p, x in zip(_rounded(law, table, decimals), left, strict=True)]


def wrapped(angle: Integers, decimals: int) -> Integers:
    """Angles in [-180, 180) degrees, as integers of 10^-decimals."""
    turn = 360 * 10**decimals
    return (angle + turn // 2) % turn - turn // 2


def _rounded(law: AbstractLaw, table: Int32[np.ndarray, "frames columns"], decimals: int) -> list[Integers]:
    angles = np.zeros((table.shape[1], len(table)))
    for c in law.inputs:
        angles[c] = table[:, c] * 10.0 ** (4 - decimals)
    return [np.rint(p * 10.0 ** (decimals - 4)).astype(np.int64) for p in law.predict(angles)]


def law_spec(law: AbstractLaw) -> dict[str, object]:
    """A law as JSON; its numbers are kept apart."""
    return {"law": type(law).__name__.lower(), **law.spec()}


def law_from_spec(spec: dict, numbers: Sequence[float]) -> AbstractLaw:
    """The law of a spec and its numbers. Raises KeyError, TypeError or ValueError where they are none."""
    if spec["law"] == "polynomial":
        shape = tuple(spec["targets"]), tuple(spec["inputs"]), tuple(spec["scales"]), spec["degree"]
        return Polynomial(*shape, np.array(numbers).reshape(-1, len(spec["targets"])))
    zero = (0.0, 0.0, 0.0)
    joint = _joint(spec["joint"])
    if spec["law"] == "constrained":
        bare = Constrained(joint, spec["unknown"], tuple(spec["known"]), zero, zero, 0.0, spec["branch"])
    else:
        bare = Aimed(joint, _joint(spec["source"]), spec["other"], zero, zero, zero, zero, 0.0, spec["branch"])
    return bare.with_numbers(numbers)


def _listed(joint: Joint) -> list[list[int]]:
    return [list(joint.columns), list(joint.axes)]


def _joint(listed: list[list[int]]) -> Joint:
    (a, b, c), (i, j, k) = listed
    return Joint((a, b, c), (i, j, k))


def euler(matrix: list[list[Angles]], axes: tuple[int, int, int]) -> list[Angles]:
    """Angles about three different axes, the middle one within a quarter turn, of rotation matrices [row][column]."""
    a, b, c = axes
    sign = 1.0 if (b - a) % 3 == 1 else -1.0
    middle = sign * matrix[a][c]
    cosine = np.sqrt(np.maximum(1.0 - middle * middle, 0.0))
    first = arc_tangent(-sign * matrix[b][c], matrix[c][c])
    last = arc_tangent(-sign * matrix[a][b], matrix[a][a])
    return [first, arc_tangent(middle, cosine), last]


def _parts(numbers: Sequence[float], *sizes: int) -> Iterator[tuple[float, ...]]:
    rest = iter(float(x) for x in numbers)
    return (tuple(itertools.islice(rest, size)) for size in sizes)


def _rows(vector: tuple[float, ...], frames: int) -> Rows:
    return [np.full(frames, x) for x in vector]


def _dot(a: Rows, b: Rows) -> Angles:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _turned(vector: Rows, axis: int, angle: Angles) -> Rows:
    """Vectors turned about a coordinate axis."""
    sine, cosine = sine_cosine(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    out = list(vector)
    out[j], out[k] = cosine * vector[j] - sine * vector[k], sine * vector[j] + cosine * vector[k]
    return out


def _solved(left: Rows, right: Rows, axis: int, g: float, branch: int) -> Angles:
    """The angle t about the axis with left^T R(t) right = g; where none reaches g, the one that comes nearest."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    alpha = left[k] * right[j] - left[j] * right[k]
    beta = left[j] * right[j] + left[k] * right[k]
    middle = arc_tangent(alpha, beta)
    if branch == 0:
        return middle
    gamma = g - left[axis] * right[axis]
    reach = alpha * alpha + beta * beta - gamma * gamma
    angle = middle + branch * arc_tangent(np.sqrt(np.maximum(reach, 0.0)), gamma)
    return angle - 3_600_000.0 * np.rint(angle / 3_600_000.0)


def _frame_of(x: Rows) -> list[Rows]:
    """Three orthonormal vectors, the first along x; the others by the coordinate axis that x is farthest from (Duff 2017)."""
    length = np.sqrt(_dot(x, x))
    x = [c / length for c in x]
    sign = np.where(x[2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + x[2])
    b = x[0] * x[1] * a
    y = [1.0 + sign * x[0] * x[0] * a, sign * b, -sign * x[0]]
    z = [b, sign + x[1] * x[1] * a, -x[1]]
    return [x, y, z]
