"""Figures 8 and 9 of Hou et al. 2016 as players: what two methods leave of a clip at the same ratio, joint by joint."""

from __future__ import annotations

import base64
from collections.abc import Iterator

import numpy as np

from ..codecs import Target, decode
from ..errors import JaxmocapError
from ..kinematics import positions_cm
from ..metrics import compare
from ..motion import Motion
from ..viewer import motion_player
from .lsdt_methods import CLIP_BASED, FRAME_BASED, Method

PAIRS = {"fig8": ("lsdt-frame", "dct-frame"), "fig9": ("lsdt-clip runs L=240", "mdtt")}
MEAN_CM = 1.0
_TRIES, _CLOSE = 10, 0.99
_HEAT = 0.995  # the share of joints and frames whose error lies within the colour scale


def measure(motion: Motion) -> dict[str, dict]:
    """Of each figure, by method: the stream (base64), its bytes and ratio, and its errors; in cm, also joint by joint."""
    methods = FRAME_BASED | CLIP_BASED
    found: dict[str, dict] = {}
    for figure, (ours, rival) in PAIRS.items():
        data = methods[ours].codec(Target("mean", MEAN_CM)).encode(motion)
        streams = {ours: data, rival: of_size(methods[rival], motion, len(data))}
        found[figure] = {name: _row(motion, stream) for name, stream in streams.items()}
    return found


def of_size(method: Method, motion: Motion, size: int) -> bytes:
    """The largest stream of at most so many bytes that a search of the error finds. Raises JaxmocapError where none is."""
    best, low, high, cm = b"", 0.0, np.inf, 2 * MEAN_CM
    for _ in range(_TRIES):
        data = method.codec(Target("mean", cm)).encode(motion)
        if len(data) > size:
            low = cm
        else:
            high = cm
            best = max(best, data, key=len)
            if len(data) >= _CLOSE * size:
                break
        cm = float(np.sqrt(low * high)) if 0 < low and high < np.inf else 2 * low if low else high / 2
    if not best:
        raise JaxmocapError(f"{method.config['codec']} has no stream of at most {size} bytes for this motion")
    return best


def _row(motion: Motion, data: bytes) -> dict:
    errors = compare(motion, decode(data))
    return {
        "bytes": len(data),
        "ratio": motion.frame_count * motion.skeleton.joint_count * 12 / len(data),
        **{name: errors[name] for name in ("mean_cm", "max_cm", "per_joint_cm")},
        "stream": base64.b64encode(data).decode("ascii"),
    }


def pages(motion: Motion, found: dict[str, dict]) -> Iterator[tuple[str, str]]:
    """Names and texts of the HTML files: the clip beside what decodes, with its errors as heat, on one scale a figure."""
    for figure, rows in found.items():
        decoded = {name: decode(base64.b64decode(row["stream"])) for name, row in rows.items()}
        original = np.asarray(positions_cm(motion))
        errors = [np.linalg.norm(np.asarray(positions_cm(m)) - original, axis=-1) for m in decoded.values()]
        heat = float(np.quantile(errors, _HEAT))
        for name, row in rows.items():
            title = f"{name}, {row['ratio']:.0f}:1"
            text = motion_player(motion, decoded[name], ("original", title), heat)
            yield f"{figure}_{name.replace(' ', '_').replace('=', '')}.html", text
