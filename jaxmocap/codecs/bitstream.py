"""Bytes and bits read with bounds: every length is checked against what is left before anything is allocated."""

from __future__ import annotations

import struct

from ..errors import CorruptStream, TruncatedStream


class ByteReader:
    """Walks through bytes; raises TruncatedStream when they end early."""

    def __init__(self, data: bytes):
        self.data = data
        self.at = 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, count: int) -> bytes:
        if count > self.left:
            raise TruncatedStream(f"the stream ends at byte {len(self.data)}; byte {self.at + count} was promised")
        self.at += count
        return self.data[self.at - count : self.at]

    def byte(self) -> int:
        return self.take(1)[0]

    def varint(self) -> int:
        """An unsigned integer, seven bits a byte, low bits first; at most 2^35 - 1, and never longer than needed."""
        value = 0
        for shift in range(0, 35, 7):
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                if byte == 0 and shift:
                    raise CorruptStream(f"byte {self.at - 1}: an integer is written longer than it needs")
                return value
        raise CorruptStream(f"byte {self.at - 1}: an integer runs over five bytes")

    def float64(self) -> float:
        return struct.unpack("<d", self.take(8))[0]


def varint(value: int) -> bytes:
    """The bytes that `ByteReader.varint` reads back."""
    if not 0 <= value < 1 << 35:
        raise ValueError(f"{value} does not fit a varint of 35 bits")
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


class BitWriter:
    """Collects bits, most significant first."""

    def __init__(self) -> None:
        self._bits: list[str] = []

    def write(self, value: int, count: int) -> None:
        """The `count` low bits of `value`."""
        if count:
            self._bits.append(format(value & ((1 << count) - 1), f"0{count}b"))

    def to_bytes(self) -> bytes:
        """All bits, filled up with zeros to a whole byte."""
        bits = "".join(self._bits)
        size = (len(bits) + 7) // 8
        return int(bits.ljust(8 * size, "0") or "0", 2).to_bytes(size, "big")


class BitReader:
    """Reads bits, most significant first; raises TruncatedStream past the last byte."""

    def __init__(self, data: bytes):
        self._bits = "".join(map(_BYTE_BITS.__getitem__, data))
        self.at = 0

    def read(self, count: int) -> int:
        if not count:
            return 0
        end = self.at + count
        if end > len(self._bits):
            raise TruncatedStream("a chunk's bits end early")
        value = int(self._bits[self.at : end], 2)
        self.at = end
        return value

    def peek(self, count: int) -> int:
        """The next bits, zeros past the end."""
        return int(self._bits[self.at : self.at + count].ljust(count, "0"), 2)

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self._bits):
            raise TruncatedStream("a chunk's bits end early")


_BYTE_BITS = [format(b, "08b") for b in range(256)]
