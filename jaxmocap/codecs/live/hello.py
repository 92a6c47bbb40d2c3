"""What a receiver must know before it can read a packet: whose motion it is, by which model, in which step and axes.

Some eight bytes for a person of the model's corpus: the model, the step, the direction of the floor's axes, how many frames a
packet tells again, the skeleton, how fast frames come, and the unit.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from ...errors import CorruptStream, UnsupportedVersion
from ..bitstream import ByteReader
from ..container import DIGEST_BYTES
from ..learned.basis import DIRECTIONS
from ..learned.distortion import METRICS, Metric
from ..learned.steps import STEPS
from ..released import RELEASED
from .setting import FINENESS, OWN_RIG

VERSION = 1
_METRIC, _FRAME_TIME, _NUMBERED = 0x80, 0x40, 0x20
_UNIT_OF_MODEL, _UNIT_UNKNOWN, _UNIT_STATED = range(3)


@dataclass(frozen=True)
class Hello:
    """`frame_time` (s) and `unit_cm` are None where the model's own hold; a `unit_cm` of 0 says that nobody knows it."""

    metric: Metric
    setting_flags: int
    repeats: int
    digest: bytes
    step_index: int
    direction: int
    frame_time: float | None
    unit_cm: float | None
    skeleton: bytes

    def to_bytes(self) -> bytes:
        number = RELEASED.index(self.digest) if self.digest in RELEASED else None
        unit = _UNIT_OF_MODEL if self.unit_cm is None else _UNIT_UNKNOWN if self.unit_cm == 0 else _UNIT_STATED
        flags = _METRIC * METRICS.index(self.metric) | self.setting_flags
        flags |= _FRAME_TIME * (self.frame_time is not None) | _NUMBERED * (number is not None)
        out = bytes([VERSION << 4 | self.repeats << 2 | unit, flags]) + (self.digest if number is None else bytes([number]))
        out += (self.step_index * DIRECTIONS + self.direction).to_bytes(2, "big")
        out += struct.pack("<d", self.frame_time) if self.frame_time is not None else b""
        out += struct.pack("<d", self.unit_cm) if unit == _UNIT_STATED and self.unit_cm is not None else b""
        return out + self.skeleton

    @staticmethod
    def of_bytes(data: bytes) -> Hello:
        """Raises CorruptStream, TruncatedStream or UnsupportedVersion."""
        reader = ByteReader(data)
        first, flags = reader.byte(), reader.byte()
        if first >> 4 != VERSION or first & 3 > _UNIT_STATED:
            raise UnsupportedVersion(f"the packets are of version {first >> 4}, this jaxmocap reads {VERSION}: upgrade")
        if flags & _NUMBERED:
            number = reader.byte()
            if number >= len(RELEASED):
                raise UnsupportedVersion(f"the packets need released model {number}, which this jaxmocap lacks: upgrade")
            digest = RELEASED[number]
        else:
            digest = reader.take(DIGEST_BYTES)
        step_index, direction = divmod(int.from_bytes(reader.take(2), "big"), DIRECTIONS)
        frame_time = _positive(reader.float64()) if flags & _FRAME_TIME else None
        unit_cm = (None, 0.0)[first & 3] if first & 3 < _UNIT_STATED else _positive(reader.float64())
        if step_index >= STEPS:
            raise CorruptStream(f"the packets have the step {step_index}, wanted less than {STEPS}")
        kept = flags & (OWN_RIG | FINENESS)
        metric, repeats, skeleton = METRICS[flags >> 7], first >> 2 & 3, reader.take(reader.left)
        return Hello(metric, kept, repeats, digest, step_index, direction, frame_time, unit_cm, skeleton)


def _positive(value: float) -> float:
    if not 1e-9 < value < 1e9:
        raise CorruptStream(f"the packets give a frame time or a unit of {value}")
    return value
