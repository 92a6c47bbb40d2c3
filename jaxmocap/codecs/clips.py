"""Cutting a motion into clips of equal length, and the temporal DCT and spatial transform of all clips at once."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..transforms.dct import dct_matrix
from .quantise import dequantise


class Bases(NamedTuple):
    """Rows of the spatial basis of each coordinate, for analysis and synthesis: equal where the basis is orthogonal."""

    analysis: Float[np.ndarray, "3 components joints"]
    synthesis: Float[np.ndarray, "3 components joints"]


class Cut(NamedTuple):
    """How `frames` frames lie in clips: all full but the last, which may be shorter. `clips` is padded to few sizes."""

    frames: int
    clip_frames: int
    full: Float[np.ndarray, "frames frames"]
    last: Float[np.ndarray, "frames frames"]

    @property
    def clip_count(self) -> int:
        return -(-self.frames // self.clip_frames)

    @property
    def lengths(self) -> list[int]:
        """Frames of each clip."""
        rest = self.frames - (self.clip_count - 1) * self.clip_frames
        return [self.clip_frames] * (self.clip_count - 1) + [rest]

    @property
    def padded(self) -> int:
        return 1 << (self.clip_count - 1).bit_length()


@functools.lru_cache(maxsize=16)
def cut(frames: int, clip_frames: int) -> Cut:
    """The DCT matrix of a full clip, and that of the last clip in the corner of a matrix of the same size."""
    full = dct_matrix(clip_frames).astype(np.float32)
    rest = (frames - 1) % clip_frames + 1
    last = np.zeros_like(full)
    last[:rest, :rest] = dct_matrix(rest)
    return Cut(frames, clip_frames, full, last)


def to_clips(positions: Float[np.ndarray, "frames joints 3"], c: Cut) -> Float[np.ndarray, "clips 3 frames joints"]:
    """The clips of every coordinate, zeros beyond the last frame."""
    padded = np.zeros((c.padded * c.clip_frames, *positions.shape[1:]), np.float32)
    padded[: c.frames] = positions
    return np.ascontiguousarray(padded.reshape(c.padded, c.clip_frames, -1, 3).transpose(0, 3, 1, 2))


@jax.jit
def analyse(
    clips: Float[Array, "clips 3 frames joints"], full: Array, last: Array, at: int, basis: Array
) -> Float[Array, "clips 3 frequencies components"]:
    """Temporal DCT (eq. 4), then the spatial basis (eq. 5); clip `at` is the last and takes the matrix `last`."""
    spectrum = (full @ clips).at[at].set(last @ clips[at])
    return spectrum @ jnp.swapaxes(basis, -1, -2)


@jax.jit
def synthesise(
    levels: Int[Array, "clips 3 frequencies components"], step: float, full: Array, last: Array, at: int, basis: Array
) -> Float[Array, "padded_frames joints 3"]:
    """The inverse: levels to joint positions, the frames of all clips one after another, those beyond the last included."""
    spectrum = dequantise(levels, step) @ basis
    clips = (full.T @ spectrum).at[at].set(last.T @ spectrum[at])
    joined = jnp.moveaxis(clips, 1, -1)
    return joined.reshape(-1, *joined.shape[2:])
