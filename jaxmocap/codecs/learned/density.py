"""How likely every magnitude is, by a small network of its context: trained with gradients, frozen to integers to code.

The network says, as logits, whether a magnitude stops at 0, at 1 and at 2, and how far the tail beyond reaches.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...components import A, namespace
from ..entropy import integers
from ..entropy.tables import TOTAL
from .contexts import OCTAVE

STOPS = 3  # magnitudes 0, 1 and 2 have logits of their own
OUTPUTS = STOPS + 1
_LOGIT = 32  # outputs of the frozen network are in such parts of a logit, or of an octave for the tail
_MOST = 12 * _LOGIT
_TAIL_LOW, _TAIL_HIGH, _TAIL_PER_OCTAVE = -2, 13, 4
_WEIGHT_BITS, _HIDDEN_BITS = 10, 6
_HIDDEN_MOST = 1 << 12
_BIAS_SCALE = 1 << _WEIGHT_BITS + _HIDDEN_BITS
_WEIGHT_SCALES = (_BIAS_SCALE // OCTAVE, 1 << _WEIGHT_BITS, 1 << _WEIGHT_BITS)
_LN2 = float(np.log(2.0))


class Density(eqx.Module):
    """The trainable network: contexts in sixteenths of an octave to logits of stopping and log2 of the tail's reach."""

    weights: list[Float[Array, "inputs outputs"]]
    biases: list[Float[Array, " outputs"]]

    @staticmethod
    def init(inputs: int, hidden: int, key: PRNGKeyArray, outputs: int = OUTPUTS) -> Density:
        """Outputs beyond the first four are the caller's own."""
        sizes = (inputs, hidden, hidden, outputs)
        keys = jax.random.split(key, len(sizes) - 1)
        weights = [
            jax.random.normal(k, (a, b)) * np.sqrt(2.0 / a) for k, a, b in zip(keys, sizes, sizes[1:], strict=False)
        ]
        biases = [jnp.zeros(n) for n in sizes[1:]]
        return Density([*weights[:-1], 0.1 * weights[-1]], biases)

    def __call__(self, contexts: Float[Array, "places inputs"]) -> Float[Array, "places outputs"]:
        h = contexts / OCTAVE
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            h = jax.nn.relu(h @ weight + bias[None])
        return h @ self.weights[-1] + self.biases[-1][None]

    def bits(self, contexts: Float[Array, "places inputs"], levels: Float[Array, " places"]) -> Float[Array, " places"]:
        """What each level costs, sign and all; between whole levels in a straight line, so that it has a gradient."""
        return bits(self(contexts), jnp.abs(levels))

    def freeze(self) -> FrozenDensity:
        """The integers that alone encode. Raises ValueError where a weight is too large for them."""
        weights = [np.rint(np.asarray(w, np.float64) * s) for w, s in zip(self.weights, _WEIGHT_SCALES, strict=True)]
        biases = [np.rint(np.asarray(b, np.float64) * _BIAS_SCALE) for b in self.biases]
        if max(np.abs(w).max() for w in weights) > 32767:
            raise ValueError("the network has weights too large to freeze")
        return FrozenDensity([w.astype(np.int16) for w in weights], [b.astype(np.int32) for b in biases])


@dataclass(frozen=True, eq=False)
class FrozenDensity:
    """The network in integers: no rounding, and so the same outputs on every machine, in numpy and in compiled JAX."""

    weights: list[np.ndarray]
    biases: list[np.ndarray]

    def __call__(self, contexts: Int[A, "places inputs"]) -> Int[A, "places outputs"]:
        """In 32nds of a logit (of an octave, for the tail)."""
        xp = namespace(contexts)
        h = contexts
        weights = self._doubles if xp is np else self.weights
        for n, (weight, bias) in enumerate(zip(weights, self.biases, strict=True)):
            h = _product(h, weight) + xp.asarray(bias)[None]
            if n < len(weights) - 1:
                h = xp.minimum(xp.maximum(h >> _WEIGHT_BITS, 0), _HIDDEN_MOST)
        shift = _WEIGHT_BITS + _HIDDEN_BITS - (_LOGIT.bit_length() - 1)
        return xp.clip(h >> shift, -_MOST, _MOST + _LOGIT)

    def logits(self, contexts: Int[np.ndarray, "places inputs"]) -> Float[np.ndarray, "places outputs"]:
        """About the same as real numbers, quickly: for costs, never for coding."""
        *hidden, (weight, bias) = self._floats
        h = contexts.astype(np.float32)
        for w, b in hidden:
            h = h @ w
            h += b
            np.maximum(h, 0, out=h)
            np.minimum(h, _HIDDEN_MOST >> _HIDDEN_BITS, out=h)
        return h @ weight + bias

    @functools.cached_property
    def _doubles(self) -> list[np.ndarray]:
        return [weight.astype(np.float64) for weight in self.weights]

    @functools.cached_property
    def _floats(self) -> list[tuple[np.ndarray, np.ndarray]]:
        first = np.float32(_BIAS_SCALE)
        scales = [first] + [np.float32(1 << _WEIGHT_BITS)] * (len(self.weights) - 1)
        return [
            (w.astype(np.float32) / scale, b.astype(np.float32) / first)
            for w, b, scale in zip(self.weights, self.biases, scales, strict=True)
        ]

    def thaw(self) -> Density:
        """The trainable network that freezes to this one."""
        weights = [jnp.asarray(w / s, float) for w, s in zip(self.weights, _WEIGHT_SCALES, strict=True)]
        return Density(weights, [jnp.asarray(b / _BIAS_SCALE, float) for b in self.biases])

    def tensors(self, name: str) -> dict[str, np.ndarray]:
        layers = enumerate(zip(self.weights, self.biases, strict=True))
        return {f"{name}.{kind}{n}": x for n, pair in layers for kind, x in zip(("weight", "bias"), pair, strict=True)}

    @staticmethod
    def load(name: str, tensors: dict[str, np.ndarray]) -> FrozenDensity:
        count = sum(key.startswith(f"{name}.weight") for key in tensors)
        return FrozenDensity(*([tensors[f"{name}.{kind}{n}"] for n in range(count)] for kind in ("weight", "bias")))


def _product(x: Int[A, "places inputs"], weight: np.ndarray) -> Int[A, "places outputs"]:
    """Exact: numpy has a quick product for doubles alone, which hold whole numbers up to 2^53; XLA's integers have 32 bits."""
    if isinstance(x, np.ndarray):
        return (x.astype(np.float64) @ weight).astype(np.int64)
    return jnp.matmul(x.astype(jnp.int32), jnp.asarray(weight, jnp.int32))


def bits(outputs: Float[A, "*places outputs"], magnitudes: Float[A, "*places"]) -> Float[A, "*places"]:
    """The length of code of magnitudes and their signs, linear between whole ones."""
    xp = namespace(outputs)
    stop = xp.logaddexp(0.0, -outputs[..., :STOPS]) / _LN2
    go = xp.logaddexp(0.0, outputs[..., :STOPS]) / _LN2
    reach = xp.exp2(xp.clip(outputs[..., STOPS], _TAIL_LOW, _TAIL_HIGH))
    zero = stop[..., 0]
    one = go[..., 0] + 1 + stop[..., 1]
    two = go[..., 0] + 1 + go[..., 1] + stop[..., 2]
    beyond = go[..., 0] + 1 + go[..., 1] + go[..., 2] - xp.log1p(-xp.exp(-1 / reach)) / _LN2
    slope = 1 / (reach * _LN2)
    a = magnitudes
    below = xp.where(a < 1, zero + a * (one - zero), one + (a - 1) * (two - one))
    return xp.where(a < 2, below, xp.where(a < 3, two + (a - 2) * (beyond - two), beyond + (a - 3) * slope))


def stop_frequencies(outputs: Int[np.ndarray, "places outputs"], logistic: np.ndarray) -> Int[np.ndarray, "places 4"]:
    """How often, in parts of 65,536, a magnitude is 0, 1, 2 and more, each at least once; by integers alone."""
    p = logistic[np.minimum(outputs[:, :STOPS], _MOST) + _MOST].astype(np.int64)
    left = np.full(len(outputs), TOTAL, np.int64)
    columns = []
    for n in range(STOPS):
        here = 1 + ((left - (STOPS + 1 - n)) * p[:, n] >> 16)
        columns.append(here)
        left = left - here
    return np.stack([*columns, left], 1)


def tail_rows(outputs: Int[np.ndarray, "places outputs"]) -> Int[np.ndarray, " places"]:
    """The row of the tail's table for every place."""
    return tail_rows_of(outputs[:, STOPS] // (_LOGIT // OCTAVE))


def tail_rows_of(reach: Int[np.ndarray, " places"]) -> Int[np.ndarray, " places"]:
    """The row for a geometric law of reach 2^(reach / 16)."""
    return np.clip(reach // (OCTAVE // _TAIL_PER_OCTAVE) - _TAIL_LOW * _TAIL_PER_OCTAVE, 0, _tail_count() - 1)


def _tail_count() -> int:
    return (_TAIL_HIGH - _TAIL_LOW) * _TAIL_PER_OCTAVE + 1


def logistic_table() -> Int[np.ndarray, " outputs"]:
    """65,536 times the logistic function of every 32nd of a logit in -12..12; kept in the model, not made anew."""
    z = np.arange(-_MOST, _MOST + 1) / _LOGIT
    return np.clip(np.rint(TOTAL / (1 + np.exp(-z))), 0, TOTAL - 1).astype(np.uint16)


def tail_table() -> Int[np.ndarray, "reaches symbols"]:
    """Frequencies, each less one, of the symbols of what is beyond 3 under a geometric law of every reach."""
    starts = np.array([integers.join(s, 0) for s in range(integers.SYMBOLS)] + [np.inf])
    rows = []
    for n in range(_tail_count()):
        reach = 2.0 ** ((n + 0.5) / _TAIL_PER_OCTAVE + _TAIL_LOW)
        mass = np.exp(-starts[:-1] / reach) - np.exp(-starts[1:] / reach)
        frequencies = np.floor(mass * (TOTAL - integers.SYMBOLS)).astype(np.int64)
        frequencies[np.argmax(frequencies)] += TOTAL - integers.SYMBOLS - frequencies.sum()
        rows.append(frequencies)
    return np.stack(rows).astype(np.uint16)
