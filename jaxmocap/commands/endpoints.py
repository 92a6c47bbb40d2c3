"""Where the bytes of a live stream come from and go to: files, pipes, TCP, and UDP."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from ..codecs.live.transport import (
    DatagramSink,
    DatagramSource,
    LengthSink,
    LengthSource,
    PacketSink,
    PacketSource,
    Source,
    close,
)
from ..errors import JaxmocapError

_PATIENCE_SECONDS = 5.0  # of who connects, while nobody listens yet
_RECEIVE_BYTES = 1 << 20


@dataclass(frozen=True)
class Address:
    """A file, a pipe, or an end of a connection: with no host it is the one that listens."""

    kind: Literal["file", "pipe", "tcp", "udp"]
    text: str
    host: str | None = None
    port: int = 0

    @staticmethod
    def parse(text: str) -> Address:
        """Of a path, "-", "tcp://host:port" or "udp://:port". Raises JaxmocapError for what is none of these."""
        if "://" not in text:
            return Address("pipe" if text == "-" else "file", text)
        try:
            parts = urlsplit(text)
            if parts.scheme in ("tcp", "udp") and parts.port is not None and not parts.path:
                return Address("tcp" if parts.scheme == "tcp" else "udp", text, parts.hostname, parts.port)
        except ValueError:
            pass
        raise JaxmocapError(f"{text} is no address: wanted a file, -, tcp://host:port or udp://host:port, or no host to listen")


class PipeSink:
    """A pipe or a connection: what is gone is gone."""

    def __init__(self, file: int | socket.socket):
        self._file = file

    def write(self, data: bytes) -> None:
        if not isinstance(self._file, int):
            return self._file.sendall(data)
        while data:
            data = data[os.write(self._file, data) :]

    def patch(self, at: int, data: bytes) -> None:
        pass

    def close(self) -> None:
        close(self._file)


class FileSink:
    """A file, written beside and renamed when it is closed. Where nothing was written, or not all could be, it leaves none."""

    def __init__(self, path: Path):
        self._path, self._beside, self._whole = path, path.with_name(f".{path.name}.{os.getpid()}.part"), False
        try:
            self._file = self._beside.open("wb", buffering=0)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error

    def write(self, data: bytes) -> None:
        self._whole = False
        written = self._file.write(data)
        self._whole = written == len(data)
        if not self._whole:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))

    def patch(self, at: int, data: bytes) -> None:
        self._file.seek(at)
        self._file.write(data)

    def close(self) -> None:
        self._file.close()
        if self._whole:
            os.replace(self._beside, self._path)
        else:
            self._beside.unlink()


def open_source(address: Address) -> Source:
    """Raises JaxmocapError or OSError where nothing can be read there."""
    if address.kind == "udp":
        raise JaxmocapError(f"{address.text}: UDP is for packets; motion comes and goes by a file, a pipe, or TCP")
    if address.kind == "tcp":
        return Source(_connected(address))
    return Source(sys.stdin.fileno() if address.kind == "pipe" else os.open(address.text, os.O_RDONLY))


def open_sink(address: Address) -> PipeSink | FileSink:
    """Raises JaxmocapError or OSError where nothing can be written there."""
    if address.kind == "udp":
        raise JaxmocapError(f"{address.text}: UDP is for packets; motion comes and goes by a file, a pipe, or TCP")
    if address.kind == "tcp":
        return PipeSink(_connected(address))
    if address.kind == "pipe":
        return PipeSink(sys.stdout.fileno())
    path = Path(address.text)
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        return PipeSink(os.open(path, os.O_WRONLY))
    return FileSink(path)


def open_packet_source(address: Address) -> PacketSource:
    """Over UDP it is the receiver who listens."""
    if address.kind != "udp":
        return LengthSource(open_source(address))
    bound = _bound(address, socket.SOCK_DGRAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
    _announce(address, bound)
    return DatagramSource(bound)


def open_packet_sink(address: Address) -> PacketSink:
    """Over UDP it is the receiver who listens."""
    if address.kind != "udp":
        return LengthSink(open_sink(address))
    if address.host is None:
        raise JaxmocapError(f"{address.text} says nowhere to send to; over UDP it is the receiver who listens")
    with _named(address):
        family, *_, place = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)[0]
        sender = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sender.connect(place)
        except OSError:
            sender.close()
            raise
    return DatagramSink(sender)


def _connected(address: Address) -> socket.socket:
    """The one who connects may come a little before the one who listens."""
    if address.host is None:
        with _bound(address, socket.SOCK_STREAM) as listener:
            listener.listen(1)
            _announce(address, listener)
            return _prompt(listener.accept()[0])
    until = time.monotonic() + _PATIENCE_SECONDS
    while True:
        try:
            with _named(address):
                return _prompt(socket.create_connection((address.host, address.port)))
        except ConnectionRefusedError:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)


def _bound(address: Address, kind: socket.SocketKind) -> socket.socket:
    """Without a host, at all addresses of this machine."""
    both = address.host is None and socket.has_dualstack_ipv6()
    with _named(address):
        host = "::" if both else address.host
        family, *_, place = socket.getaddrinfo(host, address.port, type=kind, flags=socket.AI_PASSIVE)[0]
        bound = socket.socket(family, kind)
        try:
            if both:
                bound.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            if kind == socket.SOCK_STREAM:
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(place)
        except OSError:
            bound.close()
            raise
    return bound


def _announce(address: Address, bound: socket.socket) -> None:
    print(f"jaxmocap: listens at {address.kind} port {bound.getsockname()[1]}", file=sys.stderr, flush=True)


def _prompt(connected: socket.socket) -> socket.socket:
    """Sends what is small at once."""
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connected


@contextlib.contextmanager
def _named(address: Address) -> Iterator[None]:
    """Errors that say of which address they are."""
    try:
        yield
    except OSError as error:
        raise type(error)(error.errno, error.strerror, address.text) from error
