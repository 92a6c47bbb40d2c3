"""Joint positions through compressors of arrays, as well as these can be used: joints that coincide once, all but the root
relative to it, and every m-th frame with a cubic spline between them where that takes fewer bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

from ..errors import JaxmocapError
from ..skeleton import POSITION_CHANNELS, Skeleton

Channels = Float[np.ndarray, "channels knots"]
Positions = Float[np.ndarray, "frames joints 3"]
ALL_FRAMES = (1,)
THINNED = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24, 32)
_ROOT_WEIGHT = 4.0  # its error is every joint's: of 1, 2, 3, 4 and 6 the best for SZ3 and for xz
_HEAD = struct.Struct("<IB")  # frames, every
_TRIALS, _CLOSE = 12, 0.99


@dataclass(frozen=True)
class ArrayCoder:
    """Ways to compress channels to within a bound, all undone by `decompress(data, (channels, knots))`."""

    ways: tuple[Callable[[Channels, float], bytes], ...]
    decompress: Callable[[bytes, tuple[int, int]], Channels]


def encode(
    positions: Positions, skeleton: Skeleton, coder: ArrayCoder, mean_cm: float, everies: Sequence[int] = THINNED
) -> bytes:
    """The smallest stream found whose mean joint error is at most `mean_cm`. Raises JaxmocapError where none is."""
    place = _places(skeleton)
    kept = positions[:, np.unique(place, return_index=True)[1]]
    found: list[bytes] = []
    for every in everies:
        if every > 1 and every >= len(positions):
            break
        floor = _error(_between(kept[_knots(len(kept), every)], len(kept), every)[:, place], positions)
        if floor >= mean_cm:
            continue
        channels = _to_channels(kept[_knots(len(kept), every)])
        head = _HEAD.pack(len(positions), every)
        for way in coder.ways:

            def trial(bound: float, way=way, channels=channels, head=head) -> tuple[bytes, float]:
                data = head + way(channels, bound)
                return data, _error(decode(data, skeleton, coder), positions)

            found += _coarsest(trial, mean_cm, floor)
    if not found:
        raise JaxmocapError(f"a mean error of {mean_cm:g} cm is out of reach")
    return min(found, key=len)


def decode(data: bytes, skeleton: Skeleton, coder: ArrayCoder) -> Positions:
    """The positions of a stream, in cm; which joints coincide is known from the skeleton."""
    frames, every = _HEAD.unpack_from(data)
    place = _places(skeleton)
    shape = (3 * (int(place.max()) + 1), len(_knots(frames, every)))
    return _between(_from_channels(coder.decompress(data[_HEAD.size :], shape)), frames, every)[:, place]


def _places(skeleton: Skeleton) -> Int[np.ndarray, "joints"]:
    """Numbers of the places that joints are at: a bone without length, and without position channels, leads nowhere."""
    place: list[int] = []
    for parent, offset, channels in zip(skeleton.parents, skeleton.offsets, skeleton.channels, strict=True):
        stays = parent >= 0 and not np.any(offset) and not set(channels) & set(POSITION_CHANNELS)
        place.append(place[parent] if stays else max(place, default=-1) + 1)
    return np.array(place)


def _knots(frames: int, every: int) -> Int[np.ndarray, "knots"]:
    """Every so many frames, and the last."""
    return np.append(np.arange(0, frames - 1, every), frames - 1)


def _between(at_knots: Positions, frames: int, every: int) -> Positions:
    return at_knots if every == 1 else CubicSpline(_knots(frames, every), at_knots)(np.arange(frames))


def _to_channels(positions: Positions) -> Channels:
    """x of all joints, then y, then z: more even from row to row than joint by joint."""
    root = positions[:, :1]
    return np.concatenate([root * _ROOT_WEIGHT, positions[:, 1:] - root], 1).transpose(2, 1, 0).reshape(-1, len(positions))


def _from_channels(channels: Channels) -> Positions:
    relative = channels.reshape(3, -1, channels.shape[1]).transpose(2, 1, 0)
    root = relative[:, :1] / _ROOT_WEIGHT
    return np.concatenate([root, relative[:, 1:] + root], 1)


def _error(decoded: Positions, positions: Positions) -> float:
    return float(np.linalg.norm(decoded - positions, axis=-1).mean())


def _coarsest(trial: Callable[[float], tuple[bytes, float]], mean_cm: float, floor: float) -> list[bytes]:
    """Streams that meet a mean error, for ever better bounds; `floor` is the error that no bound takes away."""
    low, high, bound = 0.0, math.inf, mean_cm
    found = []
    for _ in range(_TRIALS):
        data, error = trial(bound)
        if error <= mean_cm:
            low = bound
            found.append(data)
            if error > _CLOSE * mean_cm:
                break
        else:
            high = bound
        ours = max(error**2 - floor**2, (mean_cm**2 - floor**2) / 64)  # errors of knots and between them add as squares
        aim = bound * math.sqrt((mean_cm**2 - floor**2) / ours) * (1 + _CLOSE) / 2
        bound = aim if low < aim < high else math.sqrt(low * high) if low else high / 2
    return found
