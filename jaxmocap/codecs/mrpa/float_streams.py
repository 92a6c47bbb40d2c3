"""Payloads of the float coder: all channels of a table as lanes, one frame after the other."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int8, Int32, UInt8, UInt16, UInt32

from ...errors import CorruptStream, TruncatedStream
from ..bitstream import ByteReader, varint
from ..entropy import lanes
from ..entropy.lanes import Decoding
from . import float_coding
from .float_coding import EXPONENTS, FIRST_SCALE, LIMIT, Floats, Stream, Symbols, Tables

CHUNK = 512  # frames decoded in one compiled call
ORDER = 3  # steps that a channel's next one is expected from
_UNIT = 32
_EIGHTHS = 8
_STEP_LIMIT = 1 << 19
_EXPONENT_BITS = 5


class Steps(NamedTuple):
    """What frames are predicted from besides the channel's own past.

    `other` is the step that another motion takes into a frame, `weight` its share in eighths; `inner` tells whether the
    step into the frame is one of the motion, so that later frames may go on with it.
    """

    other: Int32[np.ndarray, "frames lanes"]
    weight: UInt8[np.ndarray, "frames lanes"]
    inner: Bool[np.ndarray, " frames"]


class _State(NamedTuple):
    """What is known between two frames: how far the stream is read, the last frame, the last steps, and the scales."""

    stream: Stream
    last: Floats
    steps: Int32[Array, "order lanes"] | Int32[np.ndarray, "order lanes"]
    scale: Int32[np.ndarray, " lanes"]


def inner_frames(frames: int) -> Bool[np.ndarray, " frames"]:
    """All but the first two: in many files frame 0 is a T-pose, so that the step out of it is a jump."""
    return np.arange(frames) >= 2


def own_steps(
    values: Int32[np.ndarray, "frames lanes"], inner: Bool[np.ndarray, " frames"]
) -> Int32[np.ndarray, "frames lanes"]:
    """The step into every frame, 0 where it is none of the motion."""
    return np.where(inner[:, None], np.diff(values, axis=0, prepend=0).clip(-_STEP_LIMIT, _STEP_LIMIT), 0).astype(np.int32)


def last_steps(steps: Int32[np.ndarray, "frames lanes"]) -> Int32[np.ndarray, "order frames lanes"]:
    """For every frame the steps into the frames before it, the last one first."""
    padded = np.concatenate([np.zeros((ORDER, steps.shape[1]), np.int32), steps])
    return np.stack([padded[ORDER - 1 - k : len(padded) - 1 - k] for k in range(ORDER)])


def expected_step(last, coefficients):
    """What a channel's own last steps let expect, by linear prediction in fractions of 32."""
    return (last * coefficients).sum(0, dtype=np.int32) + _UNIT // 2 >> 5


def predict(last: Floats, own, other, weight) -> Floats:
    """The last frame, and the mean of the channel's own expected step and of another motion's, by weight."""
    weight = weight.astype(np.int32)
    step = (_EIGHTHS - weight) * own + weight * other + _EIGHTHS // 2 >> 3
    value = (last.value + step).clip(-LIMIT, LIMIT)
    return Floats(value, float_coding.predicted_sign(value, last))


def predictions(values: Floats, steps: Steps, coefficients: Int8[np.ndarray, "order lanes"]) -> Floats:
    """The predictions of all frames but the first, which an encoder knows at once. `steps` are those of all frames."""
    known, negative = values.value.copy(), values.negative.copy()
    known[:1], negative[:1] = 0, False  # the first frame is decoded last
    last = Floats(known[:-1], negative[:-1])
    past = last_steps(own_steps(known, steps.inner))
    own = expected_step(past, coefficients.astype(np.int32)[:, None])
    return predict(last, own[1:], steps.other[1:], steps.weight[1:])


def split(values: Floats, prediction: Floats) -> Symbols:
    """The symbols of all frames but the first."""
    actual = Floats(values.value[1:], values.negative[1:])
    return float_coding.symbols(prediction, actual, _scales(actual.value - prediction.value))


def _scales(corrections: Int32[np.ndarray, "frames lanes"]) -> Int32[np.ndarray, "frames lanes"]:
    """The scale of every lane before each frame."""
    found = np.empty_like(corrections)
    scale = np.full(corrections.shape[1], FIRST_SCALE, np.int32)
    for n, correction in enumerate(corrections):
        found[n] = scale
        scale = float_coding.next_scale(np, scale, correction)
    return found


def encode(values: Floats, coded: Symbols, tables: Tables) -> bytes:
    """The payload of a table of one frame or more."""
    count = values.value.shape[1]
    first = _pack_frame(Floats(values.value[0], values.negative[0]))
    rest, more = first[: 2 * count].ljust(2 * count, b"\0"), first[2 * count :]
    states, words = lanes.encode(*_intervals(coded, tables), np.frombuffer(rest, "<u2").astype(np.uint16))
    bits = lanes.pack_bits(coded.raw.ravel(), coded.raw_bits.ravel())
    return varint(len(words)) + varint(len(more)) + lanes.pack_states(states) + words.astype("<u2").tobytes() + more + bits


def _intervals(coded: Symbols, tables: Tables) -> tuple[UInt16[np.ndarray, "rows lanes"], UInt16[np.ndarray, "rows lanes"]]:
    """Starts and frequencies of what the lanes take: a row of classes and a row of tokens for every frame."""
    classes, tokens = (coded.class_context, coded.group), (coded.mantissa_context, coded.token)
    starts = np.stack([np.asarray(tables.class_starts)[classes], np.asarray(tables.token_starts)[tokens]], 1)
    frequencies = np.stack([np.asarray(tables.classes)[classes], np.asarray(tables.tokens)[tokens]], 1)
    shape = (-1, coded.group.shape[1])
    return starts.astype(np.uint16).reshape(shape), frequencies.astype(np.uint16).reshape(shape)


def _pack_frame(frame: Floats) -> bytes:
    """A frame without prediction: exponents, signs, then mantissas less their leading ones."""
    size = abs(frame.value)
    e = float_coding.exponent(np, size)
    bits = np.maximum(e - 1, 0)
    values = np.concatenate([e, frame.negative, size])
    return lanes.pack_bits(values, np.concatenate([np.full_like(e, _EXPONENT_BITS), np.ones_like(e), bits]))


def _unpack_frame(data: bytes, count: int) -> Floats:
    head = np.repeat([_EXPONENT_BITS, 1], count)
    if len(data) * 8 < head.sum():
        raise TruncatedStream("the first frame of a payload is cut short")
    e, sign = np.split(lanes.unpack_bits(data, head).astype(np.int64), 2)
    bits = np.maximum(e - 1, 0)
    counts = np.concatenate([head, bits])
    if e.max(initial=0) >= EXPONENTS or len(data) * 8 < counts.sum():
        raise CorruptStream("the first frame of a payload holds no floats")
    mantissa = lanes.unpack_bits(data, counts)[2 * count :].astype(np.int64)
    size = np.where(e > 0, mantissa | 1 << bits, 0).astype(np.int32)
    return Floats(np.where(sign, -size, size).astype(np.int32), sign.astype(bool))


class TableDecoder:
    """Decodes a table piece by piece, so that later pieces may lean on earlier ones. The first frame comes at the end."""

    def __init__(self, data: bytes, coefficients: Int8[np.ndarray, "order lanes"], tables: Tables):
        """Raises TruncatedStream or CorruptStream."""
        count = coefficients.shape[1]
        reader = ByteReader(data)
        self._word_count, more = reader.varint(), reader.varint()
        states = lanes.unpack_states(reader, count)
        words = np.frombuffer(reader.take(2 * self._word_count), "<u2").astype(np.uint32)
        self._more = reader.take(more)
        raw = reader.take(reader.left)
        self._byte_count = len(raw)
        spare = np.zeros(2 * (CHUNK + 1) * count + 2, np.uint32)
        self._words = np.concatenate([words, spare])
        self._bits = np.concatenate([np.frombuffer(raw + bytes(-len(raw) % 4), "<u4"), spare])
        self._word = self._bit = 0
        self._tables, self._count, self._coefficients = tables, count, coefficients.astype(np.int32)
        zeros = np.zeros(count, np.int32)
        stream = Stream(Decoding(states, np.zeros((), np.int32)), np.zeros((), np.int32))
        last, steps = Floats(zeros, zeros.astype(bool)), np.zeros((ORDER, count), np.int32)
        self._state = _State(stream, last, steps, np.full(count, FIRST_SCALE, np.int32))

    def frames(self, steps: Steps) -> Floats:
        """The next frames, 1..CHUNK of them, from frame 1 on. Raises TruncatedStream."""
        n, room = len(steps.inner), 2 * (CHUNK + 1) * self._count
        padded = Steps(*(np.concatenate([a, np.zeros((CHUNK - n, *a.shape[1:]), a.dtype)]) for a in steps))
        words = self._words[self._word : self._word + room]
        bits = self._bits[self._bit >> 5 : (self._bit >> 5) + room]
        stream = Stream(self._state.stream.coder._replace(at=np.zeros((), np.int32)), np.array(self._bit & 31, np.int32))
        state = self._state._replace(stream=stream)
        self._state, values = _decode_chunk(state, words, bits, self._tables, self._coefficients, padded, n)
        self._word += int(self._state.stream.coder.at)
        self._bit = (self._bit & ~31) + int(self._state.stream.bit)
        if self._word > self._word_count or self._bit > 8 * self._byte_count:
            raise TruncatedStream("a payload ends before its last frame")
        return Floats(*(np.asarray(a)[:n] for a in values))

    def first(self) -> Floats:
        """The first frame, once all others are decoded. Raises CorruptStream where the payload does not end there."""
        if self._word != self._word_count or -(-self._bit // 8) != self._byte_count:
            raise CorruptStream("a payload does not end with its last frame")
        rest = lanes.rest(self._state.stream.coder).astype("<u2").tobytes()
        return _unpack_frame(rest + self._more, self._count)


@jax.jit
def _decode_chunk(
    state: _State,
    words: UInt32[Array, " words"],
    bits: UInt32[Array, " words"],
    tables: Tables,
    coefficients: Int32[Array, "order lanes"],
    steps: Steps,
    count: int,
) -> tuple[_State, tuple[Int32[Array, "frames lanes"], Bool[Array, "frames lanes"]]]:
    def frame(n: Array, carry: tuple[_State, tuple[Array, Array]]) -> tuple[_State, tuple[Array, Array]]:
        state, (values, negative) = carry
        own = expected_step(state.steps, coefficients)
        prediction = predict(state.last, own, steps.other[n], steps.weight[n])
        value, stream = float_coding.decode(jnp, state.stream, words, bits, tables, prediction, state.scale)
        scale = float_coding.next_scale(jnp, state.scale, value.value - prediction.value)
        step = (value.value - state.last.value).clip(-_STEP_LIMIT, _STEP_LIMIT) * steps.inner[n]
        now = _State(stream, value, jnp.concatenate([step[None], state.steps[:-1]]), scale)
        return now, (values.at[n].set(value.value), negative.at[n].set(value.negative))

    empty = jnp.zeros(steps.other.shape, jnp.int32), jnp.zeros(steps.other.shape, bool)
    return lax.fori_loop(0, count, frame, (state, empty))
