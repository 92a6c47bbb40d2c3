"""The joints of a figure: names, tree, bone offsets, end sites and the channels that move them."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

POSITION_CHANNELS = ("Xposition", "Yposition", "Zposition")
ROTATION_CHANNELS = ("Xrotation", "Yrotation", "Zrotation")


class Skeleton(eqx.Module):
    """A forest of joints. Joints are known by their index: names may repeat.

    `parents[j] < j`, and -1 marks a root. `offsets[j]` leads from the parent of `j` to `j` in the parent's frame, in file
    units. `channels[j]` names what moves joint `j`, in the order of its columns; rotations multiply left to right, as
    in BVH, and a position channel replaces that component of the offset. `axes[j]` is the constant frame C in which the
    rotation channels of `j` are given, so that its local rotation is C R C^T (`axis` in ASF, the identity in
    BVH; `has_axes` says whether any is another).
    End site `e` sits on joint `end_joints[e]` at `end_offsets[e]`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    parents: tuple[int, ...] = eqx.field(static=True)
    channels: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    end_joints: tuple[int, ...] = eqx.field(static=True)
    offsets: Float[np.ndarray, "joints 3"]
    end_offsets: Float[np.ndarray, "ends 3"]
    axes: Float[np.ndarray, "joints 3 3"]
    has_axes: bool = eqx.field(static=True)

    def __init__(
        self,
        names: Sequence[str],
        parents: Sequence[int],
        offsets: Float[np.ndarray, "joints 3"],
        channels: Sequence[Sequence[str]],
        end_joints: Sequence[int] = (),
        end_offsets: Float[np.ndarray, "ends 3"] | None = None,
        axes: Float[np.ndarray, "joints 3 3"] | None = None,
    ):
        """Raises ValueError when the lengths disagree, a parent does not precede its child, or a channel is unknown."""
        self.names = tuple(names)
        self.parents = tuple(int(p) for p in parents)
        self.channels = tuple(tuple(c) for c in channels)
        self.end_joints = tuple(int(j) for j in end_joints)
        joints = len(self.names)
        self.offsets = np.asarray(offsets, np.float64).reshape(-1, 3)
        self.end_offsets = np.zeros((0, 3)) if end_offsets is None else np.asarray(end_offsets, np.float64).reshape(-1, 3)
        plain = np.tile(np.eye(3), (joints, 1, 1))
        self.axes = plain if axes is None else np.asarray(axes, np.float64).reshape(-1, 3, 3)
        self.has_axes = not np.array_equal(self.axes, plain)
        lengths = {len(self.parents), len(self.channels), len(self.offsets), len(self.axes)}
        if joints == 0 or lengths != {joints}:
            raise ValueError(f"names, parents, channels, offsets and axes must agree in length, got {joints} and {lengths}")
        for j, parent in enumerate(self.parents):
            if not -1 <= parent < j:
                raise ValueError(f"parents[{j}] = {parent}: a parent must precede its child, -1 marks a root")
        for j, channels_of_joint in enumerate(self.channels):
            unknown = set(channels_of_joint) - set(POSITION_CHANNELS) - set(ROTATION_CHANNELS)
            if unknown:
                raise ValueError(f"channels[{j}] has {sorted(unknown)}; wanted {POSITION_CHANNELS + ROTATION_CHANNELS}")
        if len(self.end_offsets) != len(self.end_joints) or any(not 0 <= j < joints for j in self.end_joints):
            raise ValueError("end_joints must be joint indices, one an end offset")

    @property
    def joint_count(self) -> int:
        return len(self.names)

    @property
    def channel_count(self) -> int:
        return sum(len(c) for c in self.channels)

    @property
    def roots(self) -> tuple[int, ...]:
        return tuple(j for j, parent in enumerate(self.parents) if parent < 0)

    @property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """`children[j]`: the joints whose parent is `j`, in order."""
        found: list[list[int]] = [[] for _ in self.names]
        for j, parent in enumerate(self.parents):
            if parent >= 0:
                found[parent].append(j)
        return tuple(tuple(c) for c in found)

    @property
    def first_column(self) -> tuple[int, ...]:
        """The column of each joint's first channel in a frame's values."""
        return tuple(np.cumsum([0] + [len(c) for c in self.channels])[:-1].tolist())

    @property
    def has_rotations(self) -> bool:
        return any(c in ROTATION_CHANNELS for channels in self.channels for c in channels)

    @property
    def is_rigid(self) -> bool:
        """True when only roots carry position channels, so that bones keep their lengths."""
        return not any(
            c in POSITION_CHANNELS for j, cs in enumerate(self.channels) if self.parents[j] >= 0 for c in cs
        )

    def same_rig(self, other: Skeleton) -> bool:
        """True when names, tree, channels and end sites agree: the same rig, whatever the person's bone lengths."""
        mine = (self.names, self.parents, self.channels, self.end_joints)
        theirs = (other.names, other.parents, other.channels, other.end_joints)
        return mine == theirs and bool(np.array_equal(self.axes, other.axes))

    def height(self) -> float:
        """The largest extent of the rest pose along one axis, in file units: how large the figure is.

        Every tree is measured from its own root, since roots stand where the motion puts them.
        """
        rest = np.zeros((self.joint_count, 3))
        for j, parent in enumerate(self.parents):
            rest[j] = self.offsets[j] + rest[parent] if parent >= 0 else 0.0
        points = np.concatenate([rest, self.end_offsets + rest[list(self.end_joints)]])
        return float(np.max(points.max(0) - points.min(0)))
