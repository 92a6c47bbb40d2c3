"""`lsdt-clip`: the clip-based method of Hou et al. 2016 (section 3.2), with real bytes.

Clips of L frames, temporal DCT (4), learned spatial transform (5), hard threshold and uniform quantisation, entropy
coding. Ours: the two readings of the entropy coding (`form`), bones of exact length in what is decoded (joint rotations
are fitted to the decoded positions), chunks of four clips, and a basis that travels along where no model knows the rig.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..errors import CorruptStream, JaxmocapError
from ..features.recovery import freed, recover, recoverable
from ..kinematics import pose, positions_cm
from ..motion import Motion
from ..skeleton import Skeleton
from . import coefficients_paper, coefficients_runs, lsdt_basis
from .artifact import Artifact, stream_artifact
from .base import AbstractCodec, Target, frame_range
from .clips import Cut, analyse, cut, synthesise, to_clips
from .coefficients_runs import frame_rate
from .container import DIGEST_BYTES, Header, Stream, read_stream, write_stream
from .entropy import integers
from .lsdt_basis import Coding
from .lsdt_model import CLIP_FRAMES, LsdtModel
from .quantise import quantise, step_cm, step_index
from .rate_control import coarsest, meets, out_of_reach
from .rig import read_skeleton, write_skeleton

NUMBER = 1
CHUNK_CLIPS = 4
FORMS = ("paper", "runs")
_UNIT_FRAMES = 60
_MOST_AT_ONCE = 1 << 23  # joint positions, 37 minutes of a figure: a crafted stream could claim more in a few bytes


class LsdtClip(AbstractCodec):
    """`artifact` is the trained model; `target` None means a mean error of 0.5 % of the figure's height.

    `embed` puts the model itself into every stream.
    """

    artifact: Artifact = eqx.field(static=True)
    clip_frames: int = eqx.field(static=True, default=240)
    form: Literal["paper", "runs"] = eqx.field(static=True, default="runs")
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.clip_frames not in CLIP_FRAMES:
            raise ValueError(f"clip_frames is {self.clip_frames}, wanted one of {CLIP_FRAMES}")
        if self.form not in FORMS:
            raise ValueError(f"form is {self.form!r}, wanted one of {FORMS}")

    def config(self) -> dict:
        target = None if self.target is None else {"kind": self.target.kind, "cm": self.target.cm}
        return {"codec": "lsdt-clip", "clip_frames": self.clip_frames, "form": self.form, "target": target, "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; what decodes from it has been measured to meet the target.

        Raises JaxmocapError where the target is out of reach.
        """
        source = _Source.of(motion, _model(self.artifact), self.clip_frames)
        target = self.target or Target.default(motion)
        coding = lsdt_basis.known(source.model) if source.known else lsdt_basis.fit(source.positions, source.model)
        index = source.coarsest_step(coding, target)
        if not source.known:
            band = coefficients_runs.bands(self.clip_frames, source.frame_rate)
            coding = lsdt_basis.fit_to_levels(coding, source.levels(coding, index), band, index)
        while True:  # what the search found holds but for the rounding of bones
            data = self._write(source, coding, index)
            error = source.error(data, self.artifact)
            if meets(error, target):
                return data
            if index == 0:
                raise out_of_reach(error, target)
            index -= 1

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)

    def _write(self, source: _Source, coding: Coding, index: int) -> bytes:
        levels = source.levels(coding, index)
        clips = [levels[n, :, :length] for n, length in enumerate(source.cut.lengths)]
        chunks = [
            _encode_chunk(self.form, clips[n : n + CHUNK_CLIPS], coding, index, source.frame_rate)
            for n in range(0, len(clips), CHUNK_CLIPS)
        ]
        rig, motion = source.model.rig, source.motion
        skeleton = write_skeleton(motion.skeleton, rig, source.scale, index)
        header = Header(
            codec=NUMBER,
            params=bytes([FORMS.index(self.form) << 7 | self.clip_frames // _UNIT_FRAMES, index]),
            frames=motion.frame_count,
            chunk_frames=min(CHUNK_CLIPS * self.clip_frames, motion.frame_count),
            skeleton=skeleton if coding.own is None else skeleton + lsdt_basis.write_own(coding.own, self.form),
            digest=bytes.fromhex(self.artifact.digest)[:DIGEST_BYTES],
            model=self.artifact.data if self.embed else None,
            frame_time=None if motion.frame_time == rig.frame_time else motion.frame_time,
            unit_cm=None if motion.unit_cm == rig.unit_cm else motion.unit_cm or 0.0,
        )
        return write_stream(header, chunks)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    form, clip_frames, index = _params(header)
    model = _model(stream_artifact(header.model, header.digest, at_hand))
    unit_cm = model.rig.unit_cm if header.unit_cm is None else header.unit_cm or None
    skeleton, scale, rest, is_known = read_skeleton(header.skeleton, model.rig, unit_cm, index)
    coding = lsdt_basis.known(model) if is_known else lsdt_basis.read_own(rest, skeleton.joint_count, model, form)
    frame_time = model.rig.frame_time if header.frame_time is None else header.frame_time

    start, stop = frame_range(frames, header.frames)
    if (stop - start + header.chunk_frames) * skeleton.joint_count > _MOST_AT_ONCE:
        raise JaxmocapError(f"{stop - start} frames are too many to decode at once; take them in parts (--frames A:B)")
    first, last = start // header.chunk_frames, (stop - 1) // header.chunk_frames
    clips = []
    for n in range(first, last + 1):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        clips += _decode_chunk(form, stream.chunk(n), cut(held, clip_frames).lengths, coding, index, frame_rate(frame_time))
    total = sum(c.shape[1] for c in clips)
    c = cut(total, clip_frames)
    levels = np.zeros((c.padded, 3, clip_frames, coding.components), np.int32)
    for n, clip in enumerate(clips):
        levels[n, :, : clip.shape[1]] = clip
    positions = _positions(levels, c, coding, index)
    motion = _to_motion(skeleton, positions, scale, model.rig.expected if is_known else None, total, frame_time, unit_cm)
    skipped = first * header.chunk_frames
    return motion if frames is None else motion.frames(start - skipped, stop - skipped)


@dataclass(frozen=True)
class _Source:
    """A motion made ready for one encoding after another. `scale` is cm per file unit, guessed where it is unknown."""

    motion: Motion
    model: LsdtModel
    known: bool
    scale: float
    positions: Float[np.ndarray, "frames joints 3"]
    cut: Cut
    clips: Float[Array, "clips 3 frames joints"]

    @staticmethod
    def of(motion: Motion, model: LsdtModel, clip_frames: int) -> _Source:
        """Raises JaxmocapError where the motion has no frames, or values that are not finite."""
        if not motion.frame_count or not np.isfinite(motion.values).all():
            raise JaxmocapError("the motion has no frames, or values that are not finite numbers")
        motion = _codable(motion)
        known = model.rig.skeleton.same_rig(motion.skeleton)
        scale = motion.unit_cm or (model.rig.unit_cm if known else 1.0)
        positions = np.asarray(positions_cm(motion)) / motion.scale * scale
        c = cut(motion.frame_count, clip_frames)
        return _Source(motion, model, known, scale, positions, c, jnp.asarray(to_clips(positions, c)))

    @property
    def frame_rate(self) -> int:
        return frame_rate(self.motion.frame_time)

    def levels(self, coding: Coding, index: int) -> Int[np.ndarray, "clips 3 frequencies components"]:
        coefficients = np.asarray(self._coefficients(coding))
        if not np.abs(coefficients).max() < step_cm(index) * (integers.LIMIT - 1):
            raise JaxmocapError(
                f"a step of {step_cm(index):.3g} cm is too fine for joints as far away as in this motion; is the unit right?"
            )
        return np.asarray(quantise(coefficients, step_cm(index)))

    def _coefficients(self, coding: Coding) -> Array:
        return analyse(self.clips, self.cut.full, self.cut.last, self.cut.clip_count - 1, coding.bases.analysis)

    def coarsest_step(self, coding: Coding, target: Target) -> int:
        """Found on positions alone first, which is quick, then on what the decoder makes of them."""
        target = Target(target.kind, target.cm * self.scale / self.motion.scale)
        if target.kind == "step":
            return step_index(target.cm)
        coefficients = self._coefficients(coding)

        def decoded(index: int) -> Float[Array, "frames joints 3"]:
            levels = quantise(coefficients, step_cm(index))
            return _positions(levels, self.cut, coding, index)

        def on_positions(index: int) -> tuple[float, float]:
            return _error(self.positions, decoded(index))

        def on_motion(index: int) -> tuple[float, float]:
            expected = self.model.rig.expected if self.known else None
            in_units = np.asarray(decoded(index)) / np.float32(self.scale)
            made = recover(self.motion.skeleton, in_units[: self.cut.frames], expected).positions
            return _error(self.positions, made * self.scale)

        start = coarsest(on_positions, target)
        if not recoverable(self.motion.skeleton):
            return start
        return coarsest(on_motion, target, start)

    def error(self, data: bytes, artifact: Artifact) -> tuple[float, float]:
        """Mean and maximum joint error of what a stream decodes to, in cm, or in file units where the unit is unknown."""
        stream, frames = read_stream(data), self.motion.frame_count
        part = _MOST_AT_ONCE // self.motion.skeleton.joint_count - 2 * stream.header.chunk_frames
        total, largest = 0.0, 0.0
        for start in range(0, frames, part):
            original = self.positions[start : start + part]
            decoded = decode(stream, artifact, slice(start, start + len(original)))
            mean, most = _error(original, pose(decoded).positions * self.scale)
            total, largest = total + mean * len(original), max(largest, most)
        unit = self.motion.scale / self.scale
        return total / frames * unit, largest * unit


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


def _positions(levels: np.ndarray | Array, c: Cut, coding: Coding, index: int) -> Float[Array, "padded_frames joints 3"]:
    """Joint positions in cm, before any fit."""
    return synthesise(levels, step_cm(index), c.full, c.last, c.clip_count - 1, coding.bases.synthesis)


def _to_motion(
    skeleton: Skeleton,
    positions: Float[Array, "padded_frames joints 3"],
    scale: float,
    expected: np.ndarray | None,
    frames: int,
    frame_time: float,
    unit_cm: float | None,
) -> Motion:
    """Rotations fitted to positions in cm; where joints have position channels of their own, the positions as they are.

    Raises CorruptStream where bones or joints are beyond what floats can hold.
    """
    in_units = np.asarray(positions)[:frames] / np.float32(scale)
    if not recoverable(skeleton):
        return Motion.from_positions(in_units, skeleton.names, frame_time, skeleton.parents, unit_cm)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            values = recover(skeleton, in_units, expected).values.astype(np.float64)
    except np.linalg.LinAlgError as error:
        raise CorruptStream(f"the stream's bones fit no joints: {error}") from error
    if not np.isfinite(values).all():
        raise CorruptStream("the stream's bones or joints are beyond all measure")
    return Motion(skeleton, values, frame_time, unit_cm)


def _encode_chunk(form: str, clips: list[np.ndarray], coding: Coding, index: int, frame_rate: int) -> bytes:
    lengths = [c.shape[1] for c in clips]
    if form == "runs":
        return coefficients_runs.encode_clips(clips, [coding.tables(n) for n in lengths], index, frame_rate)
    return coefficients_paper.encode_clips(clips, [coding.codes(n) for n in lengths], index)


def _decode_chunk(form: str, data: bytes, lengths: list[int], coding: Coding, index: int, frame_rate: int) -> list[np.ndarray]:
    if form == "runs":
        tables = [coding.tables(n) for n in lengths]
        return coefficients_runs.decode_clips(data, lengths, coding.components, tables, index, frame_rate)
    return coefficients_paper.decode_clips(data, lengths, coding.components, [coding.codes(n) for n in lengths], index)


def _params(header: Header) -> tuple[str, int, int]:
    """Form, frames a clip and step index of a stream."""
    if header.codec != NUMBER or len(header.params) != 2:
        raise CorruptStream(f"this is no lsdt-clip stream: codec {header.codec}, {len(header.params)} bytes of settings")
    first, index = header.params
    clip_frames = (first & 127) * _UNIT_FRAMES
    if clip_frames not in CLIP_FRAMES:
        raise CorruptStream(f"the stream has clips of {clip_frames} frames, known are {CLIP_FRAMES}")
    if header.layers != 1:
        raise CorruptStream(f"the stream has {header.layers} layers, where lsdt-clip has one")
    if header.chunk_frames != min(CHUNK_CLIPS * clip_frames, header.frames):
        raise CorruptStream(f"the stream has chunks of {header.chunk_frames} frames for clips of {clip_frames}")
    return FORMS[first >> 7], clip_frames, index


@functools.lru_cache(maxsize=8)
def _model(artifact: Artifact) -> LsdtModel:
    return LsdtModel.load(artifact)
