"""What `lsdt-frame` and `dct-frame` share: all but the spatial transform.

Every chunk begins with a frame that nothing predicts, so that frame ranges decode without the rest; chunks are long, since
such a frame costs as much as dozens of others. A stream says how many bits its counts take, and at most so many nonzeros
as these can say are coded of a later vector, the largest: the encoder takes the width that codes smallest, with the step
that then meets the target.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream, JaxmocapError
from ..motion import Motion
from . import frame_transform
from .artifact import Artifact, stream_artifact
from .base import Target
from .bitstream import BitWriter
from .container import Stream, write_stream
from .entropy import integers
from .frame_coefficients import FrameCodes, decode_frames, encode_frames, size_in_bits
from .frame_model import FrameModel
from .frame_transform import AbstractSpatialTransform, Coding
from .joint_positions import Decoded, Figure, Source, chunk_length
from .quantise import step_cm, step_index
from .residual_frames import analyse, closed_loop, reconstruct, synthesise

CHUNK_FRAMES = 4096


def encode(
    motion: Motion, transform: AbstractSpatialTransform, artifact: Artifact, target: Target | None, embed: bool
) -> bytes:
    """The stream; what decodes from it has been measured to meet the target, 0.5 % of the figure's height where None.

    Raises JaxmocapError where the target is out of reach.
    """
    model = FrameModel.load(artifact, transform.name)
    source = Source.of(motion, model.rig)
    goal = target or Target.default(motion)
    frames, count_bits, index = _planned(source, transform, model, goal)

    def write(at: int) -> bytes:
        params = bytes([count_bits, at])
        header = source.header(transform.number, params, CHUNK_FRAMES, at, frames.coding.own, artifact, embed)
        chunks = [_encode(levels, frames.coding.codes, at, count_bits) for levels in frames.levels(at, count_bits)]
        return write_stream(header, chunks)

    def read(stream: Stream, at_hand: Artifact, part: slice) -> Motion:
        return decode(stream, transform, at_hand, part)

    return source.measured(write, read, artifact, index, goal)


def _planned(
    source: Source, transform: AbstractSpatialTransform, model: FrameModel, goal: Target
) -> tuple[_Frames, int, int]:
    """The frames in the basis that they are coded in, bits of a count, and the step index that a search found."""
    if source.known:
        frames = _Frames(source, frame_transform.known(model))
        return frames, *frames.cheapest(goal)
    joints, entries = source.positions.shape[1], transform.entries(source.positions)
    frames = _Frames(source, frame_transform.of_entries(entries, joints, transform, model))
    count_bits, index = frames.cheapest(goal)
    coding = frame_transform.fit_to_levels(frames.levels(index, count_bits), entries, joints, transform, model)
    return _Frames(source, coding), min(count_bits, coding.codes.components.bit_length()), index


def decode(
    stream: Stream, transform: AbstractSpatialTransform, at_hand: Artifact | None, frames: slice | None = None
) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    figure, coding, count_bits, index = _opened(stream, transform, at_hand)
    chunks, wanted = figure.chunks(stream.header, frames)
    sums = np.concatenate([reconstruct(levels) for levels in _levels(stream, chunks, coding, count_bits, index)])
    return figure.motion(synthesise(sums[wanted], index, coding.bases.synthesis))


def levels_of(stream: Stream, transform: AbstractSpatialTransform, at_hand: Artifact | None) -> list[np.ndarray]:
    """All levels of a stream, (frames, 3, components), chunk by chunk: integers, so the same on every machine."""
    _, coding, count_bits, index = _opened(stream, transform, at_hand)
    return _levels(stream, range(stream.header.chunk_count), coding, count_bits, index)


def packets(stream: Stream, transform: AbstractSpatialTransform, at_hand: Artifact | None) -> list[bytes]:
    """Every frame of a stream as bytes of its own, as it would be sent the moment it is there; without any framing."""
    _, coding, count_bits, index = _opened(stream, transform, at_hand)
    writers = []
    for levels in _levels(stream, range(stream.header.chunk_count), coding, count_bits, index):
        of_chunk = [BitWriter() for _ in levels]
        encode_frames(levels, coding.codes, index, count_bits, of_chunk)
        writers += of_chunk
    return [writer.to_bytes() for writer in writers]


def _levels(stream: Stream, chunks: range, coding: Coding, count_bits: int, index: int) -> list[np.ndarray]:
    payloads = [stream.chunk(n) for n in chunks]  # all checked before the first is decoded
    return [
        decode_frames(payload, chunk_length(stream.header, n), coding.codes, index, count_bits)
        for n, payload in zip(chunks, payloads, strict=True)
    ]


class _Frames:
    """The coefficients of a source, and what the closed loop makes of them."""

    def __init__(self, source: Source, coding: Coding):
        self.source = source
        self.coding = coding
        coefficients = analyse(source.positions, coding.bases.analysis)
        self._chunks = [coefficients[n : n + CHUNK_FRAMES] for n in range(0, len(coefficients), CHUNK_FRAMES)]
        self._reach = float(np.abs(coefficients).max())

    @property
    def most_bits(self) -> int:
        """Bits of a count that holds any number of nonzeros."""
        return self.coding.codes.components.bit_length()

    def levels(self, index: int, count_bits: int) -> list[Int[np.ndarray, "frames 3 components"]]:
        """Chunk by chunk. Raises JaxmocapError where the step is too fine for integers."""
        if not self._reach < step_cm(index) * (integers.LIMIT // 2 - 1):
            raise JaxmocapError(
                f"a step of {step_cm(index):.3g} cm is too fine for joints as far away as in this motion; is the unit right?"
            )
        return [closed_loop(chunk, index, (1 << count_bits) - 1) for chunk in self._chunks]

    def decoded(self, count_bits: int) -> Decoded:
        """Joint positions in cm by step index."""

        def at(index: int) -> Float[np.ndarray, "frames joints 3"]:
            sums = [reconstruct(closed_loop(chunk, index, (1 << count_bits) - 1)) for chunk in self._chunks]
            return synthesise(np.concatenate(sums), index, self.coding.bases.synthesis)

        return at

    def cheapest(self, goal: Target) -> tuple[int, int]:
        """Bits of a count, and the step index that with them meets the target: those that take the fewest bits in all."""
        target = self.source.in_cm(goal)
        if target.kind == "step":
            index = step_index(target.cm)
            counts = [(levels[1:] != 0).sum(2).max(initial=0) for levels in self.levels(index, self.most_bits)]
            return int(max(counts)).bit_length(), index
        index = self.source.coarsest_step(self.decoded(self.most_bits), goal)
        best = self._size(index, self.most_bits), self.most_bits, index
        for count_bits in range(self.most_bits - 1, -1, -1):
            try:
                index = self.source.coarsest_on_motion(self.decoded(count_bits), target, index)
                tried = self._size(index, count_bits), count_bits, index
            except JaxmocapError:  # so few a frame never catch up
                break
            if tried[0] >= best[0]:
                break
            best = tried
        return best[1:]

    def _size(self, index: int, count_bits: int) -> int:
        return sum(size_in_bits(levels, self.coding.codes, index, count_bits) for levels in self.levels(index, count_bits))


def _encode(levels: np.ndarray, codes: FrameCodes, index: int, count_bits: int) -> bytes:
    writer = BitWriter()
    encode_frames(levels, codes, index, count_bits, itertools.repeat(writer))
    return writer.to_bytes()


def _opened(
    stream: Stream, transform: AbstractSpatialTransform, at_hand: Artifact | None
) -> tuple[Figure, Coding, int, int]:
    """Who moves, what codes them, bits of a count, and the step index."""
    header = stream.header
    if header.codec != transform.number or len(header.params) != 2 or header.layers != 1:
        raise CorruptStream(f"this is no {transform.name} stream: codec {header.codec}, {len(header.params)} bytes of settings")
    count_bits, index = header.params
    model = FrameModel.load(stream_artifact(header.model, header.digest, at_hand), transform.name)
    figure = Figure.of(header, model.rig, index)
    if figure.known:
        coding = frame_transform.known(model)
    else:
        coding = frame_transform.read_own(figure.own, figure.skeleton.joint_count, transform, model)
    if count_bits > coding.codes.components.bit_length():
        raise CorruptStream(f"counts of {count_bits} bits for vectors of {coding.codes.components} coefficients")
    return figure, coding, count_bits, index
