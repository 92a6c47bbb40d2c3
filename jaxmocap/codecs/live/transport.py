"""Packets into bytes, and back: behind their lengths in files, pipes and TCP, and as datagrams over UDP.

The end of a stream over UDP is said by datagrams of two bytes, which no packet has.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from typing import Protocol

from ...errors import CorruptStream, TruncatedStream
from ..bitstream import ByteReader, varint
from .packets import FRAMING_BYTES, MOST_BYTES, NUMBERS

_BLOCK = 1 << 16
_END = 0xE000
_END_SECONDS = 0.01
_ENDS = 5  # as any of them may be lost; two must arrive, so that no stray datagram ends a stream


class StreamEnd(Exception):
    """No packet follows; `frames` is how many there were, modulo 4050, where that was said."""

    def __init__(self, frames: int | None = None):
        super().__init__("the stream has ended")
        self.frames = frames


class Source:
    """Bytes that come in parts."""

    def __init__(self, file: int | socket.socket):
        self._file = file

    def read(self, timeout: float) -> bytes | None:
        """What has come; None where that is nothing in `timeout` seconds, and no bytes at the end."""
        if not select.select([self._file], [], [], max(timeout, 0.0))[0]:
            return None
        return os.read(self._file, _BLOCK) if isinstance(self._file, int) else self._file.recv(_BLOCK)

    def close(self) -> None:
        close(self._file)


class Sink(Protocol):
    """Where bytes go."""

    def write(self, data: bytes) -> None:
        """All of them, now. Raises ConnectionError where the reader has gone away."""
        ...

    def close(self) -> None: ...


class PacketSink(Protocol):
    """Where packets go; `size` is the number of bytes that they took, with their lengths where these are sent."""

    size: int

    def send(self, packet: bytes) -> None:
        """Now. Raises ConnectionError where the reader has gone away."""
        ...

    def close(self) -> None:
        """Says that these were all, and closes."""
        ...


class LengthSink:
    """Packets into bytes, each behind its length."""

    def __init__(self, sink: Sink):
        self.size, self._sink = 0, sink

    def send(self, packet: bytes) -> None:
        data = varint(len(packet)) + packet
        self._sink.write(data)
        self.size += len(data)

    def close(self) -> None:
        self._sink.close()


class DatagramSink:
    """Packets as datagrams; whether anybody listens, nobody knows."""

    def __init__(self, socket_: socket.socket):
        self.size, self._socket, self._frames = 0, socket_, 0

    def send(self, packet: bytes) -> None:
        self._send(packet)
        self.size += len(packet)
        self._frames += 1

    def close(self) -> None:
        for _ in range(_ENDS if self._frames else 0):
            time.sleep(_END_SECONDS)
            self._send((_END | self._frames % NUMBERS).to_bytes(2, "big"))
        self._socket.close()

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(ConnectionRefusedError):  # somebody may listen later
            self._socket.send(data)


class PacketSource(Protocol):
    """Where packets come from."""

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None where none has come in `timeout` seconds.

        Raises StreamEnd at the end, TruncatedStream where that is within a packet, and CorruptStream for what are no packets.
        """
        ...

    def close(self) -> None: ...


class LengthSource:
    """Packets out of bytes, each behind its length."""

    def __init__(self, source: Source):
        self._source, self._waiting = source, b""

    def receive(self, timeout: float) -> bytes | None:
        until = time.monotonic() + timeout
        while (packet := self._whole()) is None:
            data = self._source.read(until - time.monotonic())
            if data is None:
                return None
            if not data:
                raise TruncatedStream("the stream ends within a packet") if self._waiting else StreamEnd
            self._waiting += data
        return packet

    def close(self) -> None:
        self._source.close()

    def _whole(self) -> bytes | None:
        """The first packet, if all of it is there."""
        reader = ByteReader(self._waiting)
        try:
            size = reader.varint()
            if not FRAMING_BYTES <= size <= MOST_BYTES:
                raise CorruptStream(f"a packet of {size} bytes is none of a live stream")
            packet = reader.take(size)
        except TruncatedStream:
            return None
        self._waiting = self._waiting[reader.at :]
        return packet


class DatagramSource:
    """Packets as datagrams."""

    def __init__(self, socket_: socket.socket):
        self._socket, self._ended = socket_, -1

    def receive(self, timeout: float) -> bytes | None:
        if not select.select([self._socket], [], [], max(timeout, 0.0))[0]:
            return None
        with contextlib.suppress(ConnectionRefusedError):
            packet = self._socket.recv(_BLOCK)
            if len(packet) != 2:
                return packet
            said = int.from_bytes(packet, "big")
            if said == self._ended:
                raise StreamEnd(said - _END)
            self._ended = said if 0 <= said - _END < NUMBERS else -1
        return None

    def close(self) -> None:
        self._socket.close()


def close(file: int | socket.socket) -> None:
    os.close(file) if isinstance(file, int) else file.close()
