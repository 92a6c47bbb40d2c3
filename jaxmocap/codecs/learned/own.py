"""The basis of a rig that no model knows, fitted to the motion and written into its stream: some hundred bytes.

What a model learns of spectra holds for any rig; only how large each component is differs. Rows of the synthesis are
integers, counted in how far each moves the figure, so that all are as precise as it is seen. `own_fit` makes them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ... import components as rot
from ...errors import CorruptStream
from ...skeleton import Skeleton
from ..entropy import integers
from ..entropy.range_coder import Decoder, Encoder, RangeDecoder, RangeEncoder
from .basis import Basis
from .coefficients import decode_signs, decode_sizes, encode_signs, encode_sizes, tail_frequencies
from .contexts import OCTAVE, PATH, magnitude
from .density import tail_rows_of
from .distortion import Metric
from .golomb import read_signed, write_signed
from .model import LearnedModel
from .pose_vectors import PoseVectors
from .spectrum import SLOW_BINS, Spectrum
from .steps import STEP_BITS, step_cm

LEVEL_UNIT = 4  # levels of components are multiples of a quarter of an octave
MOST_LEVEL = 20 * OCTAVE // LEVEL_UNIT
COUNT_BITS = 8
_LEVER_CM = 2.0  # turns are no more precise than those of a lever of this length need be
_TYPICAL = 24  # of the model's components that tell what spectra are like
_LEVEL_ORDER, _CHANGE_ORDER, _SHIFT_ORDER = 4, 0, 1
_MOST_SHIFT = 48  # half octaves
_FORGET, _ONE = 13, 16  # history is in sixteenths, and keeps 13 of them from row to row


@dataclass(frozen=True, eq=False)
class OwnBasis:
    """The integers of a basis. `fineness` is the index of the step, in cm, of `rows` and `means`.

    `levels`, of the path's three and of all components, and `turn`, of cm a radian, are in quarters of an octave. A row
    counts how far each pose vector by itself moves the figure when the component is at its level; `means` likewise.
    """

    fineness: int
    turn: int
    levels: Int[np.ndarray, " path_and_components"]
    rows: Int[np.ndarray, "components size"]
    means: Int[np.ndarray, " size"]

    def mean_pose(self, skeleton: Skeleton) -> Float[np.ndarray, "joints 3 3"]:
        """The mean local rotation of every joint, of joint 0 less its heading. `skeleton` is in cm."""
        figure = plain(skeleton)
        _, vectors, _ = self._means(figure)
        rotations = figure.mean.copy()
        rotations[figure.turning] = rot.last(rot.from_rotation_vector(vectors.T), 2)
        return rotations

    def basis(self, skeleton: Skeleton, model: LearnedModel, metric: Metric) -> Basis:
        """What vectors about the mean pose are made of. `skeleton` is in cm."""
        height, vectors, shifts = self._means(plain(skeleton))
        mean = np.concatenate([height, np.zeros(vectors.size), shifts.ravel()])
        scale = size_of(self.levels[PATH:])[:, None] * self.arms(skeleton)[None]
        spectrum = _spectrum(model.bases[metric].spectrum, self.levels)
        return Basis(mean, self.rows * step_cm(self.fineness) / scale, float(size_of(self.turn)), spectrum)

    def arms(self, skeleton: Skeleton) -> Float[np.ndarray, " size"]:
        """About how far a unit of every pose vector moves the figure, which counts of rows are relative to."""
        figure = plain(skeleton)
        return lever_arms(figure, self._means(figure)[2])

    def _means(self, figure: PoseVectors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the height (1,), of turning joints (turning, 3) and of sliding ones (sliding, 3), in cm and radians."""
        turns = 3 * len(figure.turning)
        at = self.means * step_cm(self.fineness)
        shifts = (at / lever_arms(figure, np.zeros((len(figure.sliding), 3))))[1 + turns :].reshape(-1, 3)
        return at[:1], (at / lever_arms(figure, shifts))[1 : 1 + turns].reshape(-1, 3), shifts


def plain(skeleton: Skeleton) -> PoseVectors:
    """The figure about no mean pose."""
    return PoseVectors(skeleton, np.tile(np.eye(3), (skeleton.joint_count, 1, 1)))


def size_of(level: Int[np.ndarray, "..."] | int) -> np.ndarray:
    """What a level stands for, in cm."""
    return np.exp2(np.asarray(level) * (LEVEL_UNIT / OCTAVE))


def lever_arms(figure: PoseVectors, shifts: Float[np.ndarray, "sliding 3"]) -> Float[np.ndarray, " size"]:
    """About how far joints move, root mean square, by a unit of every pose vector, seen from the rest pose.

    `shifts` of sliding joints are added to their bones, in cm.
    """
    skeleton, joints = figure.skeleton, figure.skeleton.joint_count
    bones = skeleton.offsets.copy()
    bones[figure.sliding] += shifts
    at, below = np.zeros((joints, 3)), np.eye(joints, dtype=bool)  # below[d, j]: d hangs from j
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            at[j] = at[parent] + bones[j]
            below[j] |= below[parent]
    square = np.array([((at[below[:, j]] - at[j]) ** 2).sum() / joints for j in figure.turning])
    carried = np.sqrt(below.sum(0) / joints)[figure.sliding]
    return np.concatenate([[1.0], np.repeat(np.sqrt(square + _LEVER_CM**2), 3), np.repeat(carried, 3)])


def typical_spectrum(spectrum: Spectrum) -> tuple[Int[np.ndarray, "bins 4"], Int[np.ndarray, "octaves 4"]]:
    """A model's spectra about level 0, each less its mean over bins: of the path's three, and the mean of the body's."""
    slow, fast = (x[:, : PATH + _TYPICAL].astype(np.int64) for x in (spectrum.slow, spectrum.fast))
    level = slow[1:].sum(0) // (SLOW_BINS - 1)
    return _typical(slow - level[None]), _typical(fast - level[None])


def _typical(x: Int[np.ndarray, "rows components"]) -> Int[np.ndarray, "rows 4"]:
    of_body = x[:, PATH:].sum(1, keepdims=True) // max(x.shape[1] - PATH, 1)
    return np.concatenate([x[:, :PATH], of_body], 1)


def _spectrum(of_model: Spectrum, levels: Int[np.ndarray, " path_and_components"]) -> Spectrum:
    kind = np.minimum(np.arange(len(levels)), PATH)
    slow, fast = (x[:, kind] + LEVEL_UNIT * levels[None] for x in typical_spectrum(of_model))
    return Spectrum(slow, fast)


def write_own(own: OwnBasis, tail: Int[np.ndarray, "reaches symbols"]) -> bytes:
    """The bytes of a basis; `tail` are the model's densities of integers."""
    encoder = RangeEncoder()
    encoder.encode_bits(own.fineness, STEP_BITS)
    encoder.encode_bits(len(own.rows), COUNT_BITS)
    for value in (own.turn, *own.levels[: PATH + 1].tolist()):
        write_signed(encoder, value, _LEVEL_ORDER)
    for change in np.diff(own.levels[PATH:]).tolist():
        write_signed(encoder, change, _CHANGE_ORDER)
    history = _History(len(own.means))
    for row in (*own.rows, own.means):
        _write_row(encoder, row, history, tail)
    return encoder.finish()


def read_own(data: bytes, skeleton: Skeleton, tail: Int[np.ndarray, "reaches symbols"]) -> OwnBasis:
    """Raises CorruptStream where no encoder wrote such bytes."""
    decoder = RangeDecoder(data)
    fineness, count = decoder.decode_bits(STEP_BITS), decoder.decode_bits(COUNT_BITS)
    turn, *levels = (read_signed(decoder, _LEVEL_ORDER) for _ in range(1 + PATH + (count > 0)))
    for _ in range(count - 1):
        levels.append(levels[-1] + read_signed(decoder, _CHANGE_ORDER))
    if max(abs(level) for level in (turn, *levels)) > MOST_LEVEL:
        raise CorruptStream("a component of the stream's basis is beyond all measure")
    size = plain(skeleton).size
    history = _History(size)
    *rows, means = (_read_row(decoder, history, tail) for _ in range(count + 1))
    return OwnBasis(fineness, turn, np.array(levels, np.int64), np.array(rows, np.int64).reshape(count, size), means)


class _History:
    """What rows so far lead to expect of the next: vectors that moved much go on to."""

    def __init__(self, size: int):
        self._sum, self._weight, self.shift = np.zeros(size, np.int64), 0, 0

    def reach(self) -> Int[np.ndarray, " size"]:
        """Of a geometric law, in sixteenths of an octave."""
        mean = 4 * _ONE * (self._sum + 6) // (self._weight + 13)  # in 64ths
        return magnitude(mean + 18) - 6 * OCTAVE

    def add(self, sizes: Int[np.ndarray, " size"], shift: int) -> None:
        self._sum = (self._sum * _FORGET >> 4) + _ONE * sizes
        self._weight, self.shift = (self._weight * _FORGET >> 4) + _ONE, shift


def _write_row(encoder: Encoder, row: Int[np.ndarray, " size"], history: _History, tail: np.ndarray) -> None:
    """A row is expected as the history has it, but for a factor of its own."""
    symbol, _, _ = integers.split(np.abs(row))
    reach = history.reach()
    costs = {s: _cost(symbol, reach, s, tail) + 3 * abs(s - history.shift) / 2 for s in range(-_MOST_SHIFT, _MOST_SHIFT + 1)}
    shift = min(costs, key=costs.__getitem__)
    write_signed(encoder, shift - history.shift, _SHIFT_ORDER)
    encode_sizes(encoder, np.abs(row), _frequencies(reach, shift, tail))
    encode_signs(encoder, row[row != 0])
    history.add(np.abs(row), shift)


def _read_row(decoder: Decoder, history: _History, tail: np.ndarray) -> Int[np.ndarray, " size"]:
    shift = history.shift + read_signed(decoder, _SHIFT_ORDER)
    if abs(shift) > _MOST_SHIFT:
        raise CorruptStream("a row of the stream's basis is beyond all measure")
    sizes = decode_sizes(decoder, _frequencies(history.reach(), shift, tail))
    history.add(sizes.copy(), shift)
    return decode_signs(decoder, sizes)


def _frequencies(reach: Int[np.ndarray, " size"], shift: int, tail: np.ndarray) -> Int[np.ndarray, "size symbols"]:
    return tail_frequencies(tail, tail_rows_of(reach + shift * (OCTAVE // 2)))


def _cost(symbol: np.ndarray, reach: np.ndarray, shift: int, tail: np.ndarray) -> float:
    rows = tail_rows_of(reach + shift * (OCTAVE // 2))
    return -float(np.log2((tail[rows, symbol].astype(np.float64) + 1) / 65536).sum())
