"""Fitting a density to rows of contexts and levels: Adam, a falling rate, and the best epoch on rows held out."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from ...codecs.learned.density import Density
from .rows import Rows

BATCH = 2048
PEAK_RATE = 3e-3


def optimiser(steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(PEAK_RATE, steps))


def loss(density: Density, contexts: Float[Array, "rows inputs"], sizes: Float[Array, " rows"]) -> Float[Array, ""]:
    """Mean bits a level."""
    return density.bits(contexts, sizes).mean()


@eqx.filter_jit
def epoch(
    density: Density, state: optax.OptState, rows: Rows, order: Array, steps: int
) -> tuple[Density, optax.OptState, Array]:
    """One pass over the rows in batches; `order` is (batches, batch). Gives the mean loss, too."""
    arrays, static = eqx.partition(density, eqx.is_array)

    def step(carry, chosen):
        arrays, state = carry
        x, y = jnp.asarray(rows.contexts[chosen], jnp.float32), jnp.asarray(rows.sizes[chosen])
        value, gradient = eqx.filter_value_and_grad(loss)(eqx.combine(arrays, static), x, y)
        update, state = optimiser(steps).update(gradient, state)
        return (eqx.apply_updates(arrays, update), state), value

    (arrays, state), values = jax.lax.scan(step, (arrays, state), order)
    return eqx.combine(arrays, static), state, values.mean()


@eqx.filter_jit
def evaluate(density: Density, rows: Rows) -> Float[Array, ""]:
    """Mean bits a level over all rows."""
    return loss(density, jnp.asarray(rows.contexts, jnp.float32), jnp.asarray(rows.sizes))
