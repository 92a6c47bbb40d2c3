"""One packet a frame: bytes with their framing for a mean error that the frames as shown have, beside the continuous file.

A receiver that joins in the middle has heard every component after REFRESH_FRAMES frames at the latest: all packets count,
and errors from that frame on, of all methods alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..codecs import Target, lsdt_frame, make
from ..codecs.live.packets import FRAMING_BYTES
from ..codecs.live.stream import Decoder, Encoder
from ..codecs.live.tracker import REFRESH_FRAMES
from ..errors import JaxmocapError
from ..metrics import compare
from ..motion import Motion

SHOWN_FROM = REFRESH_FRAMES
REPEATS = (0, 1)
_TRIES, _CLOSE, _STEP = 6, 0.99, 0.03


class Packets(NamedTuple):
    """Bytes of all packets of a clip, framing included, and the mean joint error in cm, where `asked` was asked for."""

    asked: float
    bytes: int
    mean_cm: float


Sender = Callable[[Motion, float], Packets]


def by_lsdt_frame(motion: Motion, cm: float) -> Packets:
    """Every frame rounded up to whole bytes. Step, bones and skeleton are not in the packets."""
    codec = make({"codec": "lsdt-frame", "target": Target("mean", cm)})
    data = codec.encode(motion)
    size = sum(len(packet) + FRAMING_BYTES for packet in lsdt_frame.packets(data))
    return Packets(cm, size, _error(motion, codec.decode(data)))


def by_live(repeats: int) -> Sender:
    """Packets that can be joined at any time, each of which tells the last `repeats` frames again."""

    def send(motion: Motion, cm: float) -> Packets:
        encoder = Encoder(motion.skeleton, motion.frame_time, motion.unit_cm, "error", cm, "joints", repeats)
        decoder = Decoder()
        size, shown = 0, []
        for values in np.asarray(motion.values):
            packet = encoder.push(values)
            size += len(packet)
            frame = decoder.push(packet)
            if frame is not None:
                shown.append(frame.values)
        if len(shown) < motion.frame_count - SHOWN_FROM or decoder.skeleton is None:
            raise JaxmocapError(f"only {len(shown)} of {motion.frame_count} frames were shown")
        late = np.zeros((motion.frame_count - len(shown), len(shown[0])))  # before anything is shown: not looked at
        decoded = Motion(decoder.skeleton, np.concatenate([late, shown]), motion.frame_time, decoder.unit_cm)
        return Packets(cm, size, _error(motion, decoded))

    return send


def _error(motion: Motion, decoded: Motion) -> float:
    error = compare(motion.frames(SHOWN_FROM), decoded.frames(SHOWN_FROM))["mean_cm"]
    assert isinstance(error, float)
    return error


def meeting(send: Sender, motion: Motion, cm: float) -> Packets:
    """The fewest bytes found whose error is at most `cm`. Raises JaxmocapError where none is.

    Steps are sixteenths of an octave, so that some errors that are asked for give the same packets.
    """
    best: Packets | None = None
    low, high, asked = 0.0, math.inf, cm
    for _ in range(_TRIES):
        sent = send(motion, asked)
        if sent.mean_cm <= cm:
            low, best = asked, sent if best is None else min(best, sent, key=lambda of: of.bytes)
        else:
            high = asked
        if high - low < _STEP * high or _CLOSE * cm <= sent.mean_cm <= cm:
            break
        aim = asked * cm / sent.mean_cm * (1 + _CLOSE) / 2
        aim = aim if sent.mean_cm <= cm else min(aim, asked * (1 - _STEP))
        asked = aim if low < aim < high else (low + high) / 2
    if best is None:
        raise JaxmocapError(f"no packets were found that keep a mean error of {cm:g} cm")
    return best


def rows(motions: Mapping[str, Motion], targets: Sequence[float]) -> dict[str, list[dict]]:
    """Of each method a row a target, which every clip meets by itself: bytes a packet, and ratio to float32 positions."""
    found: dict[str, list[dict]] = {"lsdt-frame": []} | {name_of(repeats): [] for repeats in REPEATS}
    for cm in targets:
        sent = {name: meeting(by_lsdt_frame, motion, cm) for name, motion in motions.items()}
        found["lsdt-frame"].append(_row(cm, motions, sent))
        sent = {name: meeting(by_live(REPEATS[0]), motion, cm) for name, motion in motions.items()}
        found[name_of(REPEATS[0])].append(_row(cm, motions, sent))
        for repeats in REPEATS[1:]:  # the same frames, told more often
            again = {name: by_live(repeats)(motion, sent[name].asked) for name, motion in motions.items()}
            found[name_of(repeats)].append(_row(cm, motions, again))
    return found


def name_of(repeats: int) -> str:
    return f"live, {repeats} repeats"


def _row(cm: float, motions: Mapping[str, Motion], sent: Mapping[str, Packets]) -> dict:
    clips = [
        {
            "clip": name,
            "frames": motion.frame_count,
            "bytes": sent[name].bytes,
            "bytes_a_packet": sent[name].bytes / motion.frame_count,
            "ratio": motion.frame_count * motion.skeleton.joint_count * 12 / sent[name].bytes,
            "asked_cm": sent[name].asked,
            "mean_cm": sent[name].mean_cm,
        }
        for name, motion in motions.items()
    ]
    frames, size = sum(c["frames"] for c in clips), sum(c["bytes"] for c in clips)
    counted = [c["frames"] - SHOWN_FROM for c in clips]
    return {
        "target_cm": cm,
        "bytes": size,
        "bytes_a_packet": size / frames,
        "ratio": sum(c["ratio"] * c["bytes"] for c in clips) / size,
        "mean_cm": float(np.average([c["mean_cm"] for c in clips], weights=counted)),
        "clips": clips,
    }
