"""The prediction of `exact`: every column is a lane that predicts its next value, learns from it, and adapts its scale.

Lane i works i frames behind lane 0 (a wavefront). A step is therefore one vector operation over all lanes, and yet every
lane knows what all lanes before it did in the same frame. All arithmetic is 32-bit integer, in NumPy and JAX alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int8, Int16, Int32, UInt16

PER_OCTAVE = 8  # logarithms of magnitudes are in eighths of octaves
CLASSES = 80  # of scale, four an octave
WEIGHT_BITS = 10  # fraction of the prediction weights
SCALE_BITS = 8  # fraction of the scale weights
FEATURES = 5  # of a lane's own past: three moving averages and the two last magnitudes
RATES = (2, 4, 6)  # the averages move by 1/4, 1/16 and 1/64
FRACTION = 11  # of the moving averages
LOG_FLOOR = PER_OCTAVE * FRACTION  # logarithm of magnitude 1
DRIVING_CLIP = 1 << 16  # of what predicts other lanes
MAGNITUDE_CLIP = 1 << 18

# Adaptive weights: least mean squares on values in units of their own scale, with 6 bits of fraction.
_LAGS = 3
_UNIT_BITS, _ADAPTIVE_BITS = 6, 16
_INPUT_CLIP, _ERROR_CLIP, _OUTPUT_CLIP = 3 << _UNIT_BITS, 3 << _UNIT_BITS - 1, 3 << 14
_RATE, _RATE_FRAMES, _RATE_BOOST = 131, 100, 3  # 0.002 of 2^16; faster by so much in the first frames
# The mean magnitude of a class, 0.83 octaves above its mean logarithm. Powers are spelled out: libraries differ in them.
_QUARTERS = np.array([1.7776853623331403, 2.114036081122761, 2.5140267490436567, 2.989698497269877])
_MEAN_SCALES = np.ldexp(_QUARTERS[np.arange(CLASSES) % 4], np.arange(CLASSES) // 4)
_EIGHTHS = np.array([1.0, 1.0905077326652577, 1.189207115002721, 1.2968395546510096,
                     1.4142135623730951, 1.5422108254079407, 1.681792830507429, 1.8340080864093424])  # fmt: skip
_LIMITS = (4 * _MEAN_SCALES).astype(np.int32)
_RECIPROCALS = np.rint(2.0 ** (15 + _UNIT_BITS) / _MEAN_SCALES).astype(np.int32)
_EXPONENTS = np.floor(np.arange(CLASSES) / 4 + 0.83).astype(np.int32)
_MANTISSAS = np.rint(_MEAN_SCALES * 2.0 ** (8 - _EXPONENTS)).astype(np.int32)


@dataclass(frozen=True)
class LaneModel:
    """What a rig teaches about its lanes, all in integers. Only the first `moving` lanes are extrapolated.

    `weights[c, j]`: how the second difference of lane j < c in the same frame enters the prediction of lane c.
    `own[c]`: bias and weights of the lane's own logarithms; `shared[c, j]`: of the logarithm of lane j < c in the same
    frame, relative to its average. `start[c]`: logarithms that give the scale classes of the first two frames, and that the
    averages start from. `frequencies`: symbols by scale class, parts of 2^14.
    """

    weights: Int16[np.ndarray, "moving moving"]
    own: Int16[np.ndarray, "lanes 6"]
    shared: Int8[np.ndarray, "lanes lanes"]
    start: Int16[np.ndarray, "lanes 3"]
    frequencies: UInt16[np.ndarray, "classes symbols"]

    @property
    def count(self) -> int:
        return len(self.own)

    @property
    def moving(self) -> int:
        return len(self.weights)


class Tables(NamedTuple):
    """The model as arrays of a step; matrices are [from, to]."""

    weights: Array | np.ndarray
    shared: Array | np.ndarray
    own: Array | np.ndarray
    start: Array | np.ndarray


class Wave(NamedTuple):
    """All that lanes remember.

    A row of the last three belongs to a frame: rows `at`, `at + 1`, ... are those that lanes 0, 1, ... come to in this step,
    and `at` falls by one a step, so that nothing need be moved. `turned` makes room again when it has come to 0.
    """

    value: Array | np.ndarray  # (lanes,)
    velocity: Array | np.ndarray
    averages: Array | np.ndarray  # (3, lanes)
    logs: Array | np.ndarray  # (2, lanes)
    past: Array | np.ndarray  # (lags, moving): own values of frames before, in units of their scale
    past_weights: Array | np.ndarray  # (lags, moving)
    surprise: Array | np.ndarray  # (lanes,): what the step before found, still to be entered into the matrices
    driving: Array | np.ndarray  # (moving,), likewise
    unit: Array | np.ndarray  # (moving,), likewise
    error: Array | np.ndarray  # (moving,), likewise
    weights: Array | np.ndarray  # (moving, from moving), adaptive
    window: Array | np.ndarray  # (moving, from moving): the rows of `inputs` that the lanes are at
    scaled: Array | np.ndarray  # (rows, to lanes): sums of `shared` so far
    predicted: Array | np.ndarray  # (rows, to moving): sums of the model's weights so far
    inputs: Array | np.ndarray  # (rows, from moving): values in units of their scale


class Expected(NamedTuple):
    """What a lane expects of its next value."""

    classes: Array | np.ndarray  # of the scale of what is left
    change: Array | np.ndarray  # the expected second difference, or value of a lane that does not move
    fixed: Array | np.ndarray  # that part of it which is not adaptive
    averaged: Array | np.ndarray


def logarithm(xp: ModuleType, x: Int32[np.ndarray, "*n"] | Int32[Array, "*n"]) -> Int32[np.ndarray, "*n"] | Int32[Array, "*n"]:
    """Eighths of octaves of a positive integer, linear within an eighth: the leading bits of its float32."""
    floats = x.astype(np.float32)
    bits = floats.view(np.int32) if xp is np else jax.lax.bitcast_convert_type(floats, jnp.int32)
    return (bits >> 20) - 127 * PER_OCTAVE


def power(eighths: Int16[np.ndarray, "*n"]) -> Int32[np.ndarray, "*n"]:
    """The nearest integer to two to the power of so many eighths, up to 30 octaves."""
    eighths = np.clip(eighths.astype(np.int32), 0, 30 * PER_OCTAVE)
    return np.rint(np.ldexp(_EIGHTHS[eighths % PER_OCTAVE], eighths // PER_OCTAVE)).astype(np.int32)


def magnitude_logarithm(xp: ModuleType, magnitude):
    """The logarithm of a residual's magnitude plus a half."""
    return logarithm(xp, (xp.minimum(magnitude, np.int32(MAGNITUDE_CLIP)) << FRACTION) + np.int32(1 << FRACTION - 1))


def begin(model: LaneModel, room: int) -> Wave:
    """Before the first frame, with room for so many steps."""
    lanes, moving = model.count, model.moving
    average = power(model.start[:, 2])
    logs = np.stack([model.start[:, 2].astype(np.int32)] * 2)
    return Wave(
        value=np.zeros(lanes, np.int32),
        velocity=np.zeros(lanes, np.int32),
        averages=np.stack([average] * len(RATES)),
        logs=logs,
        past=np.zeros((_LAGS, moving), np.int32),
        past_weights=np.zeros((_LAGS, moving), np.int32),
        surprise=np.zeros(lanes, np.int32),
        driving=np.zeros(moving, np.int32),
        unit=np.zeros(moving, np.int32),
        error=np.zeros(moving, np.int32),
        weights=np.zeros((moving, moving), np.int32),
        window=np.zeros((moving, moving), np.int32),
        scaled=np.zeros((room + lanes, lanes), np.int32),
        predicted=np.zeros((room + moving, moving), np.int32),
        inputs=np.zeros((room + moving, moving), np.int32),
    )


def turned(xp: ModuleType, wave: Wave, room: int) -> Wave:
    """The same wave with room for so many steps again."""
    rows = [xp.concatenate([xp.zeros_like(m[:room]), m[: len(m) - room]]) for m in wave[-3:]]
    return Wave(*wave[:-3], *rows)


def tables(model: LaneModel) -> Tables:
    arrays = (model.weights.T, model.shared.T, model.own.T, model.start.T)
    return Tables(*(a.astype(np.int32) for a in arrays))


def entered(xp: ModuleType, t: Tables, wave: Wave, at) -> Wave:
    """The wave with what the step before found in its matrices.

    This waits for a step, since XLA would compute a vector again for every element of the matrix that it enters.
    """
    before = at + 1
    lanes = xp.arange(len(wave.unit))
    here = lanes[:, None] == lanes[None]
    inputs = _put(xp, wave.inputs, before, xp.where(here, wave.unit[:, None], wave.window))
    return wave._replace(
        weights=_corrected(xp, wave.weights, wave.error[:, None], wave.window),
        window=_rows(xp, inputs, at),
        scaled=_put(xp, wave.scaled, before, _rows(xp, wave.scaled, before) + t.shared * wave.surprise[:, None]),
        predicted=_put(xp, wave.predicted, before, _rows(xp, wave.predicted, before) + t.weights * wave.driving[:, None]),
        inputs=inputs,
    )


def expect(xp: ModuleType, t: Tables, wave: Wave, at, frame) -> Expected:
    """What every lane expects of the frame that it has come to (`frame`, int32), whose row is `at` and so on."""
    moving = len(t.weights)
    averaged = logarithm(xp, wave.averages + np.int32(1 << FRACTION - 5))
    features = xp.concatenate([averaged, wave.logs])
    weighted = (features * t.own[1:]).sum(0, dtype=np.int32) + _diagonal(xp, _rows(xp, wave.scaled, at))
    scale = t.own[0] + (weighted >> SCALE_BITS)
    scale = xp.where(frame < 1, t.start[0], xp.where(frame < 2, t.start[1], scale))
    classes = xp.clip(scale - np.int32(LOG_FLOOR) >> 1, 0, CLASSES - 1)
    fixed = _diagonal(xp, _rows(xp, wave.predicted, at)) >> WEIGHT_BITS
    total = (wave.weights * wave.window).sum(1, dtype=np.int32)
    total = total + (wave.past_weights * wave.past).sum(0, dtype=np.int32)
    total = xp.clip(total >> _UNIT_BITS + _ADAPTIVE_BITS - 14, -_OUTPUT_CLIP, _OUTPUT_CLIP)
    shift = np.int32(22) - xp.asarray(_EXPONENTS)[classes[:moving]]
    product = total * xp.asarray(_MANTISSAS)[classes[:moving]]
    adapted = product + (np.int32(1) << shift - 1) >> shift
    still = xp.zeros(len(classes) - moving, np.int32)
    warm = frame >= 2
    change = xp.where(warm, xp.concatenate([fixed + adapted, still]), 0)
    return Expected(classes, change, xp.where(warm[:moving], fixed, 0), averaged)


def learn(xp: ModuleType, t: Tables, wave: Wave, frame, active, expected: Expected, change, residual) -> Wave:
    """The wave after every active lane has learned its change, of which the residual was not expected."""
    moving = len(t.weights)
    warm = active & (frame >= 2)
    magnitude = xp.abs(residual)
    log = magnitude_logarithm(xp, magnitude)
    surprise = xp.where(warm, log - expected.averaged[1], 0)
    target = xp.minimum(magnitude, np.int32(MAGNITUDE_CLIP)) << FRACTION
    averages = xp.stack([a + (target - a >> r) for a, r in zip(wave.averages, RATES, strict=True)])

    value = xp.where(active[:moving], wave.value[:moving] + wave.velocity[:moving] + change[:moving], 0)
    velocity = xp.where(active[:moving] & (frame[:moving] >= 1), value - wave.value[:moving], 0)
    driving = xp.where(warm[:moving], xp.clip(change[:moving], -DRIVING_CLIP, DRIVING_CLIP), 0)
    classes = expected.classes[:moving]
    unit = xp.where(warm[:moving], _in_units(xp, change[:moving] - expected.fixed, classes, _INPUT_CLIP), 0)
    error = xp.where(warm[:moving], _in_units(xp, residual[:moving], classes, _ERROR_CLIP), 0)
    rate = _RATE + np.int32(_RATE * _RATE_BOOST * _RATE_FRAMES) // (_RATE_FRAMES + xp.maximum(frame[:moving], 0))
    still = xp.zeros(len(frame) - moving, np.int32)
    past = xp.concatenate([unit[None], wave.past[:-1]])
    return wave._replace(
        value=xp.concatenate([value, still]),
        velocity=xp.concatenate([velocity, still]),
        averages=xp.where(warm[None], averages, wave.averages),
        logs=xp.where(warm[None], xp.stack([log, wave.logs[0]]), wave.logs),
        past=xp.where(warm[None, :moving], past, wave.past),
        past_weights=_corrected(xp, wave.past_weights, (error * rate)[None], wave.past),
        surprise=surprise,
        driving=driving,
        unit=unit,
        error=error * rate,
    )


def _corrected(xp: ModuleType, weights, error, inputs):
    """A step of least mean squares."""
    limit = 1 << _ADAPTIVE_BITS
    return xp.clip(weights + (error * inputs + np.int32(1 << 11) >> 12), -limit, limit)


def _in_units(xp: ModuleType, x, classes, clip: int):
    """Values in 64ths of the mean magnitude of their class."""
    limit = xp.asarray(_LIMITS)[classes]
    product = xp.clip(x, -limit, limit) * xp.asarray(_RECIPROCALS)[classes]
    return xp.clip(product + np.int32(1 << 14) >> 15, -clip, clip)


def _diagonal(xp: ModuleType, matrix):
    at = xp.arange(len(matrix))
    return matrix[at, at]


def _rows(xp: ModuleType, matrix, at):
    """The rows of the frames that the lanes have come to: as many as there are columns."""
    count = matrix.shape[1]
    return matrix[at : at + count].copy() if xp is np else jax.lax.dynamic_slice_in_dim(matrix, at, count)


def _put(xp: ModuleType, matrix, at, rows):
    """The matrix with these rows from `at` on (NumPy's in place, as nothing else holds it)."""
    if xp is np:
        matrix[at : at + len(rows)] = rows
        return matrix
    return jax.lax.dynamic_update_slice_in_dim(matrix, rows, at, 0)
