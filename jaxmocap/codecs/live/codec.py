"""`live` as a file: every frame coded from those before it alone, as a stream of packets has them, but in one string."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Int

from ...errors import CorruptStream, JaxmocapError
from ...motion import Motion
from ..artifact import Artifact, stream_artifact
from ..base import AbstractCodec, Target, frame_range, target_config
from ..container import Header, Stream, read_stream, write_stream
from ..entropy import integers
from ..entropy.range_coder import RangeDecoder, RangeEncoder
from ..learned.basis import DIRECTIONS, direction_of
from ..learned.bones import FINENESSES
from ..learned.codec import codable, points_as_measured
from ..learned.distortion import METRICS, Metric
from ..learned.figure import in_cm
from ..learned.steps import STEP_BITS, STEPS, coarsest_within, index_of, step_cm
from .encoder import encode_frames
from .levels import Tables, decode_first, decode_frame, encode_first, encode_frame
from .model import LiveModel
from .setting import FINENESS, OWN_RIG, Setting, figure_of, read_setting, write_setting
from .tracker import FINEST_STEP, State, advance, look, place_of, step_units, to_units

NUMBER = 7
CHUNK_FRAMES = 4096
_MOST_AT_ONCE = 1 << 23  # joints times frames
_LARGEST = 1e9  # degrees or file units
_DIRECTION_BITS = DIRECTIONS.bit_length() - 1
_MEAN_STEPS, _POWER = 1.5, 0.95  # the mean error is about so many steps, and goes about as this power of the step
_TRIES = 12


class Live(AbstractCodec):
    """`artifact` is the trained model; `target` None means a mean error of 0.5 % of the figure's height.

    `metric` says what the target is an error of: "joints" their positions, "shell" three points 3 cm from each, which see
    twist and the rotations of leaves, too. `embed` puts the model itself into every stream. No frame waits for a later
    one; but the step, one for the file, is found by coding it several times.
    """

    artifact: Artifact = eqx.field(static=True)
    metric: Literal["joints", "shell"] = eqx.field(static=True, default="shell")
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.metric not in METRICS:
            raise ValueError(f"metric is {self.metric!r}, wanted one of {METRICS}")

    def config(self) -> dict:
        return {"codec": "live", "metric": self.metric, "target": target_config(self.target), "embed": self.embed}

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
        cm = asked.cm * scale / motion.scale
        setting = write_setting(motion.skeleton, scale, model, self.metric, fineness_for(cm))
        parts = _parts(motion, scale, setting)
        original = points_as_measured(motion, self.metric, motion.scale)

        def coded(index: int) -> tuple[list[np.ndarray], float]:
            """Levels of every chunk at a step, and the error of what they decode to."""
            levels, places = zip(*(encode_frames(w, setting.prior, model.network, index) for _, w in parts), strict=True)
            if asked.kind == "step":
                return list(levels), 0.0
            values = np.concatenate([setting.values(p, d, scale) for p, (d, _) in zip(places, parts, strict=True)])
            made = Motion(in_cm(setting.figure.skeleton, 1 / scale), values, motion.frame_time, motion.unit_cm)
            errors = np.linalg.norm(original - points_as_measured(made, self.metric, motion.scale), axis=0)
            return list(levels), float(errors.mean(dtype=np.float64) if asked.kind == "mean" else errors.max())

        if asked.kind == "step":
            index = max(coarsest_within(cm), FINEST_STEP)
            levels, _ = coded(index)
        else:
            index, levels = _coarsest(coded, asked, cm)
        chunks = [_write_chunk(d, of_chunk, setting, model, index) for (d, _), of_chunk in zip(parts, levels, strict=True)]
        flags = METRICS.index(self.metric) << 7 | setting.flags
        header = Header(
            codec=NUMBER,
            params=bytes([flags]),
            frames=motion.frame_count,
            chunk_frames=min(CHUNK_FRAMES, motion.frame_count),
            skeleton=setting.section,
            digest=self.artifact.short_digest,
            model=self.artifact.data if self.embed else None,
            frame_time=None if motion.frame_time == model.rig.frame_time else motion.frame_time,
            unit_cm=None if motion.unit_cm == model.rig.unit_cm else motion.unit_cm or 0.0,
        )
        return write_stream(header, chunks)

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    flags, metric = params_of(header)
    model = model_of(stream_artifact(header.model, header.digest, at_hand))
    unit_cm = model.rig.unit_cm if header.unit_cm is None else header.unit_cm or None
    setting = read_setting(header.skeleton, flags, model, metric)
    scale = unit_cm or (1.0 if flags & OWN_RIG else model.rig.unit_cm)
    frame_time = model.rig.frame_time if header.frame_time is None else header.frame_time
    start, stop = frame_range(frames, header.frames)
    skeleton = in_cm(setting.figure.skeleton, 1 / scale)
    if (stop - start + header.chunk_frames) * skeleton.joint_count > _MOST_AT_ONCE:
        raise JaxmocapError(f"{stop - start} frames are too many to decode at once; take them in parts (--frames A:B)")
    first, last = start // header.chunk_frames, (stop - 1) // header.chunk_frames
    payloads = [stream.chunk(n) for n in range(first, last + 1)]  # all whole, before one is decoded
    parts = []
    for n, payload in enumerate(payloads, first):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        direction, places = read_chunk(payload, held, setting, model)
        parts.append(setting.values(places, direction, scale))
    values = np.concatenate(parts)
    if not np.isfinite(values).all():
        raise CorruptStream("the stream's bones or joints are beyond all measure")
    skipped = first * header.chunk_frames
    return Motion(skeleton, values[start - skipped : stop - skipped], frame_time, unit_cm)


def fineness_for(mean_cm: float) -> int:
    """Of bones, which are multiples of about a third of the error."""
    return int(np.clip(round(math.log2(mean_cm / 3)) + 13, 0, FINENESSES - 1))


def params_of(header: Header) -> tuple[int, Metric]:
    """Flags of the setting, and the metric of a stream."""
    if header.codec != NUMBER or len(header.params) != 1 or header.params[0] & ~(1 << 7 | OWN_RIG | FINENESS):
        raise CorruptStream(f"this is no live stream: codec {header.codec}, settings {header.params.hex()}")
    if header.chunk_frames != min(CHUNK_FRAMES, header.frames):
        raise CorruptStream(f"the stream has chunks of {header.chunk_frames} frames, wanted {CHUNK_FRAMES}")
    if header.layers != 1:
        raise CorruptStream(f"the stream has {header.layers} layers, where live has one")
    return header.params[0] & (OWN_RIG | FINENESS), METRICS[header.params[0] >> 7]


@functools.lru_cache(maxsize=8)
def model_of(artifact: Artifact) -> LiveModel:
    return LiveModel.load(artifact)


def _parts(motion: Motion, scale: float, setting: Setting) -> list[tuple[int, Int[np.ndarray, "frames components"]]]:
    """Direction and places wanted of every chunk."""
    figure, parts = figure_of(motion.skeleton, scale, setting), []
    for n in range(0, motion.frame_count, CHUNK_FRAMES):
        path, body = figure.analyse(motion.frames(n, n + CHUNK_FRAMES), scale)
        direction = direction_of(path)
        parts.append((direction, to_units(setting.basis.coefficients(path, body, direction))))
    return parts


def _write_chunk(direction: int, levels: np.ndarray, setting: Setting, model: LiveModel, index: int) -> bytes:
    if np.abs(levels).max() >= integers.LIMIT:
        raise JaxmocapError("the motion goes too far for so small an error: it is out of this codec's reach")
    encoder, t = RangeEncoder(), Tables.of(model)
    encoder.encode_bits(index, STEP_BITS)
    encoder.encode_bits(direction, _DIRECTION_BITS)
    encode_first(encoder, levels[0], setting.prior, index, t)
    state = State.at(levels[0] * step_units(index))
    for of_frame in levels[1:]:
        outlook = look(state, setting.prior, model.network, index)
        encode_frame(encoder, of_frame, outlook, t)
        state = advance(state, place_of(outlook, of_frame, index), of_frame)
    return encoder.finish()


def read_chunk(
    data: bytes, frames: int, setting: Setting, model: LiveModel
) -> tuple[int, Int[np.ndarray, "frames components"]]:
    """Direction and places. Raises CorruptStream where no encoder wrote such bytes."""
    decoder, t = RangeDecoder(data), Tables.of(model)
    index, direction = decoder.decode_bits(STEP_BITS), decoder.decode_bits(_DIRECTION_BITS)
    if index < FINEST_STEP:
        raise CorruptStream(f"a chunk has the step {index}, the finest is {FINEST_STEP}")
    places = np.zeros((frames, len(setting.prior.speed)), np.int64)
    places[0] = decode_first(decoder, setting.prior, index, t) * step_units(index)
    state = State.at(places[0])
    for n in range(1, frames):
        outlook = look(state, setting.prior, model.network, index)
        levels = decode_frame(decoder, outlook, t)
        places[n] = place_of(outlook, levels, index)
        state = advance(state, places[n], levels)
    return direction, places


def _coarsest(coded: Callable[[int], tuple[list[np.ndarray], float]], asked: Target, cm: float) -> tuple[int, list[np.ndarray]]:
    """The coarsest step found to meet the target, and its levels: by the error's power law, inside a bracket that closes."""
    low, high = FINEST_STEP - 1, STEPS  # low meets the target, high does not
    index, found, error = int(np.clip(index_of(cm / _MEAN_STEPS), FINEST_STEP, STEPS - 1)), None, math.inf
    for _ in range(_TRIES):
        levels, error = coded(index)
        if error <= asked.cm:
            low, found = index, (index, levels)
        else:
            high = index
        if high - low <= 1:
            break
        aim = index + math.floor(16 * math.log2(asked.cm / max(error, 1e-9)) / _POWER)
        index = min(max(aim, low + 1), high - 1)
    if found is None:
        raise JaxmocapError(
            f"a {asked.kind} error of {asked.cm:g} cm is out of this codec's reach on this motion: "
            f"the finest step tried, {step_cm(index):.4g} cm, leaves {error:.4g} cm"
        )
    return found
