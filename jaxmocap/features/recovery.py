"""Rotations recovered from joint positions alone, by closed fits down the tree.

Where a joint holds several bones their common rotation is fitted (Kabsch 1976); where it holds one, the smallest swing
from the expected pose turns that bone; a leaf keeps its expected rotation, and with it the twist that no position shows.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import components as rot
from ..rotations import from_euler, to_euler
from ..skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton


def recoverable(skeleton: Skeleton) -> bool:
    """True when positions determine channels: roots move freely, bones are rigid, and rotations have an Euler order."""
    roots_move = all(set(POSITION_CHANNELS) <= set(skeleton.channels[r]) for r in skeleton.roots)
    orders = [_order(channels) for channels in skeleton.channels]
    return skeleton.is_rigid and roots_move and all(len(o) <= 3 and _neighbours_differ(o) for o in orders)


class Recovered(NamedTuple):
    """Channel values (degrees, file units), and where they put the joints (file units)."""

    values: Float[Array, "frames channels"]
    positions: Float[Array, "frames joints 3"]


def recover(
    skeleton: Skeleton,
    positions: Float[Array, "frames joints 3"],
    expected: Float[np.ndarray, "joints 3 3"] | None = None,
) -> Recovered:
    """The channel values whose forward kinematics comes closest to the global `positions` (file units).

    `expected` holds the local rotation that each joint is assumed to have where positions leave it open: the mean pose,
    or the rest pose where it is None. Exact where the positions come from this skeleton. Raises ValueError where
    `recoverable` says no.
    """
    if not recoverable(skeleton):
        raise ValueError("this skeleton's channels cannot be recovered from positions; see recoverable()")
    if expected is None:
        expected = np.tile(np.eye(3), (skeleton.joint_count, 1, 1))
    levels, kabsch = _plan(skeleton, np.asarray(expected, np.float64))
    return Recovered(*_recover(skeleton, levels, kabsch, positions))


class _Level(NamedTuple):
    """One depth of the tree, padded to the widest; the arrays of all levels are stacked for the scan."""

    joint: np.ndarray  # slots: joints, then the world, then a slot for padding
    parent: np.ndarray
    offset: np.ndarray
    expected: np.ndarray
    target: np.ndarray  # the far end of the one bone that the joint turns
    place: np.ndarray  # of the target in the joint's frame; zero where nothing swings
    fitted: np.ndarray  # True where Kabsch has settled the rotation
    free: np.ndarray  # number of rotation channels
    turn: np.ndarray  # the frame whose x, y axes are the joint's first two channel axes


class _Kabsch(NamedTuple):
    joints: tuple[int, ...]
    targets: np.ndarray  # (joints, bones), padded with weight 0
    places: np.ndarray


def _plan(skeleton: Skeleton, expected: np.ndarray) -> tuple[_Level, _Kabsch]:
    joints = skeleton.joint_count
    targets = [_targets(skeleton, j, expected) for j in range(joints)]
    several = tuple(j for j, t in enumerate(targets) if np.linalg.matrix_rank(np.array([p for _, p in t] or [[0.0] * 3]), 1e-6) > 1)
    depth = [0] * joints
    for j, parent in enumerate(skeleton.parents):
        depth[j] = 0 if parent < 0 else depth[parent] + 1
    rows = [[j for j in range(joints) if depth[j] == d] for d in range(max(depth) + 1)]
    width = max(len(r) for r in rows)

    def lane(j: int | None) -> _Level:
        none = np.zeros(3)
        if j is None:
            return _Level(*map(np.asarray, (joints + 1, joints, none, np.eye(3), 0, none, False, 3, np.eye(3))))
        parent = skeleton.parents[j]
        target, place = max(targets[j], key=lambda t: float((t[1] ** 2).sum()), default=(0, none))
        offset = skeleton.offsets[j] if parent >= 0 else none
        order = _order(skeleton.channels[j])
        return _Level(*map(np.asarray, (
            j, parent if parent >= 0 else joints, offset, expected[j], target, place, j in several, len(order),
            _channel_frame(order) @ skeleton.axes[j].T,
        )))

    lanes = [[lane(j) for j in row] + [lane(None)] * (width - len(row)) for row in rows]
    levels = _Level(*(np.array([[lane[field] for lane in row] for row in lanes]) for field in range(len(_Level._fields))))
    bones = max((len(targets[j]) for j in several), default=1)
    at = np.zeros((len(several), bones), np.int32)
    places = np.zeros((len(several), bones, 3))
    for n, j in enumerate(several):
        for b, (t, place) in enumerate(targets[j]):
            at[n, b], places[n, b] = t, place
    return levels, _Kabsch(several, at, places)


def _targets(skeleton: Skeleton, joint: int, expected: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The joints at the far ends of the bones that `joint` turns, and their places in its frame.

    Children on top of their parent are looked through: their bones start at the same point.
    """
    found: list[tuple[int, np.ndarray]] = []
    ahead = [(c, np.eye(3)) for c in skeleton.children[joint]]
    for child, frame in ahead:
        if np.any(skeleton.offsets[child] != 0):
            found.append((child, frame @ skeleton.offsets[child]))
        else:
            ahead += [(c, frame @ expected[child]) for c in skeleton.children[child]]
    return found


# Inside, components and joints lead and frames trail, (3, 3, joints, frames): see components.py.


@eqx.filter_jit
def _recover(skeleton: Skeleton, levels: _Level, kabsch: _Kabsch, positions: Array) -> tuple[Array, Array]:
    joints, dtype = skeleton.joint_count, positions.dtype
    seen = jnp.transpose(positions, (2, 1, 0))
    world = rot.identity((joints + 2, seen.shape[2]), dtype)
    if kabsch.joints:
        at = np.array(kabsch.joints)
        world = world.at[:, :, at].set(_fit(seen[:, kabsch.targets] - seen[:, at][:, :, None], kabsch.places))
    placed = jnp.concatenate([seen, jnp.zeros_like(seen[:, :2])], 1)
    limited = any(len(_order(c)) < 3 for c in skeleton.channels)

    def descend(state, level):
        world, placed = state
        up = world[:, :, level.parent]
        root = (level.parent == joints)[:, None]
        here = placed[:, level.parent] + rot.apply(up, level.offset.T[:, :, None])
        here = jnp.where(root, placed[:, level.joint], here)
        predicted = rot.multiply(up, level.expected.transpose(1, 2, 0)[..., None])
        bone = rot.apply(predicted, level.place.T[:, :, None])
        swung = rot.multiply(rot.swing(bone, seen[:, level.target] - here), predicted)
        still = (jnp.abs(level.place).sum(-1) == 0)[:, None]
        turned = jnp.where(still, predicted, swung)
        turned = jnp.where(level.fitted[:, None], world[:, :, level.joint], turned)
        if limited:
            turned = rot.multiply(up, _allowed(rot.multiply(rot.transpose(up), turned), level.free, level.turn))
        return (world.at[:, :, level.joint].set(turned), placed.at[:, level.joint].set(here)), None

    levels = jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, levels)
    (world, placed), _ = jax.lax.scan(descend, (world, placed), levels)
    above = np.where(np.array(skeleton.parents) < 0, joints, skeleton.parents)
    local = rot.multiply(rot.transpose(world[:, :, above]), world[:, :, :joints])
    if skeleton.has_axes:
        axes = jnp.asarray(skeleton.axes, dtype).transpose(1, 2, 0)[..., None]
        local = rot.multiply(rot.multiply(rot.transpose(axes), local), axes)
    return _values(skeleton, local, seen), jnp.transpose(placed[:, :joints], (2, 1, 0))


def _fit(seen: Float[Array, "3 joints bones frames"], places: np.ndarray) -> Float[Array, "3 3 joints frames"]:
    """The rotation that brings all bones of a joint nearest to where their ends were seen (Kabsch)."""
    m = jnp.einsum("ijbf,jbk->jfik", seen, jnp.asarray(places, seen.dtype))
    u, _, vt = jnp.linalg.svd(m, full_matrices=False)
    mirror = jnp.sign(jnp.linalg.det(u @ vt))
    scale = jnp.stack([jnp.ones_like(mirror), jnp.ones_like(mirror), mirror], -1)
    return rot.first((u * scale[..., None, :]) @ vt, 2)


def _allowed(local: Float[Array, "3 3 lanes frames"], free: Array, turn: Array) -> Float[Array, "3 3 lanes frames"]:
    """The part of each local rotation that a joint with fewer than three rotation channels can make."""
    turn = turn.transpose(1, 2, 0)[..., None]
    m = rot.multiply(rot.multiply(turn, local), rot.transpose(turn))
    alone = jnp.arctan2(m[2, 1] - m[1, 2], m[1, 1] + m[2, 2])
    two = to_euler(rot.last(m, 2), "XYZ")
    zero = jnp.zeros_like(alone)
    count = free[:, None]
    x = jnp.where(count == 0, zero, jnp.where(count == 1, alone, two[..., 0]))
    y = jnp.where(count == 2, two[..., 1], zero)
    made = rot.first(from_euler(jnp.stack([x, y], -1), "XY"), 2)
    kept = rot.multiply(rot.multiply(rot.transpose(turn), made), turn)
    return jnp.where(count == 3, local, kept)


def _values(skeleton: Skeleton, local: Float[Array, "3 3 joints frames"], seen: Float[Array, "3 joints frames"]) -> Array:
    """Channel columns in file order. One Euler conversion an order serves all joints that share it."""
    orders = [_order(c) for c in skeleton.channels]
    angles: dict[int, Array] = {}
    for order in sorted(set(orders) - {""}):
        of_order = [j for j, o in enumerate(orders) if o == order]
        # Channels that a joint lacks are zero in its rotation by now, so any completing axis will do.
        rest = "".join(a for a in "XYZ" if a not in order)
        converted = jnp.rad2deg(to_euler(rot.last(local[:, :, np.array(of_order)], 2), (order + rest)[:3]))
        angles |= {j: converted[n] for n, j in enumerate(of_order)}
    columns = []
    for j, channels in enumerate(skeleton.channels):
        turns = iter(range(3))
        for c in channels:
            is_position = c in POSITION_CHANNELS
            columns.append(seen[POSITION_CHANNELS.index(c), j] if is_position else angles[j][:, next(turns)])
    return jnp.stack(columns, -1)


def _order(channels: tuple[str, ...]) -> str:
    return "".join(c[0] for c in channels if c in ROTATION_CHANNELS)


def _neighbours_differ(order: str) -> bool:
    return all(a != b for a, b in zip(order, order[1:], strict=False))


def _channel_frame(order: str) -> np.ndarray:
    """Rows: the axes of the first two channels, and their cross product; any axes complete a shorter order."""
    axes = (order + "".join(a for a in "XYZ" if a not in order))[:2]
    x, y = np.eye(3)["XYZ".index(axes[0])], np.eye(3)["XYZ".index(axes[1])]
    return np.stack([x, y, np.cross(x, y)])
