"""The coder of `exact`: every column is a lane that predicts, adapts its scale, and decodes one symbol a step.

Lane i works i frames behind lane 0 (a wavefront). A step is therefore one vector operation over all lanes, and yet every
lane knows what all lanes before it did in the same frame. All arithmetic is 32-bit integer, in NumPy and JAX alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int8, Int16, Int32, UInt16, UInt32

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..entropy import lanes as rans

PER_OCTAVE = 8  # logarithms of magnitudes are in eighths of octaves
CLASSES = 80  # of scale, four an octave
WEIGHT_BITS = 10  # fraction of the prediction weights
SCALE_BITS = 8  # fraction of the scale weights
FEATURES = 5  # of a lane's own past: three moving averages and the two last magnitudes
RATES = (2, 4, 6)  # the averages move by 1/4, 1/16 and 1/64
_FRACTION = 11  # of the moving averages
_CLIP = 1 << 16  # of what predicts other lanes
_MAGNITUDE_CLIP = 1 << 18
LOG_FLOOR = PER_OCTAVE * _FRACTION  # logarithm of magnitude 1
_BLOCK = 512  # steps compiled together
_WORTH_COMPILING = 100  # steps; fewer are done in NumPy before XLA would have compiled
LIMIT = 1 << 27  # residuals are smaller

# Bins of magnitudes in units of 2^shift: 8 single ones, 4 an octave up to 64, 2 an octave up to 4096, and an escape.
_WIDTHS = np.array([0] * 8 + [o - 2 for o in (3, 4, 5) for _ in range(4)] + [o - 1 for o in range(6, 12) for _ in range(2)])
SYMBOLS = len(_WIDTHS) + 1
_ESCAPE = SYMBOLS - 1
_BASES = np.append(np.concatenate([[0], np.cumsum(1 << _WIDTHS)[:-1]]), 0).astype(np.int32)
_EXTRA = np.append(_WIDTHS, 27).astype(np.int32)


@dataclass(frozen=True)
class LaneModel:
    """What a rig teaches about its lanes, all in integers. The last lanes may be `still`: no motion is extrapolated.

    `moving`: how many lanes extrapolate. `weights[c, j]`: how the second difference of lane j < c in the same frame
    enters the prediction of lane c. `own[c]`: bias and weights of the lane's own logarithms; `shared[c, j]`: of the
    logarithm of lane j < c in the same frame, relative to its average. `start[c]`: scale classes of the first two frames,
    and the logarithm that the averages start from. `frequencies`: symbols by scale class, parts of 2^14.
    """

    moving: int
    weights: Int16[np.ndarray, "lanes lanes"]
    own: Int16[np.ndarray, "lanes 6"]
    shared: Int8[np.ndarray, "lanes lanes"]
    start: Int16[np.ndarray, "lanes 3"]
    frequencies: UInt16[np.ndarray, "classes symbols"]

    @property
    def count(self) -> int:
        return len(self.own)


class _Tables(NamedTuple):
    """The model as arrays of a step."""

    moves: Array | np.ndarray
    weights: Array | np.ndarray  # [from, to]
    shared: Array | np.ndarray  # [from, to]
    own: Array | np.ndarray
    start: Array | np.ndarray
    cumulative: Array | np.ndarray


class _State(NamedTuple):
    coder: rans.Decoding
    bit: Array | np.ndarray
    value: Array | np.ndarray
    velocity: Array | np.ndarray
    averages: Array | np.ndarray  # (3, lanes)
    logs: Array | np.ndarray  # (2, lanes)
    predicted: Array | np.ndarray  # (wave, to): sums so far, by the lane that its frame has come to
    scaled: Array | np.ndarray


def logarithm(xp: ModuleType, x: Int32[np.ndarray, "*n"] | Int32[Array, "*n"]) -> Int32[np.ndarray, "*n"] | Int32[Array, "*n"]:
    """Eighths of octaves of a positive integer, linear within an eighth: the leading bits of its float32."""
    floats = x.astype(np.float32)
    bits = floats.view(np.int32) if xp is np else jax.lax.bitcast_convert_type(floats, jnp.int32)
    return (bits >> 20) - 127 * PER_OCTAVE


def magnitude_logarithm(xp: ModuleType, magnitude):
    """The logarithm of a residual's magnitude plus a half."""
    return logarithm(xp, (xp.minimum(magnitude, np.int32(_MAGNITUDE_CLIP)) << _FRACTION) + np.int32(1 << _FRACTION - 1))


def _averaged(xp: ModuleType, averages, magnitude):
    target = xp.minimum(magnitude, np.int32(_MAGNITUDE_CLIP)) << _FRACTION
    return xp.stack([a + (target - a >> r) for a, r in zip(averages, RATES, strict=True)])


def _average_logarithms(xp: ModuleType, averages):
    return logarithm(xp, averages + np.int32(1 << _FRACTION - 5))


def _initial_average(start: Int16[np.ndarray, " lanes"]) -> Int32[np.ndarray, "3 lanes"]:
    average = np.rint(2.0 ** (start / PER_OCTAVE)).astype(np.int32)
    return np.stack([average] * len(RATES))


def _shift_of(classes):
    """Low bits that are raw at a scale class."""
    return (classes >> 2) - 3 if isinstance(classes, int) else (classes >> 2) - np.int32(3)


def _step(xp: ModuleType, tables: _Tables, words, bits, frames, state: _State, step) -> tuple[_State, Array | np.ndarray]:
    lanes = len(tables.moves)
    frame = step - xp.arange(lanes, dtype=np.int32)
    active = (frame >= 0) & (frame < frames)
    warm = active & (frame >= 2)
    diagonal = xp.arange(lanes)
    averaged = _average_logarithms(xp, state.averages)
    features = xp.concatenate([averaged, state.logs])
    scale = tables.own[0] + ((features * tables.own[1:]).sum(0, dtype=np.int32) + state.scaled[diagonal, diagonal] >> SCALE_BITS)
    scale = xp.where(frame < 1, tables.start[0], xp.where(frame < 2, tables.start[1], scale))
    classes = xp.clip(scale - np.int32(LOG_FLOOR) >> 1, 0, CLASSES - 1)

    rows = tables.cumulative[classes]
    slot = rans.slots(state.coder)
    symbol = (rows[:, 1:] <= slot[:, None]).sum(1, dtype=np.int32)
    low = xp.take_along_axis(rows, symbol[:, None], 1)[:, 0]
    high = xp.take_along_axis(rows, symbol[:, None] + 1, 1)[:, 0]
    low = xp.where(active, low, np.uint32(0))
    high = xp.where(active, high, np.uint32(rans.TOTAL))
    shift = xp.maximum(_shift_of(classes), np.int32(0))
    shift = xp.where(symbol == _ESCAPE, np.int32(0), shift)
    symbol, shift, low, high = _computed_once(xp, symbol, shift, low, high)
    coder = rans.advance(xp, state.coder, words, low, high - low)
    extra = xp.asarray(_EXTRA)[symbol]
    count = xp.where(active & ((symbol > 0) | (shift > 0)), extra + shift + 1, 0)
    (count,) = _computed_once(xp, count)
    raw, bit = rans.take_bits(xp, state.bit, bits, count)
    raw = raw.astype(np.int32)
    magnitude = (xp.asarray(_BASES)[symbol] << shift) + (raw >> 1)
    residual = xp.where(raw & 1 == 1, -magnitude, magnitude)

    change = xp.where(warm, residual + (state.predicted[diagonal, diagonal] >> WEIGHT_BITS), residual)
    value = state.value + state.velocity + change
    moved = xp.where(active & (tables.moves == 1), value, 0)
    velocity = xp.where(active & (tables.moves == 1) & (frame >= 1), value - state.value, 0)
    driving = xp.where(warm & (tables.moves == 1), xp.clip(change, -_CLIP, _CLIP), 0)
    residual, change, driving, magnitude = _computed_once(xp, residual, change, driving, magnitude)
    log = magnitude_logarithm(xp, magnitude)
    surprise = xp.where(warm, log - averaged[1], 0)
    (surprise,) = _computed_once(xp, surprise)
    predicted = _pass_on(xp, state.predicted + tables.weights * driving[:, None])
    scaled = _pass_on(xp, state.scaled + tables.shared * surprise[:, None])
    averages = xp.where(warm, _averaged(xp, state.averages, magnitude), state.averages)
    logs = xp.where(warm, xp.stack([log, state.logs[0]]), state.logs)
    return _State(coder, bit, moved, velocity, averages, logs, predicted, scaled), value


def _computed_once(xp: ModuleType, *arrays):
    """Keeps XLA from computing a vector again for every element of what it enters."""
    return arrays if xp is np else jax.lax.optimization_barrier(arrays)


def _pass_on(xp: ModuleType, sums):
    """Every frame goes on to the next lane; a new frame begins at the first one."""
    return xp.concatenate([xp.zeros_like(sums[:1]), sums[:-1]])


def _tables(xp: ModuleType, model: LaneModel) -> _Tables:
    moves = (np.arange(model.count) < model.moving).astype(np.int32)
    own = model.own.T.astype(np.int32)
    return _Tables(
        xp.asarray(moves),
        xp.asarray(model.weights.T.astype(np.int32)),
        xp.asarray(model.shared.T.astype(np.int32)),
        xp.asarray(own),
        xp.asarray(model.start.T.astype(np.int32)),
        xp.asarray(_cumulative(model).astype(np.uint32)),
    )


def _cumulative(model: LaneModel) -> np.ndarray:
    return np.concatenate([np.zeros((CLASSES, 1), np.int64), np.cumsum(model.frequencies, 1, dtype=np.int64)], 1)


def _initial(xp: ModuleType, model: LaneModel, states: UInt32[np.ndarray, " lanes"]) -> _State:
    zero = np.zeros(model.count, np.int32)
    square = np.zeros((model.count, model.count), np.int32)
    averages = _initial_average(model.start[:, 2])
    logs = np.stack([model.start[:, 2].astype(np.int32)] * 2)
    coder = rans.Decoding(xp.asarray(states), xp.asarray(np.int32(0)))
    return _State(coder, xp.asarray(np.int32(0)), *(xp.asarray(a) for a in (zero, zero, averages, logs, square, square)))


def encode(model: LaneModel, values: Int32[np.ndarray, "frames lanes"], rest: bytes) -> tuple[bytes, bytes]:
    """The payload of the lanes' values, and what of `rest` found no room in it (two bytes a lane do)."""
    residual, classes = residuals(model, values)
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
    model: LaneModel, values: Int32[np.ndarray, "frames lanes"]
) -> tuple[Int32[np.ndarray, "frames lanes"], Int32[np.ndarray, "frames lanes"]]:
    """What prediction leaves of the values, and the scale classes it is coded in: all frames at once, as none is unknown."""
    warm = (np.arange(len(values)) >= 2)[:, None]
    moves = np.arange(model.count) < model.moving
    change = np.where(moves, changes(values), values)
    driving = np.where(warm & moves, np.clip(change, -_CLIP, _CLIP), 0)
    predicted = _product(driving, model.weights) >> WEIGHT_BITS
    residual = np.where(warm, change - predicted, change).astype(np.int32)
    averaged, logs, log = own_logarithms(model.start[:, 2], residual)
    surprise = np.where(warm, log - averaged[1], 0)
    features = np.concatenate([averaged, logs])
    weighted = (features * model.own[:, 1:].T.astype(np.int32)[:, None]).sum(0, dtype=np.int32)
    scale = model.own[:, 0] + (weighted + _product(surprise, model.shared) >> SCALE_BITS)
    scale[:1], scale[1:2] = model.start[:, 0], model.start[:, 1]
    return residual, np.clip(scale - LOG_FLOOR >> 1, 0, CLASSES - 1)


def changes(values: Int32[np.ndarray, "frames lanes"]) -> Int32[np.ndarray, "frames lanes"]:
    """The first values, the first differences of the second frame, and second differences from there on."""
    out = values.copy()
    out[1:] -= values[:-1]
    out[2:] -= values[1:-1] - values[:-2]
    return out


def own_logarithms(start: np.ndarray, residual: Int32[np.ndarray, "frames lanes"]):
    """Logarithms that a lane's own past gives for every frame: (3, frames, lanes) of the averages, (2, ...) of the last
    two magnitudes, and the magnitude of the frame itself."""
    frames = len(residual)
    log = magnitude_logarithm(np, np.abs(residual))
    target = np.minimum(np.abs(residual), _MAGNITUDE_CLIP) << _FRACTION
    averages = np.zeros((frames, len(RATES), residual.shape[1]), np.int32)
    state, rates = _initial_average(start), np.array(RATES, np.int32)[:, None]
    for n in range(frames):
        averages[n] = state
        if n >= 2:
            state = state + (target[n] - state >> rates)
    logs = np.empty((2, *log.shape), np.int32)
    for lag in (1, 2):
        logs[lag - 1, : 2 + lag] = start
        logs[lag - 1, 2 + lag :] = log[2:-lag] if frames > 2 + lag else log[:0]
    return _average_logarithms(np, averages.transpose(1, 0, 2)), logs, log


def _product(driving: np.ndarray, weights: np.ndarray) -> Int32[np.ndarray, "frames lanes"]:
    """Sums of integer products; doubles hold them exactly, whatever their order."""
    return (driving.astype(np.float64) @ weights.T.astype(np.float64)).astype(np.int64).astype(np.int32)


def _symbols(residual: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbol, raw bits and their number. The sign is the lowest raw bit; a zero that is its own symbol has none."""
    shift = np.maximum(_shift_of(classes), 0)
    magnitude = np.abs(residual)
    symbol = np.searchsorted(_BASES[:_ESCAPE], magnitude >> shift, "right") - 1
    escaped = magnitude >> shift >= _BASES[_ESCAPE - 1] + (1 << _EXTRA[_ESCAPE - 1])
    symbol = np.where(escaped, _ESCAPE, symbol)
    shift = np.where(escaped, 0, shift)
    raw = (magnitude - (_BASES[symbol] << shift)) << 1 | (residual < 0)
    count = np.where((symbol > 0) | (shift > 0), _EXTRA[symbol] + shift + 1, 0)
    return symbol, raw, count


def symbols_and_classes(model: LaneModel, values: Int32[np.ndarray, "frames lanes"]) -> tuple[np.ndarray, np.ndarray]:
    """The symbol and the scale class of every value, for counting."""
    residual, classes = residuals(model, values)
    return _symbols(residual, classes)[0], classes


def magnitude_bounds(scale_class: int) -> np.ndarray:
    """Where the symbols of a class begin, the escape's included, as magnitudes half a unit down."""
    begins = np.append(_BASES[:_ESCAPE], _BASES[_ESCAPE - 1] + (1 << _EXTRA[_ESCAPE - 1]))
    return np.maximum((begins << max(_shift_of(scale_class), 0)) - 0.5, 0.0)


def _skewed(rows: np.ndarray, idle: int) -> np.ndarray:
    """(frames, lanes) as (steps, lanes): lane i is i steps late."""
    frames, lanes = rows.shape
    out = np.full((frames + lanes - 1, lanes), idle, rows.dtype)
    for i in range(lanes):
        out[i : i + frames, i] = rows[:, i]
    return out


def decode(
    model: LaneModel, reader: ByteReader, frames: int, rest: int
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
    walk = _walk_compiled if steps >= _WORTH_COMPILING else _walk_plainly
    rows, coder, bit = walk(model, states, words, bits, frames, steps)
    if coder.at != count or -(-int(bit) // 8) != len(data):
        raise CorruptStream("the lanes of a payload end before their words or bits do, or behind them")
    values = np.stack([rows[i : i + frames, i] for i in range(model.count)], 1)
    return values, rans.rest(coder).astype("<u2").tobytes()[:rest]


def _walk_plainly(model: LaneModel, states, words, bits, frames: int, steps: int):
    """All steps in NumPy: slow steps, but nothing to compile."""
    state = _initial(np, model, states)
    tables = _tables(np, model)
    spare = np.zeros(model.count + 2, np.uint32)
    words, bits = np.concatenate([words, spare]), np.concatenate([bits, spare])
    rows = np.empty((steps, model.count), np.int32)
    for n in range(steps):
        state, rows[n] = _step(np, tables, words, bits, np.int32(frames), state, np.int32(n))
    return rows, state.coder, state.bit


def _walk_compiled(model: LaneModel, states, words, bits, frames: int, steps: int):
    """The steps by blocks of one size, each with a window of its words and bits, so that one compilation serves all."""
    state = _initial(jnp, model, states)
    tables = _tables(jnp, model)
    room = (_BLOCK + 1) * model.count
    words, bits = (np.concatenate([a, np.zeros(room + 2, np.uint32)]) for a in (words, bits))
    rows, word, bit = [], 0, 0
    for n in range(0, steps, _BLOCK):
        state = state._replace(coder=state.coder._replace(at=jnp.int32(0)), bit=jnp.int32(bit & 31))
        if max(word + room, (bit >> 5) + room) > max(len(words), len(bits)):
            raise CorruptStream("the lanes of a payload want more words than there are")
        window = words[word : word + room], bits[bit >> 5 : (bit >> 5) + room]
        state, block = _scan(tables, *map(jnp.asarray, window), jnp.int32(frames), state, jnp.int32(n))
        word, bit = word + int(state.coder.at), (bit & ~31) + int(state.bit)
        rows.append(np.asarray(block))
    coder = rans.Decoding(np.asarray(state.coder.states), np.int32(word))
    return np.concatenate(rows)[:steps], coder, bit


@eqx.filter_jit
def _scan(tables: _Tables, words, bits, frames, state: _State, begin):
    def step(state: _State, n):
        return _step(jnp, tables, words, bits, frames, state, begin + n)

    return jax.lax.scan(step, state, jnp.arange(_BLOCK, dtype=jnp.int32))
