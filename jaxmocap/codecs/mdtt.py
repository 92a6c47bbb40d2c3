"""`mdtt`: mocap-data-tailored transform coding with clips of equal length (Hou, Chau, Magnenat-Thalmann, He 2015, TVCG 21(7)).

Clips of L = 240 frames, temporal DCT; for each sequence and coordinate the orthogonal basis that all clips together ask
for, cut to its first vectors; coefficients and bases quantised uniformly and entropy coded, both in the stream. Ours:
bones of exact length in what is decoded, chunks of eight clips, and how many vectors, how finely, by rate and distortion.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..motion import Motion
from ..transforms.dct import dct_matrix
from .adaptive_levels import Neighbour, Surroundings, code_levels
from .artifact import Artifact, stream_artifact
from .base import AbstractCodec, Target, target_config
from .basis_coding import CodedBasis, Coordinates, code_basis, cost, precision, quantise_basis
from .bitstream import ByteReader, varint
from .container import Stream, read_stream, write_stream
from .entropy.adaptive import Reader, Writer
from .joint_positions import Figure, Source, chunk_length
from .places import Places
from .quantise import step_cm
from .sequence import (
    CHUNK_FRAMES,
    WORTHS,
    check_basis,
    check_header,
    encode_chunks,
    level_bits,
    levels_of,
    places_at,
    rig_of,
    smallest,
    worth_keeping,
)

NUMBER = 5
CLIP_FRAMES = 240
# A clip's three coordinates are planes one after another, so that three planes back is the same one in the clip before.
AROUND = Surroundings(
    3,
    (2, 1, 0),
    (
        Neighbour(0, 1, 0, 4), Neighbour(0, 2, 0, 2), Neighbour(0, 3, 0, 1), Neighbour(0, 4, 0, 1), Neighbour(0, 1, 1, 1),
        Neighbour(0, 0, -1, 3), Neighbour(0, 0, -2, 1), Neighbour(1, 0, 0, 3), Neighbour(2, 0, 0, 2), Neighbour(3, 0, 0, 3),
    ),
)  # fmt: skip


class Mdtt(AbstractCodec):
    """`artifact` is an lsdt-clip model, of which the rig is used; `target` None means a mean error of 0.5 % of the
    figure's height. `embed` puts the model itself into every stream."""

    artifact: Artifact = eqx.field(static=True)
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def config(self) -> dict:
        return {"codec": "mdtt", "target": target_config(self.target), "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; what decodes from it has been measured to meet the target.

        Raises JaxmocapError where the target is out of reach.
        """
        source = Source.of(motion, rig_of(self.artifact))
        target = self.target or Target.default(motion)
        spectra = _Spectra(source)
        ways = [_Sequence(spectra, worth) for worth in WORTHS]
        return smallest(source, ways, self._write, decode, self.artifact, target)

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)

    def _write(self, sequence: _Sequence, index: int) -> bytes:
        coded = sequence.at(index)
        bases = Writer()
        for basis in coded.bases:
            code_basis(bases, basis, _space(coded.places))
        own = b"".join(varint(b.count) for b in coded.bases) + bases.finish()
        header = sequence.spectra.source.header(NUMBER, bytes([index]), CHUNK_FRAMES, index, own, self.artifact, self.embed)
        per_chunk = 3 * (CHUNK_FRAMES // CLIP_FRAMES)
        return write_stream(header, encode_chunks(coded.planes, per_chunk, AROUND))


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    check_header(header, NUMBER, "mdtt", 1)
    index = header.params[0]
    figure = Figure.of(header, rig_of(stream_artifact(header.model, header.digest, at_hand)), index)
    chunks, wanted = figure.chunks(header, frames)
    places = Places.of(figure.skeleton)
    bases = _read_bases(figure.own, places)
    positions = np.concatenate([_decode_chunk(stream, n, index, bases, places) for n in chunks])
    return figure.motion(positions[wanted].astype(np.float32))


def _decode_chunk(
    stream: Stream, chunk: int, index: int, bases: list[CodedBasis], places: Places
) -> Float[np.ndarray, "frames joints 3"]:
    lengths = clip_lengths(chunk_length(stream.header, chunk))
    empty = [np.zeros((length, b.count), np.int64) for length in lengths for b in bases]
    return synthesise(code_levels(Reader(stream.chunk(chunk)), empty, AROUND), index, [b.rows() for b in bases], places)


def clip_lengths(frames: int) -> list[int]:
    """Frames of each clip: all of 240 but the last, which has what is left."""
    return [min(CLIP_FRAMES, frames - at) for at in range(0, frames, CLIP_FRAMES)]


def spectra(
    positions: Float[np.ndarray, "frames places 3"], places: Places
) -> list[Float[np.ndarray, "3 frequencies places"]]:
    """The temporal DCT of every trajectory, clip by clip, in coordinates in which all joints count alike."""
    clips = np.split(positions, range(CLIP_FRAMES, len(positions), CLIP_FRAMES))
    root = np.sqrt(places.counts)
    return [np.einsum("kf,fpd->dkp", dct_matrix(len(clip)), clip) * root for clip in clips]


def synthesise(
    planes: list[Int[np.ndarray, "frequencies components"]],
    index: int,
    bases: list[Float[np.ndarray, "components places"]],
    places: Places,
) -> Float[np.ndarray, "frames joints 3"]:
    """Levels, three planes a clip, to joint positions in cm."""
    root = np.sqrt(places.counts)
    coordinates = [
        dct_matrix(len(plane)).T @ (plane * step_cm(index)) @ bases[n % 3] / root for n, plane in enumerate(planes)
    ]
    return places.spread(np.stack([np.concatenate(coordinates[d::3]) for d in range(3)], axis=-1))


class _Coded(NamedTuple):
    """A sequence at one step; planes hold levels, three a clip, and bases one a coordinate."""

    places: Places
    bases: list[CodedBasis]
    planes: list[Int[np.ndarray, "frequencies components"]]


class _Fit(NamedTuple):
    """The spectra of all clips, and for each coordinate what they have in common: singular values and right singular
    vectors of their matrices, one below the other."""

    places: Places
    clips: list[Float[np.ndarray, "3 frequencies places"]]
    singular: list[tuple[Float[np.ndarray, " components"], Float[np.ndarray, "components places"]]]


class _Spectra:
    """A source made ready; its fit depends on the step only where bones are shorter than it."""

    def __init__(self, source: Source):
        self.source = source
        self._fitted: dict[bytes, _Fit] = {}

    def fit(self, index: int) -> _Fit:
        places = places_at(self.source, index)
        key = places.first.tobytes()
        if key not in self._fitted:
            clips = spectra(places.gather(self.source.positions.astype(np.float64)), places)
            matrices = [np.concatenate([clip[d] for clip in clips]) for d in range(3)]
            self._fitted[key] = _Fit(places, clips, [np.linalg.svd(m, full_matrices=False)[1:] for m in matrices])
        return self._fitted[key]


class _Sequence:
    """Spectra at one step after another, a bit being worth so many squared steps."""

    def __init__(self, spectra: _Spectra, worth: float):
        self.spectra, self.worth = spectra, worth
        self.at = functools.lru_cache(maxsize=4)(self._at)

    def decoded(self, index: int) -> Float[np.ndarray, "frames joints 3"]:
        """Joint positions in cm."""
        coded = self.at(index)
        return synthesise(coded.planes, index, [b.rows() for b in coded.bases], coded.places)

    def _at(self, index: int) -> _Coded:
        places, clips, singular = self.spectra.fit(index)
        step = step_cm(index)
        bases, planes = [], []
        for d in range(3):
            matrix = np.concatenate([clip[d] for clip in clips])
            basis, levels = _truncated(matrix, *singular[d], step, self.worth * step**2, _space(places))
            bases.append(basis)
            planes.append(np.split(levels, np.cumsum([clip.shape[1] for clip in clips])[:-1]))
        return _Coded(places, bases, [planes[d][n] for n in range(len(clips)) for d in range(3)])


def _truncated(
    matrix: Float[np.ndarray, "rows places"],
    weight: Float[np.ndarray, " components"],
    vectors: Float[np.ndarray, "components places"],
    step: float,
    bit: float,
    space: Coordinates,
) -> tuple[CodedBasis, Int[np.ndarray, "rows components"]]:
    """The basis cut to what is worth its bits, and the levels in it; a bit is worth that much squared error."""
    count = max(1, int((weight > step / 2).sum()))
    basis = quantise_basis(vectors[:count], precision(weight[:count], step))
    coefficients = matrix @ basis.rows().T
    levels = levels_of(coefficients, step)
    gain = (coefficients**2 - (coefficients - levels * step) ** 2).sum(0)
    kept = worth_keeping(gain, cost(basis, space) + level_bits(levels).sum(0), bit)
    return basis.first(kept), levels[:, :kept]


def _space(places: Places) -> Coordinates:
    return Coordinates(places.parents, places.counts)


def _read_bases(data: bytes, places: Places) -> list[CodedBasis]:
    """Raises CorruptStream where the bytes are no bases over so many places."""
    reader = ByteReader(data)
    counts = [reader.varint() for _ in range(3)]
    for count in counts:
        check_basis(count, places.count)
    bits = Reader(reader.take(reader.left))
    return [code_basis(bits, CodedBasis.blank(count, places.count), _space(places)) for count in counts]
