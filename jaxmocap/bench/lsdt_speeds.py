"""How long a frame takes in `live`, encoded and decoded in one process, and how many streams that leaves room for."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..codecs.live.stream import Decoder, Encoder
from ..motion import Motion

WANTED_CM = 0.5
_WARM_FRAMES = 130  # within which a receiver shows frames, and a sender has measured what they look like once
Clock = Callable[[], float]


class Stream:
    """One sender and its receiver, who go over a motion again and again, from some frame on."""

    def __init__(self, motion: Motion, first: int, repeats: int):
        values = np.asarray(motion.values)
        self._frames = itertools.cycle(np.roll(values, -first, axis=0))
        of_motion = motion.skeleton, motion.frame_time, motion.unit_cm
        self._encoder, self._decoder = Encoder(*of_motion, "error", WANTED_CM, "joints", repeats), Decoder()
        for _ in range(_WARM_FRAMES):
            self.step()

    def step(self) -> None:
        """A frame there and back."""
        self._decoder.push(self._encoder.push(next(self._frames)))


class Times(NamedTuple):
    """Of frames, in ms."""

    median_ms: float
    p99_ms: float
    max_ms: float

    @staticmethod
    def of(seconds: Float[np.ndarray, " frames"]) -> Times:
        ms = 1000 * seconds
        return Times(float(np.median(ms)), float(np.quantile(ms, 0.99)), float(ms.max()))


def a_frame(motion: Motion, repeats: int) -> dict[str, dict[str, float]]:
    """Encode plus decode of one frame, after warm-up: by the clock on the wall, and by that of the processor."""
    stream = Stream(motion, 0, repeats)
    taken = []
    for _ in range(motion.frame_count):
        began = time.perf_counter(), time.process_time()
        stream.step()
        taken.append((time.perf_counter() - began[0], time.process_time() - began[1]))
    wall, processor = np.array(taken).T
    return {"wall": Times.of(wall)._asdict(), "processor": Times.of(processor)._asdict()}


def streams_held(motion: Motion, repeats: int, clock: Clock = time.process_time) -> int:
    """How many streams, encoded and decoded in turn, one core holds for a second of motion without falling behind.

    By processor time: what else runs on this machine does not count.
    """
    streams: list[Stream] = []

    def holds(count: int) -> bool:
        streams.extend(Stream(motion, 37 * n, repeats) for n in range(len(streams), count))
        return keeps_up(streams[:count], motion.frame_time, clock)

    low, high = 0, 1
    while holds(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def keeps_up(streams: list[Stream], frame_time: float, clock: Clock) -> bool:
    """Whether every frame of a second is through before the next second's first comes; frames come at their times."""
    frames = round(1 / frame_time)
    busy_until = 0.0
    for n in range(frames):
        began = clock()
        for stream in streams:
            stream.step()
        busy_until = max(busy_until, n * frame_time) + clock() - began
    return busy_until <= frames * frame_time


def measure(motion: Motion, repeats: tuple[int, ...]) -> list[dict]:
    """A row for each number of repeats."""
    return [
        {
            "repeats": n,
            "wanted_cm": WANTED_CM,
            "frames": motion.frame_count,
            "a_frame": a_frame(motion, n),
            "streams": streams_held(motion, n),
        }
        for n in repeats
    ]
