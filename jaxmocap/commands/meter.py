"""The numbers of a live stream while it runs: one line on stderr, written anew every second."""

from __future__ import annotations

import sys
import time
from collections import deque

import numpy as np

_EVERY_SECONDS = 1.0
_KEPT = 1 << 17  # times of frames, for the totals
_ANEW = "\r\x1b[K"


class Meter:
    """Frames, packets, and how long frames took. On a terminal its line is overwritten; elsewhere it comes once, at the end."""

    def __init__(self) -> None:
        self.frames = self.packets = self.packet_bytes = 0
        self.frame_time: float | None = None
        self.losses: dict[str, int] = {}
        self._times: deque[float] = deque(maxlen=_KEPT)
        self._began = self._shown = time.monotonic()
        self._last = 0, 0, 0  # packets, their bytes, and frames, when the line was last written
        self._terminal = sys.stderr.isatty()

    def packet(self, size: int) -> None:
        self.packets += 1
        self.packet_bytes += size

    def took(self, seconds: float, frames: int = 1) -> None:
        """So many frames, done in so many seconds."""
        self.frames += frames
        self._times.extend([seconds / frames] * frames)

    def look(self) -> None:
        """Writes the line, if it is time."""
        now = time.monotonic()
        if self._terminal and now - self._shown >= _EVERY_SECONDS:
            print(_ANEW + self._line(), end="", file=sys.stderr, flush=True)
            self._shown, self._last = now, (self.packets, self.packet_bytes, self.frames)

    def end(self) -> None:
        """Writes the line of all that was."""
        self._last = 0, 0, 0
        print((_ANEW if self._terminal else "") + self._line(), file=sys.stderr, flush=True)

    def totals(self) -> dict[str, object]:
        median, most = self._milliseconds(0)
        return {
            "frames": self.frames,
            "seconds": time.monotonic() - self._began,
            "packet_bytes": self.packet_bytes,
            "kbit_s": self._kbit_s(0, 0),
            "ms_median": median,
            "ms_99th": most,
            **self.losses,
        }

    def _line(self) -> str:
        """Of what was since the last one."""
        packets, size, frames = self._last
        median, most = self._milliseconds(frames)
        kbit_s = self._kbit_s(packets, size)
        rate = "" if kbit_s is None else f", {kbit_s:.1f} kbit/s"
        times = "" if median is None else f", {median:.2f} ms a frame (99th percentile {most:.2f})"
        return f"{self.frames:,} frames{rate}{times}" + "".join(f", {count} {name}" for name, count in self.losses.items())

    def _milliseconds(self, since: int) -> tuple[float | None, float | None]:
        """Median and 99th percentile of the frames after so many."""
        times = list(self._times)[-(self.frames - since) :] if self.frames > since else []
        if not times:
            return None, None
        median, most = np.percentile(1000 * np.array(times), (50, 99))
        return float(median), float(most)

    def _kbit_s(self, packets: int, size: int) -> float | None:
        """Of the packets after so many, framing included, at the motion's own pace."""
        if not self.frame_time or self.packets == packets:
            return None
        return 8e-3 * (self.packet_bytes - size) / ((self.packets - packets) * self.frame_time)
