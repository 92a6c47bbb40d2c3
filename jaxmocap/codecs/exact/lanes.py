"""The entropy coder of `exact`: what the wave of lanes does not expect, as symbols, raw bits and rANS in lanes."""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..entropy import lanes as rans
from . import wave as waves
from .wave import CLASSES, LaneModel, Tables, Wave

_BLOCK = 512  # steps compiled together
_WORTH_COMPILING = 3000  # frames; fewer are done in NumPy before XLA would have compiled
_compiled_for: set[tuple[int, int]] = set()  # numbers of moving and of all lanes
LIMIT = 1 << 27  # residuals are smaller

# Bins of magnitudes in units of 2^shift: 8 single ones, 4 an octave up to 64, 2 an octave up to 4096, and an escape.
_WIDTHS = np.array([0] * 8 + [o - 2 for o in (3, 4, 5) for _ in range(4)] + [o - 1 for o in range(6, 12) for _ in range(2)])
SYMBOLS = len(_WIDTHS) + 1
_ESCAPE = SYMBOLS - 1
_BASES = np.append(np.concatenate([[0], np.cumsum(1 << _WIDTHS)[:-1]]), 0).astype(np.int32)
_EXTRA = np.append(_WIDTHS, 27).astype(np.int32)


class Streams(NamedTuple):
    """What is read: the frequencies of the symbols, summed, the coder's words and the raw bits."""

    cumulative: Array | np.ndarray  # (classes, symbols + 1)
    words: Array | np.ndarray
    bits: Array | np.ndarray


class Reading(NamedTuple):
    """What the lanes remember, and how far words and bits have been read."""

    wave: Wave
    coder: rans.Decoding
    bit: Array | np.ndarray


def worth_compiling(model: LaneModel, frames: int) -> bool:
    """Whether compiled steps are the faster ones for so many frames, all tables together; the bytes are the same."""
    return frames >= _WORTH_COMPILING or (model.moving, model.count) in _compiled_for


def encode(model: LaneModel, values: Int32[np.ndarray, "frames lanes"], rest: bytes, compiled: bool) -> tuple[bytes, bytes]:
    """The payload of the lanes' values, and what of `rest` found no room in it (two bytes a lane do)."""
    residual, classes = residuals(model, values, compiled)
    symbols, raw, count = _symbols(residual, classes)
    cumulative = _cumulative(model)
    starts = cumulative[classes, symbols]
    widths = cumulative[classes, symbols + 1] - starts
    room, more = rest[: 2 * model.count].ljust(2 * model.count, b"\0"), rest[2 * model.count :]
    ends = np.frombuffer(room, "<u2").astype(np.uint16)
    states, words = rans.encode(_skewed(starts, 0).astype(np.uint16), _skewed(widths, rans.TOTAL).astype(np.uint16), ends)
    bits = rans.pack_bits(_skewed(raw, 0).ravel(), _skewed(count, 0).ravel())
    return varint(len(words)) + rans.pack_states(states) + words.astype("<u2").tobytes() + bits, more


def residuals(
    model: LaneModel, values: Int32[np.ndarray, "frames lanes"], compiled: bool
) -> tuple[Int32[np.ndarray, "frames lanes"], Int32[np.ndarray, "frames lanes"]]:
    """What is left of the values' changes by prediction, and the scale classes it is coded in."""
    frames, count = values.shape
    changes = np.concatenate([differences(values[:, : model.moving]), values[:, model.moving :]], 1)
    skewed = _skewed(changes.astype(np.int32), 0)
    walk = _predict_compiled if compiled else _predict_plainly
    residual, classes = walk(model, skewed, frames)
    return _unskewed(residual, frames, count), _unskewed(classes, frames, count)


def differences(values: Int32[np.ndarray, "frames lanes"]) -> Int32[np.ndarray, "frames lanes"]:
    """The first values, the first differences of the second frame, and second differences from there on."""
    out = values.copy()
    out[1:] -= values[:-1]
    out[2:] -= values[1:-1] - values[:-2]
    return out


def decode(
    model: LaneModel, reader: ByteReader, frames: int, rest: int, compiled: bool
) -> tuple[Int32[np.ndarray, "frames lanes"], bytes]:
    """The values of a payload, and the first `rest` bytes of what was put beside them.

    Raises TruncatedStream, and CorruptStream where the payload cannot be one.
    """
    count = reader.varint()
    states = rans.unpack_states(reader, model.count)
    words = np.frombuffer(reader.take(2 * count), "<u2").astype(np.uint32)
    data = reader.take(reader.left)
    bits = np.frombuffer(data + bytes(-len(data) % 4), "<u4")
    steps = frames + model.count - 1
    walk = _read_compiled if compiled else _read_plainly
    rows, coder, bit = walk(model, states, words, bits, frames, steps)
    if coder.at != count or -(-int(bit) // 8) != len(data):
        raise CorruptStream("the lanes of a payload end before their words or bits do, or behind them")
    values = _unskewed(rows, frames, model.count)
    return values, rans.rest(coder).astype("<u2").tobytes()[:rest]


def symbols_and_classes(model: LaneModel, values: Int32[np.ndarray, "frames lanes"]) -> tuple[np.ndarray, np.ndarray]:
    """The symbol and the scale class of every value, for counting."""
    residual, classes = residuals(model, values, True)
    return _symbols(residual, classes)[0], classes


def code_lengths(model: LaneModel, values: Int32[np.ndarray, "frames lanes"]) -> np.ndarray:
    """Bits that every value costs (frames, lanes)."""
    residual, classes = residuals(model, values, True)
    symbols, _, count = _symbols(residual, classes)
    return count - np.log2(model.frequencies[classes, symbols] / rans.TOTAL)


def magnitude_bounds(scale_class: int) -> np.ndarray:
    """Where the symbols of a class begin, the escape's included, as magnitudes half a unit down."""
    begins = np.append(_BASES[:_ESCAPE], _BASES[_ESCAPE - 1] + (1 << _EXTRA[_ESCAPE - 1]))
    return np.maximum((begins << _shift(np, np.int32(scale_class))) - 0.5, 0.0)


def _shift(xp: ModuleType, classes):
    """The bins of a scale class are in units of 2^shift."""
    return xp.maximum((classes >> 2) - np.int32(3), 0)


def _symbols(residual: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbol, raw bits and their number. The sign is the lowest raw bit; a zero that is its own symbol has none."""
    shift = _shift(np, classes)
    magnitude = np.abs(residual)
    symbol = np.searchsorted(_BASES[:_ESCAPE], magnitude >> shift, "right") - 1
    escaped = magnitude >> shift >= _BASES[_ESCAPE - 1] + (1 << _EXTRA[_ESCAPE - 1])
    symbol = np.where(escaped, _ESCAPE, symbol)
    shift = np.where(escaped, 0, shift)
    raw = (magnitude - (_BASES[symbol] << shift)) << 1 | (residual < 0)
    count = np.where((symbol > 0) | (shift > 0), _EXTRA[symbol] + shift + 1, 0)
    return symbol, raw, count


def _skewed(rows: np.ndarray, idle: int) -> np.ndarray:
    """(frames, lanes) as (steps, lanes): lane i is i steps late."""
    frames, lanes = rows.shape
    out = np.full((frames + lanes - 1, lanes), idle, rows.dtype)
    for i in range(lanes):
        out[i : i + frames, i] = rows[:, i]
    return out


def _unskewed(rows: np.ndarray, frames: int, lanes: int) -> np.ndarray:
    """The inverse of `_skewed`."""
    return np.stack([rows[i : i + frames, i] for i in range(lanes)], 1)


def _place(xp: ModuleType, step, frames, lanes: int):
    """The row of the wave, the frame that every lane is at, and whether there is one."""
    frame = step - xp.arange(lanes, dtype=np.int32)
    return _BLOCK - 1 - step % _BLOCK, frame, (frame >= 0) & (frame < frames)


def _predict_step(xp: ModuleType, tables: Tables, frames, wave: Wave, step, change):
    """A step of encoding: the changes are known, what is left of them is wanted."""
    at, frame, active = _place(xp, step, frames, len(change))
    wave = waves.entered(xp, tables, wave, at)
    expected = waves.expect(xp, tables, wave, at, frame)
    residual = change - expected.change
    return waves.learn(xp, tables, wave, frame, active, expected, change, residual), (residual, expected.classes)


def _read_step(xp: ModuleType, tables: Tables, streams: Streams, frames, state: Reading, step):
    """A step of decoding: what is left is read, the values follow."""
    at, frame, active = _place(xp, step, frames, len(state.wave.value))
    wave = waves.entered(xp, tables, state.wave, at)
    expected = waves.expect(xp, tables, wave, at, frame)
    classes = expected.classes
    rows = streams.cumulative[classes]
    symbol = (rows[:, 1:] <= rans.slots(state.coder)[:, None]).sum(1, dtype=np.int32)
    low = xp.take_along_axis(rows, symbol[:, None], 1)[:, 0]
    high = xp.take_along_axis(rows, symbol[:, None] + 1, 1)[:, 0]
    low = xp.where(active, low, np.uint32(0))
    high = xp.where(active, high, np.uint32(rans.TOTAL))
    shift = xp.where(symbol == _ESCAPE, np.int32(0), _shift(xp, classes))
    coder = rans.advance(xp, state.coder, streams.words, low, high - low)
    signed = active & ((symbol > 0) | (shift > 0))
    count = xp.where(signed, xp.asarray(_EXTRA)[symbol] + shift + 1, 0)
    raw, bit = rans.take_bits(xp, state.bit, streams.bits, count)
    raw = raw.astype(np.int32)
    magnitude = (xp.asarray(_BASES)[symbol] << shift) + (raw >> 1)
    residual = xp.where(raw & 1 == 1, -magnitude, magnitude)
    change = residual + expected.change
    value = wave.value + wave.velocity + change
    wave = waves.learn(xp, tables, wave, frame, active, expected, change, residual)
    return Reading(wave, coder, bit), value


def _cumulative(model: LaneModel) -> np.ndarray:
    return np.concatenate([np.zeros((CLASSES, 1), np.int64), np.cumsum(model.frequencies, 1, dtype=np.int64)], 1)


def _predict_plainly(model: LaneModel, changes: np.ndarray, frames: int):
    """All steps in NumPy: slow steps, but nothing to compile."""
    tables, wave = waves.tables(model), waves.begin(model, _BLOCK)
    residual, classes = np.empty_like(changes), np.empty_like(changes)
    for n, change in enumerate(changes):
        wave = waves.turned(np, wave, _BLOCK) if n and n % _BLOCK == 0 else wave
        wave, (residual[n], classes[n]) = _predict_step(np, tables, np.int32(frames), wave, np.int32(n), change)
    return residual, classes


def _predict_compiled(model: LaneModel, changes: np.ndarray, frames: int):
    """The steps by blocks of one size, so that one compilation serves all."""
    tables, wave = waves.tables(model), waves.begin(model, _BLOCK)
    padded = np.concatenate([changes, np.zeros((-len(changes) % _BLOCK, changes.shape[1]), np.int32)])
    out = []
    for n in range(0, len(padded), _BLOCK):
        wave, left = _predict_block(tables, np.int32(frames), wave, np.int32(n), padded[n : n + _BLOCK])
        out.append([np.asarray(x) for x in left])
    return tuple(np.concatenate(part) for part in zip(*out, strict=True))


@eqx.filter_jit
def _predict_block(tables: Tables, frames, wave: Wave, begin, changes):
    def step(wave: Wave, x):
        return _predict_step(jnp, tables, frames, wave, begin + x[0], x[1])

    wave, left = jax.lax.scan(step, wave, (jnp.arange(_BLOCK, dtype=jnp.int32), changes))
    return waves.turned(jnp, wave, _BLOCK), left


def _read_plainly(model: LaneModel, states, words, bits, frames: int, steps: int):
    tables = waves.tables(model)
    spare = np.zeros(model.count + 2, np.uint32)
    cumulative = _cumulative(model).astype(np.uint32)
    streams = Streams(cumulative, np.concatenate([words, spare]), np.concatenate([bits, spare]))
    state = Reading(waves.begin(model, _BLOCK), rans.Decoding(states, np.array(0, np.int32)), np.array(0, np.int32))
    rows = np.empty((steps, model.count), np.int32)
    for n in range(steps):
        if n and n % _BLOCK == 0:
            if state.coder.at > len(words):
                raise CorruptStream("the lanes of a payload want more words than there are")
            state = state._replace(wave=waves.turned(np, state.wave, _BLOCK))
        state, rows[n] = _read_step(np, tables, streams, np.int32(frames), state, np.int32(n))
    return rows, state.coder, state.bit


def _read_compiled(model: LaneModel, states, words, bits, frames: int, steps: int):
    """By blocks, each with a window of its words and bits."""
    _compiled_for.add((model.moving, model.count))
    tables, cumulative = waves.tables(model), _cumulative(model).astype(np.uint32)
    zero = np.array(0, np.int32)
    state = Reading(waves.begin(model, _BLOCK), rans.Decoding(states, zero), zero)
    room = (_BLOCK + 1) * model.count
    words, bits = (np.concatenate([a, np.zeros(room + 2, np.uint32)]) for a in (words, bits))
    rows, word, bit = [], 0, 0
    for n in range(0, steps, _BLOCK):
        if word + room > len(words) or (bit >> 5) + room > len(bits):
            raise CorruptStream("the lanes of a payload want more words than there are")
        window = words[word : word + room], bits[bit >> 5 : (bit >> 5) + room]
        count = np.int32(min(steps - n, _BLOCK))
        state = Reading(state.wave, state.coder._replace(at=zero), np.array(bit & 31, np.int32))
        state, block = _read_block(tables, Streams(cumulative, *window), np.int32(frames), state, np.int32(n), count)
        word, bit = word + int(state.coder.at), (bit & ~31) + int(state.bit)
        rows.append(np.asarray(block))
    coder = rans.Decoding(np.asarray(state.coder.states), np.array(word))
    return np.concatenate(rows)[:steps], coder, bit


@eqx.filter_jit
def _read_block(tables: Tables, streams: Streams, frames, state: Reading, begin, steps):
    def step(n, carry: tuple[Reading, Array]):
        state, values = _read_step(jnp, tables, streams, frames, carry[0], begin + n)
        return state, jax.lax.dynamic_update_index_in_dim(carry[1], values, n, 0)

    rows = jnp.zeros((_BLOCK, len(state.wave.value)), jnp.int32)
    state, rows = jax.lax.fori_loop(np.int32(0), steps, step, (state, rows))
    return state._replace(wave=waves.turned(jnp, state.wave, _BLOCK)), rows
