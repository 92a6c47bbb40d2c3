"""`lsdt-clip`: the clip-based method of Hou et al. 2016 (section 3.2), with real bytes.

Clips of L frames, temporal DCT (4), learned spatial transform (5), hard threshold and uniform quantisation, entropy
coding. Ours: the two readings of the entropy coding (`form`), bones of exact length in what is decoded (joint rotations
are fitted to the decoded positions), chunks of four clips, and a basis that travels along where no model knows the rig.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..errors import CorruptStream, JaxmocapError
from ..motion import Motion
from . import coefficients_paper, coefficients_runs, lsdt_basis
from .artifact import Artifact, stream_artifact
from .base import AbstractCodec, Target, target_config
from .clips import Cut, analyse, cut, synthesise, to_clips
from .coefficients_runs import frame_rate
from .container import Header, Stream, read_stream, write_stream
from .entropy import integers
from .joint_positions import Figure, Source, chunk_length
from .lsdt_basis import Coding
from .lsdt_model import CLIP_FRAMES, LsdtModel
from .quantise import quantise, step_cm

NUMBER = 1
CHUNK_CLIPS = 4
FORMS = ("paper", "runs")
_UNIT_FRAMES = 60


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
        target = target_config(self.target)
        return {"codec": "lsdt-clip", "clip_frames": self.clip_frames, "form": self.form, "target": target, "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; what decodes from it has been measured to meet the target.

        Raises JaxmocapError where the target is out of reach.
        """
        model = _model(self.artifact)
        source = Source.of(motion, model.rig)
        clips = _Clips(source, self.clip_frames)
        target = self.target or Target.default(motion)
        coding = lsdt_basis.known(model) if source.known else lsdt_basis.fit(source.positions, model)
        index = source.coarsest_step(clips.decoded(coding), target)
        if not source.known:
            band = coefficients_runs.bands(self.clip_frames, clips.frame_rate)
            coding = lsdt_basis.fit_to_levels(coding, clips.levels(coding, index), band, index)
        return source.measured(lambda at: self._write(clips, coding, at), decode, self.artifact, index, target)

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)

    def _write(self, clips: _Clips, coding: Coding, index: int) -> bytes:
        levels = clips.levels(coding, index)
        held = [levels[n, :, :length] for n, length in enumerate(clips.cut.lengths)]
        chunks = [
            _encode_chunk(self.form, held[n : n + CHUNK_CLIPS], coding, index, clips.frame_rate)
            for n in range(0, len(held), CHUNK_CLIPS)
        ]
        params = bytes([FORMS.index(self.form) << 7 | self.clip_frames // _UNIT_FRAMES, index])
        own = b"" if coding.own is None else lsdt_basis.write_own(coding.own, self.form)
        chunk_frames = CHUNK_CLIPS * self.clip_frames
        header = clips.source.header(NUMBER, params, chunk_frames, index, own, self.artifact, self.embed)
        return write_stream(header, chunks)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    header = stream.header
    form, clip_frames, index = _params(header)
    model = _model(stream_artifact(header.model, header.digest, at_hand))
    figure = Figure.of(header, model.rig, index)
    joints = figure.skeleton.joint_count
    coding = lsdt_basis.known(model) if figure.known else lsdt_basis.read_own(figure.own, joints, model, form)
    chunks, wanted = figure.chunks(header, frames)
    clips = []
    for n in chunks:
        lengths = cut(chunk_length(header, n), clip_frames).lengths
        clips += _decode_chunk(form, stream.chunk(n), lengths, coding, index, frame_rate(figure.frame_time))
    c = cut(sum(clip.shape[1] for clip in clips), clip_frames)
    levels = np.zeros((c.padded, 3, clip_frames, coding.components), np.int32)
    for n, clip in enumerate(clips):
        levels[n, :, : clip.shape[1]] = clip
    return figure.motion(np.asarray(_positions(levels, c, coding, index))[wanted])


class _Clips:
    """A source cut into clips, and their levels."""

    def __init__(self, source: Source, clip_frames: int):
        self.source = source
        self.cut = cut(source.motion.frame_count, clip_frames)
        self.frame_rate = frame_rate(source.motion.frame_time)
        self._clips = jnp.asarray(to_clips(source.positions, self.cut))

    def levels(self, coding: Coding, index: int) -> Int[np.ndarray, "clips 3 frequencies components"]:
        coefficients = np.asarray(self._coefficients(coding))
        if not np.abs(coefficients).max() < step_cm(index) * (integers.LIMIT - 1):
            raise JaxmocapError(
                f"a step of {step_cm(index):.3g} cm is too fine for joints as far away as in this motion; is the unit right?"
            )
        return np.asarray(quantise(coefficients, step_cm(index)))

    def decoded(self, coding: Coding) -> Callable[[int], Float[Array, "padded_frames joints 3"]]:
        """Joint positions in cm by step index."""
        coefficients = self._coefficients(coding)

        def at(index: int) -> Float[Array, "padded_frames joints 3"]:
            return _positions(quantise(coefficients, step_cm(index)), self.cut, coding, index)

        return at

    def _coefficients(self, coding: Coding) -> Float[Array, "clips 3 frequencies components"]:
        return analyse(self._clips, self.cut.full, self.cut.last, self.cut.clip_count - 1, coding.bases.analysis)


def _positions(levels: np.ndarray | Array, c: Cut, coding: Coding, index: int) -> Float[Array, "padded_frames joints 3"]:
    """Joint positions in cm, before any fit."""
    return synthesise(levels, step_cm(index), c.full, c.last, c.clip_count - 1, coding.bases.synthesis)


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
