"""Local rotations turned back into the channel values of a skeleton: what every way back to a Motion ends with."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float

from .. import components as rot
from ..components import A
from ..skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton


def rotation_order(channels: tuple[str, ...]) -> str:
    """The axes of a joint's rotation channels, such as "ZYX"; empty where it has none."""
    return "".join(c[0] for c in channels if c in ROTATION_CHANNELS)


def has_euler_orders(skeleton: Skeleton) -> bool:
    """True when no joint has more than three rotation channels, nor the same axis twice in a row."""
    orders = [rotation_order(channels) for channels in skeleton.channels]
    return all(len(o) <= 3 and all(a != b for a, b in zip(o, o[1:], strict=False)) for o in orders)


def angles_of(rotation: Float[A, "3 3 ..."], order: str) -> Float[A, "channels ..."]:
    """Radians about the axes of a joint's channels, (channels, ...), of its rotation in the frame of those channels.

    Exact where `order` can make the rotation. What fewer than three channels cannot make is dropped: the one angle is
    that of the nearest rotation about its axis, and of two each is read where the other leaves no trace.
    """
    if len(order) == 3:
        return rot.to_euler(rotation, order)
    xp, r = rot.namespace(rotation), rotation
    if not order:
        return xp.zeros((0, *r.shape[2:]), r.dtype)
    i = "XYZ".index(order[0])
    if len(order) == 1:
        j, k = (i + 1) % 3, (i + 2) % 3
        return xp.arctan2(r[k, j] - r[j, k], r[j, j] + r[k, k])[None]
    j = "XYZ".index(order[1])
    k, sign = 3 - i - j, 1.0 if (j - i) % 3 == 1 else -1.0
    return xp.stack([xp.arctan2(sign * r[k, j], r[j, j]), xp.arctan2(sign * r[i, k], r[i, i])])


def values_of(
    skeleton: Skeleton,
    local: Float[A, "3 3 joints frames"],
    translations: Float[A, "3 joints frames"],
) -> Float[A, "frames channels"]:
    """Channel values (degrees, file units) in file order of local rotations and translations, components in front.

    `translations` is read only where a joint has position channels; a root's is its position. `has_euler_orders` must
    hold. Takes numpy arrays or JAX's.
    """
    xp = rot.namespace(local)
    if skeleton.has_axes:
        axes = xp.asarray(skeleton.axes, local.dtype).transpose(1, 2, 0)[..., None]
        local = rot.multiply(rot.multiply(rot.transpose(axes), local), axes)
    joints, frames = translations.shape[1:]
    orders, columns = _layout(skeleton.channels)
    parts = [translations.reshape(-1, frames)]
    for order, of_order in orders:  # one Euler conversion an order serves all joints that share it
        parts.append(xp.rad2deg(angles_of(local[:, :, of_order], order)).reshape(-1, frames))
    return xp.concatenate(parts)[columns].T


@functools.lru_cache(maxsize=64)
def _layout(channels: tuple[tuple[str, ...], ...]) -> tuple[list[tuple[str, np.ndarray]], np.ndarray]:
    """The joints of every rotation order; and of every channel its row, where all translations are followed by their angles."""
    joints = len(channels)
    orders = [rotation_order(c) for c in channels]
    rows, found = 3 * joints, []
    first_angle: dict[int, tuple[int, int]] = {}  # of every joint: the row of its first angle, and the step to the next
    for order in sorted(set(orders) - {""}):
        of_order = [j for j, o in enumerate(orders) if o == order]
        found.append((order, np.array(of_order)))
        first_angle |= {j: (rows + n, len(of_order)) for n, j in enumerate(of_order)}
        rows += len(order) * len(of_order)
    columns = []
    for j, of_joint in enumerate(channels):
        turns = 0
        for c in of_joint:
            if c in POSITION_CHANNELS:
                columns.append(POSITION_CHANNELS.index(c) * joints + j)
            else:
                row, step = first_angle[j]
                columns.append(row + turns * step)
                turns += 1
    return found, np.array(columns, int)
