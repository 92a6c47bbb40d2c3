"""Pose vectors of one frame, by quaternions: what `PoseVectors.analyse` gives of a motion, ten times as fast for a frame."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...motion import Motion
from ...skeleton import POSITION_CHANNELS
from ..learned.pose_vectors import PoseVectors, angle_columns, quaternions

_TURN = 2 * math.pi


@dataclass(eq=False)
class Analysis:
    """Frame after frame of one figure, whose unit is `scale` cm; each goes on from the last without a jump of a turn."""

    figure: PoseVectors
    scale: float

    def __post_init__(self) -> None:
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        channels = self.figure.skeleton.channels
        self._orders = angle_columns(channels)
        names = {name: n for n, name in enumerate(channels[0]) if name in POSITION_CHANNELS}
        self._columns = [names.get(name) for name in POSITION_CHANNELS]

    def of(self, values: Float[np.ndarray, " channels"]) -> tuple[Float[np.ndarray, "1 3"], Float[np.ndarray, "1 size"]]:
        """Path (cm and radians) and body of a frame in degrees and file units."""
        f = self.figure
        if len(f.sliding) or f.skeleton.has_axes:
            path, body = f.analyse(Motion(f.skeleton, values[None], 1.0), self.scale)
        else:
            path, body = self._of_angles(values)
        if self._last is not None:
            path, body = _unwound(path, self._last[0]), _nearest_turn(body, self._last[1], len(f.turning))
        self._last = path, body
        return path, body

    def _of_angles(self, values: Float[np.ndarray, " channels"]) -> tuple[np.ndarray, np.ndarray]:
        f = self.figure
        half = np.deg2rad(values) / 2
        cosine, sine = np.cos(half), np.sin(half)
        q = np.zeros((4, f.skeleton.joint_count))
        q[0] = 1
        for order, joints, columns in self._orders:
            q[:, joints] = _of_order(order, cosine[columns.T], sine[columns.T])
        turn = 2 * math.atan2(q[2, 0], q[0, 0]) if f.has_heading else 0.0
        if f.has_heading:
            c, s = math.cos(turn / 2), math.sin(turn / 2)
            w, x, y, z = q[:, 0]
            q[:, 0] = c * w + s * y, c * x - s * z, c * y - s * w, c * z + s * x
        w, *v = _product(self._undo_mean, q[:, f.turning])
        sign = np.where(w < 0, -1.0, 1.0)
        v = np.stack(v) * sign
        length = np.sqrt((v * v).sum(0))
        safe = np.maximum(length, 1e-9)
        vectors = v * np.where(length > 1e-9, 2 * np.arctan2(length, w * sign) / safe, 2.0)
        offset = f.skeleton.offsets[0] / self.scale
        root = [offset[n] if c is None else values[c] for n, c in enumerate(self._columns)]
        x, y, z = (self.scale * r for r in root)
        return np.array([[x, z, turn]]), np.concatenate([[y], vectors.T.ravel()])[None]

    @functools.cached_property
    def _undo_mean(self) -> Float[np.ndarray, "4 turning"]:
        mean = quaternions(self.figure.mean[self.figure.turning][None])[0].T
        return mean * np.array([1.0, -1, -1, -1])[:, None]


def _of_order(order: str, cosine: Float[np.ndarray, "angles joints"], sine: Float[np.ndarray, "angles joints"]) -> np.ndarray:
    """Quaternions w, x, y, z of turns about axes, left to right."""
    found = None
    for axis, c, s in zip(order, cosine, sine, strict=True):
        q = np.zeros((4, len(c)))
        q[0], q[1 + "XYZ".index(axis)] = c, s
        found = q if found is None else _product(found, q)
    assert found is not None
    return found


def _product(p: Float[np.ndarray, "4 joints"], q: Float[np.ndarray, "4 joints"]) -> Float[np.ndarray, "4 joints"]:
    a, b, c, d = p
    w, x, y, z = q
    return np.stack([
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ])  # fmt: skip


def _unwound(path: Float[np.ndarray, "1 3"], last: Float[np.ndarray, "1 3"]) -> Float[np.ndarray, "1 3"]:
    """The heading on the same turn as the last frame's."""
    path = path.copy()
    path[:, 2] += _TURN * np.rint((last[:, 2] - path[:, 2]) / _TURN)
    return path


def _nearest_turn(body: Float[np.ndarray, "1 size"], last: Float[np.ndarray, "1 size"], turning: int) -> np.ndarray:
    """Rotation vectors of the same rotations, nearest to those of the last frame."""
    vectors, before = (x[0, 1 : 1 + 3 * turning].reshape(-1, 3) for x in (body, last))
    if np.abs(vectors - before).max(initial=0) < math.pi / 2:
        return body
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    other = vectors - vectors / np.maximum(angle, 1e-9) * _TURN
    closer = np.linalg.norm(other - before, axis=1) < np.linalg.norm(vectors - before, axis=1)
    body = body.copy()
    body[0, 1 : 1 + 3 * turning] = np.where((closer & (angle[:, 0] > 1e-6))[:, None], other, vectors).ravel()
    return body
