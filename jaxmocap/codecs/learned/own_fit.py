"""Fits the basis that a stream carries to its motion: a weighted Karhunen-Loeve transform, as precise as it pays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from ...motion import Motion
from ...skeleton import Skeleton
from ..entropy import integers
from . import bands
from .attempt import step_of_mean
from .basis import Basis, direction_of
from .contexts import OCTAVE, PATH
from .distortion import Distortion, Metric
from .klt import jacobian_moment, weighted_analysis, weighted_klt
from .model import LearnedModel
from .own import COUNT_BITS, LEVEL_UNIT, MOST_LEVEL, OwnBasis, lever_arms, plain, size_of, typical_spectrum
from .pose_vectors import PoseVectors
from .spectrum import Spectrum, slow_bins
from .steps import index_of, step_cm

_MOST_FRAMES = 8192
_FINENESS = 0.09  # of rows and means at their levels, in steps of the quantiser
_DEAD_ZONE = 0.45
_LEAST_SPREAD = 0.2  # in steps: what moves less is not worth its row
_MOST_ERROR = 0.7  # of the mean error asked for
_LARGEST = integers.LIMIT - 1
_TYPICAL_ROWS = 256  # of the lowest band


def fit_own(
    motion: Motion, skeleton: Skeleton, scale: float, metric: Metric, model: LearnedModel, mean_cm: float
) -> tuple[OwnBasis, Basis]:
    """The basis of a motion whose unit is `scale` cm, for a mean error of about `mean_cm`.

    `skeleton` is the one that decodes, in cm. The Basis is that of the OwnBasis, but finds the coefficients that are best seen.
    """
    some = motion.values[:: max(-(-motion.frame_count // _MOST_FRAMES), 1)]
    some = Motion(motion.skeleton, some, motion.frame_time, motion.unit_cm)
    step, best = step_of_mean(mean_cm), None
    while True:
        own, basis, error = _fit(some, skeleton, scale, metric, model, step)
        if best is not None and error >= best[2]:
            return best[:2]
        best = own, basis, error
        if error <= _MOST_ERROR * mean_cm or not own.fineness:
            return own, basis
        step *= 0.7


def _fit(
    motion: Motion, skeleton: Skeleton, scale: float, metric: Metric, model: LearnedModel, step: float
) -> tuple[OwnBasis, Basis, float]:
    """As precise as suits a quantiser's step in cm, and the mean error that it leaves even without that quantiser."""
    energy = _energy(model, metric, motion.frame_time)
    fineness = index_of(_FINENESS * step / energy[PATH])
    means = _means(motion, plain(skeleton), scale, step_cm(fineness))
    size = len(means)
    own = OwnBasis(fineness, 0, np.zeros(PATH, np.int64), np.zeros((0, size), np.int64), means)
    figure = PoseVectors(skeleton, own.mean_pose(skeleton))
    path, body = figure.analyse(motion, scale)
    moment, radius = jacobian_moment(figure, metric, body)
    rows = weighted_klt(moment, np.cov(body, rowvar=False, bias=True).reshape(size, size))
    spread = np.std(body @ weighted_analysis(rows, moment), axis=0)
    kept = np.flatnonzero(spread > _LEAST_SPREAD * step)[: (1 << COUNT_BITS) - 1]
    turn = int(_levels(np.array([radius]) ** 0.5)[0])
    spread = np.concatenate([_path_spread(path, float(size_of(turn))), spread[kept]])
    levels = _levels(spread / energy[np.minimum(np.arange(len(spread)), PATH)])
    wanted = rows[kept] * size_of(levels[PATH:])[:, None] * own.arms(skeleton)[None] / step_cm(fineness)
    counts = _integers(np.sign(wanted) * np.floor(np.abs(wanted) + _DEAD_ZONE))
    used = counts.any(1)
    own = OwnBasis(fineness, turn, np.concatenate([levels[:PATH], levels[PATH:][used]]), counts[used], means)
    basis = own.basis(skeleton, model, metric)
    basis = replace(basis, fitted=weighted_analysis(basis.synthesis, moment))
    direction = direction_of(path)
    distortion = Distortion(figure, basis, metric, direction, figure, path, body)
    return own, basis, float(distortion.errors(basis.coefficients(path, body, direction)).mean())


def _means(motion: Motion, figure: PoseVectors, scale: float, step: float) -> Int[np.ndarray, " size"]:
    """Counts of height, mean rotation vectors (of the rotations nearest to the sums) and mean shifts."""
    from scipy.spatial.transform import Rotation  # which decoders need not wait for

    path, body = figure.analyse(motion, scale)
    local, _ = figure.local(np.zeros_like(path), body)
    u, _, vt = np.linalg.svd(local.sum(-1).transpose(2, 0, 1)[figure.turning])
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turns = 3 * len(figure.turning)
    height, shifts = body[:, :1].mean(0), body[:, 1 + turns :].mean(0)
    still = np.zeros((len(figure.sliding), 3))
    shifts = _integers(np.rint(shifts * lever_arms(figure, still)[1 + turns :] / step))
    decoded = (shifts * step / lever_arms(figure, still)[1 + turns :]).reshape(-1, 3)
    vectors = Rotation.from_matrix(u @ vt).as_rotvec().ravel() * lever_arms(figure, decoded)[1 : 1 + turns]
    return np.concatenate([_integers(np.rint(height / step)), _integers(np.rint(vectors / step)), shifts])


def _path_spread(path: Float[np.ndarray, "frames 3"], turn_cm: float) -> Float[np.ndarray, "3"]:
    """How far the path strays along and across the direction in which it begins, and by turning, in cm."""
    nothing = np.zeros((0, 0))
    basis = Basis(np.zeros(0), nothing, turn_cm, Spectrum(nothing, nothing))
    return np.std(basis.coefficients(path, np.zeros((len(path), 0)), direction_of(path)), axis=0)


def _energy(model: LearnedModel, metric: Metric, frame_time: float) -> Float[np.ndarray, "4"]:
    """The spread of components whose spectra are the typical ones, at level 0: magnitudes are taken to be Laplacian."""
    slow, _ = typical_spectrum(model.bases[metric].spectrum)
    rows = slow_bins(_TYPICAL_ROWS)[1:]
    energy = 2 * (np.exp2(slow[rows] / OCTAVE) ** 2).sum(0) / (_TYPICAL_ROWS << bands.octave_count(frame_time))
    return np.sqrt(energy)


def _levels(size: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    level = np.rint(np.log2(np.maximum(size, 1e-9)) * (OCTAVE / LEVEL_UNIT))
    return np.clip(level, -MOST_LEVEL, MOST_LEVEL).astype(np.int64)


def _integers(x: np.ndarray) -> Int[np.ndarray, "..."]:
    return np.clip(x, -_LARGEST, _LARGEST).astype(np.int64)
