"""A skeleton in centimetres, whatever its file counts in."""

from __future__ import annotations

from ...skeleton import Skeleton


def in_cm(skeleton: Skeleton, scale: float) -> Skeleton:
    """The skeleton with its bones in cm; `scale` is cm per file unit."""
    s = skeleton
    return Skeleton(s.names, s.parents, s.offsets * scale, s.channels, s.end_joints, s.end_offsets * scale, s.axes)
