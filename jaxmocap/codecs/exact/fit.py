"""Learns the integers of a LaneModel from tables: weighted least squares, then counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int32

from ..entropy.lanes import TOTAL
from . import lanes, wave
from .lanes import SYMBOLS
from .wave import CLASSES, FEATURES, FRACTION, LOG_FLOOR, PER_OCTAVE, RATES, SCALE_BITS, WEIGHT_BITS, LaneModel

Values = Int32[np.ndarray, "frames lanes"]
_RIDGE = 1e-4
_HUBER = 3.0  # residuals beyond so many scales count less
_WEIGHT_LIMIT = 1 << 13  # of the sum of a lane's prediction weights: driving values times it stay in 32 bits
SHORTEST = 12  # frames of a file that teaches
_SETTLED = 8  # frames before a file's averages mean something


def fit_lanes(files: Sequence[Values], moving: int) -> LaneModel:
    """The model of lanes whose first `moving` ones extrapolate; every file of SHORTEST frames or more teaches."""
    model = untrained(files[0].shape[1], moving)
    files = [f for f in files if len(f) >= SHORTEST]
    if not files or not model.count:
        return model
    model = replace(model, start=_starts(files, moving))
    model = replace(model, weights=_prediction_weights(model, files))
    model = _with_scales(replace(model, start=_starts(files, moving, model)), files)
    return replace(model, frequencies=_frequencies(model, files))


def untrained(count: int, moving: int) -> LaneModel:
    """Second differences, scales from the lane's own averages, and tables of a Laplace mixture."""
    own = np.tile(np.array([0, 77, 77, 77, 13, 12], np.int16), (count, 1))
    square = np.zeros((count, count))
    start = np.tile(np.array([18, 14, 8], np.int16) * PER_OCTAVE + LOG_FLOOR, (count, 1))
    prior = np.stack([_rounded(row) for row in _mixture()])
    return LaneModel(np.zeros((moving, moving), np.int16), own, square.astype(np.int8), start, prior)


def _starts(files: Sequence[Values], moving: int, model: LaneModel | None = None) -> np.ndarray:
    """Classes that hold the first two frames, and the mean logarithm of what follows."""
    if model is None:
        changes = [np.concatenate([lanes.differences(f[:, :moving]), f[:, moving:]], 1) for f in files]
    else:
        changes = [lanes.residuals(model, f, True)[0] for f in files]
    first, second = (np.stack([c[n] for c in changes]) for n in (0, 1))
    logs = [wave.magnitude_logarithm(np, np.abs(c[2:])) for c in changes]
    mean = np.concatenate(logs).mean(0)
    large = [wave.magnitude_logarithm(np, np.abs(x)).mean(0) for x in (first, second)]
    return np.rint(np.stack([*large, mean], 1)).astype(np.int16)


def _prediction_weights(model: LaneModel, files: Sequence[Values]) -> np.ndarray:
    """How the second differences of earlier lanes predict each lane's, weighed by the lane's momentary scale."""
    count = model.moving
    weights = np.zeros((count, count), np.int16)
    products = np.zeros((count, count, count))
    aims = np.zeros((count, count))
    for file in files:
        change = np.clip(lanes.differences(file[:, :count]), -wave.DRIVING_CLIP, wave.DRIVING_CLIP)[2:].astype(np.float64)
        classes = lanes.residuals(model, file, True)[1][2:, :count]
        for c in range(1, count):
            scale = 2.0 ** (classes[:, c] / 4)
            weight = 1 / np.maximum(scale, np.abs(change[:, c]) / _HUBER)
            weighted = change[:, : c + 1] * weight[:, None]
            gram = weighted.T @ weighted
            products[c, :c, :c] += gram[:c, :c]
            aims[c, :c] += gram[c, :c]
    for c in range(1, count):
        solved = np.rint(_solve(products[c, :c, :c], aims[c, :c]) * (1 << WEIGHT_BITS))
        solved = np.clip(solved, -(1 << 14), 1 << 14)
        if np.abs(solved).sum() < _WEIGHT_LIMIT:
            weights[c, :c] = solved
    return weights


def _with_scales(model: LaneModel, files: Sequence[Values]) -> LaneModel:
    """How the logarithms that are known predict the logarithm of each magnitude."""
    count = model.count
    own, shared = np.zeros((count, 1 + FEATURES), np.int16), np.zeros((count, count), np.int8)
    products = np.zeros((count, 1 + FEATURES + count, 1 + FEATURES + count))
    aims = np.zeros(products.shape[:2])
    for file in files:
        residual = lanes.residuals(model, file, True)[0]
        averaged, logs, log = _own_logarithms(model.start[:, 2], residual)
        surprise = (log - averaged[1])[_SETTLED:].astype(np.float64)
        features = np.concatenate([np.ones((1, *log.shape)), averaged, logs])[:, _SETTLED:].astype(np.float64)
        for c in range(count):
            known = np.concatenate([features[:, :, c].T, surprise[:, :c]], 1)
            size = known.shape[1]
            products[c, :size, :size] += known.T @ known
            aims[c, :size] += known.T @ log[_SETTLED:, c]
    for c in range(count):
        size = 1 + FEATURES + c
        solved = _solve(products[c, :size, :size], aims[c, :size])
        solved[1:] = np.rint(solved[1:] * (1 << SCALE_BITS))
        own[c, 0] = np.rint(solved[0])
        own[c, 1:] = solved[1 : 1 + FEATURES]
        shared[c, :c] = np.clip(solved[1 + FEATURES :], -127, 127)
    return replace(model, own=own, shared=shared)


def _own_logarithms(start: np.ndarray, residual: Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a lane's own past gives for every frame, as in wave.py: logarithms of its averages (3, frames, lanes) and of its
    two last magnitudes (2, ...), and the logarithm of the frame's own magnitude."""
    log = wave.magnitude_logarithm(np, np.abs(residual))
    target = np.minimum(np.abs(residual), wave.MAGNITUDE_CLIP) << FRACTION
    averages = np.empty((len(residual), len(RATES), residual.shape[1]), np.int32)
    state = np.tile(wave.power(start), (len(RATES), 1))
    for n in range(len(residual)):
        averages[n] = state
        if n >= 2:
            state = state + (target[n] - state >> np.array(RATES, np.int32)[:, None])
    last = [np.concatenate([np.tile(start, (2 + lag, 1)), log[2:-lag]]) for lag in (1, 2)]
    averaged = wave.logarithm(np, averages.transpose(1, 0, 2) + (1 << FRACTION - 5))
    return np.asarray(averaged), np.stack(last), np.asarray(log)


def _solve(gram: Float[np.ndarray, "n n"], aim: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    scale = np.sqrt(np.diag(gram)) + 1e-9
    ridged = gram / np.outer(scale, scale) + _RIDGE * np.eye(len(gram))
    return np.linalg.solve(ridged, aim / scale) / scale


def _frequencies(model: LaneModel, files: Sequence[Values]) -> np.ndarray:
    """Symbols by scale class, a class seen little leaning on the mixture."""
    counts = np.zeros((CLASSES, SYMBOLS))
    for file in files:
        symbols, classes = lanes.symbols_and_classes(model, file)
        np.add.at(counts, (classes[2:], symbols[2:]), 1)
    prior = _mixture()
    return np.stack([_rounded((n + 50 * p) / (n.sum() + 50)) for n, p in zip(counts, prior, strict=True)])


def _mixture() -> Float[np.ndarray, "classes symbols"]:
    """Probabilities of the symbols under Laplace laws of several widths around the class's own."""
    out = np.zeros((CLASSES, SYMBOLS))
    for n in range(CLASSES):
        bounds = lanes.magnitude_bounds(n)
        scale = 2.0 ** (n / 4) * 1.6
        for width, share in ((0.45, 0.25), (1.0, 0.5), (2.4, 0.2), (8.0, 0.05)):
            below = 1 - np.exp(-bounds / (scale * width))
            out[n, :-1] += share * np.diff(below)
    out[:, -1] = 1e-4
    return out / out.sum(1, keepdims=True)


def _rounded(probabilities: Float[np.ndarray, " symbols"]) -> np.ndarray:
    """Frequencies of at least 1 that sum to TOTAL."""
    frequencies = 1 + np.floor(probabilities / probabilities.sum() * (TOTAL - SYMBOLS)).astype(np.int64)
    frequencies[np.argmax(frequencies)] += TOTAL - frequencies.sum()
    return frequencies.astype(np.uint16)
