"""Mending: where a decoded motion is off by more than a bound, the few corrections that bring it under it.

Greedy: of all bumps around a frame that is off, the one that lowers what is too much the most for its bits. A frame that
no bump helps is restored as a whole.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .attempt import Source
from .corrections import HEIGHT, Corrections, sample_counts
from .distortion import points_of
from .optimise import STILL
from .payload import Coded

_BROAD_ROUNDS, _ROUNDS = 20, 50  # with bumps of every length, then with those of a single frame
_APART = 8  # frames that are mended at a time
_AT_ONCE = 64
_AIM, _NEAR, _SAFE = 0.97, 0.85, 0.9995  # of the bound: errors from _NEAR on choose which components are tried
_LINEAR = 0.3
_TRIED = 8  # components for every place
_SIZES = np.array([1, 2, 3, 4, 6, 8], np.float32)
_BITS, _MORE_BITS = 9.0, 2.0  # of a bump of size 1, and of changing one
_SPAN = 8  # samples on each side of a bump that it is followed for
_LEAST = 0.03


def mended(source: Source, coded: Coded, most_cm: float) -> tuple[Coded, float]:
    """With corrections so that no error is above `most_cm`, and the largest error: above it where none help."""
    mender = _Mender(source, coded, _SAFE * most_cm)
    mender.run()
    coded = coded._replace(corrections=mender.corrections())
    return coded, float(source.distortion.errors(source.known + coded.coefficients()).max())


class _Bump(NamedTuple):
    """`rate` is how much it gains for its bits."""

    rate: float
    octave: int
    row: int
    component: int
    level: int


class _Mender:
    """Of one source at one step; `levels` of every octave are (samples, components)."""

    def __init__(self, source: Source, coded: Coded, most: float):
        self.source, self.step, self.most = source, coded.step, most
        self.plain = source.known + coded.coefficients()
        self.frames, self.components = self.plain.shape
        # Components that the motion does not use move channels that it holds constant, which decode as they were.
        self.used = np.flatnonzero(np.abs(source.coefficients).max(0) > STILL)
        self.levels = [np.zeros((n, self.components), np.int64) for n in sample_counts(self.frames, source.octaves)]

    def corrections(self) -> Corrections:
        parts = [(np.full(len(r), o), r, k, x[r, k]) for o, x in enumerate(self.levels) for r, k in [np.nonzero(x)]]
        return Corrections(*(np.concatenate(column).astype(np.int64) for column in zip(*parts, strict=True)))

    def run(self) -> None:
        """Adds corrections until no error is above the bound, or none helps."""
        for n in range(_ROUNDS):
            y = self.plain + self.corrections().shift(self.frames, self.source.octaves, self.components, self.step)
            off = self._points(y) - self.source.distortion.target
            frames = _worst(np.sqrt((off**2).sum(0)).max(0), self.most, _APART if n < _BROAD_ROUNDS else 0)
            if not frames:
                return
            before = [level.copy() for level in self.levels]
            for start in range(0, len(frames), _AT_ONCE):
                self._mend(y, off, frames[start : start + _AT_ONCE], broad=n < _BROAD_ROUNDS)
            if n >= _BROAD_ROUNDS and all(np.array_equal(a, b) for a, b in zip(before, self.levels, strict=True)):
                return

    def _mend(self, y: np.ndarray, off: np.ndarray, frames: list[int], broad: bool) -> None:
        """Adds to every frame the bump that is best, unless it reaches where another was added."""
        untouched = np.ones(self.frames, bool)
        for frame, turn in zip(frames, self._turns(y[frames]), strict=True):
            octaves = range(len(self.levels))[0 if broad else -1 :]
            bump = max(self._best(off, turn, octave, frame) for octave in octaves)
            inside, _ = self._wave(bump.octave, bump.row)
            if bump.rate > 0 and untouched[inside].all():
                self.levels[bump.octave][bump.row, bump.component] += bump.level
                untouched[inside] = False
            elif bump.rate <= 0 and not broad:
                apart = (self.source.coefficients[frame] - y[frame]) / (HEIGHT * self.step)
                self.levels[-1][frame] += np.rint(apart).astype(np.int64)

    def _points(self, y: Float[np.ndarray, "frames components"]) -> Float[np.ndarray, "3 points frames"]:
        vectors = self.source.basis.vectors(y.astype(np.float32), self.source.direction)
        return points_of(self.source.decoding, self.source.metric, *vectors)

    def _turns(self, y: Float[np.ndarray, "frames components"]) -> Float[np.ndarray, "frames 3 points used"]:
        """How a bump of size 1 in every component that is used moves the points of these frames, in cm."""
        moved = np.concatenate([y[:, None], y[:, None] + HEIGHT * self.step * np.eye(self.components)[None, self.used]], 1)
        points = self._points(moved.reshape(-1, self.components))
        points = points.reshape(*points.shape[:2], len(y), -1).transpose(2, 0, 1, 3)
        return points[..., 1:] - points[..., :1]

    def _wave(self, octave: int, row: int) -> tuple[slice, Float[np.ndarray, " frames"]]:
        """The frames that a sample's bump reaches, and the bump."""
        octaves = self.source.octaves - octave
        before = max(row - _SPAN, 0)
        start, wave = _wave_of(min(self.frames - (before << octaves), 2 * _SPAN + 1 << octaves), octaves, row - before)
        first = (before << octaves) + start
        return slice(first, first + len(wave)), wave

    def _best(self, off: np.ndarray, turn: np.ndarray, octave: int, frame: int) -> _Bump:
        """The best bump of an octave at a frame, as if points moved all along it as they do there."""
        known = self.levels[octave]
        row = min(round(frame / (1 << self.source.octaves - octave)), len(known) - 1)
        inside, wave = self._wave(octave, row)
        near = off[:, :, inside]
        error = np.sqrt((near**2).sum(0))
        excess = np.maximum(1 - np.float32(_NEAR * self.most) / np.maximum(error, np.float32(1e-6)), 0)
        gradient = (near * excess @ wave).ravel() @ turn.reshape(-1, len(self.used))
        tried = np.argsort(-np.abs(gradient))[:_TRIED]
        sign = -np.sign(gradient[tried])
        change = turn[:, :, tried] * sign
        across = 2 * np.einsum("cpt,cpk->kpt", near, change) * wave
        along = (change**2).sum(0).T[:, :, None] * wave**2
        after = [self._too_much(error**2 + s * across + s * s * along).sum((1, 2)) for s in _SIZES]
        gain = self._too_much(error**2).sum() - np.stack(after)
        bits = np.where(known[row, self.used[tried]][None] != 0, _MORE_BITS, _BITS) + 2 * np.log2(_SIZES)[:, None]
        size, n = np.unravel_index((gain / bits).argmax(), gain.shape)
        return _Bump(float((gain / bits)[size, n]), octave, row, int(self.used[tried[n]]), int(_SIZES[size] * sign[n]))

    def _too_much(self, square: np.ndarray) -> np.ndarray:
        """What errors, given by their squares, cost where they are above the bound or all but."""
        beyond = np.maximum(np.sqrt(np.maximum(square, 0)) / np.float32(_AIM * self.most) - 1, 0)
        return beyond * (beyond + np.float32(_LINEAR))


def _worst(error: Float[np.ndarray, " frames"], most: float, apart: int) -> list[int]:
    """Frames above the bound, the worst first, no two of them `apart` frames or less apart."""
    chosen: list[int] = []
    free = error > most
    for t in np.argsort(-error)[: int(free.sum())].tolist():
        if free[t]:
            chosen.append(t)
            free[max(t - apart, 0) : t + apart + 1] = False
    return chosen


@functools.lru_cache(maxsize=1024)
def _wave_of(frames: int, octaves: int, row: int) -> tuple[int, Float[np.ndarray, " frames"]]:
    """What a sample does to so many frames: the first that it reaches, and the bump from there to the last."""
    one = Corrections(*(np.array([x]) for x in (0, row, 0, 1)))
    wave = one.shift(frames, octaves, 1, 1 / HEIGHT)[:, 0]
    reached = np.flatnonzero(np.abs(wave) > _LEAST)
    return int(reached[0]), wave[reached[0] : reached[-1] + 1].astype(np.float32)
