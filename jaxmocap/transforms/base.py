"""What every transform is: an invertible map that is also a pytree, so that jit, vmap and grad work on it."""

from __future__ import annotations

import abc

import equinox as eqx
from jaxtyping import Array, Float


class AbstractTransform(eqx.Module):
    """Maps signals of shape (..., frames, channels); time is the last axis but one."""

    @abc.abstractmethod
    def forward(self, x: Float[Array, "... frames channels"]) -> Float[Array, "... rows columns"]:
        """Coefficients of the signal."""

    @abc.abstractmethod
    def inverse(self, y: Float[Array, "... rows columns"]) -> Float[Array, "... frames channels"]:
        """The signal of the coefficients."""


class Chain(AbstractTransform):
    """Transforms applied one after another; the inverse undoes them from the last to the first."""

    transforms: tuple[AbstractTransform, ...]

    def forward(self, x: Float[Array, "... frames channels"]) -> Float[Array, "... rows columns"]:
        for transform in self.transforms:
            x = transform.forward(x)
        return x

    def inverse(self, y: Float[Array, "... rows columns"]) -> Float[Array, "... frames channels"]:
        for transform in reversed(self.transforms):
            y = transform.inverse(y)
        return y
