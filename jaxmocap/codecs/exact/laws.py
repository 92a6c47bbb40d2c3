"""Laws of a rig: channels that others in the same frame determine, by the geometry of joints.

A joint with fewer than three axes leaves its three Euler angles a law u^T R v = g, which is a sine and a cosine of any one
of them. A joint that aims where another one points has all three. What a law predicts is the same on every machine.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int32, Int64

from .bends import Bent
from .law import AbstractLaw, Angles, Joint, Rows, dot, joint_of, listed, rows, turned
from .polynomials import Polynomial
from .trigonometry import arc_tangent

Integers = Int64[np.ndarray, " frames"]


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
        return {"joint": listed(self.joint), "unknown": self.unknown, "known": list(self.known), "branch": self.branch}

    def with_numbers(self, numbers: Sequence[float]) -> Constrained:
        u, v, (g,) = _parts(numbers, 3, 3, 1)
        return replace(self, u=u, v=v, g=g)

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        frames = angles.shape[1]
        left, right = rows(self.u, frames), rows(self.v, frames)
        for k in range(self.unknown):
            if k in self.known:
                left = turned(left, self.joint.axes[k], -angles[self.joint.columns[k]])
        for k in range(2, self.unknown, -1):
            if k in self.known:
                right = turned(right, self.joint.axes[k], angles[self.joint.columns[k]])
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
        return {"joint": listed(self.joint), "source": listed(self.source), "other": self.other, "branch": self.branch}

    def with_numbers(self, numbers: Sequence[float]) -> Aimed:
        d, k, u, v, (g,) = _parts(numbers, 3, 3, 3, 3, 1)
        return replace(self, d=d, k=k, u=u, v=v, g=g)

    def predict(self, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
        """R = Q T: T turns d onto the first axis and then by an angle about it, Q turns the first axis onto the aim."""
        frames = angles.shape[1]
        aim = rows(self.k, frames)
        for axis, column in zip(self.source.axes[::-1], self.source.columns[::-1], strict=True):
            aim = turned(aim, axis, angles[column])
        basis = _frame_of(aim)
        own = _frame_of(rows(self.d, frames))
        left = [dot(rows(self.u, frames), b) for b in basis]
        right = [dot(rows(self.v, frames), b) for b in own]
        turn = _solved(left, right, 0, self.g, self.branch)
        columns = [turned([row[n] for row in own], 0, turn) for n in range(3)]  # of T: its image of each unit vector
        matrix = [[dot([b[r] for b in basis], columns[c]) for c in range(3)] for r in range(3)]
        return [angle for n, angle in enumerate(euler(matrix, self.joint.axes)) if n != self.other]


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
    zero = (0.0, 0.0, 0.0)
    match spec["law"]:
        case "polynomial":
            shape = tuple(spec["targets"]), tuple(spec["inputs"]), tuple(spec["scales"]), spec["degree"]
            bare = Polynomial(*shape, np.zeros((0, len(spec["targets"]))))
        case "bent":
            first, second, third = map(joint_of, spec["joints"])
            bare = Bent((first, second, third), spec["degree"], 0.0, np.zeros((1, 3, 1)))
        case "constrained":
            joint = joint_of(spec["joint"])
            bare = Constrained(joint, spec["unknown"], tuple(spec["known"]), zero, zero, 0.0, spec["branch"])
        case "aimed":
            joint, source = joint_of(spec["joint"]), joint_of(spec["source"])
            bare = Aimed(joint, source, spec["other"], zero, zero, zero, zero, 0.0, spec["branch"])
        case kind:
            raise ValueError(f"laws of the kind {kind!r} are not known")
    return bare.with_numbers(numbers)


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
    length = np.sqrt(dot(x, x))
    x = [c / length for c in x]
    sign = np.where(x[2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + x[2])
    b = x[0] * x[1] * a
    y = [1.0 + sign * x[0] * x[0] * a, sign * b, -sign * x[0]]
    z = [b, sign + x[1] * x[1] * a, -x[1]]
    return [x, y, z]
