"""What codecs of joint positions share: motions made codable, steps that meet a target, headers, and the way back.

Positions are coded; what decodes is a motion whose bones have exact lengths and whose joint rotations are fitted to the
decoded positions. Errors are measured on that motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from ..errors import CorruptStream, JaxmocapError
from ..features.recovery import freed, recover, recoverable
from ..kinematics import pose, positions_cm
from ..motion import Motion
from ..skeleton import Skeleton
from .artifact import Artifact
from .base import Target, frame_range
from .container import Header, Stream, read_stream
from .quantise import STEPS, step_index
from .rate_control import coarsest, meets, out_of_reach
from .rig import Rig, read_skeleton, write_skeleton

MOST_AT_ONCE = 1 << 23  # joint positions, 37 minutes of a figure: a crafted stream could claim more in a few bytes

# Joint positions in cm at a step index, before any fit; frames beyond the motion's may follow.
Decoded = Callable[[int], Float[Array, "padded_frames joints 3"] | Float[np.ndarray, "padded_frames joints 3"]]
Decode = Callable[[Stream, Artifact, slice], Motion]


@dataclass(frozen=True)
class Source:
    """A motion made ready for one encoding after another. `scale` is cm per file unit, guessed where it is unknown."""

    motion: Motion
    rig: Rig
    known: bool
    scale: float
    positions: Float[np.ndarray, "frames joints 3"]

    @staticmethod
    def of(motion: Motion, rig: Rig) -> Source:
        """Raises JaxmocapError where the motion has no frames, or values that are not finite."""
        if not motion.frame_count or not np.isfinite(motion.values).all():
            raise JaxmocapError("the motion has no frames, or values that are not finite numbers")
        motion = _codable(motion)
        known = rig.skeleton.same_rig(motion.skeleton)
        scale = motion.unit_cm or (rig.unit_cm if known else 1.0)
        return Source(motion, rig, known, scale, np.asarray(positions_cm(motion)) / motion.scale * scale)

    def in_cm(self, target: Target) -> Target:
        """The target in what this source takes for centimetres."""
        return Target(target.kind, target.cm * self.scale / self.motion.scale)

    def coarsest_step(self, decoded: Decoded, target: Target) -> int:
        """The step index for a target as given: found on positions alone, which is quick, then on the motion."""
        target = self.in_cm(target)
        if target.kind == "step":
            return step_index(target.cm)
        start = self.coarsest_on_positions(decoded, target)
        return self.coarsest_on_motion(decoded, target, start) if recoverable(self.motion.skeleton) else start

    def coarsest_on_positions(self, decoded: Decoded, target: Target, start: int = STEPS // 2) -> int:
        """The step index at which decoded positions meet a target in cm. Raises JaxmocapError where none does."""
        return coarsest(lambda index: _error(self.positions, decoded(index)), target, start)

    def coarsest_on_motion(self, decoded: Decoded, target: Target, start: int) -> int:
        """The same for what the decoder makes of the positions."""
        if not recoverable(self.motion.skeleton):
            return self.coarsest_on_positions(decoded, target, start)
        expected = self.rig.expected if self.known else None

        def distortion(index: int) -> tuple[float, float]:
            in_units = np.asarray(decoded(index)) / np.float32(self.scale)
            made = recover(self.motion.skeleton, in_units[: self.motion.frame_count], expected).positions
            return _error(self.positions, made * self.scale)

        return coarsest(distortion, target, start)

    def measured(
        self, write: Callable[[int], bytes], decode: Decode, artifact: Artifact, index: int, target: Target
    ) -> bytes:
        """The stream of the coarsest step, from `index` down, that has been measured to meet the target as given.

        What a search found holds but for the rounding of bones. Raises JaxmocapError where the finest does not, either.
        """
        while True:
            data = write(index)
            error = self._error_of(data, decode, artifact)
            if meets(error, target):
                return data
            if index == 0:
                raise out_of_reach(error, target)
            index -= 1

    def _error_of(self, data: bytes, decode: Decode, artifact: Artifact) -> tuple[float, float]:
        """Mean and maximum joint error of what a stream decodes to, in cm, or in file units where the unit is unknown."""
        stream, frames = read_stream(data), self.motion.frame_count
        part = MOST_AT_ONCE // self.motion.skeleton.joint_count - 2 * stream.header.chunk_frames
        total, largest = 0.0, 0.0
        for start in range(0, frames, part):
            original = self.positions[start : start + part]
            decoded = decode(stream, artifact, slice(start, start + len(original)))
            mean, most = _error(original, pose(decoded).positions * self.scale)
            total, largest = total + mean * len(original), max(largest, most)
        unit = self.motion.scale / self.scale
        return total / frames * unit, largest * unit

    def header(
        self, codec: int, params: bytes, chunk_frames: int, index: int, own: bytes, artifact: Artifact, embed: bool
    ) -> Header:
        """The header of a stream; `own` follows the skeleton where the rig is not the model's."""
        motion, rig = self.motion, self.rig
        return Header(
            codec=codec,
            params=params,
            frames=motion.frame_count,
            chunk_frames=min(chunk_frames, motion.frame_count),
            skeleton=write_skeleton(motion.skeleton, rig, self.scale, index) + own,
            digest=artifact.short_digest,
            model=artifact.data if embed else None,
            frame_time=None if motion.frame_time == rig.frame_time else motion.frame_time,
            unit_cm=None if motion.unit_cm == rig.unit_cm else motion.unit_cm or 0.0,
        )


@dataclass(frozen=True)
class Figure:
    """What a stream's header says of who moves. `own` are the bytes that follow a skeleton which no model knows."""

    skeleton: Skeleton
    scale: float
    expected: Float[np.ndarray, "joints 3 3"] | None
    frame_time: float
    unit_cm: float | None
    known: bool
    own: bytes

    @staticmethod
    def of(header: Header, rig: Rig, index: int) -> Figure:
        """Raises CorruptStream where the skeleton section contradicts itself."""
        unit_cm = rig.unit_cm if header.unit_cm is None else header.unit_cm or None
        skeleton, scale, own, known = read_skeleton(header.skeleton, rig, unit_cm, index)
        frame_time = rig.frame_time if header.frame_time is None else header.frame_time
        return Figure(skeleton, scale, rig.expected if known else None, frame_time, unit_cm, known, own)

    def chunks(self, header: Header, frames: slice | None) -> tuple[range, slice]:
        """The chunks that hold the frames asked for, and where these lie in what the chunks decode to.

        Raises ValueError for frames that are none, and JaxmocapError for more than fit in memory.
        """
        start, stop = frame_range(frames, header.frames)
        if (stop - start + header.chunk_frames) * self.skeleton.joint_count > MOST_AT_ONCE:
            raise JaxmocapError(f"{stop - start} frames are too many to decode at once; take them in parts (--frames A:B)")
        first = start // header.chunk_frames
        skipped = first * header.chunk_frames
        return range(first, (stop - 1) // header.chunk_frames + 1), slice(start - skipped, stop - skipped)

    def motion(self, positions: Float[Array | np.ndarray, "frames joints 3"]) -> Motion:
        """Rotations fitted to positions in cm; where joints have position channels of their own, the positions as they are.

        Raises CorruptStream where bones or joints are beyond what floats can hold.
        """
        s, in_units = self.skeleton, np.asarray(positions) / np.float32(self.scale)
        if not recoverable(s):
            return Motion.from_positions(in_units, s.names, self.frame_time, s.parents, self.unit_cm)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                values = recover(s, in_units, self.expected).values.astype(np.float64)
        except np.linalg.LinAlgError as error:
            raise CorruptStream(f"the stream's bones fit no joints: {error}") from error
        if not np.isfinite(values).all():
            raise CorruptStream("the stream's bones or joints are beyond all measure")
        return Motion(s, values, self.frame_time, self.unit_cm)


def chunk_length(header: Header, chunk: int) -> int:
    """Frames of a chunk: the last holds what is left."""
    return min(header.chunk_frames, header.frames - chunk * header.chunk_frames)


def _codable(motion: Motion) -> Motion:
    """The motion with a skeleton that positions determine: limited joints are freed, moving bones become positions."""
    s = motion.skeleton
    if recoverable(s):
        return motion
    positions = np.asarray(pose(motion).positions)
    if s.is_rigid and s.has_rotations:
        free = freed(s)
        return Motion(free, recover(free, positions).values.astype(np.float64), motion.frame_time, motion.unit_cm)
    return Motion.from_positions(positions, s.names, motion.frame_time, s.parents, motion.unit_cm)


def _error(positions: Float[np.ndarray, "frames joints 3"], decoded: Array | np.ndarray) -> tuple[float, float]:
    """Mean and maximum joint error in cm; on the host, where positions are by now."""
    error = np.linalg.norm(np.asarray(decoded)[: len(positions)] - positions, axis=-1)
    return float(error.mean(dtype=np.float64)), float(error.max())
