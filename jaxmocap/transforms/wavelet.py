"""Wavelets along time: the orthonormal Haar of the LSDT paper, and the 9/7 of Cohen, Daubechies and Feauveau."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..components import A, namespace
from .base import AbstractTransform

# The lifting steps of the 9/7 pair (Daubechies and Sweldens 1998, section 7.7), and the scaling that makes it
# nearly orthonormal.
_LIFT = (-1.586134342059924, -0.052980118572961, 0.882911075530934, 0.443506852043971)
_SCALE = 1.149604398860241


def haar_matrix(length: int, levels: int = 3) -> Float[np.ndarray, "coefficients samples"]:
    """Rows are the orthonormal Haar basis over any length: averages first, then details from coarse to fine.

    An odd sample at the end of a level is carried up unchanged, which keeps the matrix orthogonal.
    """
    details: list[np.ndarray] = []
    smooth = np.eye(length)
    for _ in range(levels):
        pairs = len(smooth) // 2
        if pairs == 0:
            break
        even, odd, rest = smooth[0 : 2 * pairs : 2], smooth[1 : 2 * pairs : 2], smooth[2 * pairs :]
        details.insert(0, (even - odd) / np.sqrt(2.0))
        smooth = np.concatenate([(even + odd) / np.sqrt(2.0), rest])
    return np.concatenate([smooth, *details])


class Haar(AbstractTransform):
    """The orthonormal Haar transform over frames, as a matrix product."""

    levels: int = eqx.field(static=True, default=3)

    def forward(self, x: Float[Array, "... frames channels"]) -> Float[Array, "... frames channels"]:
        return jnp.asarray(haar_matrix(x.shape[-2], self.levels), x.dtype) @ x

    def inverse(self, y: Float[Array, "... frames channels"]) -> Float[Array, "... frames channels"]:
        return jnp.asarray(haar_matrix(y.shape[-2], self.levels).T, y.dtype) @ y


class Cdf97(AbstractTransform):
    """The 9/7 wavelet by lifting, symmetric at the ends, any length; `levels` stop where two frames are left."""

    levels: int = eqx.field(static=True, default=3)

    def forward(self, x: Float[Array, "... frames channels"]) -> Float[Array, "... frames channels"]:
        """Coarsest averages first, then details from coarse to fine."""
        details: list[Array] = []
        smooth = x
        for _ in range(self.levels):
            if smooth.shape[-2] < 2:
                break
            smooth, detail = split(smooth)
            details.insert(0, detail)
        return jnp.concatenate([smooth, *details], -2)

    def inverse(self, y: Float[Array, "... frames channels"]) -> Float[Array, "... frames channels"]:
        lengths = [y.shape[-2]]
        while len(lengths) <= self.levels and lengths[-1] >= 2:
            lengths.append((lengths[-1] + 1) // 2)
        smooth = y[..., : lengths[-1], :]
        for length in reversed(lengths[:-1]):
            smooth = merge(smooth, y[..., smooth.shape[-2] : length, :])
        return smooth


# One level, for numpy arrays and JAX's alike: decoders run on the host, where nothing need be compiled.


def split(x: Float[A, "... frames channels"]) -> tuple[A, A]:
    """One level of the 9/7: averages (the larger half of the frames) and details."""
    even, odd = x[..., 0::2, :], x[..., 1::2, :]
    for n in (0, 2):
        odd = odd + _LIFT[n] * _neighbours_of_odd(even, odd)
        even = even + _LIFT[n + 1] * _neighbours_of_even(odd, even)
    return even * _SCALE, odd / _SCALE


def merge(smooth: Float[A, "... averages channels"], detail: Float[A, "... details channels"]) -> A:
    """The signal of one level; undoes `split`."""
    even, odd = smooth / _SCALE, detail * _SCALE
    for n in (2, 0):
        even = even - _LIFT[n + 1] * _neighbours_of_even(odd, even)
        odd = odd - _LIFT[n] * _neighbours_of_odd(even, odd)
    xp = namespace(even)
    frames = even.shape[-2] + odd.shape[-2]
    if odd.shape[-2] < even.shape[-2]:
        odd = xp.concatenate([odd, even[..., -1:, :]], -2)
    woven = xp.stack([even, odd], -2)
    return woven.reshape(*even.shape[:-2], -1, even.shape[-1])[..., :frames, :]


def _neighbours_of_odd(even: A, odd: A) -> A:
    """The sum of both even neighbours of every odd sample; beyond the end the signal is mirrored."""
    right = namespace(even).concatenate([even[..., 1:, :], even[..., -1:, :]], -2)[..., : odd.shape[-2], :]
    return even[..., : odd.shape[-2], :] + right


def _neighbours_of_even(odd: A, even: A) -> A:
    xp = namespace(odd)
    left = xp.concatenate([odd[..., :1, :], odd], -2)[..., : even.shape[-2], :]
    right = xp.concatenate([odd, odd[..., -1:, :]], -2)[..., : even.shape[-2], :]
    return left + right
