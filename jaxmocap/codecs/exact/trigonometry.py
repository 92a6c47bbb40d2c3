"""Sine, cosine and arc tangent that give the same bits on every machine.

Libraries differ in the last bit of these functions. Here each is made of NumPy's additions, multiplications, divisions and
square roots, one array operation at a time, and IEEE 754 leaves their results no choice. Angles are in 1e-4 degrees.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Doubles = Float[np.ndarray, "*n"]

_QUARTER = 900_000.0
_RADIAN = 572957.7951308232  # in 1e-4 degrees
_SINE = (-1.6666666666666666e-1, 8.333333333333333e-3, -1.984126984126984e-4, 2.7557319223985893e-6, -2.505210838544172e-8,
         1.6059043836821613e-10, -7.647163731819816e-13)  # fmt: skip
_COSINE = (-0.5, 4.1666666666666664e-2, -1.388888888888889e-3, 2.48015873015873e-5, -2.755731922398589e-7,
           2.08767569878681e-9, -1.1470745597729725e-11, 4.779477332387385e-14)  # fmt: skip
_TANGENTS = (0.0, 0.25, 0.5, 0.75, 1.0)  # arcs between them are reduced to less than an eighth
_ARCS = (0.0, 0.24497866312686414, 0.4636476090008061, 0.6435011087932844, 0.7853981633974483)


def sine_cosine(angle: Doubles) -> tuple[Doubles, Doubles]:
    """Of angles below 2^40."""
    turns = np.rint(angle / _QUARTER)
    x = (angle - turns * _QUARTER) / _RADIAN
    square = x * x
    sine, cosine = x + x * square * _polynomial(_SINE, square), 1.0 + square * _polynomial(_COSINE, square)
    quarter = turns - 4.0 * np.floor(turns / 4.0)
    odd = (quarter == 1) | (quarter == 3)
    s, c = np.where(odd, cosine, sine), np.where(odd, sine, cosine)
    return np.where(quarter >= 2, -s, s), np.where((quarter == 1) | (quarter == 2), -c, c)


def arc_tangent(y: Doubles, x: Doubles) -> Doubles:
    """The angle of the point (x, y), in (-1,800,000, 1,800,000]; 0 for the origin."""
    ax, ay = np.abs(x), np.abs(y)
    steep = ay > ax
    large, small = np.where(steep, ay, ax), np.where(steep, ax, ay)
    ratio = small / np.where(large > 0, large, 1.0)
    index = np.rint(4.0 * ratio).astype(np.int64)
    tangent = np.array(_TANGENTS)[index]
    z = (ratio - tangent) / (1.0 + ratio * tangent)
    square = z * z
    terms = [(-1.0) ** n / (2 * n + 1) for n in range(1, 10)]
    arc = np.array(_ARCS)[index] + (z + z * square * _polynomial(terms, square))
    arc = np.where(steep, np.pi / 2 - arc, arc)
    arc = np.where(x < 0, np.pi - arc, arc)
    return np.where(y < 0, -arc, arc) * _RADIAN


def _polynomial(coefficients, x: Doubles) -> Doubles:
    total = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total
