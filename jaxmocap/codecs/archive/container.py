"""The bytes of a motion database (docs/format.md, 6): a head, a section that all files need, and a record a file.

A damaged record spoils its own file. What all need is mended where a single byte of it is damaged: its checksum says
which one it was.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

from ...errors import CorruptStream, TruncatedStream, UnsupportedVersion
from ..bitstream import ByteReader, varint
from ..squeeze import expand, squeeze
from .crc import mended
from .index import BLOB, NUMBERS, Entry, encoded, pack_entries, shown, unpack_entries

MAGIC = b"JMD"
VERSION = 1

_HEAD = struct.Struct("<3sBIIII")  # magic, version, size, CRC-32 and Adler-32 of the section, CRC-32 of what is before
HEAD_BYTES = _HEAD.size


@dataclass(frozen=True)
class Shared:
    """What numbers need: their codec's id, its model or the first bytes of that one's digest, and its own bytes."""

    codec: str = ""
    model: bytes = b""
    tables: bytes = b""


@dataclass(frozen=True, eq=False)
class Archive:
    """An archive whose section is whole; each record is verified as it is taken. `notices` say what was mended."""

    shared: Shared
    entries: tuple[Entry, ...]
    starts: tuple[int, ...]
    data: bytes = field(repr=False)
    packed_templates: bytes
    templates_size: int
    notices: tuple[str, ...] = ()

    def templates(self, dictionary: bytes = b"") -> list[bytes]:
        """The templates of motion texts. Raises CorruptStream or TruncatedStream."""
        reader = ByteReader(expand(self.packed_templates, self.templates_size, dictionary))
        found = []
        while reader.left:
            found.append(reader.take(reader.varint()))
        if any(entry.template >= len(found) for entry in self.entries):
            raise CorruptStream("a file of the archive has a template that is not there")
        return found

    def record(self, index: int) -> tuple[bytes, bytes]:
        """Layout and payload of a file, the layout expanded. Raises CorruptStream or TruncatedStream, with its name."""
        entry, start = self.entries[index], self.starts[index]
        record = self.data[start : start + entry.stored]
        if len(record) < entry.stored:
            raise TruncatedStream(f"{shown(entry.name)}: the archive ends at byte {len(self.data)}, before this file does")
        if zlib.crc32(record) != entry.record_checksum:
            raise CorruptStream(f"{shown(entry.name)}: its bytes (from {start} on) do not match their checksum")
        layout = _expanded(record[: entry.layout_stored], entry.layout_size)
        return layout, record[entry.layout_stored :]

    def section_bytes(self) -> dict[str, int]:
        """Where the bytes go: they sum to the size of the archive."""
        found = {
            "model": len(self.shared.model),
            "shared": len(self.shared.tables),
            "templates": len(self.packed_templates),
            "layouts": sum(e.layout_stored for e in self.entries),
            "numbers": sum(e.payload for e in self.entries if e.kind >= NUMBERS),
            "blobs": sum(e.payload for e in self.entries if e.kind == BLOB),
        }
        return {"index": len(self.data) - sum(found.values()), **found}


@dataclass(frozen=True)
class Record:
    """A file to be written: `layout` and `payload` of numbers, or the bytes of the file as `payload` alone."""

    name: str
    kind: int
    mode: int
    size: int
    checksum: int
    layout: bytes = b""
    payload: bytes = b""


def write_archive(shared: Shared, templates: Sequence[bytes], records: Sequence[Record], dictionary: bytes = b"") -> bytes:
    """The bytes of an archive; equal arguments give equal bytes. `dictionary` is text that its texts may refer to."""
    records = sorted(records, key=lambda record: encoded(record.name))
    entries, bodies = [], []
    for r in records:
        layout = _squeezed(r.layout)
        payload = _squeezed(r.payload, dictionary) if r.kind == BLOB else r.payload
        bodies.append(layout + payload)
        sizes = (len(r.layout), len(layout), len(payload), zlib.crc32(layout + payload))
        entries.append(Entry(r.name, r.kind, r.mode, r.size, r.checksum, *sizes))
    section = _write_section(shared, templates, entries, dictionary)
    head = _HEAD.pack(MAGIC, VERSION, len(section), zlib.crc32(section), zlib.adler32(section), 0)[:-4]
    return b"".join([head, struct.pack("<I", zlib.crc32(head)), section, *bodies])


def blob(entry: Entry, payload: bytes, dictionary: bytes = b"") -> bytes:
    """The bytes of a file that was stored as it is. Raises CorruptStream."""
    return _expanded(payload, entry.size, dictionary)


def is_archive(head: bytes) -> bool:
    """True for the first HEAD_BYTES of an archive, even with one of them damaged."""
    try:
        _read_head(head, [])
    except UnsupportedVersion:
        return True
    except CorruptStream:
        return head[: len(MAGIC)] == MAGIC
    return True


def read_archive(data: bytes) -> Archive:
    """An archive with all of its lengths checked; a single damaged byte in what all files need is mended.

    Raises CorruptStream, TruncatedStream or UnsupportedVersion.
    """
    notices: list[str] = []
    size, section_checksum, adler = _read_head(data[:HEAD_BYTES], notices)
    section = data[HEAD_BYTES : HEAD_BYTES + size]
    if len(section) < size:
        raise TruncatedStream(f"the archive ends at byte {len(data)}; its index reaches to byte {HEAD_BYTES + size}")
    if zlib.crc32(section) != section_checksum:
        ways = (way for way in mended(section, section_checksum) if zlib.adler32(way) == adler)
        found = next(ways, None)
        if found is None:
            raise CorruptStream("the index of the archive is damaged in several places: fetch the archive again")
        at = next(n for n, (a, b) in enumerate(zip(found, section, strict=True)) if a != b)
        notices.append(f"byte {HEAD_BYTES + at}, in the index, was damaged and has been mended")
        section = found
    reader = ByteReader(section)
    codec = reader.take(reader.varint()).decode("ascii", "replace")
    shared = Shared(codec, reader.take(reader.varint()), reader.take(reader.varint()))
    templates_size, templates = reader.varint(), reader.take(reader.varint())
    entries = unpack_entries(reader)
    starts = [HEAD_BYTES + size, *(HEAD_BYTES + size + end for end in accumulate(entry.stored for entry in entries))]
    if starts[-1] < len(data):
        notices.append(f"{len(data) - starts[-1]} bytes follow the archive")
    return Archive(shared, entries, tuple(starts[:-1]), data, templates, templates_size, tuple(notices))


def _read_head(head: bytes, notices: list[str]) -> tuple[int, int, int]:
    if len(head) < HEAD_BYTES:
        if head[:3] != MAGIC[: len(head)]:
            raise CorruptStream("this is no jaxmocap database: it does not begin with 'JMD'")
        raise TruncatedStream(f"the archive ends at byte {len(head)}, in its head of {HEAD_BYTES} bytes")
    body, stored = head[:-4], _HEAD.unpack(head)[5]
    mark = (zlib.crc32(body) ^ stored).to_bytes(4, "little")
    if any(mark) and mark.count(0) < 3:
        body = next((way for way in mended(body, stored) if way[:3] == MAGIC), b"")
        if not body:
            raise CorruptStream("this is no jaxmocap database, or its first bytes are damaged: it does not begin with 'JMD'")
    if any(mark):
        notices.append(f"a byte of the first {HEAD_BYTES} was damaged and has been mended")
    magic, version, size, section_checksum, adler, _ = _HEAD.unpack(body + bytes(4))
    if magic != MAGIC:
        raise CorruptStream("this is no jaxmocap database: it does not begin with 'JMD'")
    if version != VERSION:
        raise UnsupportedVersion(f"the archive has format {version}, this jaxmocap reads {VERSION}: upgrade")
    return size, section_checksum, adler


def _write_section(shared: Shared, templates: Sequence[bytes], entries: Sequence[Entry], dictionary: bytes) -> bytes:
    texts = b"".join(varint(len(text)) + text for text in templates)
    packed = squeeze(texts, dictionary) if texts else b""
    return b"".join([
        *(varint(len(part)) + part for part in (shared.codec.encode(), shared.model, shared.tables)),
        varint(len(texts)) + varint(len(packed)) + packed,
        pack_entries(entries),
    ])


def _squeezed(data: bytes, dictionary: bytes = b"") -> bytes:
    """The data compressed, or as it is where that is no larger."""
    packed = squeeze(data, dictionary)
    return packed if len(packed) < len(data) else data


def _expanded(data: bytes, size: int, dictionary: bytes = b"") -> bytes:
    return data if len(data) == size else expand(data, size, dictionary)
