"""Compact virtual markers: joint positions and a few points beside them, from which all rotations come back.

I-C. Lin, J-Y. Peng, C-C. Lin, M-H. Tsai: Adaptive motion data representation with repeated motion analysis. IEEE TVCG
17(4), 2011, section 3 and Fig. 2(b). Ours: joints on top of one another share a marker, joints that do not turn get
none beyond their position, and b and c stand at one distance, `arm`, along the bone and across it.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import components as rot
from ..kinematics import pose
from ..motion import Motion
from ..rotations import apply, from_sixd, multiply, transpose
from ..skeleton import POSITION_CHANNELS, Skeleton
from .base import AbstractFeature
from .channels import has_euler_orders, rotation_order


class Layout(NamedTuple):
    """Which markers there are: first one a place of joints, then the points b and c of the joints that turn."""

    of_joint: Int[np.ndarray, " joints"]  # the marker where each joint is
    first_joint: Int[np.ndarray, " places"]  # the first joint at each place
    beside: Int[np.ndarray, " beside"]  # the joint that each further marker is fixed to
    offset: Float[np.ndarray, "beside 3"]  # and where in its frame, in file units
    turning: Int[np.ndarray, " turning"]  # the joints with rotations of their own
    along: Int[np.ndarray, " turning"]  # the marker a' or b
    across: Int[np.ndarray, " turning"]  # the marker c
    rest: Float[np.ndarray, "turning 3 3"]  # the frame that a, a' (or b) and c span where the rotation is the identity
    carrier: Int[np.ndarray, " joints"]  # which turning joint turns each joint's frame; their number means none does

    @property
    def marker_count(self) -> int:
        return len(self.first_joint) + len(self.beside)


def layout(skeleton: Skeleton, arm: float) -> Layout:
    """The compact set: a for every place of joints, c `arm` file units beside every joint that turns, and b where no
    child is fixed to it at half that distance or more."""
    of_joint, first_joint = _places(skeleton)
    turning = [j for j, channels in enumerate(skeleton.channels) if rotation_order(channels)]
    carrier = _carriers(skeleton, turning)
    beside: list[int] = []
    offset: list[np.ndarray] = []
    along: list[int] = []
    across: list[int] = []
    rest: list[np.ndarray] = []

    def add(joint: int, place: np.ndarray) -> int:
        beside.append(joint)
        offset.append(place)
        return len(first_joint) + len(beside) - 1

    for j in turning:
        child, bone = _longest_bone(skeleton, j)
        length = float(np.linalg.norm(bone))
        x = bone / length if length > 0 else _end_direction(skeleton, j)
        across_bone = np.eye(3)[np.abs(x).argmin()]
        z = across_bone - (across_bone @ x) * x
        z /= np.linalg.norm(z)
        along.append(int(of_joint[child]) if length >= arm / 2 else add(j, arm * x))
        across.append(add(j, arm * z))
        rest.append(np.stack([x, z, np.cross(x, z)], -1))
    return Layout(
        of_joint, np.array(first_joint), np.array(beside, int), np.reshape(offset, (-1, 3)), np.array(turning, int),
        np.array(along, int), np.array(across, int), np.reshape(rest, (-1, 3, 3)), carrier,
    )


def _places(skeleton: Skeleton) -> tuple[np.ndarray, list[int]]:
    of_joint, first_joint = np.zeros(skeleton.joint_count, int), []
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0 and not _slides(skeleton, j) and not np.any(skeleton.offsets[j]):
            of_joint[j] = of_joint[parent]
        else:
            of_joint[j] = len(first_joint)
            first_joint.append(j)
    return of_joint, first_joint


def _carriers(skeleton: Skeleton, turning: list[int]) -> np.ndarray:
    carrier = np.full(skeleton.joint_count, len(turning))
    for j, parent in enumerate(skeleton.parents):
        if j in turning:
            carrier[j] = turning.index(j)
        elif parent >= 0:
            carrier[j] = carrier[parent]
    return carrier


def _longest_bone(skeleton: Skeleton, joint: int) -> tuple[int, np.ndarray]:
    """The farthest joint that is fixed in the frame of `joint`, and its place there; joints that do not turn are
    looked through."""
    ahead = [(joint, np.zeros(3))]
    for at, place in ahead:
        if at == joint or not rotation_order(skeleton.channels[at]):
            ahead += [(c, place + skeleton.offsets[c]) for c in skeleton.children[at] if not _slides(skeleton, c)]
    return max(ahead, key=lambda bone: float((bone[1] ** 2).sum()))


def _end_direction(skeleton: Skeleton, joint: int) -> np.ndarray:
    ends = [o for j, o in zip(skeleton.end_joints, skeleton.end_offsets, strict=True) if j == joint and np.any(o)]
    return ends[0] / np.linalg.norm(ends[0]) if ends else np.array([1.0, 0.0, 0.0])


def _slides(skeleton: Skeleton, joint: int) -> bool:
    return any(c in POSITION_CHANNELS for c in skeleton.channels[joint])


@eqx.filter_jit
def place_markers(
    of: Layout, positions: Float[Array, "frames joints 3"], rotations: Float[Array, "frames joints 3 3"]
) -> Float[Array, "frames markers 3"]:
    """The markers of global positions and rotations, in the unit of the positions, which is the file's."""
    offset = jnp.broadcast_to(jnp.asarray(of.offset, positions.dtype), (len(positions), *of.offset.shape))
    beside = positions[:, of.beside] + apply(rotations[:, of.beside], offset)
    return jnp.concatenate([positions[:, of.first_joint], beside], 1)


@eqx.filter_jit
def read_markers(
    of: Layout, markers: Float[Array, "frames markers 3"]
) -> tuple[Float[Array, "frames joints 3"], Float[Array, "frames joints 3 3"]]:
    """Global positions and rotations of markers, noisy ones too: the bone's direction is kept, c gives the twist."""
    positions = markers[:, of.of_joint]
    a = positions[:, of.turning]
    seen = from_sixd(jnp.concatenate([markers[:, of.along] - a, markers[:, of.across] - a], -1))
    turned = multiply(seen, transpose(jnp.asarray(of.rest, seen.dtype))[None])
    still = jnp.broadcast_to(jnp.eye(3, dtype=seen.dtype), (len(seen), 1, 3, 3))
    return positions, jnp.concatenate([turned, still], 1)[:, of.carrier]


class Markers(AbstractFeature):
    """Virtual markers, x y z of the first one first, in cm (in file units where the unit is unknown)."""

    skeleton: Skeleton
    frame_time: float = eqx.field(static=True)
    unit_cm: float | None = eqx.field(static=True)
    layout: Layout

    @staticmethod
    def of(motion: Motion, arm: float | None = None) -> Markers:
        """`arm` is in file units, a tenth of the figure's height where it is None. The longer it is, the more an error
        in a rotation weighs against one in a position.

        Raises ValueError where a joint's rotations have no Euler order, or `arm` is not above 0.
        """
        skeleton = motion.skeleton
        if not has_euler_orders(skeleton):
            raise ValueError("a joint has more than three rotation channels, or one axis twice in a row")
        arm = (skeleton.height() / 10 or 1.0) if arm is None else arm
        if not arm > 0:
            raise ValueError(f"arm is {arm}, wanted file units above 0")
        return Markers(skeleton, motion.frame_time, motion.unit_cm, layout(skeleton, arm))

    def to_matrix(self, motion: Motion) -> Float[Array, "frames channels"]:
        self.check(motion)
        p = pose(motion)
        return place_markers(self.layout, p.positions, p.rotations).reshape(motion.frame_count, -1) * self.scale

    def to_motion(self, matrix: Float[Array, "frames channels"]) -> Motion:
        """Raises ValueError where the matrix has not three columns a marker."""
        columns = 3 * self.layout.marker_count
        if matrix.shape[1:] != (columns,):
            raise ValueError(f"matrix has shape {matrix.shape}, wanted (frames, {columns})")
        markers = jnp.reshape(matrix, (len(matrix), -1, 3)) / self.scale
        seen = read_markers(self.layout, markers)
        positions, rotations = (np.asarray(x).transpose(*range(2, x.ndim), 1, 0) for x in seen)
        is_root, parent = np.array(self.skeleton.parents) < 0, np.array(self.skeleton.parents)
        up = np.where(is_root[:, None], rot.identity(rotations.shape[2:], rotations), rotations[:, :, parent])
        bones = positions - np.where(is_root[:, None], 0.0, positions[:, parent]).astype(positions.dtype)
        return self.motion(rot.multiply(rot.transpose(up), rotations), rot.apply(rot.transpose(up), bones))
