"""Where the numbers of a motion text stand: rows of BVH are lines, those of AMC a line with a number and a line a bone."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ...formats.text import token_spans

_BVH = re.compile(rb"(?:\xef\xbb\xbf)?\s*HIERARCHY\s", re.IGNORECASE)
_FRAMES = re.compile(rb"Frames\s*:[ \t]*(\d{1,9})(?!\S)", re.IGNORECASE)
_FRAME_TIME = re.compile(rb"Frame\s*Time\s*:[^\r\n]*(?:\r\n|\r|\n)", re.IGNORECASE)
_JOINT = re.compile(rb"(?:ROOT|JOINT)[ \t]+([^\r\n{]*)|CHANNELS\s+\d+((?:\s+[XYZ](?:position|rotation))*)", re.IGNORECASE)

_MOST_DIGITS = 10  # of the number of an AMC frame


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a text: bytes `starts` to `stops` each, the numbers in them, and, in AMC, the number of the row.

    `body` is the first byte behind the header; `count` is where the header says how many rows there are.
    """

    columns: tuple[str, ...]
    body: int
    count: tuple[int, int] | None
    starts: Int[np.ndarray, " rows"]
    stops: Int[np.ndarray, " rows"]
    number_starts: Int[np.ndarray, "rows columns"]
    number_stops: Int[np.ndarray, "rows columns"]
    counter_stops: Int[np.ndarray, " rows"] | None


def find_rows(data: bytes) -> Rows | None:
    """None for what is no BVH and no AMC, or has no whole row."""
    return _bvh_rows(data) if _BVH.match(data) else _amc_rows(data)


def _bvh_rows(data: bytes) -> Rows | None:
    frame_time = _FRAME_TIME.search(data)
    if not frame_time:
        return None
    body, frames = frame_time.end(), _FRAMES.search(data, 0, frame_time.start())
    columns = _bvh_columns(data[:body])
    lines = _Lines(data, body)
    whole = np.flatnonzero(lines.counts == len(columns)) if columns else np.zeros(0, int)
    if not len(whole):
        return None
    tokens = lines.first[whole, None] + np.arange(len(columns))
    starts, stops = lines.starts[whole], lines.stops[whole]
    count = frames.span(1) if frames else None
    return Rows(columns, body, count, starts, stops, lines.token_starts[tokens], lines.token_stops[tokens], None)


def _bvh_columns(header: bytes) -> tuple[str, ...]:
    columns, joint = [], ""
    for match in _JOINT.finditer(header):
        if match[1] is not None:
            joint = match[1].strip().decode("utf-8", "replace")
        else:
            columns += [f"{joint} {channel.decode()}" for channel in match[2].split()]
    return tuple(columns)


def _amc_rows(data: bytes) -> Rows | None:
    lines = _Lines(data, 0)
    single = np.flatnonzero(lines.counts == 1)
    spans = zip(lines.token_starts[lines.first[single]].tolist(), lines.token_stops[lines.first[single]].tolist(), strict=True)
    heads = single[[b - a <= _MOST_DIGITS and data[a:b].isdigit() for a, b in spans]] if len(single) else single
    if not len(heads):
        return None
    first = lines.first[heads]
    sizes = np.diff(first, append=len(lines.token_starts))
    size = int(np.median(sizes))
    whole = np.flatnonzero(sizes == size)
    if size < 3 or not len(whole):
        return None
    middle = whole[len(whole) // 2]
    names = set((lines.first[heads[middle] :][lines.counts[heads[middle] :] > 0] - first[middle]).tolist())
    places = np.array([place for place in range(size) if place not in names])
    if not len(places):
        return None
    tokens = first[whole, None] + places
    last = np.searchsorted(lines.stops, lines.token_stops[first[whole] + size - 1])
    return Rows(
        _amc_columns(data, lines, int(first[middle]), size, names),
        int(lines.starts[heads[whole[0]]]),
        None,
        lines.starts[heads[whole]],
        lines.stops[last],
        lines.token_starts[tokens],
        lines.token_stops[tokens],
        lines.token_stops[first[whole]],
    )


def _amc_columns(data: bytes, lines: _Lines, first: int, size: int, names: set[int]) -> tuple[str, ...]:
    columns, bone, index = [], "", 0
    for place in range(1, size):
        if place in names:
            name = data[lines.token_starts[first + place] : lines.token_stops[first + place]]
            bone, index = name.decode("utf-8", "replace"), 0
        else:
            index += 1
            columns.append(f"{bone} {index}")
    return tuple(columns)


class _Lines:
    """All lines from an offset on, and the words of each: `counts` of them, the `first` being that index."""

    def __init__(self, data: bytes, start: int):
        byte = np.frombuffer(data, np.uint8)[start:]
        ends = byte == ord("\n")
        if b"\r" in data:
            ends[:-1] |= (byte[:-1] == ord("\r")) & (byte[1:] != ord("\n"))
            ends[-1:] |= byte[-1:] == ord("\r")
        stops = np.flatnonzero(ends) + (start + 1)
        self.stops = stops if len(stops) and stops[-1] == len(data) else np.append(stops, len(data))
        self.starts = np.concatenate([[start], self.stops[:-1]])
        self.token_starts, self.token_stops = token_spans(data, start)
        self.first = np.searchsorted(self.token_starts, self.starts)
        self.counts = np.diff(self.first, append=len(self.token_starts))
