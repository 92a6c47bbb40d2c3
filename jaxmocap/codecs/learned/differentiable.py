"""Rate and reconstruction of `learned` with gradients: in the motion, the basis, the step and the densities.

Given a key, levels are not rounded but take uniform noise (Balle, Laparra and Simoncelli: End-to-end optimized image
compression, 2017, section 3); without one they are rounded, and gradients pass as if they were not. The context of a
level is the same function of levels as the coder's, with no roundings. The encoder's search for better levels is left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...features.alignment import heading
from ...kinematics import Pose, local_rotations
from ...rotations import about_axis, multiply, to_quaternion, transpose
from ...skeleton import POSITION_CHANNELS
from ..quantise import ROUNDING
from . import bands
from .basis import DIRECTIONS, Basis, turn_of
from .coefficients import Densities
from .contexts import OCTAVE, PATH, BandContexts, fast_contexts, slow_contexts, smooth_activity, smooth_magnitude
from .density import Density
from .pose_vectors import PoseVectors
from .spectrum import Spectrum

_CUTOFF = 1e-5  # of singular values of the basis: all that moves anything lies above


class Vectors(NamedTuple):
    """A motion as `PoseVectors.analyse` gives it: x, z (cm) and heading (radians) of joint 0, and the body's vectors."""

    path: Float[Array, "frames 3"]
    body: Float[Array, "frames size"]


class Transform(eqx.Module):
    """A basis, a step and the densities as arrays that have gradients; `log_step` is log2 of the step in cm."""

    mean: Float[Array, " size"]
    synthesis: Float[Array, "components size"]
    turn_cm: Float[Array, ""]
    log_step: Float[Array, ""]
    slow: Density
    fast: Density
    spectrum: Spectrum = eqx.field(static=True)

    @staticmethod
    def of(basis: Basis, densities: Densities, step: float) -> Transform:
        """Of a model's basis and densities; `step` is in cm."""
        mean, synthesis = jnp.asarray(basis.mean, float), jnp.asarray(basis.synthesis, float)
        turn_cm, log_step = jnp.asarray(basis.turn_cm, float), jnp.asarray(math.log2(step), float)
        slow, fast = densities.slow.thaw(), densities.fast.thaw()
        return Transform(mean, synthesis, turn_cm, log_step, slow, fast, basis.spectrum)

    @property
    def step(self) -> Float[Array, ""]:
        """In cm."""
        return jnp.exp2(self.log_step)

    def coefficients(self, vectors: Vectors, direction: Float[Array, ""]) -> Float[Array, "frames components"]:
        """In cm, as `Basis.coefficients`."""
        x, z, turn = (vectors.path[:, n] for n in range(PATH))
        angle = turn_of(direction)
        c, s = jnp.cos(angle), jnp.sin(angle)
        floor = jnp.stack([c * x - s * z, s * x + c * z, (turn - angle) * self.turn_cm], 1)
        analysis = jnp.linalg.pinv(self.synthesis, rtol=_CUTOFF)
        return jnp.concatenate([floor, (vectors.body - self.mean[None]) @ analysis], 1)

    def vectors(self, y: Float[Array, "frames components"], direction: Float[Array, ""]) -> Vectors:
        """As `Basis.vectors`."""
        angle = turn_of(direction)
        c, s = jnp.cos(angle), jnp.sin(angle)
        path = jnp.stack([c * y[:, 0] + s * y[:, 1], c * y[:, 1] - s * y[:, 0], y[:, 2] / self.turn_cm + angle], 1)
        return Vectors(path, y[:, PATH:] @ self.synthesis + self.mean[None])


class Quantised(NamedTuple):
    """Levels of every band, in steps; those from a band's count of components on are zero, and are not coded."""

    direction: Float[Array, ""]
    levels: list[Float[Array, "rows components"]]
    counts: Int[Array, " bands"]


def vectors_of(figure: PoseVectors, values: Float[Array, "frames channels"], scale: float) -> Vectors:
    """`PoseVectors.analyse` with gradients, of channel values in degrees and file units of `scale` cm."""
    local = local_rotations(figure.skeleton, values)
    turn = heading(local[:, 0]) if figure.has_heading else jnp.zeros(len(values), values.dtype)
    level = multiply(transpose(about_axis(jnp.asarray([0.0, 1.0, 0.0]), turn)), local[:, 0])
    turned = jnp.stack([level if j == 0 else local[:, j] for j in figure.turning.tolist()], 1)
    relative = multiply(jnp.asarray(figure.mean[figure.turning].swapaxes(1, 2), values.dtype)[None], turned)
    place = _translations(figure, values, scale)
    path = jnp.stack([place[:, 0, 0], place[:, 0, 2], turn], 1)
    parts = [place[:, 0, 1:2], _continuous_vectors(relative).reshape(len(values), -1)]
    return Vectors(path, jnp.concatenate([*parts, figure.shifts(place).reshape(len(values), -1)], 1))


def quantised(transform: Transform, vectors: Vectors, octaves: int, key: PRNGKeyArray | None = None) -> Quantised:
    """Levels with noise where there is a key, else rounded; `octaves` is `bands.octave_count` of the frame time."""
    direction = jax.lax.stop_gradient(jnp.rint(vectors.path[0, 2] * (DIRECTIONS / (2 * math.pi))) % DIRECTIONS)
    real = [x / transform.step for x in bands.forward(transform.coefficients(vectors, direction), octaves)]
    rounded = [jax.lax.stop_gradient(jnp.sign(x) * jnp.floor(jnp.abs(x) + ROUNDING)) for x in real]
    counts = _active_components(rounded)
    if key is None:
        levels = [r + (x - jax.lax.stop_gradient(x)) for x, r in zip(real, rounded, strict=True)]
    else:
        keys = jax.random.split(key, len(real))
        levels = [x + jax.random.uniform(k, x.shape, x.dtype, -0.5, 0.5) for x, k in zip(real, keys, strict=True)]
    return Quantised(direction, [x * _is_active(x, count) for x, count in zip(levels, counts, strict=True)], counts)


def level_rate(transform: Transform, coded: Quantised) -> Float[Array, ""]:
    """Bits of levels in their contexts, as `coefficients.level_bits`."""
    level = OCTAVE * transform.log_step
    spectrum, levels = transform.spectrum, coded.levels
    prior = jnp.asarray(spectrum.slow_prior(len(levels[0]), 0), level.dtype) - level
    total = _band_rate(transform.slow, slow_contexts(prior, level), levels[0], coded.counts[0])
    parents = smooth_magnitude(smooth_activity(levels[0]))
    for octave, band in enumerate(levels[1:]):
        if not len(band):
            continue
        prior = jnp.asarray(spectrum.fast_prior(len(band), octave, 0), level.dtype) - level
        contexts = fast_contexts(prior, level, octave, parents)
        total = total + _band_rate(transform.fast, contexts, band, coded.counts[octave + 1])
        parents = smooth_magnitude(band)
    return total


def level_pose(transform: Transform, figure: PoseVectors, coded: Quantised) -> Pose:
    """What levels decode to, in cm; `figure` is the person to move."""
    y = bands.inverse([x * transform.step for x in coded.levels])
    return figure.pose(*transform.vectors(y, coded.direction))


def rate(transform: Transform, vectors: Vectors, octaves: int, key: PRNGKeyArray | None = None) -> Float[Array, ""]:
    """Bits of a motion. Differentiable in all arrays of the transform and of the vectors.

    With noise the rate of levels that are mostly zero is overestimated: noise makes something of every nothing. To make a
    motion cheaper descend with noise all the same: gradients that pass by rounding say nothing of what is rounded away.
    """
    return level_rate(transform, quantised(transform, vectors, octaves, key))


def reconstruct(
    transform: Transform, figure: PoseVectors, vectors: Vectors, octaves: int, key: PRNGKeyArray | None = None
) -> Pose:
    """The decoded pose in cm: positions and rotations of joints, and end sites. Differentiable as `rate` is."""
    return level_pose(transform, figure, quantised(transform, vectors, octaves, key))


def _band_rate(density: Density, contexts: BandContexts, levels: Array, count: Array) -> Float[Array, ""]:
    bits = density.bits(contexts.smooth_inputs(smooth_magnitude(levels)), levels.reshape(-1))
    return (bits.reshape(levels.shape) * _is_active(levels, count)).sum()


def _active_components(levels: list[Array]) -> Int[Array, " bands"]:
    """As `coefficients.active_components`."""
    place = jnp.arange(1, levels[0].shape[1] + 1)
    needed = jnp.stack([jnp.where((x != 0).any(0), place, 0).max() for x in levels])
    return jax.lax.cummax(needed, reverse=True)


def _is_active(levels: Float[Array, "rows components"], count: Int[Array, ""]) -> Float[Array, "1 components"]:
    return (jnp.arange(levels.shape[1]) < count).astype(levels.dtype)[None]


def _continuous_vectors(rotations: Float[Array, "frames joints 3 3"]) -> Float[Array, "frames joints 3"]:
    """As in `PoseVectors.analyse`: rotation vectors that do not jump, up to a length of a whole turn."""
    q = to_quaternion(rotations)
    flips = jnp.cumprod(jnp.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0), 0)
    flips = jnp.concatenate([jnp.ones_like(flips[:1]), flips]) if len(flips) else jnp.ones_like(q[..., 0])
    flips = flips * jnp.where((flips * q[..., 0]).sum(0) < 0, -1.0, 1.0)[None]
    q = q * flips[..., None]
    square = (q[..., 1:] ** 2).sum(-1)
    small = square < 1e-12
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    factor = jnp.where(small, 2.0, 2 * jnp.arctan2(sine, q[..., 0]) / sine)
    return q[..., 1:] * factor[..., None]


def _translations(figure: PoseVectors, values: Array, scale: float) -> Float[Array, "frames joints 3"]:
    """Of every joint in its parent's frame, in cm."""
    s = figure.skeleton
    still = jnp.asarray(s.offsets, values.dtype)
    columns = [
        [first + channels.index(name) if name in channels else None for name in POSITION_CHANNELS]
        for first, channels in zip(s.first_column, s.channels, strict=True)
    ]
    return jnp.stack([
        jnp.stack([
            jnp.broadcast_to(still[j, axis], values.shape[:1]) if at is None else values[:, at] * scale
            for axis, at in enumerate(of_joint)
        ], -1)
        for j, of_joint in enumerate(columns)
    ], 1)  # fmt: skip
