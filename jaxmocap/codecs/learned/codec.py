"""`learned`: the codec of this project's own, optimal in rate and distortion, for every rig.

A motion becomes a path and rotation vectors, these the coefficients of a learned transform, these bands in time, these
levels, chosen for the least bits at the error asked for, and coded in the context of what is decoded before them.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Literal

import equinox as eqx
import numpy as np

from ...errors import CorruptStream, JaxmocapError
from ...features.channels import has_euler_orders
from ...features.recovery import freed, recover
from ...kinematics import pose
from ...motion import Motion
from ...skeleton import Skeleton
from ..artifact import Artifact, find_artifact, parse_artifact
from ..base import AbstractCodec, Target, frame_range
from ..bitstream import ByteReader, varint
from ..container import DIGEST_BYTES, Header, Stream, read_stream, write_stream
from ..quantise import step_cm
from ..rig import bones_of, with_bones
from . import bands
from .bones import FINENESSES, read_bones, write_bones
from .constants import with_constants, write_constants
from .distortion import METRICS, Metric, points_of
from .encoder import Source, encode_to, rough_bytes, typical_mean
from .figure import in_cm
from .model import LearnedModel
from .payload import read_payload, write_payload
from .pose_vectors import PoseVectors

NUMBER = 2
CHUNK_FRAMES = 8192
_HAS_CONSTANTS = 0x40
_MOST_AT_ONCE = 1 << 23  # joints times frames


class Learned(AbstractCodec):
    """`artifact` is the trained model; `target` None means a mean error of 0.5 % of the figure's height.

    `metric` says what the target is an error of: "joints" their positions, "shell" three points 3 cm from each, which see
    twist and the rotations of leaves, too. `embed` puts the model itself into every stream.
    """

    artifact: Artifact = eqx.field(static=True)
    metric: Literal["joints", "shell"] = eqx.field(static=True, default="shell")
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.metric not in METRICS:
            raise ValueError(f"metric is {self.metric!r}, wanted one of {METRICS}")

    def config(self) -> dict:
        target = None if self.target is None else {"kind": self.target.kind, "cm": self.target.cm}
        return {"codec": "learned", "metric": self.metric, "target": target, "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; what decodes from it has been measured to meet the target.

        Raises JaxmocapError where the target is out of reach.
        """
        if not motion.frame_count or not np.isfinite(motion.values).all():
            raise JaxmocapError("the motion has no frames, or values that are not finite numbers")
        motion = _codable(motion)
        target = self.target or Target.default(motion)
        model = _model(self.artifact)
        aim = target
        while True:
            data = self._encode(motion, model, aim)
            error = _error(motion, decode(read_stream(data), self.artifact), self.metric, target)
            if error <= target.cm:
                return data
            aim = Target(aim.kind, aim.cm * min(0.998, target.cm / error))

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)

    def _encode(self, motion: Motion, model: LearnedModel, target: Target) -> bytes:
        rig = model.rig
        scale = motion.unit_cm or rig.unit_cm
        target = Target(target.kind, target.cm * scale / motion.scale)
        original = PoseVectors(in_cm(motion.skeleton, scale), rig.expected)
        basis = model.bases[self.metric]
        parts = [
            original.analyse(motion.frames(start, start + CHUNK_FRAMES), scale)
            for start in range(0, motion.frame_count, CHUNK_FRAMES)
        ]
        octaves = bands.octave_count(motion.frame_time)
        sources = [Source(original, original, *part, octaves, basis, self.metric, model.densities) for part in parts]
        bones = _bone_fineness(sources, model, typical_mean(target))
        section, decoding = _bones(original, model, bones)
        chunks = []
        for source in sources:
            index, coded = encode_to(replace(source, decoding=decoding), target)
            chunks.append(write_payload(coded, index, basis, model.densities))
        constants = write_constants(motion, model.constants)
        if constants:
            section = varint(len(section)) + section + constants
        header = Header(
            codec=NUMBER,
            params=bytes([METRICS.index(self.metric) << 7 | _HAS_CONSTANTS * bool(constants) | bones]),
            frames=motion.frame_count,
            chunk_frames=min(CHUNK_FRAMES, motion.frame_count),
            skeleton=section,
            digest=bytes.fromhex(self.artifact.digest)[:DIGEST_BYTES],
            model=self.artifact.data if self.embed else None,
            frame_time=None if motion.frame_time == rig.frame_time else motion.frame_time,
            unit_cm=None if motion.unit_cm == rig.unit_cm else motion.unit_cm or 0.0,
        )
        return write_stream(header, chunks)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    metric, bones = _params(header)
    model = _model(_artifact(header, at_hand))
    unit_cm = model.rig.unit_cm if header.unit_cm is None else header.unit_cm or None
    scale = unit_cm or model.rig.unit_cm
    section, constants = _sections(header)
    in_cm_ = with_bones(model.rig.skeleton, read_bones(section, model.bones, bones, model.densities.tail))
    skeleton = in_cm(in_cm_, 1 / scale)
    frame_time = model.rig.frame_time if header.frame_time is None else header.frame_time
    start, stop = frame_range(frames, header.frames)
    if (stop - start + header.chunk_frames) * skeleton.joint_count > _MOST_AT_ONCE:
        raise JaxmocapError(f"{stop - start} frames are too many to decode at once; take them in parts (--frames A:B)")
    figure, basis = PoseVectors(in_cm_, model.rig.expected), model.bases[metric]
    first, last = start // header.chunk_frames, (stop - 1) // header.chunk_frames
    parts = []
    for n in range(first, last + 1):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        index, coded = read_payload(stream.chunk(n), held, bands.octave_count(frame_time), basis, model.densities)
        y = coded.coefficients(step_cm(index)).astype(np.float32)
        parts.append(figure.values(*basis.vectors(y, coded.direction), scale))
    values = with_constants(np.concatenate(parts), constants, model.constants)
    if not np.isfinite(values).all():
        raise CorruptStream("the stream's bones or joints are beyond all measure")
    skipped = first * header.chunk_frames
    return Motion(skeleton, values[start - skipped : stop - skipped], frame_time, unit_cm)


def _bone_fineness(sources: list[Source], model: LearnedModel, mean_cm: float) -> int:
    """The fineness of bones that costs least: their bytes, and those that their error takes from what the levels may err."""
    usual = int(np.clip(round(math.log2(mean_cm / 3)) + 13, 2, FINENESSES - 2))
    levels = sum(rough_bytes(source, mean_cm) for source in sources)
    costs = {}
    for fineness in range(usual - 2, usual + 2):
        section, decoding = _bones(sources[0].original, model, fineness)
        distortion = replace(sources[0], decoding=decoding).distortion
        share = float(distortion.errors(sources[0].coefficients).mean()) / mean_cm
        costs[fineness] = len(section) + levels * share**2 / 2
    return min(costs, key=lambda fineness: costs[fineness])


def _bones(original: PoseVectors, model: LearnedModel, fineness: int) -> tuple[bytes, PoseVectors]:
    """The bones' bytes, and the figure that decodes from them."""
    section = write_bones(bones_of(original.skeleton), model.bones, fineness, model.densities.tail)
    bones = read_bones(section, model.bones, fineness, model.densities.tail)
    return section, PoseVectors(with_bones(original.skeleton, bones), original.mean)


def _codable(motion: Motion) -> Motion:
    """The motion with a skeleton whose rotations have Euler orders; what has none becomes free joints, or positions."""
    s = motion.skeleton
    if has_euler_orders(s):
        return motion
    positions = np.asarray(pose(motion).positions)
    if s.is_rigid:
        free = freed(s)
        return Motion(free, recover(free, positions).values.astype(np.float64), motion.frame_time, motion.unit_cm)
    return Motion.from_positions(positions, s.names, motion.frame_time, s.parents, motion.unit_cm)


def _error(motion: Motion, decoded: Motion, metric: Metric, target: Target) -> float:
    """What the target speaks of, in cm, or in file units where the unit is unknown; 0 where it speaks of no error."""
    if target.kind == "step":
        return 0.0
    scale = motion.scale
    figures = [PoseVectors(in_cm(m.skeleton, scale), _upright(m.skeleton)) for m in (motion, decoded)]
    points = [points_of(f, metric, *f.analyse(m, scale)) for f, m in zip(figures, (motion, decoded), strict=True)]
    errors = np.linalg.norm(points[0] - points[1], axis=0)
    return float(errors.mean(dtype=np.float64) if target.kind == "mean" else errors.max())


def _upright(skeleton: Skeleton) -> np.ndarray:
    return np.tile(np.eye(3), (skeleton.joint_count, 1, 1))


def _params(header: Header) -> tuple[Metric, int]:
    """Metric and fineness of bones of a stream."""
    if header.codec != NUMBER or len(header.params) != 1 or header.params[0] & 0x30:
        raise CorruptStream(f"this is no learned stream: codec {header.codec}, settings {header.params.hex()}")
    if header.chunk_frames != min(CHUNK_FRAMES, header.frames):
        raise CorruptStream(f"the stream has chunks of {header.chunk_frames} frames, wanted {CHUNK_FRAMES}")
    return METRICS[header.params[0] >> 7], header.params[0] & 15


def _sections(header: Header) -> tuple[bytes, bytes]:
    """Bones and constants of a stream's skeleton."""
    if not header.params[0] & _HAS_CONSTANTS:
        return header.skeleton, b""
    reader = ByteReader(header.skeleton)
    bones = reader.take(reader.varint())
    return bones, reader.take(reader.left)


def _artifact(header: Header, at_hand: Artifact | None) -> Artifact:
    if header.model is not None:
        return parse_artifact(header.model, "the stream's model")
    return find_artifact(header.digest, at_hand)


@functools.lru_cache(maxsize=8)
def _model(artifact: Artifact) -> LearnedModel:
    return LearnedModel.load(artifact)
