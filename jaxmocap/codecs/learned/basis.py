"""The learned transform of poses: coefficients in cm, each of which moves the figure by its value (root mean square).

A Karhunen-Loeve transform weighted by the Jacobian of forward kinematics: coefficients are uncorrelated, and a quantiser
with one step for all spreads its error over joints as it is seen, not as angles count it.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...components import A, namespace
from .contexts import PATH
from .spectrum import Spectrum

DIRECTIONS = 64  # of the clip's own axes on the floor


@dataclass(frozen=True, eq=False)
class Basis:
    """`synthesis` gives the body's vectors, less their `mean`, of coefficients in cm; `turn_cm` is how far a radian of
    heading moves the figure. The first three components are the path, in axes that the clip chooses. `fitted` finds the
    coefficients where the synthesis does not reach all that moves; an encoder alone has need of it."""

    mean: Float[np.ndarray, " size"]
    synthesis: Float[np.ndarray, "components size"]
    turn_cm: float
    spectrum: Spectrum
    fitted: Float[np.ndarray, "size components"] | None = None

    @functools.cached_property
    def analysis(self) -> Float[np.ndarray, "size components"]:
        """The inverse of the synthesis, or what was fitted in its place."""
        return self.fitted if self.fitted is not None else np.linalg.pinv(self.synthesis.astype(np.float64), rcond=1e-9)

    @property
    def components(self) -> int:
        return PATH + len(self.synthesis)

    def coefficients(self, path: np.ndarray, body: np.ndarray, direction: int) -> Float[np.ndarray, "frames components"]:
        """All components, in cm, of a path and a body."""
        angle = turn_of(direction)
        c, s = math.cos(angle), math.sin(angle)
        x, z, turn = path[:, 0], path[:, 1], path[:, 2]
        floor = np.stack([c * x - s * z, s * x + c * z, (turn - angle) * self.turn_cm], 1)
        return np.concatenate([floor, (body - self.mean) @ self.analysis], 1)

    def vectors(self, coefficients: Float[A, "frames components"], direction: int | A) -> tuple[A, A]:
        """Path and body of coefficients; differentiable."""
        y = coefficients
        xp = namespace(y)
        angle = turn_of(direction)
        c, s = xp.cos(angle), xp.sin(angle)
        path = xp.stack([c * y[:, 0] + s * y[:, 1], c * y[:, 1] - s * y[:, 0], y[:, 2] / self.turn_cm + angle], 1)
        body = y[:, PATH:] @ xp.asarray(self.synthesis, y.dtype) + xp.asarray(self.mean, y.dtype)[None]
        return path.astype(y.dtype), body

    def pull(self, path: np.ndarray, body: np.ndarray, direction: int) -> Float[np.ndarray, "frames components"]:
        """The gradient with respect to coefficients, of that with respect to path and body."""
        angle = turn_of(direction)
        c, s = math.cos(angle), math.sin(angle)
        x, z, turn = path[:, 0], path[:, 1], path[:, 2]
        floor = np.stack([c * x - s * z, s * x + c * z, turn / self.turn_cm], 1)
        return np.concatenate([floor, body @ self.synthesis.T.astype(body.dtype)], 1)


def turn_of(direction: int | A):
    """Radians of the clip's forward axis."""
    return direction * (2 * math.pi / DIRECTIONS)


def direction_of(path: Float[np.ndarray, "frames 3"]) -> int:
    """The direction nearest to the first frame's heading."""
    return int(np.rint(path[0, 2] / (2 * math.pi / DIRECTIONS))) % DIRECTIONS
