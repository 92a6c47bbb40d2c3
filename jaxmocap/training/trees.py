"""Pytrees of arrays in the state of a training run, under names, and back."""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .loop import State

Tree = TypeVar("Tree")


def flatten(tree: object, name: str) -> State:
    """The arrays of a tree as `name.0`, `name.1`, ..."""
    return {f"{name}.{n}": np.asarray(leaf) for n, leaf in enumerate(jax.tree.leaves(eqx.filter(tree, eqx.is_array)))}


def unflatten(tree: Tree, state: State, name: str) -> Tree:
    """A tree like this one, with the arrays that the state has under its name."""
    leaves, structure = jax.tree.flatten(tree)
    return jax.tree.unflatten(structure, [jnp.asarray(state[f"{name}.{n}"]) for n in range(len(leaves))])
