"""Principal component analysis of poses: the orthonormal basis of largest variance about the mean."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import AbstractTransform


class Pca(AbstractTransform):
    """`basis` holds one principal direction a row, largest variance first; fewer rows than channels project."""

    mean: Float[Array, " channels"]
    basis: Float[Array, "components channels"]
    variance: Float[Array, " components"]

    def forward(self, x: Float[Array, "... frames channels"]) -> Float[Array, "... frames components"]:
        return (x - jnp.broadcast_to(self.mean, x.shape)) @ self.basis.T

    def inverse(self, y: Float[Array, "... frames components"]) -> Float[Array, "... frames channels"]:
        x = y @ self.basis
        return x + jnp.broadcast_to(self.mean, x.shape)


@eqx.filter_jit
def fit_pca(samples: Float[Array, "samples channels"], components: int | None = None) -> Pca:
    """Principal directions by the eigenvectors of the covariance; all of them unless `components` says how many.

    Signs are fixed so that each direction's entry of largest magnitude is positive. Raises ValueError where
    `components` exceeds the channels.
    """
    channels = samples.shape[-1]
    count = channels if components is None else components
    if not 1 <= count <= channels:
        raise ValueError(f"components is {components}, wanted 1 to {channels}")
    mean = samples.mean(0)
    centred = samples - mean[None]
    variance, vectors = jnp.linalg.eigh(centred.T @ centred / samples.shape[0])
    basis = vectors.T[::-1][:count]
    largest = jnp.take_along_axis(basis, jnp.abs(basis).argmax(1, keepdims=True), 1)
    return Pca(mean, basis * jnp.sign(largest), jnp.maximum(variance[::-1][:count], 0.0))
