"""`learned`: the codec of this project's own, optimal in rate and distortion, for every rig.

A motion becomes a path and rotation vectors, these the coefficients of a learned transform, these bands in time, these
levels, chosen for the least bits at the error asked for, and coded in the context of what is decoded before them.
"""

from __future__ import annotations

import functools
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...errors import CorruptStream, JaxmocapError
from ...features.channels import has_euler_orders
from ...features.recovery import freed, recover
from ...kinematics import pose
from ...motion import Motion
from ...skeleton import Skeleton
from ..artifact import Artifact, stream_artifact
from ..base import AbstractCodec, Target, frame_range, target_config
from ..container import MOST_LAYERS, Header, Stream, read_stream, write_stream
from . import bands
from .attempt import Source
from .constants import with_constants, write_constants
from .distortion import METRICS, Metric, points_of
from .encoder import encode_in_layers, typical_mean
from .figure import in_cm
from .model import LearnedModel
from .payload import coefficients_of, read_layers, write_layers
from .pose_vectors import PoseVectors
from .setting import (
    CHUNK_FRAMES,
    HAS_CONSTANTS,
    KNOWN_FLAGS,
    OWN_BASIS,
    Setting,
    join_sections,
    read_setting,
    write_known,
    write_own_setting,
)

NUMBER = 2
_MOST_AT_ONCE = 1 << 23  # joints times frames
_LARGEST = 1e9  # degrees or file units


class Learned(AbstractCodec):
    """`artifact` is the trained model; `target` None means a mean error of 0.5 % of the figure's height.

    `metric` says what the target is an error of: "joints" their positions, "shell" three points 3 cm from each, which see
    twist and the rotations of leaves, too. `embed` puts the model itself into every stream. With `qualities` the stream
    is progressive: its beginnings decode, too, to motions whose mean error is about 2.2 times as large for each left out.
    """

    artifact: Artifact = eqx.field(static=True)
    metric: Literal["joints", "shell"] = eqx.field(static=True, default="shell")
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)
    qualities: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        if self.metric not in METRICS:
            raise ValueError(f"metric is {self.metric!r}, wanted one of {METRICS}")
        if self.qualities not in range(1, MOST_LAYERS + 1):
            raise ValueError(f"qualities is {self.qualities}, wanted a whole number from 1 to {MOST_LAYERS}")

    def config(self) -> dict:
        target = target_config(self.target)
        return {"codec": "learned", "metric": self.metric, "target": target, "embed": self.embed, "qualities": self.qualities}

    def encode(self, motion: Motion) -> bytes:
        """The stream; what decodes from it has been measured to meet the target.

        Raises JaxmocapError where the target is out of reach.
        """
        if not motion.frame_count or not (np.abs(motion.values) < _LARGEST).all():
            raise JaxmocapError(f"the motion has no frames, or values that are not finite numbers below {_LARGEST:g}")
        motion = codable(motion)
        model = model_of(self.artifact)
        known = model.rig.skeleton.same_rig(motion.skeleton)
        scale = motion.unit_cm or (model.rig.unit_cm if known else 1.0)
        asked = self.target or Target.default(motion)
        aim = Target(asked.kind, asked.cm * scale / motion.scale)
        write = write_known if known else write_own_setting
        setting, sources = write(motion, scale, model, self.metric, typical_mean(aim))
        original = points_as_measured(motion, self.metric, motion.scale)
        while True:
            data = self._stream(motion, model, setting, sources, aim)
            decoded = points_as_measured(decode(read_stream(data), self.artifact), self.metric, motion.scale)
            error = _error(original - decoded, asked.kind)
            if error <= asked.cm:
                return data
            aim = Target(aim.kind, aim.cm * min(0.998, asked.cm / error))

    def decode(self, data: bytes, frames: slice | None = None, quality: int | None = None) -> Motion:
        """With `quality`, from 1 on, as it is after so many layers; bytes beyond them need not be there."""
        return decode(read_stream(data, quality), self.artifact, frames)

    def _stream(
        self, motion: Motion, model: LearnedModel, setting: Setting, sources: list[Source], target: Target
    ) -> bytes:
        constants = write_constants(motion, model.constants)
        coded = [encode_in_layers(source, target, self.qualities) for source in sources]
        payloads = [write_layers(layers, setting.basis, model.densities) for layers in coded]
        chunks = [of_chunk[n] for n in range(self.qualities) for of_chunk in payloads]
        flags = METRICS.index(self.metric) << 7 | setting.flags | HAS_CONSTANTS * bool(constants)
        rig = model.rig
        header = Header(
            codec=NUMBER,
            params=bytes([flags] if flags else []),
            frames=motion.frame_count,
            chunk_frames=min(CHUNK_FRAMES, motion.frame_count),
            skeleton=join_sections([*setting.sections, *([constants] if constants else [])]),
            digest=self.artifact.short_digest,
            model=self.artifact.data if self.embed else None,
            frame_time=None if motion.frame_time == rig.frame_time else motion.frame_time,
            unit_cm=None if motion.unit_cm == rig.unit_cm else motion.unit_cm or 0.0,
            layers=self.qualities,
        )
        return write_stream(header, chunks)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    flags, metric = params_of(header)
    model = model_of(stream_artifact(header.model, header.digest, at_hand))
    unit_cm = model.rig.unit_cm if header.unit_cm is None else header.unit_cm or None
    setting = read_setting(header.skeleton, flags, model, metric)
    scale = unit_cm or (1.0 if flags & OWN_BASIS else model.rig.unit_cm)
    skeleton = in_cm(setting.figure.skeleton, 1 / scale)
    frame_time = model.rig.frame_time if header.frame_time is None else header.frame_time
    start, stop = frame_range(frames, header.frames)
    if (stop - start + header.chunk_frames) * skeleton.joint_count > _MOST_AT_ONCE:
        raise JaxmocapError(f"{stop - start} frames are too many to decode at once; take them in parts (--frames A:B)")
    figure, basis = setting.figure, setting.basis
    first, last = start // header.chunk_frames, (stop - 1) // header.chunk_frames
    chunks = range(first, last + 1)
    payloads = [[stream.chunk(n, k) for k in range(stream.layers)] for n in chunks]  # all whole, before one is decoded
    parts = []
    for n, of_layers in zip(chunks, payloads, strict=True):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        layers = read_layers(of_layers, held, bands.octave_count(frame_time), basis, model.densities)
        y = np.asarray(coefficients_of(layers), np.float32)
        parts.append(figure.values(*basis.vectors(y, layers[0].direction), scale))
    values = with_constants(np.concatenate(parts), setting.constants, model.constants)
    if not np.isfinite(values).all():
        raise CorruptStream("the stream's bones or joints are beyond all measure")
    skipped = first * header.chunk_frames
    return Motion(skeleton, values[start - skipped : stop - skipped], frame_time, unit_cm)


def codable(motion: Motion) -> Motion:
    """The motion with a skeleton whose rotations have Euler orders; what has none becomes free joints, or positions."""
    s = motion.skeleton
    if has_euler_orders(s):
        return motion
    positions = np.asarray(pose(motion).positions)
    if s.is_rigid:
        free = freed(s)
        return Motion(free, recover(free, positions).values.astype(np.float64), motion.frame_time, motion.unit_cm)
    return Motion.from_positions(positions, s.names, motion.frame_time, s.parents, motion.unit_cm)


def points_as_measured(motion: Motion, metric: Metric, scale: float) -> Float[np.ndarray, "3 points frames"]:
    """What the metric looks at, in cm, or in file units where the unit is unknown: as everybody else will measure it."""
    figure = PoseVectors(in_cm(motion.skeleton, scale), _upright(motion.skeleton))
    return points_of(figure, metric, *figure.analyse(motion, scale))


def _error(difference: Float[np.ndarray, "3 points frames"], kind: str) -> float:
    """What a target of this kind speaks of; 0 where it speaks of no error."""
    if kind == "step":
        return 0.0
    errors = np.linalg.norm(difference, axis=0)
    return float(errors.mean(dtype=np.float64) if kind == "mean" else errors.max())


def _upright(skeleton: Skeleton) -> np.ndarray:
    return np.tile(np.eye(3), (skeleton.joint_count, 1, 1))


def params_of(header: Header) -> tuple[int, Metric]:
    """Flags of the setting, and the metric of a stream."""
    flags = header.params[0] if header.params else 0
    if header.codec != NUMBER or len(header.params) > 1 or flags & ~(1 << 7 | KNOWN_FLAGS):
        raise CorruptStream(f"this is no learned stream: codec {header.codec}, settings {header.params.hex()}")
    if header.chunk_frames != min(CHUNK_FRAMES, header.frames):
        raise CorruptStream(f"the stream has chunks of {header.chunk_frames} frames, wanted {CHUNK_FRAMES}")
    return flags & KNOWN_FLAGS, METRICS[flags >> 7]


@functools.lru_cache(maxsize=8)
def model_of(artifact: Artifact) -> LearnedModel:
    return LearnedModel.load(artifact)
