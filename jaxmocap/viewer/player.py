"""Writes the player: fills the template `player.html` with positions, errors and titles."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from ..kinematics import positions_cm
from ..motion import Motion

CAMERA_SECONDS = 0.6
"""The camera follows the figure's centre averaged over this long, so that steps do not shake the picture."""


class Track(NamedTuple):
    """One figure in motion: global positions in cm, Y up. `parents[j]` is -1 for a root; all -1 draws dots only."""

    title: str
    positions: Float[np.ndarray, "frames joints 3"]
    parents: tuple[int, ...]
    names: tuple[str, ...]


def player_html(
    tracks: Sequence[Track], frame_time: float, unit: str = "cm", subtitle: str = "", heat: float | None = None
) -> str:
    """The page, whole, that plays one track, or two (original and decoded) with their distance joint by joint.

    `frame_time` is in seconds; `unit` names the unit of the positions; `heat` is the error at which the colour scale ends,
    by default the one that 99.5 % of joints and frames stay below. Errors are embedded as computed here from the
    positions as given; the positions that are drawn are rounded (see `_embed_positions`). Both figures are drawn with
    the tree and the names of the first. Raises ValueError unless there are one or two tracks, finite, with at least
    one frame and joint, and two agree in frames and joints.
    """
    _validate(tracks, frame_time)
    positions = [np.asarray(t.positions, np.float64) for t in tracks]
    first = positions[0]
    extent = float(np.median(np.ptp(first, axis=1).max(-1)))
    data = {
        "titles": [t.title for t in tracks],
        "subtitle": subtitle,
        "unit": unit,
        "frameTime": frame_time,
        "frames": len(first),
        "names": tracks[0].names,
        "parents": [int(p) for p in tracks[0].parents],
        "size": extent or float(np.ptp(first, axis=0).max()) or 1.0,
        # The 5th percentile of the lowest joint: a calibration pose that hangs below the floor does not move the floor.
        "ground": float(np.quantile(first[..., 1].min(-1), 0.05)),
        **_embed_positions(positions, max(1, round(CAMERA_SECONDS / frame_time))),
        "errors": _embed_errors(first, positions[1], heat) if len(tracks) == 2 else None,
    }
    # "<" is written as an escape, so that no title can close the script element that holds the data.
    fields = {
        "title": html.escape(" / ".join(t.title for t in tracks)),
        "data": json.dumps(data).replace("<", "\\u003c"),
    }
    template = resources.files("jaxmocap.viewer").joinpath("player.html").read_text("utf-8")
    return re.sub(r"\{\{(title|data)\}\}", lambda field: fields[field[1]], template)


def motion_player(
    a: Motion, b: Motion | None = None, titles: tuple[str, str] = ("original", "decoded"), heat: float | None = None
) -> str:
    """The page that plays motion `a`, beside `b` where given, drawn through forward kinematics; `heat` as in `player_html`.

    Lengths are in cm, or in file units where the unit of `a` is unknown. Raises ValueError as `player_html` does.
    """
    tracks = [
        Track(title, np.asarray(positions_cm(m), np.float64), m.skeleton.parents, m.skeleton.names)
        for title, m in zip(titles, (a, b), strict=True)
        if m is not None
    ]
    return player_html(tracks, a.frame_time, "units" if a.unit_cm is None else "cm", heat=heat)


def _validate(tracks: Sequence[Track], frame_time: float) -> None:
    if len(tracks) not in (1, 2):
        raise ValueError(f"got {len(tracks)} tracks, wanted one or two")
    if not 0 < frame_time < np.inf:
        raise ValueError(f"frame_time is {frame_time}, wanted seconds above 0")
    for t in tracks:
        shape = np.shape(t.positions)
        if len(shape) != 3 or shape[2] != 3 or 0 in shape:
            raise ValueError(f"positions of {t.title!r} have shape {shape}, wanted (frames, joints, 3), none of them 0")
        if not len(t.parents) == len(t.names) == shape[1]:
            raise ValueError(f"{t.title!r} has {len(t.parents)} parents and {len(t.names)} names for {shape[1]} joints")
        if any(not -1 <= parent < j for j, parent in enumerate(t.parents)):
            raise ValueError(f"parents of {t.title!r}: a parent must precede its child, -1 marks a root")
        if not np.isfinite(t.positions).all():
            raise ValueError(f"positions of {t.title!r} hold NaN or infinity")
    if len(tracks) == 2:
        a, b = tracks
        if np.shape(a.positions) != np.shape(b.positions):
            raise ValueError(
                f"the tracks have shapes {np.shape(a.positions)} and {np.shape(b.positions)}; "
                "wanted the same frames and joints"
            )


def _embed_positions(positions: list[Float[np.ndarray, "frames joints 3"]], smooth_frames: int) -> dict[str, object]:
    """Positions as int16 steps around the path of the camera, which is float32.

    A step is the largest distance from that path / 32767: about 0.005 cm for a person 180 cm tall, wherever they walk,
    some 50 times finer than a pixel.
    """
    path = uniform_filter1d(positions[0].mean(1), smooth_frames, axis=0, mode="nearest").astype("<f4")
    local = [p - path[:, None] for p in positions]
    step = max(float(np.abs(x).max()) for x in local) / 32767 or 1.0
    return {
        "path": _base64(path),
        "step": step,
        "positions": [_base64(np.rint(x / step).astype("<i2")) for x in local],
    }


def _embed_errors(
    a: Float[np.ndarray, "frames joints 3"], b: Float[np.ndarray, "frames joints 3"], heat: float | None
) -> dict[str, object]:
    """Distance of every joint, its mean and maximum a frame and overall, and where the colour scale ends at first."""
    error = np.linalg.norm(a - b, axis=-1)
    return {
        "joints": _base64(error.astype("<f4")),
        "mean": _base64(error.mean(1).astype("<f4")),
        "max": _base64(error.max(1).astype("<f4")),
        "meanOverall": float(error.mean()),
        "maxOverall": float(error.max()),
        # The percentile keeps a single jump from washing out the colours of everything else.
        "scale": heat or float(np.quantile(error, 0.995)) or float(error.max()) or 1.0,
    }


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
