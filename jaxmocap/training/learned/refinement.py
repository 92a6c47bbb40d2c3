"""Refining a basis end to end: bits of rounded levels and errors of decoded points in one loss.

The weight of errors is drawn anew for every batch, and the step with it, so that one basis serves all rates. Components
are turned into each other (Cayley's rotation), since the encoder counts on each moving the figure by itself alone: the
less, the less they are alike in size, since a thousandth of the largest would drown the smallest. What is never coded
stays as it was, and so do the mean, which every clip would have to code that it is not at, and the densities.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...codecs.learned import bands
from ...codecs.learned.attempt import MEAN_AT_1_CM, POWER
from ...codecs.learned.basis import Basis, direction_of
from ...codecs.learned.coefficients import Densities
from ...codecs.learned.contexts import OCTAVE, PATH
from ...codecs.learned.differentiable import Transform, Vectors, level_pose, level_rate, quantised
from ...codecs.learned.distortion import Metric, points
from ...codecs.learned.pose_vectors import PoseVectors
from ...codecs.learned.spectrum import fit_spectrum
from ...kinematics import Pose
from ...metrics import mean_error
from .augmentation import MOST_WARP, resampled, warp_times

_ERRORS_CM = (0.1, 2.4)
_BITS, _FALL = 3.0, 0.9  # a frame takes about 3 bits at 1 cm, and bits fall with the error to this power
_LEAST_CODED = 0.05  # cm: components that are never larger are no levels at any step
_WARM_UP = 0.1  # of all steps


# Path (frames, 3) and body (frames, size) of a clip, as `PoseVectors.analyse` gives them.
Clip = tuple[np.ndarray, np.ndarray]


class State(NamedTuple):
    """How components turn into each other (zeros: not at all), and what the optimiser keeps."""

    turns: Float[Array, "components components"]
    optimiser: optax.OptState
    steps: Int[Array, ""]


class Metrics(NamedTuple):
    """Of a batch: the loss, bits a frame, mean error in cm, and the weight of errors in bits a frame and cm."""

    loss: Float[Array, ""]
    bits: Float[Array, ""]
    error_cm: Float[Array, ""]
    weight: Float[Array, ""]


@dataclass(frozen=True, eq=False)
class Refinement:
    """`steps` steps from `basis`, at a rate of learning that rises to `peak_rate` and falls to zero.

    `figure` is the person on whom errors are measured; `octaves` is `bands.octave_count` of the frame time.
    """

    figure: PoseVectors
    metric: Metric
    octaves: int
    basis: Basis
    densities: Densities
    steps: int
    peak_rate: float = 3e-4

    def start(self) -> State:
        turns = jnp.zeros([len(self.basis.synthesis)] * 2)
        return State(turns, self._optimiser.init(turns), jnp.zeros((), int))

    @eqx.filter_jit
    def step(self, state: State, batch: Vectors, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One step on a batch of clips, (clips, frames, ...); pure."""
        gradient, metrics = eqx.filter_grad(self.loss, has_aux=True)(state.turns, batch, drawn_error(key))
        update, optimiser = self._optimiser.update(gradient, state.optimiser)
        return State(eqx.apply_updates(state.turns, update), optimiser, state.steps + 1), metrics

    def loss(self, turns: Array, batch: Vectors, error_cm: Float[Array, ""]) -> tuple[Float[Array, ""], Metrics]:
        """Rate + weight x distortion, over what it is about to be; `error_cm` is the error that the step is meant for."""
        transform = self.transform(turns, jnp.log2(error_cm / MEAN_AT_1_CM) / POWER)

        def of_clip(vectors: Vectors) -> tuple[Array, Array]:
            coded = quantised(transform, vectors, self.octaves)
            decoded = self._points(level_pose(transform, self.figure, coded))
            error = mean_error(decoded, self._points(self.figure.pose(*vectors)))
            return level_rate(transform, coded) / len(vectors.path), error

        bits, error = (x.mean() for x in jax.vmap(of_clip)(batch))
        about = _BITS * error_cm**-_FALL
        weight = _FALL * about / error_cm
        loss = (bits + weight * error) / ((1 + _FALL) * about)
        return loss, Metrics(loss, bits, error, weight)

    def transform(self, turns: Array, log_step: Float[Array, ""]) -> Transform:
        """With components turned, at a step of 2^log_step cm."""
        first = jnp.asarray(self.basis.synthesis, turns.dtype)
        half, whole = (turns - turns.T) * self._alike / 2, jnp.eye(len(first))
        plain = Transform.of(self.basis, self.densities, 1.0)
        synthesis = jnp.linalg.solve(whole - half, (whole + half) @ first)
        return dataclasses.replace(plain, synthesis=synthesis, log_step=log_step)

    def finish(self, state: State, clips: Sequence[Clip]) -> Basis:
        """The basis, in the precision that models keep, with its spectrum in these clips."""
        synthesis = np.asarray(self.transform(state.turns, jnp.zeros(())).synthesis, np.float16).astype(np.float64)
        basis = dataclasses.replace(self.basis, synthesis=synthesis)
        coefficients = (basis.coefficients(path, body, direction_of(path)) for path, body in clips)
        spectrum = fit_spectrum([bands.forward(y, self.octaves) for y in coefficients])
        return dataclasses.replace(basis, spectrum=spectrum)

    @functools.cached_property
    def _optimiser(self) -> optax.GradientTransformation:
        warm_up = math.ceil(_WARM_UP * self.steps)
        schedule = optax.warmup_cosine_decay_schedule(0.0, self.peak_rate, warm_up, max(self.steps, warm_up + 1))
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    @functools.cached_property
    def _alike(self) -> Float[np.ndarray, "components components"]:
        """The smaller of two components' sizes over the larger, as the corpus has them in motion; 0 for what is never coded."""
        spectrum = self.basis.spectrum.slow[1:, PATH:]
        coded = spectrum.max(0) > OCTAVE * math.log2(_LEAST_CODED)
        size = spectrum.mean(0) / OCTAVE
        return np.outer(coded, coded) * np.exp2(-np.abs(size[:, None] - size[None, :])).astype(np.float32)

    def _points(self, pose: Pose) -> Float[Array, "frames points 3"]:
        return points(pose, self.figure.skeleton.end_joints, self.metric)


def drawn_error(key: PRNGKeyArray) -> Float[Array, ""]:
    """A mean error in cm, log-uniform over the rates that a model is to serve."""
    return jnp.exp(jax.random.uniform(key, minval=math.log(_ERRORS_CM[0]), maxval=math.log(_ERRORS_CM[1])))


def draw_batch(clips: Sequence[Clip], count: int, frames: int, key: PRNGKeyArray) -> Vectors:
    """`count` crops of `frames` frames, each at a speed of its own; mirror images belong among `clips`.

    Crops are drawn from all frames alike, but from clips too short for one only where there are no others; their last
    frame is then held. A function of its arguments alone.
    """
    span = math.ceil(frames * (1 + MOST_WARP))
    room = np.array([max(len(path) - span, 0) for path, _ in clips], float)
    chance = room / room.sum() if room.any() else np.full(len(clips), 1 / len(clips))
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)).astype(np.uint32))
    crops = []
    for n, which in enumerate(random.choice(len(clips), count, p=chance)):
        times = np.asarray(warp_times(frames, jax.random.fold_in(key, n)), np.float64) + random.uniform(0, room[which])
        crops.append([resampled(x, times) for x in clips[which]])
    return Vectors(*(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*crops, strict=True)))
