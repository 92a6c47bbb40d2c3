"""Rotations recovered from joint positions alone, by closed fits down the tree.

Where a joint holds several bones their common rotation is fitted (Kabsch 1976); where it holds one, the smallest
swing from the expected pose turns that bone; a leaf keeps its expected rotation, and with it the twist that no position
shows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .. import components as rot
from ..skeleton import POSITION_CHANNELS, Skeleton
from .channels import angles_of, has_euler_orders, rotation_order, values_of


def recoverable(skeleton: Skeleton) -> bool:
    """True when positions determine channels: bones are rigid, roots move, and joints that turn bones turn freely."""
    roots_move = all(set(POSITION_CHANNELS) <= set(skeleton.channels[r]) for r in skeleton.roots)
    turning = [len(rotation_order(skeleton.channels[j])) for j, children in enumerate(skeleton.children) if children]
    return skeleton.is_rigid and roots_move and all(n == 3 for n in turning) and has_euler_orders(skeleton)


def freed(skeleton: Skeleton) -> Skeleton:
    """The same bones with three rotation channels on every joint, and position channels on the roots.

    What BVH conversions of ASF do: a hinge would ask its parent for just the right twist, which positions with an
    error no longer give.
    """
    turns = ("Zrotation", "Yrotation", "Xrotation")
    channels = [POSITION_CHANNELS + turns if parent < 0 else turns for parent in skeleton.parents]
    s = skeleton
    return Skeleton(s.names, s.parents, s.offsets, channels, s.end_joints, s.end_offsets)


class Recovered(NamedTuple):
    """Channel values (degrees, file units), and where they put the joints (file units)."""

    values: Float[np.ndarray, "frames channels"]
    positions: Float[np.ndarray, "frames joints 3"]


def recover(
    skeleton: Skeleton,
    positions: Float[np.ndarray, "frames joints 3"],
    expected: Float[np.ndarray, "joints 3 3"] | None = None,
) -> Recovered:
    """The channel values whose forward kinematics comes closest to the global `positions` (file units).

    `expected` holds the local rotation that each joint is assumed to have where positions leave it open: the mean pose,
    or the rest pose where it is None. Exact where the positions come from this skeleton. Works on the host, in the
    dtype of the positions: a decoder would spend longer compiling it than running it. Raises ValueError where
    `recoverable` says no.
    """
    if not recoverable(skeleton):
        raise ValueError("this skeleton's channels cannot be recovered from positions; see recoverable()")
    seen = np.ascontiguousarray(np.asarray(positions).transpose(2, 1, 0))
    joints, frames = seen.shape[1:]
    assumed = np.tile(np.eye(3), (joints, 1, 1)) if expected is None else np.asarray(expected)
    world = np.empty((3, 3, joints + 1, frames), seen.dtype)
    world[:, :, -1] = rot.identity((frames,), seen)  # the parent of the roots
    placed = np.empty_like(seen)
    children = skeleton.children
    local = np.empty_like(world[:, :, :joints])
    for j, parent in enumerate(skeleton.parents):
        above = world[:, :, parent]
        offset = skeleton.offsets[j, :, None].astype(seen.dtype)
        placed[:, j] = seen[:, j] if parent < 0 else placed[:, parent] + rot.apply(above, offset)
        predicted = rot.multiply(above, assumed[j, :, :, None].astype(seen.dtype))
        bones = [(place, seen[:, t] - placed[:, j]) for t, place in _targets(skeleton, children, j, assumed)]
        turned = _turn(predicted, bones)
        local[:, :, j] = _allowed(skeleton, j, rot.multiply(rot.transpose(above), turned))
        world[:, :, j] = rot.multiply(above, local[:, :, j])
    return Recovered(np.asarray(values_of(skeleton, local, seen)), placed.transpose(2, 1, 0))


def _targets(
    skeleton: Skeleton, children: tuple[tuple[int, ...], ...], joint: int, assumed: np.ndarray
) -> list[tuple[int, np.ndarray]]:
    """The joints at the far ends of the bones that `joint` turns, and their places in its frame.

    Children on top of their parent are looked through: their bones start at the same point.
    """
    found: list[tuple[int, np.ndarray]] = []
    ahead = [(c, np.eye(3)) for c in children[joint]]
    for child, frame in ahead:
        if np.any(skeleton.offsets[child] != 0):
            found.append((child, frame @ skeleton.offsets[child]))
        else:
            ahead += [(c, frame @ assumed[child]) for c in children[child]]
    return found


# Inside, components lead and frames trail, (3, 3, frames): see components.py.


def _turn(predicted: np.ndarray, bones: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The global rotation that brings the bones, given by place and by where their ends were seen, nearest to those."""
    if not bones:
        return predicted
    places = np.stack([place for place, _ in bones])
    if np.linalg.matrix_rank(places, tol=1e-6 * np.abs(places).max()) > 1:
        return _kabsch(places, np.stack([end for _, end in bones]))
    longest = int(np.argmax((places**2).sum(1)))
    bone = rot.apply(predicted, places[longest, :, None].astype(predicted.dtype))
    return rot.multiply(rot.swing(bone, bones[longest][1]), predicted)


def _kabsch(places: Float[np.ndarray, "bones 3"], seen: Float[np.ndarray, "bones 3 frames"]) -> np.ndarray:
    """The rotation that brings all bones of a joint nearest to where their ends were seen."""
    u, _, vt = np.linalg.svd(np.einsum("bif,bk->fik", seen, places.astype(seen.dtype)))
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return rot.first(u @ vt, 2)


def _allowed(skeleton: Skeleton, joint: int, local: np.ndarray) -> np.ndarray:
    """The part of a local rotation that the joint's channels can make: all of it with three rotation channels."""
    order = rotation_order(skeleton.channels[joint])
    if len(order) == 3:
        return local
    axes = skeleton.axes[joint, :, :, None].astype(local.dtype)
    own = rot.multiply(rot.multiply(rot.transpose(axes), local), axes)
    return rot.multiply(rot.multiply(axes, rot.from_euler(angles_of(own, order), order)), rot.transpose(axes))
