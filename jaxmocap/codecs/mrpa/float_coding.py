"""Lossless coding of predicted floats: sign, exponent and mantissa in contexts that exponents select.

Isenburg, Lindstrom, Snoeyink, Lossless compression of predicted floating-point geometry, CAD 37(8), 2005. Numbers are
scaled by 10^decimals first, so the floats are whole: a float of exponent e has e - 1 mantissa bits, and the rest is zero.
Predictions are exact below 2^23, so they are made in int32, which on every machine gives what float32 would give.
Where the original adapts its tables, here a running scale of every lane's corrections chooses among tables that
were learned while packing: lanes then need nothing of each other.
"""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Int32, UInt8, UInt32

from ..entropy import lanes
from ..entropy.lanes import Decoding

LIMIT = (1 << 23) - 1  # the largest magnitude that is coded
FIRST_SCALE = 16 << 8
EXPONENTS = 24
CLASSES = 3 * EXPONENTS - 1  # the same sign and the change of exponent, or the other sign and the exponent
SAME = EXPONENTS - 1
_OTHER_SIGN = 2 * EXPONENTS - 1
TOKENS = 4 + 2 * (EXPONENTS - 3)
_SCALES = 44
_NEAR = 13
CLASS_CONTEXTS = 2 * _NEAR
MANTISSA_CONTEXTS = 2 * _SCALES

Lanes = Int32[np.ndarray, "*lanes"]  # of JAX inside a compiled decoder, as everywhere here
Signs = Bool[np.ndarray, "*lanes"]


class Floats(NamedTuple):
    """Whole float32 numbers as integers and their sign bits, which zeros have, too."""

    value: Lanes
    negative: Signs


def no_floats(frames: int, lanes: int) -> Floats:
    """Zeros."""
    return Floats(np.zeros((frames, lanes), np.int32), np.zeros((frames, lanes), bool))


class Symbols(NamedTuple):
    """What is coded of every number: classes and tokens with their contexts, then raw bits and how many."""

    class_context: Lanes
    group: Lanes
    mantissa_context: Lanes
    token: Lanes
    raw: Lanes
    raw_bits: Lanes


class Tables(eqx.Module):
    """Frequencies in parts of `lanes.TOTAL`, one table a context, and what a decoder looks up."""

    classes: UInt32[np.ndarray, "contexts classes"]
    tokens: UInt32[np.ndarray, "contexts tokens"]
    class_starts: UInt32[np.ndarray, "contexts classes"]
    token_starts: UInt32[np.ndarray, "contexts tokens"]
    class_of: UInt8[np.ndarray, "contexts slots"]
    token_of: UInt8[np.ndarray, "contexts slots"]

    @staticmethod
    def of(classes: UInt32[np.ndarray, "contexts classes"], tokens: UInt32[np.ndarray, "contexts tokens"]) -> Tables:
        return Tables(classes, tokens, _starts(classes), _starts(tokens), _symbol_of(classes), _symbol_of(tokens))


def _starts(frequencies: UInt32[np.ndarray, "contexts symbols"]) -> UInt32[np.ndarray, "contexts symbols"]:
    return (np.cumsum(frequencies, 1) - frequencies).astype(np.uint32)


def _symbol_of(frequencies: UInt32[np.ndarray, "contexts symbols"]) -> UInt8[np.ndarray, "contexts slots"]:
    symbols = np.arange(frequencies.shape[1], dtype=np.uint8)
    return np.stack([np.repeat(symbols, row) for row in frequencies])


def exponent(xp: ModuleType, magnitude: Lanes) -> Lanes:
    """Bits of a magnitude below 2^24: the exponent of its float32, less 126; 0 for zero."""
    return xp.maximum((magnitude.astype(np.float32).view(np.int32) >> 23) - 126, 0)


def predicted_sign(value: Lanes, before: Floats) -> Signs:
    """The sign bit of a prediction; where that is zero, the one that the channel's last zero had."""
    return (value < 0) | (value == 0) & (before.value == 0) & before.negative


def next_scale(xp: ModuleType, scale: Lanes, correction: Lanes) -> Lanes:
    """The running mean of a lane's corrections, in sixteenths."""
    step = 16 * xp.minimum(abs(correction), 1 << 17) - scale
    return scale + (xp.minimum(step, 8 * scale + 256) + 3 >> 3)


def _scale_context(xp: ModuleType, scale: Lanes) -> Lanes:
    """Twice the logarithm of a scale, in whole numbers."""
    e = exponent(xp, scale + 1)
    return xp.minimum(2 * e - 2 + (scale + 1 >> xp.maximum(e - 2, 0) & 1) * (e > 1), _SCALES - 1)


def _class_context(xp: ModuleType, magnitude: Lanes, scale: Lanes) -> Lanes:
    """How near, measured in scales, the prediction is to the floats of the next exponent, and on which side."""
    e = exponent(xp, magnitude)
    down = magnitude - ((1 << e) >> 1)
    up = (1 << e) - 1 - magnitude
    near = 2 * exponent(xp, xp.minimum(up, down) + 1) - scale + _NEAR - 1
    return xp.where(up < down, _NEAR, 0) + xp.clip(near, 0, _NEAR - 1)


def _start_of_mantissa(xp: ModuleType, prediction: Floats, negative: Signs, e: Lanes) -> Lanes:
    """The magnitude nearest to the prediction among floats of the sign and exponent."""
    magnitude = xp.where(negative == prediction.negative, abs(prediction.value), 0)
    return xp.clip(magnitude, (1 << e) >> 1, (1 << e) - 1)


def symbols(prediction: Floats, actual: Floats, scale: Int32[np.ndarray, "*lanes"]) -> Symbols:
    """Splits numbers, given their predictions and the scale that each lane had before them."""
    scale = _scale_context(np, scale)
    before, e = exponent(np, abs(prediction.value)), exponent(np, abs(actual.value))
    same_sign = prediction.negative == actual.negative
    group = np.where(same_sign, e - before + SAME, _OTHER_SIGN + e)
    difference = abs(actual.value) - _start_of_mantissa(np, prediction, actual.negative, e)
    size = abs(difference)
    low_bits = np.maximum(exponent(np, size) - 2, 0)
    token = np.where(size < 4, size, 2 * low_bits + (size >> low_bits))
    signed = (group == SAME) & (size > 0)
    low = size - (size >> low_bits << low_bits)
    raw = np.where(signed, 2 * low + (difference < 0), low)
    context = scale + np.where(group == SAME, 0, _SCALES)
    return Symbols(_class_context(np, abs(prediction.value), scale), group, context, token, raw, low_bits + signed)


class Stream(NamedTuple):
    """Where decoding has come to: the lanes' states and words, and the bit after the last raw one."""

    coder: Decoding
    bit: np.int32 | Int32[np.ndarray, ""] | Int32[Array, ""]


def decode(
    xp: ModuleType,
    at: Stream,
    words: UInt32[Array, " words"] | UInt32[np.ndarray, " words"],
    bits: UInt32[Array, " words"] | UInt32[np.ndarray, " words"],
    tables: Tables,
    prediction: Floats,
    scale: Lanes,
) -> tuple[Floats, Stream]:
    """The next number of every lane."""
    scale = _scale_context(xp, scale)
    before = exponent(xp, abs(prediction.value))
    context = _class_context(xp, abs(prediction.value), scale)
    group = tables.class_of[context, lanes.slots(at.coder)].astype(np.int32)
    coder = lanes.advance(xp, at.coder, words, tables.class_starts[context, group], tables.classes[context, group])
    context = scale + xp.where(group == SAME, 0, _SCALES)
    token = tables.token_of[context, lanes.slots(coder)].astype(np.int32)
    coder = lanes.advance(xp, coder, words, tables.token_starts[context, token], tables.tokens[context, token])
    low_bits = xp.maximum(token - 2 >> 1, 0)
    signed = (group == SAME) & (token > 0)
    raw, bit = lanes.take_bits(xp, at.bit, bits, low_bits + signed)
    size = (token - 2 * low_bits << low_bits) + (raw.astype(np.int32) >> signed)
    same_sign = group < _OTHER_SIGN
    e = xp.clip(xp.where(same_sign, before + group - SAME, group - _OTHER_SIGN), 0, EXPONENTS - 1)
    negative = prediction.negative == same_sign
    start = _start_of_mantissa(xp, prediction, negative, e)
    down = xp.where(group == SAME, signed & (raw & 1 == 1), start > (1 << e) >> 1)
    magnitude = start + xp.where(down, -size, size)
    return Floats(xp.where(negative, -magnitude, magnitude), negative), Stream(coder, bit)
