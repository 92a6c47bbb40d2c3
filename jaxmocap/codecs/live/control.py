"""How fine a live stream is, frame by frame: towards an error or a rate that is asked for, on average over a second or two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from .packets import NO_OFFSET, OFFSETS

_MEMORY = 1 / 120
_STAY = 0.8  # a step of its own costs a packet some bits
_GAIN = 0.02  # quarter octaves a frame for an octave too much


@dataclass
class Control:
    """`of` is what `wanted` speaks of: "error" in cm, "rate" in bytes a packet, or "step", which stays. `offset` is that of the
    next frame's step."""

    of: Literal["error", "rate", "step"]
    wanted: float
    offset: int = NO_OFFSET
    _aim: float = float(NO_OFFSET)
    _average: float | None = None

    def saw(self, seen: float) -> None:
        """What the last frame's error in cm, or its packet's bytes, were."""
        if self.of == "step":
            return
        self._average = seen if self._average is None else self._average + _MEMORY * (seen - self._average)
        excess = math.log2(max(self._average, 1e-6) / self.wanted)
        finer = excess if self.of == "error" else -excess
        self._aim = min(max(self._aim - _GAIN * min(max(finer, -2.0), 2.0), 0.0), OFFSETS - 1.0)
        if abs(self._aim - self.offset) > _STAY:
            self.offset = round(self._aim)
