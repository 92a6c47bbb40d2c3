"""A number table as a payload, given its rig: the few things in which it differs from the rig, and the lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int32

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..lossless import NumberTable
from ..squeeze import expand, squeeze
from . import lanes, signs
from .laws import AbstractLaw, Integers, residuals, restored, wrapped
from .model import RigModel

Rows = Int32[np.ndarray, "frames columns"]
Left = list[list[Integers]]  # what each law leaves of its targets
_FRAMES_A_BYTE = 4096  # of side information: where frames cost next to nothing, it is filled up
_RESTS, _ODD = 1, 2


@dataclass
class Exceptions:
    """What a table's rig does not say of it.

    `unwrapped`: angles that are not taken to turn past 180 degrees. `lawless`: laws (by number) that the table breaks, whose
    targets are extrapolated instead. `strays`: columns that are not constant though the rig's are, or too wild for a lane.
    """

    unwrapped: list[int] = field(default_factory=list)
    lawless: list[int] = field(default_factory=list)
    strays: list[int] = field(default_factory=list)


def encode_table(model: RigModel, table: NumberTable, compiled: bool) -> bytes:
    """Frames, side information and lanes; the side information begins in the 16 bits that every lane has to spare."""
    rests = _begins_with_rest(model, table.integers)
    body = table.integers[1:] if rests else table.integers
    left = law_residuals(model, body)
    odd = _exceptions(model, body, left)
    values = to_lanes(model, body, left, odd)
    while wild := _wild(model, values):
        odd.strays = sorted({*odd.strays, *wild})
        values = to_lanes(model, body, left, odd)
    any_odd = bool(odd.unwrapped or odd.lawless or odd.strays)
    side = _rest_bytes(model, table.integers) if rests else b""
    if any_odd:
        side += b"".join(map(_list_bytes, (odd.unwrapped, odd.lawless, odd.strays)))
        side += b"".join(_stray_bytes(body[:, c]) for c in odd.strays)
    side += signs.encode(table.integers == 0, table.negative_zeros, model.signs)
    side = side.ljust(len(table.integers) // _FRAMES_A_BYTE, b"\0")
    coded, more = lanes.encode(model.lanes, values, side, compiled) if values.size else (b"", side)
    head = varint(len(table.integers) << 2 | any_odd * _ODD | rests * _RESTS)
    return head + varint(len(side)) + more + coded


@dataclass(frozen=True, eq=False)
class _Read:
    """A payload as it was read, before the laws have given their columns."""

    values: Int32[np.ndarray, "frames lanes"]
    odd: Exceptions
    strays: dict[int, np.ndarray]
    first: dict[int, int] | None
    side: ByteReader


def decode_tables(model: RigModel, readers: Sequence[ByteReader], compiled: bool) -> list[NumberTable]:
    """What `encode_table` wrote, for many payloads. Raises CorruptStream or TruncatedStream."""
    reads = [_read(model, reader, compiled) for reader in readers]
    tables = []
    for read, body in zip(reads, _bodies(model, reads), strict=True):
        integers = body if read.first is None else np.concatenate([_first_row(model, read.first, body), body])
        negative = signs.decode(read.side, integers == 0, model.signs)
        tables.append(NumberTable(model.columns, integers, negative, model.decimals))
    return tables


def _read(model: RigModel, reader: ByteReader, compiled: bool) -> _Read:
    head, length = reader.varint(), reader.varint()
    frames, rests = head >> 2, bool(head & _RESTS)
    if frames // _FRAMES_A_BYTE > length or frames < rests:
        raise CorruptStream(f"{length} bytes of side information do not go with {frames} frames")
    body_frames, count = frames - rests, model.lanes.count
    spare = min(length, 2 * count) if body_frames and count else 0
    more = reader.take(length - spare)
    values, begun = np.zeros((body_frames, count), np.int32), b""
    if values.size:
        values, begun = lanes.decode(model.lanes, reader, body_frames, spare, compiled)
    if reader.left:
        raise CorruptStream(f"{reader.left} bytes follow the last column of a payload")
    side = ByteReader(begun + more)
    first = _read_rest(model, side) if rests else None
    odd = Exceptions()
    if head & _ODD:
        odd = Exceptions(*(_read_list(side, n) for n in (len(model.columns), len(model.laws), len(model.columns))))
    return _Read(values, odd, {c: _read_stray(side, body_frames) for c in odd.strays}, first, side)


def _bodies(model: RigModel, reads: Sequence[_Read]) -> list[Rows]:
    """The frames of every table; the laws are applied to all alike tables at once, as short arrays cost much a number."""
    alike: dict[tuple, list[int]] = {}
    for n, read in enumerate(reads):
        alike.setdefault((tuple(read.odd.strays), n if read.odd.lawless else -1), []).append(n)
    bodies: list[Rows] = [np.zeros((0, 0), np.int32)] * len(reads)
    for members in alike.values():
        own = [_moved(model, reads[n]) for n in members]
        body = np.concatenate(own) if len(own) > 1 else own[0]
        values = np.concatenate([reads[n].values for n in members]) if len(own) > 1 else reads[members[0]].values
        _obey(model, body, values, reads[members[0]].odd)
        ends = np.cumsum([len(rows) for rows in own])
        for n, rows in zip(members, np.split(body, ends[:-1]), strict=True):
            bodies[n] = rows
    return bodies


def law_residuals(model: RigModel, body: Rows) -> Left:
    """What the laws of the rig leave of a table's frames."""
    return [residuals(law, body, model.decimals) for law in model.laws]


def to_lanes(model: RigModel, body: Rows, left: Left, odd: Exceptions) -> Int32[np.ndarray, "frames lanes"]:
    """The lanes' values: the moving columns about their means, and what the laws leave of their targets."""
    targets = {}
    for n, (law, columns) in enumerate(zip(model.laws, left, strict=True)):
        if n not in odd.lawless:
            targets.update(zip(law.targets, columns, strict=True))
        elif not law.smooth:
            targets.update((c, _extrapolated(model, body, c)) for c in law.targets)
    out = []
    for c in (*model.moving, *model.targets):
        column = body[:, c] if c in odd.unwrapped else unwrapped(model, body[:, c], c)
        value = targets[c] if c in targets else column - model.mean[c]
        out.append(np.zeros_like(value) if c in odd.strays else value)
    return np.stack(out, 1).astype(np.int32) if out else np.zeros((len(body), 0), np.int32)


def _moved(model: RigModel, read: _Read) -> Rows:
    """The frames with their moving columns and strays; elsewhere the means."""
    body = np.tile(model.mean, (len(read.values), 1))
    for n, c in enumerate(model.moving):
        column = read.values[:, n].astype(np.int64) + model.mean[c]
        body[:, c] = column if c in read.odd.unwrapped or not model.turns(c) else wrapped(column, model.decimals)
    for c, column in read.strays.items():
        body[:, c] = column
    return body


def _obey(model: RigModel, body: Rows, values: Int32[np.ndarray, "frames lanes"], odd: Exceptions) -> None:
    """Enters the columns that the laws give."""
    lane = {c: n for n, c in enumerate((*model.moving, *model.targets))}
    for n, law in enumerate(model.laws):
        left = [values[:, lane[c]].astype(np.int64) for c in law.targets]
        if n not in odd.lawless:
            columns = restored(law, body, left, model.decimals)
        elif not law.smooth:
            sums = [np.cumsum(np.cumsum(x)) + model.mean[c] for c, x in zip(law.targets, left, strict=True)]
            columns = [wrapped(x, model.decimals) for x in sums]
        else:
            continue
        for c, column in zip(law.targets, columns, strict=True):
            if c not in odd.strays:
                body[:, c] = column


def unwrapped(model: RigModel, column: Int32[np.ndarray, " frames"], c: int) -> Int32[np.ndarray, " frames"]:
    """An angle that goes on past 180 degrees; other columns as they are."""
    if not model.turns(c):
        return column
    steps = np.diff(column.astype(np.int64), prepend=column[:1])
    return (column[:1] + np.cumsum(wrapped(steps, model.decimals))).astype(np.int32)


def _extrapolated(model: RigModel, body: Rows, c: int) -> np.ndarray:
    """Second differences, from the mean on, of a column whose law does not hold."""
    column = unwrapped(model, body[:, c], c).astype(np.int64) - model.mean[c]
    return np.diff(column, 2, prepend=[0, 0])


def _exceptions(model: RigModel, body: Rows, left: Left) -> Exceptions:
    odd = Exceptions()
    if not len(body):
        return odd
    within = [bool((wrapped(x.astype(np.int64), model.decimals) == x).all()) for x in body.T]
    odd.unwrapped = [c for c in model.moving if model.turns(c) and not within[c]]
    strays = {c for c in model.constant if (body[:, c] != model.mean[c]).any()}
    for n, law in enumerate(model.laws):
        if not all(within[c] for c in law.targets):
            strays |= set(law.targets)
        elif not _pays(model, law, body, left[n]):
            odd.lawless.append(n)
    odd.strays = sorted(strays)
    return odd


def _pays(model: RigModel, law: AbstractLaw, body: Rows, left: Sequence[Integers]) -> bool:
    """True where what the law leaves costs less than second differences, as it does but where a figure breaks its laws."""
    free = [_extrapolated(model, body, c) for c in law.targets]
    return _cost([np.diff(x, 2) for x in left] if law.smooth else left) <= _cost(free)


def _cost(columns: Sequence[np.ndarray]) -> float:
    return sum(float(np.log2(np.abs(x) + 1.0).sum()) for x in columns)


def _wild(model: RigModel, values: Int32[np.ndarray, "frames lanes"]) -> list[int]:
    """Columns whose lanes may leave more than a symbol can say."""
    wide, moving = values.astype(np.int64), model.lanes.moving
    changes = np.concatenate([lanes.differences(wide[:, :moving]), wide[:, moving:]], 1)
    coded = (*model.moving, *model.targets)
    return [coded[n] for n in np.flatnonzero((np.abs(changes) >= lanes.LIMIT // 2).any(0))]


def _begins_with_rest(model: RigModel, integers: Rows) -> bool:
    if len(integers) < 2 or (integers[0] == integers[1]).all():
        return False
    return bool((integers[0] == _rest_row(model, integers[1])).mean() > 0.5)


def _rest_row(model: RigModel, second: Int32[np.ndarray, " columns"]) -> Int32[np.ndarray, " columns"]:
    """The rest pose, where the figure stands in the row behind it."""
    angles = np.array([model.turns(c) for c in range(len(model.columns))])
    return np.where(angles, model.rest, second)


def _rest_bytes(model: RigModel, integers: Rows) -> bytes:
    expected = _rest_row(model, integers[1])
    other = np.flatnonzero(integers[0] != expected)
    return _list_bytes(other.tolist()) + (integers[0] - expected)[other].astype("<i4").tobytes()


def _read_rest(model: RigModel, side: ByteReader) -> dict[int, int]:
    other = _read_list(side, len(model.columns))
    return dict(zip(other, np.frombuffer(side.take(4 * len(other)), "<i4").tolist(), strict=True))


def _first_row(model: RigModel, other: dict[int, int], body: Rows) -> Rows:
    if not len(body):
        raise CorruptStream("a table of one frame cannot begin with a rest pose")
    row = _rest_row(model, body[0]).astype(np.int64)
    for c, difference in other.items():
        row[c] += difference
    return row.astype(np.int32)[None]


def _list_bytes(numbers: Sequence[int]) -> bytes:
    gaps = np.diff(numbers, prepend=-1) - 1 if len(numbers) else []
    return varint(len(numbers)) + b"".join(varint(int(g)) for g in gaps)


def _read_list(side: ByteReader, limit: int) -> list[int]:
    """Rising numbers below the limit."""
    count, numbers, at = side.varint(), [], -1
    for _ in range(min(count, limit + 1)):
        at += side.varint() + 1
        numbers.append(at)
    if count > limit or at >= limit:
        raise CorruptStream(f"a payload lists number {at} where all are below {limit}")
    return numbers


def _stray_bytes(column: Int32[np.ndarray, " frames"]) -> bytes:
    """Second differences modulo 2^32, by byte planes."""
    change = np.diff(column, 2, prepend=np.zeros(2, np.int32)).astype("<i4")
    data = squeeze(np.ascontiguousarray(change.view(np.uint8).reshape(-1, 4).T).tobytes())
    return varint(len(data)) + data


def _read_stray(side: ByteReader, frames: int) -> Int32[np.ndarray, " frames"]:
    planes = np.frombuffer(expand(side.take(side.varint()), 4 * frames), np.uint8).reshape(4, -1)
    change = np.ascontiguousarray(planes.T).view("<i4").ravel()
    return np.cumsum(np.cumsum(change, dtype=np.int32), dtype=np.int32)
