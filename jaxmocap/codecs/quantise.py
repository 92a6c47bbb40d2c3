"""Uniform quantisation with a dead zone: the border between floats and the integers that alone are coded."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..errors import JaxmocapError

# A coefficient is rounded up from this fraction of a step on: what lies below 1 - 0.33 steps is thresholded to zero,
# since a nonzero costs more bits than it saves distortion.
ROUNDING = 0.33
STEPS = 256
PER_OCTAVE = 16
_FINEST_OCTAVE = -7


def step_cm(index: int) -> float:
    """The quantiser step in cm: sixteen steps an octave, from 1/128 cm to 486 cm."""
    return 2.0 ** (index / PER_OCTAVE + _FINEST_OCTAVE)


def step_index(cm: float) -> int:
    """The index of the coarsest step that is not above `cm`. Raises JaxmocapError below the finest."""
    index = math.floor((math.log2(cm) - _FINEST_OCTAVE) * PER_OCTAVE + 1e-9) if cm > 0 else -1
    if index < 0:
        raise JaxmocapError(f"the step is {cm} cm, wanted {step_cm(0)} cm or more")
    return min(index, STEPS - 1)


@jax.jit
def quantise(coefficients: Float[Array, "..."], step: Float[Array, ""] | float) -> Int[Array, "..."]:
    """Hard threshold and uniform quantisation: the sign of c times floor(|c| / step + 0.33)."""
    magnitude = jnp.floor(jnp.abs(coefficients) / step + ROUNDING)
    return (jnp.sign(coefficients) * magnitude).astype(jnp.int32)


def dequantise(levels: Int[Array, "..."], step: Float[Array, ""] | float) -> Float[Array, "..."]:
    """The coefficient that each level stands for."""
    return levels * jnp.asarray(step, jnp.float32)
