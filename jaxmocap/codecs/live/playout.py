"""When a receiver shows a frame: as soon as its packet and all before it are there, and at its time without it.

The time of a frame goes by those packets that came soonest of late, so that it follows the sender's clock, not ours.
"""

from __future__ import annotations

from collections import deque

from ...errors import CorruptStream
from .packets import NUMBERS, unframed
from .stream import Decoder, Shown

_CLOCK = 128  # frames by which the clock goes
_AHEAD = 240  # frames: a packet further ahead is left to the decoder, to believe or not
_HELD = 16  # so many packets wait: what they wait for does not come
_LONGEST_SECONDS = 0.5  # concealed in a row; then the figure stands still, so that a sender that paused is soon followed


class Playout:
    """Every frame once, in order, from packets as they come. Times are in seconds, of any clock that never goes back."""

    def __init__(self, decoder: Decoder, delay: float | None):
        """A frame is concealed `delay` seconds behind its time; None waits for nothing: packets come in order here."""
        self._decoder, self._delay = decoder, delay
        self._next: int | None = None
        self._held: dict[int, bytes] = {}
        self._offsets: deque[float] = deque(maxlen=_CLOCK)
        self._concealed = 0

    @property
    def due(self) -> float | None:
        """When `elapsed` has something to do; None where only a packet changes anything."""
        if self._next is None or self._delay is None or not self._offsets or self._still:
            return None
        return min(self._offsets) + self._next * self._frame_time + self._delay

    def arrived(self, packet: bytes, now: float) -> list[Shown]:
        """The frames that a packet lets us show. Raises ModelMismatch or UnsupportedVersion as `Decoder.push` does."""
        number = self._number(packet)
        if number is None or self._next is None or not -_AHEAD <= number - self._next <= _AHEAD:
            shown = self._decoder.push(packet)
            return [] if shown is None else self._from(shown, now)
        if self._still:
            self._offsets.clear()  # who paused has another clock now
        if number <= self._next:
            self._offsets.append(now - number * self._frame_time)
        if number < self._next:
            self._decoder.push(packet)
            return []
        if number in self._held:
            self._decoder.tally.repeated += 1
            return []
        self._held[number] = packet
        found = self._ready()
        while self._held and (self._delay is None or len(self._held) >= _HELD or self._still and len(self._held) > 1):
            found += self._until(min(self._held))
        return found

    def elapsed(self, now: float) -> list[Shown]:
        """The frames whose time has come, concealed."""
        found = []
        while (due := self.due) is not None and due <= now and self._next is not None:
            found += self._until(self._next + 1)
        return found

    def finish(self, frames: int | None) -> list[Shown]:
        """All that is left of a stream of so many frames, modulo 4050, where that is known."""
        if self._next is None or frames is None:
            return []
        left = (frames - self._next) % NUMBERS
        return self._until(self._next + left) if left <= _AHEAD else []

    @property
    def _frame_time(self) -> float:
        return self._decoder.frame_time or 0.0

    @property
    def _still(self) -> bool:
        return self._concealed * self._frame_time >= _LONGEST_SECONDS

    def _number(self, packet: bytes) -> int | None:
        """Of the frame; None where the packet is damaged, or nothing was shown before it."""
        if self._next is None:
            return None
        try:
            short, _ = unframed(packet)
        except CorruptStream:
            return None
        return self._next + (short - self._next + NUMBERS // 2) % NUMBERS - NUMBERS // 2

    def _from(self, shown: Shown, now: float) -> list[Shown]:
        """Goes on behind a frame that the decoder took for the next one."""
        self._next, self._concealed = shown.number + 1, 0
        self._held.clear()
        self._offsets.clear()
        self._offsets.append(now - shown.number * self._frame_time)
        return [shown]

    def _ready(self) -> list[Shown]:
        """The frames whose packets are there without a gap."""
        found = []
        while self._next is not None and self._next in self._held:
            shown = self._decoder.push(self._held.pop(self._next))
            if shown is None:  # damaged, though its checksum is right: it may still come, or be concealed
                break
            found.append(shown)
            self._next, self._concealed = self._next + 1, 0
        return found

    def _until(self, number: int) -> list[Shown]:
        """All frames below this number, concealed where they are not there, and what is ready then."""
        found = self._ready()
        while self._next is not None and self._next < number:
            shown = self._decoder.conceal()
            if shown is not None:
                found.append(shown)
            self._next, self._concealed = self._next + 1, self._concealed + 1
            found += self._ready()
        return found
