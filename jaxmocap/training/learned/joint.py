"""Refining a basis and densities together, end to end: bits of rounded levels and errors of decoded points in one loss.

The weight of errors is drawn anew for every batch, and the step with it, so that one model serves all rates. Components
are turned into each other (Cayley's rotation), since the encoder counts on each moving the figure by itself alone: the
less, the less they are alike in size, since a thousandth of the largest would drown the smallest. What is never coded
stays as it was, and so does the mean: where it is moved, every clip has to code that it is not there.
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
from ...codecs.learned.basis import Basis, direction_of
from ...codecs.learned.coefficients import Densities
from ...codecs.learned.contexts import OCTAVE, PATH
from ...codecs.learned.density import Density
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


class Parameters(eqx.Module):
    """What is refined: how components turn into each other (zeros: not at all), and the densities."""

    turns: Float[Array, "components components"]
    slow: Density
    fast: Density


class State(NamedTuple):
    parameters: Parameters
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
    """`steps` steps from `basis` and `densities`, at a rate of learning that rises to `peak_rate` and falls to zero.

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
        whole = Transform.of(self.basis, self.densities, 1.0)
        parameters = Parameters(jnp.zeros([len(self.basis.synthesis)] * 2), whole.slow, whole.fast)
        return State(parameters, self._optimiser.init(eqx.filter(parameters, eqx.is_array)), jnp.zeros((), int))

    @eqx.filter_jit
    def step(self, state: State, batch: Vectors, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One step on a batch of clips, (clips, frames, ...); pure."""
        gradient, metrics = eqx.filter_grad(self.loss, has_aux=True)(state.parameters, batch, drawn_error(key))
        update, optimiser = self._optimiser.update(gradient, state.optimiser)
        return State(eqx.apply_updates(state.parameters, update), optimiser, state.steps + 1), metrics

    def loss(self, parameters: Parameters, batch: Vectors, error_cm: Float[Array, ""]) -> tuple[Float[Array, ""], Metrics]:
        """Rate + weight x distortion, over what it is about to be; `error_cm` is the error that the step is meant for."""
        transform = self.transform(parameters, jnp.log2(error_cm / 0.59) / 0.73)  # as the encoder guesses its step

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

    def transform(self, parameters: Parameters, log_step: Float[Array, ""]) -> Transform:
        """What the parameters are at a step of 2^log_step cm."""
        p, first = parameters, jnp.asarray(self.basis.synthesis, parameters.turns.dtype)
        half, whole = (p.turns - p.turns.T) * self._alike / 2, jnp.eye(len(first))
        synthesis = jnp.linalg.solve(whole - half, (whole + half) @ first)
        mean, turn_cm = jnp.asarray(self.basis.mean, first.dtype), jnp.asarray(self.basis.turn_cm, first.dtype)
        return Transform(mean, synthesis, turn_cm, log_step, p.slow, p.fast, self.basis.spectrum)

    def finish(self, state: State, clips: Sequence[Vectors]) -> tuple[Basis, Densities]:
        """The basis, in the precision that models keep, with its spectrum in these clips, and frozen densities."""
        p = state.parameters
        synthesis = np.asarray(self.transform(p, jnp.zeros(())).synthesis, np.float16).astype(np.float64)
        basis = dataclasses.replace(self.basis, synthesis=synthesis)
        coefficients = (basis.coefficients(path, body, direction_of(path)) for path, body in map(_on_host, clips))
        spectrum = fit_spectrum([bands.forward(y, self.octaves) for y in coefficients])
        densities = self.densities._replace(slow=p.slow.freeze(), fast=p.fast.freeze())
        return dataclasses.replace(basis, spectrum=spectrum), densities

    @functools.cached_property
    def _optimiser(self) -> optax.GradientTransformation:
        warm_up = math.ceil(_WARM_UP * self.steps)
        schedule = optax.warmup_cosine_decay_schedule(0.0, self.peak_rate, warm_up, max(self.steps, warm_up + 1))
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    @functools.cached_property
    def _coded(self) -> Float[np.ndarray, " components"]:
        """1 for what is ever coded."""
        return (self.basis.spectrum.slow[1:, PATH:].max(0) > OCTAVE * math.log2(_LEAST_CODED)).astype(np.float32)

    @functools.cached_property
    def _alike(self) -> Float[np.ndarray, "components components"]:
        """The smaller of two components' sizes over the larger, as the corpus has them in motion."""
        size = self.basis.spectrum.slow[1:, PATH:].mean(0) / OCTAVE
        return np.outer(self._coded, self._coded) * np.exp2(-np.abs(size[:, None] - size[None, :])).astype(np.float32)

    def _points(self, pose: Pose) -> Float[Array, "frames points 3"]:
        return points(pose, self.figure.skeleton.end_joints, self.metric)


def drawn_error(key: PRNGKeyArray) -> Float[Array, ""]:
    """A mean error in cm, log-uniform over the rates that a model is to serve."""
    return jnp.exp(jax.random.uniform(key, minval=math.log(_ERRORS_CM[0]), maxval=math.log(_ERRORS_CM[1])))


def draw_batch(clips: Sequence[Vectors], count: int, frames: int, key: PRNGKeyArray) -> Vectors:
    """`count` crops of `frames` frames, each at a speed of its own; mirror images belong among `clips`.

    Crops are drawn from all frames alike, but from clips too short for one only where there are no others; their last
    frame is then held. A function of its arguments alone.
    """
    span = math.ceil(frames * (1 + MOST_WARP))
    room = np.array([max(len(clip.path) - span, 0) for clip in clips], float)
    chance = room / room.sum() if room.any() else np.full(len(clips), 1 / len(clips))
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)).astype(np.uint32))
    crops = []
    for n, which in enumerate(random.choice(len(clips), count, p=chance)):
        times = np.asarray(warp_times(frames, jax.random.fold_in(key, n)), np.float64) + random.uniform(0, room[which])
        crops.append([resampled(x, times) for x in _on_host(clips[which])])
    return Vectors(*(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*crops, strict=True)))


def _on_host(vectors: Vectors) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(vectors.path, np.float64), np.asarray(vectors.body, np.float64)
