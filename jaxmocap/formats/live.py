"""Motion that comes and goes frame by frame: BVH text line by line, or raw float32 values."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..skeleton import Skeleton
from .bvh import format_header, format_rows, parse_header, without_axes
from .text import row_numbers

ENDLESS = "999999999"  # frames, where nobody can know how many there will be: readers that stop at the end of the text get all
_HEADER_END = re.compile(rb"Frame\s*Time\s*:[ \t]*\S+[ \t]*[\r\n]", re.IGNORECASE)
_LINE_END = re.compile(rb"\r\n|\r|\n")
_MOST_WAITING = 1 << 24


class BvhReader:
    """Frames of BVH text that comes in parts. How many the header promises is not looked at: the end of the text ends them."""

    def __init__(self, name: str):
        """`name` stands in messages."""
        self.skeleton: Skeleton | None = None
        self.frame_time = 0.0
        self._name, self._waiting, self._line = name, b"", 0
        self._row: list[bytes] = []
        self._returned = False  # a line feed that comes next ends no other line

    def feed(self, data: bytes) -> list[Float[np.ndarray, " channels"]]:
        """The frames that these bytes end. Raises FormatError, with the line."""
        self._waiting += data.removeprefix(b"\n") if self._returned else data
        self._returned = data.endswith(b"\r")
        if self.skeleton is None and not self._read_header():
            return []
        lines = _LINE_END.split(self._waiting)
        self._waiting = lines.pop()
        if len(self._waiting) > _MOST_WAITING:
            raise FormatError(f"{self._name}, line {self._line + 1}: the line does not end; wanted one line a frame")
        return [frame for line in lines if (frame := self._frame(line)) is not None]

    def end(self) -> list[Float[np.ndarray, " channels"]]:
        """What a last line without an end holds; values that are no whole frame stay in `left`."""
        if self.skeleton is None:
            parse_header(self._waiting, self._name)
        return self.feed(b"\n")

    @property
    def left(self) -> int:
        """So many values at the end are no whole frame."""
        return len(self._row)

    def _read_header(self) -> bool:
        found = _HEADER_END.search(self._waiting)
        first = self._waiting.split(maxsplit=1)
        other = len(first) > 1 and first[0].removeprefix(b"\xef\xbb\xbf").upper() != b"HIERARCHY"
        if found is None and not other and len(self._waiting) <= _MOST_WAITING:
            return False
        stop = len(self._waiting) if found is None else found.end()
        header = parse_header(self._waiting[:stop], self._name)
        self.skeleton, self.frame_time = header.skeleton, header.frame_time
        self._line = len(self._waiting[:stop].splitlines())
        self._waiting = self._waiting[stop:]
        return True

    def _frame(self, line: bytes) -> Float[np.ndarray, " channels"] | None:
        """The frame that this line ends: rows may be wrapped."""
        assert self.skeleton is not None
        self._line += 1
        self._row += line.split()
        channels = self.skeleton.channel_count
        if len(self._row) < channels:
            return None
        if len(self._row) > channels:
            raise FormatError(f"{self._name}, line {self._line}: {len(self._row)} values, wanted {channels}, one a channel")
        try:
            values = row_numbers(self._row)
        except ValueError as problem:
            raise FormatError(f"{self._name}, line {self._line}: {problem}") from None
        self._row = []
        return np.array(values)


class RawReader:
    """Frames of float32, little-endian, channels in the order of the skeleton's file."""

    def __init__(self, skeleton: Skeleton, frame_time: float):
        self.skeleton, self.frame_time = skeleton, frame_time
        self._waiting = b""

    def feed(self, data: bytes) -> list[Float[np.ndarray, " channels"]]:
        self._waiting += data
        size = 4 * self.skeleton.channel_count
        count = len(self._waiting) // size
        frames = np.frombuffer(self._waiting, "<f4", count * size // 4).astype(np.float64).reshape(count, -1)
        self._waiting = self._waiting[count * size :]
        return list(frames)

    def end(self) -> list[Float[np.ndarray, " channels"]]:
        return []

    @property
    def left(self) -> int:
        return -(-len(self._waiting) // 4)


class BvhWriter:
    """BVH text of frames one by one. The count in its header is `ENDLESS`, until `count` is written over it."""

    def __init__(self, skeleton: Skeleton, frame_time: float):
        self._skeleton = skeleton
        plain, _ = without_axes(skeleton, np.zeros((1, skeleton.channel_count)))
        self.header, self._columns = format_header(plain, ENDLESS, frame_time)
        self.count_at = self.header.rindex(ENDLESS.encode())

    def frame(self, values: Float[np.ndarray, " channels"]) -> bytes:
        return format_rows(without_axes(self._skeleton, values[None])[1][:, self._columns], 6)

    def count(self, frames: int) -> bytes:
        """What belongs at `count_at` when it is known."""
        return str(frames).ljust(len(ENDLESS)).encode()


class RawWriter:
    """Frames as `RawReader` reads them: nothing but values."""

    header, count_at = b"", 0

    def frame(self, values: Float[np.ndarray, " channels"]) -> bytes:
        return values.astype("<f4").tobytes()

    def count(self, frames: int) -> bytes:
        return b""
