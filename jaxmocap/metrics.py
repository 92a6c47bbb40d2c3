"""Distortion where it is seen: distances between joints after forward kinematics, in centimetres."""

from __future__ import annotations

from jaxtyping import Array, Float

from .components import A, namespace
from .kinematics import Pose, forward
from .motion import Motion

SHELL_CM = 3.0


def joint_error(a: Float[A, "... joints 3"], b: Float[A, "... joints 3"]) -> Float[A, "... joints"]:
    """Euclidean distance of every joint in every frame."""
    d2 = ((a - b) ** 2).sum(-1)
    zero = d2 == 0  # the gradient of a square root at 0 is not finite
    xp = namespace(d2)
    return xp.where(zero, 0.0, xp.sqrt(xp.where(zero, 1.0, d2)))


def mean_error(a: Float[A, "... frames joints 3"], b: Float[A, "... frames joints 3"]) -> Float[A, "..."]:
    """Mean over joints and frames (Hou et al. 2016, eq. 12)."""
    error = joint_error(a, b)
    return namespace(error).mean(error, (-1, -2))


def max_error(a: Float[A, "... frames joints 3"], b: Float[A, "... frames joints 3"]) -> Float[A, "..."]:
    """The largest error of any joint in any frame."""
    error = joint_error(a, b)
    return namespace(error).max(error, (-1, -2))


def rms_error(a: Float[A, "... frames joints 3"], b: Float[A, "... frames joints 3"]) -> Float[A, "..."]:
    """Root of the mean squared joint error."""
    square = (joint_error(a, b) ** 2).mean((-1, -2))
    return namespace(square).sqrt(square)


def arms_error(a: Float[A, "... frames joints 3"], b: Float[A, "... frames joints 3"]) -> Float[A, "..."]:
    """Average over frames of the root mean square over joints (Gu et al. 2009, eq. 3)."""
    square = (joint_error(a, b) ** 2).mean(-1)
    return namespace(square).sqrt(square).mean(-1)


def shell_points(p: Pose, end_joints: tuple[int, ...], unit_cm: float) -> Float[Array, "... points 3"]:
    """Three points 3 cm from every joint and end site, one along each axis of its frame, in centimetres."""
    xp = namespace(p.positions)
    at = xp.concatenate([p.positions, p.ends], -2) * unit_cm
    frame = xp.concatenate([p.rotations, p.rotations[..., list(end_joints), :, :]], -3)
    points = at[..., None, :] + SHELL_CM * xp.swapaxes(frame, -1, -2)
    return points.reshape(*points.shape[:-3], -1, 3)


def compare(a: Motion, b: Motion) -> dict[str, float | list[float] | None]:
    """All measures of `b` against `a`, in cm (in file units where the unit of `a` is unknown).

    The shell measures are None where either motion holds no rotations. Raises ValueError when frames or joints differ.
    """
    if a.skeleton.joint_count != b.skeleton.joint_count:
        raise ValueError(f"the motions have {a.skeleton.joint_count} and {b.skeleton.joint_count} joints")
    if a.frame_count != b.frame_count:
        raise ValueError(f"the motions have {a.frame_count} and {b.frame_count} frames")
    pa, pb = (forward(m.skeleton, m.values) for m in (a, b))  # on the host, where nothing need be compiled
    x, y = pa.positions * a.scale, pb.positions * b.scale
    report: dict[str, float | list[float] | None] = {
        "mean_cm": float(mean_error(x, y)),
        "max_cm": float(max_error(x, y)),
        "rms_cm": float(rms_error(x, y)),
        "arms": float(arms_error(x, y)),
        "shell_mean_cm": None,
        "shell_max_cm": None,
        "per_joint_cm": [float(e) for e in joint_error(x, y).mean(0)],
    }
    same_ends = a.skeleton.end_joints == b.skeleton.end_joints
    if a.skeleton.has_rotations and b.skeleton.has_rotations and same_ends:
        u, v = shell_points(pa, a.skeleton.end_joints, a.scale), shell_points(pb, b.skeleton.end_joints, b.scale)
        report["shell_mean_cm"] = float(mean_error(u, v))
        report["shell_max_cm"] = float(max_error(u, v))
    return report
