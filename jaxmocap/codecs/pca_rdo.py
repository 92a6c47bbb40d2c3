"""`pca-rdo`: two rounds of PCA behind a Lagrange equalisation of the joints (Vasa and Brunnett 2014, CGF 33(2)).

Joints are scaled by what their errors cost (equalisation.py); PCA of all poses of the sequence, all coordinates together;
the trajectories of its components cut into short clips, and PCA of those; of both the first vectors. Coefficients and
bases are quantised and entropy coded, bases as in Vasa and Skala 2009 (basis_coding.py). Ours: bones of exact length in
what is decoded, chunks, how many vectors, how finely and clips of what length by rate and distortion.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream
from ..motion import Motion
from ..transforms.dct import dct_matrix
from .adaptive_levels import Neighbour, Surroundings, code_levels
from .artifact import Artifact, stream_artifact
from .base import AbstractCodec, Target, figure_height, target_config
from .basis_coding import CodedBasis, cost, precision, quantise_basis
from .container import Stream, read_stream, write_stream
from .entropy.adaptive import Reader
from .equalisation import equalise
from .joint_positions import Figure, Source, chunk_length
from .pca_shape import Shape, factors, mean_step, pose_space, read_shape, time_space, write_shape
from .places import Places
from .quantise import step_cm
from .sequence import (
    CHUNK_FRAMES,
    WORTHS,
    check_header,
    encode_chunks,
    level_bits,
    levels_of,
    places_at,
    rig_of,
    smallest,
    worth_keeping,
)

NUMBER = 6
CLIP_FRAMES = (15, 30, 60, 120)
_TYPICAL = 30
AROUND = Surroundings(
    1,
    (0, 1, 2),
    (
        Neighbour(0, 1, 0, 2), Neighbour(0, 2, 0, 1), Neighbour(0, 1, 1, 1),
        Neighbour(0, 0, -1, 2), Neighbour(0, 0, -2, 1), Neighbour(0, 0, -3, 1),
        Neighbour(1, 0, 0, 5), Neighbour(1, 0, 1, 1), Neighbour(2, 0, 0, 3), Neighbour(3, 0, 0, 3),
    ),
)  # fmt: skip
_ERROR = 0.0005  # of the figure's height: where equalisation measures
_RIDGE = 0.05  # singular values of a cut clip below this share of the largest would blow up


class PcaRdo(AbstractCodec):
    """`artifact` is an lsdt-clip model, of which the rig is used; `target` None means a mean error of 0.5 % of the
    figure's height. `embed` puts the model itself into every stream."""

    artifact: Artifact = eqx.field(static=True)
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def config(self) -> dict:
        return {"codec": "pca-rdo", "target": target_config(self.target), "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; what decodes from it has been measured to meet the target.

        Raises JaxmocapError where the target is out of reach.
        """
        source = Source.of(motion, rig_of(self.artifact))
        target = self.target or Target.default(motion)
        poses = _Poses(source)
        typical, *others = WORTHS
        index = source.coarsest_step(_Sequence(poses, _TYPICAL, typical).decoded, target)
        best = min((_Sequence(poses, n, typical) for n in CLIP_FRAMES), key=lambda s: s.at(index).cost)
        ways = [best, *(_Sequence(poses, best.clip_frames, worth) for worth in others)]
        return smallest(source, ways, self._write, decode, self.artifact, target)

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)

    def _write(self, sequence: _Sequence, index: int) -> bytes:
        coded, clip_frames = sequence.at(index), sequence.clip_frames
        own = write_shape(coded.shape, coded.places)
        params = bytes([CLIP_FRAMES.index(clip_frames), index])
        header = sequence.poses.source.header(NUMBER, params, CHUNK_FRAMES, index, own, self.artifact, self.embed)
        return write_stream(header, encode_chunks(coded.planes, CHUNK_FRAMES // clip_frames, AROUND))


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    check_header(header, NUMBER, "pca-rdo", 2)
    which, index = header.params
    if which >= len(CLIP_FRAMES):
        raise CorruptStream(f"the stream has clips of kind {which}, known are 0 to {len(CLIP_FRAMES) - 1}")
    figure = Figure.of(header, rig_of(stream_artifact(header.model, header.digest, at_hand)), index)
    chunks, wanted = figure.chunks(header, frames)
    places = Places.of(figure.skeleton)
    shape = read_shape(figure.own, places, CLIP_FRAMES[which])
    synthesis = shape.synthesis(step_cm(index), header.frames)
    positions = []
    for n in chunks:
        length = chunk_length(header, n)
        empty = [np.zeros((shape.time.count, shape.pose.count), np.int64)] * -(-length // CLIP_FRAMES[which])
        planes = code_levels(Reader(stream.chunk(n)), empty, AROUND)
        positions.append(synthesis.positions(planes, length))
    return figure.motion(places.spread(np.concatenate(positions))[wanted].astype(np.float32))


class _Coded(NamedTuple):
    """A sequence at one step; planes hold the levels of its clips. `cost` is bits and distortion together."""

    places: Places
    shape: Shape
    planes: list[Int[np.ndarray, "frequencies components"]]
    cost: float


class _Pca(NamedTuple):
    """Poses scaled by place, and the principal components of these: roots of energies, and vectors."""

    places: Places
    scales: Int[np.ndarray, " places"]
    scaled: Float[np.ndarray, "frames coordinates"]
    weight: Float[np.ndarray, " components"]
    vectors: Float[np.ndarray, "components coordinates"]


class _Poses:
    """The poses of a source; what they have in common depends on the step only where bones are shorter than it."""

    def __init__(self, source: Source):
        self.source = source
        self._fitted: dict[bytes, _Pca] = {}

    def pca(self, index: int) -> _Pca:
        places = places_at(self.source, index)
        key = places.first.tobytes()
        if key not in self._fitted:
            self._fitted[key] = self._fit(places)
        return self._fitted[key]

    def _fit(self, places: Places) -> _Pca:
        source = self.source
        skeleton, expected = source.motion.skeleton, source.rig.expected if source.known else None
        positions = source.positions.astype(np.float64)
        scales = equalise(skeleton, places, positions / source.scale, expected, _ERROR * figure_height(source.motion))
        scaled = (places.gather(positions) * factors(scales)[:, None]).reshape(len(positions), -1)
        weight, vectors = np.linalg.svd(scaled - scaled.mean(0), full_matrices=False)[1:]
        return _Pca(places, scales, scaled, weight, vectors)


class _Sequence:
    """Poses in clips of so many frames, at one step after another, a bit being worth so many squared steps."""

    def __init__(self, poses: _Poses, clip_frames: int, worth: float):
        self.poses, self.clip_frames, self.worth = poses, clip_frames, worth
        self.at = functools.lru_cache(maxsize=4)(self._at)

    def decoded(self, index: int) -> Float[np.ndarray, "frames joints 3"]:
        """Joint positions in cm."""
        coded = self.at(index)
        frames = len(self.poses.source.positions)
        return coded.places.spread(coded.shape.synthesis(step_cm(index), frames).positions(coded.planes, frames))

    def _at(self, index: int) -> _Coded:
        step, (places, scales, scaled, weight, vectors) = step_cm(index), self.poses.pca(index)
        unit = mean_step(step, len(scaled))
        mean = levels_of(scaled.mean(0), unit)
        pose = _coded_basis(weight, vectors, step)
        trajectories = (scaled - mean * unit) @ pose.rows().T
        time = _coded_basis(*_clip_pca(trajectories, self.clip_frames), step)
        coefficients = _project(trajectories, time.rows() @ dct_matrix(self.clip_frames))
        levels = levels_of(coefficients, step)

        bit = self.worth * step**2
        gain, bits = coefficients**2 - (coefficients - levels * step) ** 2, level_bits(levels)
        pose_bits, time_bits = cost(pose, pose_space(places, scales)), cost(time, time_space(self.clip_frames))
        k = worth_keeping(gain.sum((0, 1)), pose_bits + bits.sum((0, 1)), bit)
        t = worth_keeping(gain[..., :k].sum((0, 2)), time_bits + bits[..., :k].sum((0, 2)), bit)
        shape, planes = Shape(scales, mean, pose.first(k), time.first(t)), list(levels[:, :t, :k])
        lost = ((shape.synthesis(step, len(scaled)).poses(planes, len(scaled)) - scaled) ** 2).sum() / bit
        rate = bits[:, :t, :k].sum() + pose_bits[:k].sum() + time_bits[:t].sum()
        return _Coded(places, shape, planes, float(rate + lost))


def _coded_basis(weight: np.ndarray, vectors: np.ndarray, step: float) -> CodedBasis:
    """The vectors whose coefficients are not all below half a step, at least one."""
    count = max(1, int((weight > step / 2).sum()))
    return quantise_basis(vectors[:count], precision(weight[:count], step))


def _clip_pca(trajectories: Float[np.ndarray, "frames components"], clip_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """PCA of the clips of all trajectories, the last clip prolonged by its last frame: roots of energies, and vectors in the
    coordinates of a DCT, where smooth vectors have few entries."""
    frames = len(trajectories)
    filled = np.pad(trajectories, ((0, -frames % clip_frames), (0, 0)), mode="edge")
    clips = filled.reshape(-1, clip_frames, filled.shape[1]).transpose(0, 2, 1).reshape(-1, clip_frames)
    return np.linalg.svd(clips @ dct_matrix(clip_frames).T, full_matrices=False)[1:]


def _project(
    trajectories: Float[np.ndarray, "frames components"], time: Float[np.ndarray, "frequencies clip_frames"]
) -> Float[np.ndarray, "clips frequencies components"]:
    """Coefficients of every clip; of the last, which may be shorter, the smallest that fit its frames best."""
    clip_frames = time.shape[1]
    clips = np.split(trajectories, range(clip_frames, len(trajectories), clip_frames))
    last = np.linalg.pinv(time[:, : len(clips[-1])].T, rcond=_RIDGE) @ clips[-1]
    return np.stack([time @ clip for clip in clips[:-1]] + [last])
