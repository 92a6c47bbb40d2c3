"""What the clips of a `pca-rdo` sequence have in common: scales of joints, the mean pose, and two bases, as they travel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..transforms.dct import dct_matrix
from .basis_coding import OTHER, OTHER_ENTRIES, CodedBasis, Coordinates, code_basis, code_entries
from .bitstream import ByteReader, varint
from .entropy.adaptive import SIXTEENTHS, Coder, Reader, Writer, code_signed, law
from .equalisation import MOST, PER_OCTAVE
from .places import Places
from .sequence import check_basis

_EXPECTED_MEAN = 64 * SIXTEENTHS
_ROOT = 92682  # 2^16.5
_SHIFT = MOST // 2


class Shape(NamedTuple):
    """What the poses of a sequence have in common: scales of places in quarter octaves, the mean pose in multiples of
    `mean_step`, the bases of scaled poses and of clips of their coefficients; those of clips in the coordinates of a DCT."""

    scales: Int[np.ndarray, " places"]
    mean: Int[np.ndarray, " coordinates"]
    pose: CodedBasis
    time: CodedBasis

    def synthesis(self, step: float, frames: int) -> Synthesis:
        """The way back, for a sequence of so many frames."""
        scale = np.repeat(factors(self.scales), 3)
        clip_frames = self.time.entries.shape[1]
        time = self.time.rows() @ dct_matrix(clip_frames)
        return Synthesis(step, scale, self.mean * mean_step(step, frames), self.pose.rows(), time)


class Synthesis(NamedTuple):
    """The way back from levels."""

    step: float
    scale: Float[np.ndarray, " coordinates"]
    mean: Float[np.ndarray, " coordinates"]
    pose: Float[np.ndarray, "components coordinates"]
    time: Float[np.ndarray, "frequencies clip_frames"]

    def poses(
        self, planes: list[Int[np.ndarray, "frequencies components"]], frames: int
    ) -> Float[np.ndarray, "frames coordinates"]:
        """Scaled poses, the last clip cut to so many frames in all."""
        trajectories = np.concatenate([self.time.T @ (plane * self.step) for plane in planes])[:frames]
        return trajectories @ self.pose + self.mean

    def positions(
        self, planes: list[Int[np.ndarray, "frequencies components"]], frames: int
    ) -> Float[np.ndarray, "frames places 3"]:
        """Those of places, in cm."""
        return (self.poses(planes, frames) / self.scale).reshape(frames, -1, 3)


def mean_step(step: float, frames: int) -> float:
    """An error in the mean pose is one in every frame."""
    return step * 2.0 ** ((1 - frames.bit_length()) / 2)


def factors(scales: Int[np.ndarray, " places"]) -> Float[np.ndarray, " places"]:
    """What positions are multiplied by."""
    return 2.0 ** (scales / PER_OCTAVE)


def pose_space(places: Places, scales: Int[np.ndarray, " places"]) -> Coordinates:
    """Coordinates x, y, z of place after place; each is predicted from the same of the parent's place."""
    parents = np.where(places.parents < 0, -3, 3 * places.parents)[:, None] + np.arange(3)
    squares = np.array([(_ROOT if s & 1 else 1 << 16) << max(s // 2 + _SHIFT, 0) for s in scales.tolist()], object)
    return Coordinates(np.maximum(parents, -1).ravel(), np.repeat(squares, 3))


def time_space(clip_frames: int) -> Coordinates:
    """Frequencies of a DCT, which tell nothing of each other."""
    return Coordinates(np.full(clip_frames, -1), np.ones(clip_frames, np.int64))


def _code_shape(coder: Coder, shape: Shape, places: Places) -> Shape:
    """Codes what clips share; a reader fills one of the same sizes."""
    scales = []
    for given, count in zip(shape.scales.tolist(), places.counts.tolist(), strict=True):
        usual = PER_OCTAVE // 2 * ((count * count).bit_length() - 1)
        scales.append(usual + code_signed(coder, OTHER, law(SIXTEENTHS), given - usual))
    scales = np.clip(scales, -MOST, MOST)
    space = pose_space(places, scales)
    mean = code_entries(coder, shape.mean.tolist(), space, _EXPECTED_MEAN, OTHER_ENTRIES, True)
    pose, time = code_basis(coder, shape.pose, space), code_basis(coder, shape.time, time_space(shape.time.entries.shape[1]))
    return Shape(scales, np.array(mean, np.int64), pose, time)


def write_shape(shape: Shape, places: Places) -> bytes:
    """What `read_shape` reads."""
    writer = Writer()
    _code_shape(writer, shape, places)
    return varint(shape.pose.count) + varint(shape.time.count) + writer.finish()


def read_shape(data: bytes, places: Places, clip_frames: int) -> Shape:
    """Raises CorruptStream where the bytes are none over so many places."""
    reader = ByteReader(data)
    n = 3 * places.count
    k, t = reader.varint(), reader.varint()
    check_basis(k, n)
    check_basis(t, clip_frames)
    blank = Shape(
        np.zeros(places.count, np.int64), np.zeros(n, np.int64), CodedBasis.blank(k, n), CodedBasis.blank(t, clip_frames)
    )
    return _code_shape(Reader(reader.take(reader.left)), blank, places)
