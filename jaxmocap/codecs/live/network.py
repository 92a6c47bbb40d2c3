"""A network that loses, swaps, repeats and damages packets, from a seed: for tests, and to look at what a receiver sees."""

from __future__ import annotations

import random
from dataclasses import dataclass, field


@dataclass
class Network:
    """Chances are of each packet; one that is swapped comes behind the next, one that is damaged has a bit flipped."""

    seed: int
    loss: float = 0.0
    swap: float = 0.0
    repeat: float = 0.0
    damage: float = 0.0
    _held: list[bytes] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def carry(self, packet: bytes) -> list[bytes]:
        """What arrives when a packet is sent: none, one, or more."""
        if self._happens(self.loss):
            return []
        if packet and self._happens(self.damage):
            packet = self._flipped(packet)
        packets = [packet] * (2 if self._happens(self.repeat) else 1)
        if not self._held and self._happens(self.swap):
            self._held = packets
            return []
        return packets + self.rest()

    def rest(self) -> list[bytes]:
        """What was still under way."""
        held, self._held = self._held, []
        return held

    def _happens(self, chance: float) -> bool:
        return self._random.random() < chance

    def _flipped(self, packet: bytes) -> bytes:
        at = self._random.randrange(8 * len(packet))
        flipped = bytearray(packet)
        flipped[at // 8] ^= 1 << at % 8
        return bytes(flipped)
