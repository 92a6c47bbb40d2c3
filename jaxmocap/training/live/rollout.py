"""The tracker of `live` in real numbers, for many clips at once, differentiable: what the network is trained through.

As codecs/live/tracker.py, but for rounding. Gradients pass from frame to frame through places alone, not through what the
network sees: they would grow without bound.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...codecs.learned.density import STOPS, Density, bits
from ...codecs.live.encoder import ROUNDING
from ...codecs.live.tracker import (
    BUSY,
    FOLLOWING,
    GAIN,
    GAIN_SHIFT,
    MOST_GAIN,
    MOST_SHRINK,
    SHRINK,
    SHRINK_SHIFT,
    SIGN,
    SWIFT,
)

_LN2 = 0.6931471805599453


class Batch(NamedTuple):
    """Coefficients in cm; log2 of their speeds and spreads; which row of the embedding is theirs."""

    coefficients: Float[Array, "clips frames components"]
    speed: Float[Array, "clips components"]
    spread: Float[Array, "clips components"]
    embedding: Float[Array, "clips components 4"]


class Rollout(NamedTuple):
    """Of every clip, frame and component: level, decoded coefficient, bits, and how far off the prediction was in steps."""

    levels: Float[Array, "clips frames components"]
    decoded: Float[Array, "clips frames components"]
    bits: Float[Array, "clips frames components"]
    surprise: Float[Array, "clips frames components"]


def rollout(network: Density, batch: Batch, log_step: Float[Array, ""]) -> Rollout:
    """Frame by frame at a step of 2^log_step cm, from each clip's first frame on."""
    step = jnp.exp2(log_step)
    following = 0.5 ** jnp.asarray(FOLLOWING, float)[:, None, None]
    lively = 0.5 ** jnp.asarray(BUSY, float)[:, None, None]
    still = _still(batch, log_step)

    def frame(state, x):
        place, average, busy = state
        inputs, side = _contexts(jax.lax.stop_gradient(state), still, step)
        outputs = network(16 * inputs.reshape(-1, inputs.shape[-1])).reshape(*x.shape, -1)
        gain = jnp.clip(outputs[..., GAIN], 0, MOST_GAIN)
        drift = gain * jax.lax.stop_gradient(place - average[SWIFT]) / 2**GAIN_SHIFT
        predicted = place + drift
        off = (x - predicted) / step
        levels = jax.lax.stop_gradient(jnp.sign(off) * jnp.floor(jnp.abs(off) + ROUNDING))
        size = jnp.abs(levels)
        sign = jnp.where(size > 0, jax.nn.softplus(-side * jnp.sign(levels) * outputs[..., SIGN]) / _LN2 - 1, 0.0)
        cost = bits(outputs[..., : STOPS + 1], size) + sign
        shrink = jnp.clip(outputs[..., SHRINK], -MOST_SHRINK, MOST_SHRINK) / 2**SHRINK_SHIFT
        moved = levels - jnp.where(size == 1, levels * shrink, 0.0)
        straight = jnp.where(size > 0, off - jax.lax.stop_gradient(off), 0.0)  # what was coded follows the original
        now = predicted + (moved + straight) * step
        average = average + (now[None] - average) * following
        busy = busy + (jnp.minimum(size, 255.0)[None] - busy) * lively
        return (now, average, busy), Rollout(levels, now, cost, off)

    first = jnp.round(batch.coefficients[:, 0] / step) * step
    start = (first, jnp.tile(first[None], (len(FOLLOWING), 1, 1)), jnp.zeros((len(BUSY), *first.shape)))
    _, made = jax.lax.scan(frame, start, batch.coefficients.transpose(1, 0, 2))
    return Rollout(*(x.transpose(1, 0, 2) for x in made))


def _contexts(state, still, step) -> tuple[Array, Array]:
    """As `tracker.contexts`, in whole units where that has sixteenths."""
    place, average, busy = state
    gone = (place[None] - average) / step
    side = jnp.where(3 * gone[1] + gone[3] >= 0, 1.0, -1.0)
    signed = jnp.clip(side[None] * gone, -8, 8) / 2
    everywhere = jnp.broadcast_to(jnp.log2(1 + 16 * busy.sum(-1, keepdims=True)) / 2, busy.shape)
    parts = [signed, jnp.log2(1 + 16 * jnp.abs(gone)) / 2, jnp.log2(1 + 64 * busy) / 2, everywhere]
    moving = jnp.concatenate(parts).transpose(1, 2, 0)
    return jnp.concatenate([moving, still], -1), side


def _still(batch: Batch, log_step: Float[Array, ""]) -> Float[Array, "clips components still"]:
    """As `tracker.still_contexts`."""
    priors = jnp.stack([batch.speed, batch.spread], -1) - log_step
    own = jnp.full((*batch.speed.shape, 1), log_step / 2)
    return jnp.concatenate([jnp.clip(priors, -12, 12) / 2, own, batch.embedding], -1)
