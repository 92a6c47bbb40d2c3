"""The network of `live`, trained end to end through the closed loop: bits and errors of decoded frames in one loss."""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from ...codecs.learned.density import STOPS, Density
from ...codecs.live.tracker import EMBEDDING, GAIN, INPUTS, MOST_GAIN, OUTPUTS
from .rollout import Batch, rollout

HIDDEN = 32
STEPS_CM = (1 / 64, 2.5)
PEAK_RATE = 1.5e-3
_ERROR, _BITS, _FALL = 1.6, 25.0, 0.75  # the mean error is about 1.6 steps; a frame takes about 25 bits at 1 cm
_SURPRISE = 0.3  # what prediction is worth beside the bits that it saves in the frame itself
_SETTLED = 8  # frames


class Learner(eqx.Module):
    """The network, and the embedding of the components of every basis."""

    network: Density
    embedding: Float[Array, "bases components 4"]

    @staticmethod
    def init(bases: int, components: int, key: PRNGKeyArray) -> Learner:
        of_network, of_embedding = jax.random.split(key)
        network = Density.init(INPUTS, HIDDEN, of_network, OUTPUTS)
        likely_zero = jnp.zeros(OUTPUTS).at[0].set(2.0).at[1:STOPS].set(1.0).at[GAIN].set(MOST_GAIN / 2)
        network = eqx.tree_at(lambda n: n.biases[-1], network, likely_zero)
        return Learner(network, 0.3 * jax.random.normal(of_embedding, (bases, components, EMBEDDING)))


class Drawn(NamedTuple):
    """Crops of clips, (clips, frames, components) in cm, each with the basis it is in, and log2 of the step in cm."""

    coefficients: Float[Array, "clips frames components"]
    basis: Array
    log_step: Float[Array, ""]


def optimiser(steps: int) -> optax.GradientTransformation:
    schedule = optax.warmup_cosine_decay_schedule(0.0, PEAK_RATE, min(50, steps // 2), steps)
    return optax.chain(optax.zero_nans(), optax.clip_by_global_norm(1.0), optax.adam(schedule))


def loss(
    learner: Learner, drawn: Drawn, speed: Float[Array, "bases components"], spread: Float[Array, "bases components"]
) -> Float[Array, ""]:
    """Bits and errors, each over what it is about to be at the step, and a little for what was not foreseen."""
    b = drawn.basis
    batch = Batch(drawn.coefficients, speed[b], spread[b], learner.embedding[b])
    made = rollout(learner.network, batch, drawn.log_step)
    off = jnp.square(made.decoded - batch.coefficients).sum(-1)
    error = jnp.sqrt(off + 1e-6)[:, _SETTLED:].mean()
    bits, foreseen = (x.sum(-1)[:, _SETTLED:].mean() for x in (made.bits, jnp.log2(1 + jnp.square(made.surprise / 0.6))))
    about = _ERROR * jnp.exp2(drawn.log_step)
    return (bits + _SURPRISE * foreseen) / (_BITS * about**-_FALL) + error / about


@eqx.filter_jit
def step(
    learner: Learner, state: optax.OptState, drawn: Drawn, speed: Array, spread: Array, steps: int
) -> tuple[Learner, optax.OptState, Float[Array, ""]]:
    """One of `steps`; pure."""
    value, gradient = eqx.filter_value_and_grad(loss)(learner, drawn, speed, spread)
    update, state = optimiser(steps).update(gradient, state)
    return eqx.apply_updates(learner, update), state, value


def log_step_of(uniform: float) -> float:
    """log2 of a step, log-uniform over those that are asked for."""
    low, high = (math.log2(s) for s in STEPS_CM)
    return low + (high - low) * uniform
