"""More motion of a corpus: its mirror image, and its own at other speeds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ...motion import Motion
from ...skeleton import POSITION_CHANNELS, Skeleton

_SIDES = (("Left", "Right"), ("left", "right"), ("L", "R"), ("l", "r"))
_ALIKE = 0.25  # of a bone's length: people are not quite symmetric
MOST_WARP = 0.15
_KNOT_FRAMES = 60


def sides_of(skeleton: Skeleton) -> np.ndarray:
    """For every joint the one on the other side by its name, itself where there is none.

    "Left" is beside "Right", and "L" beside "R" at either end of a name. Raises ValueError where partners differ in
    their channels, or hang from joints that are no partners.
    """
    at: dict[str, int] = {}
    for j, name in enumerate(skeleton.names):
        at.setdefault(name, j)
    partner = np.array([next((at[n] for n in _other_names(name) if n in at), j) for j, name in enumerate(skeleton.names)])
    parents = np.array(skeleton.parents)
    over = np.where(parents < 0, -1, partner[parents])
    same = all(set(skeleton.channels[j]) == set(skeleton.channels[p]) for j, p in enumerate(partner))
    if not (same and np.array_equal(partner[partner], np.arange(len(partner))) and np.array_equal(parents[partner], over)):
        raise ValueError("the names of the skeleton's joints do not tell its left side from its right")
    return partner


def mirror_axis(skeleton: Skeleton) -> int:
    """The axis (0: x) along which the bones of the two sides are opposite. Raises ValueError where along none."""
    partner = sides_of(skeleton)
    bones, size = skeleton.offsets, np.linalg.norm(skeleton.offsets, axis=1)
    pairs = partner != np.arange(len(partner))
    if not size[pairs].any():
        raise ValueError("the skeleton has no two sides with bones")
    apart = [np.abs(bones[partner] * _signs(axis)[None] - bones)[pairs].sum() for axis in range(3)]
    axis = int(np.argmin(apart))
    if apart[axis] > _ALIKE * size[pairs].sum():
        raise ValueError("the two sides of the skeleton are not mirror images along any axis")
    return axis


def mirrored(motion: Motion) -> Motion:
    """The mirror image, bones and all: joint positions are those of the other side, mirrored. Twice it is the motion.

    A mirror turns rotations about its axis as they were, others the other way. Raises ValueError where the rig has no
    sides that mirror each other; see `mirror_axis`.
    """
    s = motion.skeleton
    partner, axis = sides_of(s), mirror_axis(s)
    sign = _signs(axis)
    ends = _other_ends(s, partner)
    channels = [s.channels[p] for p in partner]
    skeleton = Skeleton(
        s.names, s.parents, s.offsets[partner] * sign, channels, s.end_joints, s.end_offsets[ends] * sign,
        s.axes[partner] * np.outer(sign, sign),
    )  # fmt: skip
    columns = [s.first_column[p] + n for p in partner for n in range(len(s.channels[p]))]
    return Motion(skeleton, motion.values[:, columns] * _channel_signs(channels, axis), motion.frame_time, motion.unit_cm)


def warp_times(frames: int, key: PRNGKeyArray) -> Float[Array, " frames"]:
    """When, in frames from 0 on, a motion is looked at whose speed strays smoothly by up to 15 %."""
    knots = max(frames // _KNOT_FRAMES, 1) + 1
    speed = 1 + jax.random.uniform(key, (knots,), minval=-MOST_WARP, maxval=MOST_WARP)
    eased = (1 - jnp.cos(jnp.pi * (jnp.arange(frames - 1) * ((knots - 1) / frames) % 1))) / 2
    knot = np.arange(frames - 1) * (knots - 1) // frames
    return jnp.concatenate([jnp.zeros(1), jnp.cumsum(speed[knot] * (1 - eased) + speed[knot + 1] * eased)])


def resampled(
    x: Float[np.ndarray, "frames channels"], times: Float[np.ndarray, " times"]
) -> Float[np.ndarray, "times channels"]:
    """Values between frames by cubics through them (Catmull and Rom 1974); the ends are held."""
    whole = np.floor(times).astype(int)
    t = (times - whole)[:, None]
    before, here, after, beyond = (x[np.clip(whole + n, 0, len(x) - 1)] for n in (-1, 0, 1, 2))
    slope, next_slope = (after - before) / 2, (beyond - here) / 2
    bend = 3 * (after - here) - 2 * slope - next_slope
    return here + t * (slope + t * (bend + t * (slope + next_slope - 2 * (after - here))))


def _other_names(name: str) -> list[str]:
    """What the same joint of the other side may be called."""
    found = []
    for pair in _SIDES:
        for mine, other in (pair, pair[::-1]):
            if len(mine) > 1 and mine in name:
                found.append(name.replace(mine, other))
            elif name.startswith(mine):
                found.append(other + name[len(mine) :])
            elif name.endswith(mine):
                found.append(name[: -len(mine)] + other)
    return found


def _other_ends(skeleton: Skeleton, partner: np.ndarray) -> list[int]:
    """For every end site that of the joint's partner, in their order on it."""
    places: dict[tuple[int, int], int] = {}
    keys = []
    for e, j in enumerate(skeleton.end_joints):
        keys.append((j, sum(k == j for k in skeleton.end_joints[:e])))
        places[keys[-1]] = e
    other = [(int(partner[j]), n) for j, n in keys]
    if set(other) != set(keys):
        raise ValueError("the two sides of the skeleton have different end sites")
    return [places[key] for key in other]


def _signs(axis: int) -> Float[np.ndarray, " 3"]:
    return np.where(np.arange(3) == axis, -1.0, 1.0)


def _channel_signs(channels: list[tuple[str, ...]], axis: int) -> Float[np.ndarray, "1 channels"]:
    names = [name for of_joint in channels for name in of_joint]
    return np.array([-1.0 if (name[0] == "XYZ"[axis]) == (name in POSITION_CHANNELS) else 1.0 for name in names])[None]
