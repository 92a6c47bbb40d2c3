"""The index of a motion database: what is known of every file without reading it."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..squeeze import expand, squeeze

FOLDER, BLOB, NUMBERS = 0, 1, 2  # kinds; a template's number is added to the last
KINDS = ("folder", "blob", "numbers")
EXECUTABLE, READ_ONLY = 1, 2  # modes

_CHECKS = struct.Struct("<II")
_DRIVE = re.compile(r"[A-Za-z]:")


@dataclass(frozen=True)
class Entry:
    """A file. `checksum` is the CRC-32 of its name and its bytes, `record_checksum` that of its record.

    The record is a layout of `layout_stored` bytes that expand to `layout_size`, and `payload` bytes more: the codec's, or
    the file's own. What is stored in as many bytes as it has was not compressed.
    """

    name: str
    kind: int
    mode: int
    size: int
    checksum: int
    layout_size: int = 0
    layout_stored: int = 0
    payload: int = 0
    record_checksum: int = 0

    @property
    def stored(self) -> int:
        """Bytes of the record."""
        return self.layout_stored + self.payload

    @property
    def template(self) -> int:
        return self.kind - NUMBERS


def checksum(name: str, data: bytes) -> int:
    """That of a file: its name is in it, so that no damage gives one file's bytes to another."""
    return zlib.crc32(data, zlib.crc32(encoded(name)))


def encoded(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


def shown(name: str) -> str:
    """The name for a message, which may have to go where bytes that are no UTF-8 cannot."""
    return encoded(name).decode("utf-8", "backslashreplace")


def check_name(name: str) -> None:
    """Raises ValueError for what is no relative path with slashes, or means something else on another system."""
    parts = name.split("/")
    if not name or any(part in ("", ".", "..") for part in parts) or _DRIVE.match(name) or "\\" in name or "\0" in name:
        raise ValueError(f"{name!r} is no path inside a folder: wanted one such as 09/09_01.bvh, without '..', ':' or '\\'")


def pack_entries(entries: Sequence[Entry]) -> bytes:
    """The bytes of an index: checksums as they are, and all else, column by column, compressed."""
    columns = zip(*((e.kind, e.mode, e.size, e.layout_size, e.layout_stored, e.payload) for e in entries), strict=True)
    index = b"".join(encoded(e.name) + b"\0" for e in entries)
    index += b"".join(varint(value) for column in columns for value in column)
    checks = b"".join(_CHECKS.pack(e.checksum, e.record_checksum) for e in entries)
    return varint(len(entries)) + checks + varint(len(index)) + squeeze(index)


def unpack_entries(reader: ByteReader) -> tuple[Entry, ...]:
    """The files of an index that is all the rest. Raises CorruptStream or TruncatedStream."""
    checks = list(_CHECKS.iter_unpack(reader.take(reader.varint() * _CHECKS.size)))
    size = reader.varint()
    index = ByteReader(expand(reader.take(reader.left), size))
    names = index.data.split(b"\0", len(checks))[: len(checks)]
    index.take(sum(len(name) + 1 for name in names))
    if any(a >= b for a, b in zip(names, names[1:], strict=False)):
        raise CorruptStream("the names in the archive are not in order")
    columns = [[index.varint() for _ in names] for _ in range(6)]
    return tuple(
        Entry(name.decode("utf-8", "surrogateescape"), kind, mode, length, whole, expanded, stored, payload, record)
        for name, kind, mode, length, expanded, stored, payload, (whole, record) in zip(names, *columns, checks, strict=True)
    )
