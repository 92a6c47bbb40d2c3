"""Tables of one rig form a group; what names the groups, and the values that a coder of 24-bit numbers cannot hold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..lossless import NumberTable, by_rig
from .float_coding import LIMIT, Floats


@dataclass(frozen=True)
class Group:
    """The tables of one rig: their columns and decimals, their numbers in the database, and frames of each."""

    columns: tuple[str, ...]
    decimals: int
    numbers: tuple[int, ...]
    frames: tuple[int, ...]


EncodeGroup = Callable[[Group, Sequence[Floats]], tuple[bytes, list[bytes]]]
DecodeGroup = Callable[[Group, bytes, Callable[[int], bytes], Sequence[int]], dict[int, Floats]]


def encode(tables: Sequence[NumberTable], encode_group: EncodeGroup) -> tuple[bytes, list[bytes]]:
    """Groups the tables by columns and decimals, and has every group coded: its section and one payload a table."""
    numbers = by_rig(tables)
    shared = [varint(len(numbers))]
    payloads = [b""] * len(tables)
    for (columns, decimals), members in numbers.items():
        group = Group(columns, decimals, tuple(members), tuple(len(tables[n].integers) for n in members))
        section, bodies = encode_group(group, [_floats(tables[n]) for n in members])
        shared += [_pack_group(group), varint(len(section)), section]
        for n, body in zip(members, bodies, strict=True):
            payloads[n] = _pack_patches(tables[n]) + body
    return b"".join(shared), payloads


def decode(
    shared: bytes, payload: Callable[[int], bytes], which: Sequence[int], decode_group: DecodeGroup
) -> list[NumberTable]:
    """The tables that `which` names. A group is asked for its members, counted from 0, with payloads less their patches.

    Raises CorruptStream or TruncatedStream.
    """
    reader = ByteReader(shared)
    found: dict[int, NumberTable] = {}
    wanted = set(which)
    for _ in range(reader.varint()):
        group = _read_group(reader)
        section = reader.take(reader.varint())
        members = [m for m, n in enumerate(group.numbers) if n in wanted]
        if members:
            opened = _Payloads(payload, group.numbers)
            values = decode_group(group, section, opened.body, members)
            found |= {group.numbers[m]: _table(group, values[m], opened.patches(m)) for m in members}
    if missing := wanted - found.keys():
        raise CorruptStream(f"the database does not hold the tables {sorted(missing)}")
    return [found[n] for n in which]


class _Payloads:
    """Splits payloads into patches and body, and reads each once."""

    def __init__(self, payload: Callable[[int], bytes], numbers: Sequence[int]):
        self._payload, self._numbers = payload, numbers
        self._open: dict[int, tuple[list[tuple[int, int, int]], bytes]] = {}

    def body(self, member: int) -> bytes:
        return self._read(member)[1]

    def patches(self, member: int) -> list[tuple[int, int, int]]:
        return self._read(member)[0]

    def _read(self, member: int) -> tuple[list[tuple[int, int, int]], bytes]:
        if member not in self._open:
            reader = ByteReader(self._payload(self._numbers[member]))
            patches = [(reader.varint(), reader.varint(), reader.varint()) for _ in range(reader.varint())]
            self._open[member] = patches, reader.take(reader.left)
        return self._open[member]


def _floats(table: NumberTable) -> Floats:
    value = np.clip(table.integers, -LIMIT, LIMIT).astype(np.int32)
    return Floats(value, (value < 0) | (value == 0) & table.negative_zeros)


def _table(group: Group, values: Floats, patches: list[tuple[int, int, int]]) -> NumberTable:
    integers = np.array(values.value, np.int32)
    for frame, column, value in patches:
        if frame >= integers.shape[0] or column >= integers.shape[1] or value >= 1 << 32:
            raise CorruptStream(f"a patch of frame {frame}, column {column} lies outside its table")
        integers[frame, column] = np.uint32(value).astype(np.int32)
    return NumberTable(group.columns, integers, np.asarray((integers == 0) & values.negative), group.decimals)


def _pack_patches(table: NumberTable) -> bytes:
    """Frame, column and value of every number that is too large to be coded."""
    large = np.argwhere(abs(table.integers.astype(np.int64)) > LIMIT).tolist()
    parts = [varint(len(large))]
    for frame, column in large:
        parts += [varint(frame), varint(column), varint(int(table.integers[frame, column]) & 0xFFFFFFFF)]
    return b"".join(parts)


def _pack_group(group: Group) -> bytes:
    """Names are written once a joint, followed by its channels as numbers of a list of all channels' names."""
    pairs = [("".join(name.rpartition(" ")[:2]), name.rpartition(" ")[2]) for name in group.columns]
    channels = list(dict.fromkeys(channel for _, channel in pairs))
    runs: list[tuple[str, list[int]]] = []
    for joint, channel in pairs:
        if not runs or runs[-1][0] != joint:
            runs.append((joint, []))
        runs[-1][1].append(channels.index(channel))
    parts = [_numbers([group.decimals, len(channels)]), *map(_text, channels), varint(len(runs))]
    parts += [_text(joint) + _numbers([len(ids), *ids]) for joint, ids in runs]
    parts.append(varint(len(group.numbers)))
    parts += [_numbers(pair) for pair in zip(group.numbers, group.frames, strict=True)]
    return b"".join(parts)


def _read_group(reader: ByteReader) -> Group:
    decimals = reader.varint()
    channels = [_read_text(reader) for _ in range(reader.varint())]
    columns: list[str] = []
    for _ in range(reader.varint()):
        joint = _read_text(reader)
        for _ in range(reader.varint()):
            if (k := reader.varint()) >= len(channels):
                raise CorruptStream(f"channel {k} of {len(channels)} is not named")
            columns.append(joint + channels[k])
    pairs = [(reader.varint(), reader.varint()) for _ in range(reader.varint())]
    return Group(tuple(columns), decimals, tuple(n for n, _ in pairs), tuple(f for _, f in pairs))


def _numbers(values: Sequence[int]) -> bytes:
    return b"".join(map(varint, values))


def _text(text: str) -> bytes:
    return varint(len(text.encode())) + text.encode()


def _read_text(reader: ByteReader) -> str:
    try:
        return reader.take(reader.varint()).decode()
    except UnicodeDecodeError as error:
        raise CorruptStream("a column's name is not UTF-8") from error
