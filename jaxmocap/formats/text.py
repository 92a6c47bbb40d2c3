"""What the text formats share: exact bulk parsing of decimal numbers, errors that name the line, token replacement."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..errors import FormatError
from ..skeleton import Skeleton

_BLOCK = 1 << 17  # bytes parsed at a time: small enough that the arrays of a block stay in the cache
_SPACE = re.compile(rb"\s")
_LINE = re.compile(rb"[^\r\n]+")
_TOKEN = re.compile(rb"\S+")
_NUMBER = re.compile(rb"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
# 10 to the number of digits behind a point at byte 0..7 of an 8-byte window; entry 8 is "no point"; then for a minus.
_POWER = np.outer([1, -1], [1e7, 1e6, 1e5, 1e4, 1e3, 1e2, 1e1, 1e0, 1e0]).ravel()


def _each(byte: int) -> np.uint64:
    return np.uint64(byte * 0x0101010101010101)


@dataclass(frozen=True, eq=False)
class TextSource:
    """The bytes a motion was read from and what they said; equal only to itself, so that jit never mixes two files."""

    format: str
    data: bytes
    skeleton: Skeleton
    values: Float[np.ndarray, "frames channels"]
    frame_time: float
    body: int  # offset of the first byte behind the header

    def same_skeleton(self, skeleton: Skeleton) -> bool:
        """True when names, tree, channels and all offsets are still those of the text."""
        own = self.skeleton
        return own is skeleton or (
            own.same_rig(skeleton)
            and np.array_equal(own.offsets, skeleton.offsets)
            and np.array_equal(own.end_offsets, skeleton.end_offsets)
        )


def error_at(data: bytes, offset: int, name: str, message: str) -> FormatError:
    """A FormatError that names the file and the line of `offset`; LF, CRLF and CR all end lines."""
    line = len((data[: max(offset, 0)] + b"x").splitlines())
    return FormatError(f"{name}, line {line}: {message}")


def check_text(data: bytes, name: str) -> None:
    """Raises FormatError for an empty file and for bytes that cannot be text."""
    if not data or data.isspace():
        raise FormatError(f"{name}: the file is empty")
    if b"\0" in data:
        raise error_at(data, data.index(b"\0"), name, "a NUL byte: a binary (or UTF-16) file, wanted 8-bit text")


def show(token: bytes) -> str:
    """The token for a message, shortened."""
    text = token[:40].decode("utf-8", "replace")
    return repr(text + "..." if len(token) > 40 else text)


def number(token: bytes) -> float:
    """The finite float that a token spells; raises ValueError, with the reason, for anything else."""
    if not _NUMBER.fullmatch(token):
        raise ValueError(f"{show(token)} is not a finite number; wanted one such as -12.5")
    value = float(token)
    if not math.isfinite(value):
        raise ValueError(f"{show(token)} is too large for a 64-bit number; wanted a finite one")
    return value


def row_numbers(tokens: list[bytes]) -> list[float]:
    """`number` of every token, quickly where all is well."""
    try:
        values = list(map(float, tokens))
        if math.isfinite(sum(values)) and not any(b"_" in t for t in tokens):
            return values
    except ValueError:
        pass
    return [number(t) for t in tokens]  # float() takes "nan", "inf" and "1_0"


def whole_number(token: bytes) -> int:
    """The count that a token spells (at most 12 digits); raises ValueError otherwise."""
    if not re.fullmatch(rb"\d{1,12}", token):
        raise ValueError(f"{show(token)} is not a whole number below 10^12")
    return int(token)


def numbers(data: bytes, start: int, name: str) -> Float[np.ndarray, " n"]:
    """Every whitespace-separated number from `start` to the end, each equal to float() of its token.

    Raises FormatError, with the line, for a token that is not a finite number.
    """
    blocks = []
    for at, stop in _blocks(data, start):
        block, starts, ends = _tokens(data[at:stop])
        values, odd = _short_numbers(block, starts, ends)
        try:
            values[odd] = [float(block[s:e]) for s, e in zip(starts[odd].tolist(), ends[odd].tolist(), strict=True)]
            fine = b"_" not in block and bool(np.isfinite(values).all())
        except ValueError:
            fine = False
        if not fine:  # float() takes "nan", "inf" and "1_0": look at each token
            values = np.array([_checked(data, m, name) for m in _TOKEN.finditer(data, at, stop)])
        blocks.append(values)
    return np.concatenate(blocks) if blocks else np.zeros(0)


def lines(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Offset and words of every line that is neither blank nor a # comment."""
    for match in _LINE.finditer(data, 3 if data.startswith(b"\xef\xbb\xbf") else 0):
        words = match[0].split()
        if words and not words[0].startswith(b"#"):
            yield match.start(), words


def token_spans(data: bytes, start: int) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Where every whitespace-separated token from `start` on begins and ends."""
    spans = []
    for at, stop in _blocks(data, start):
        _, starts, ends = _tokens(data[at:stop])
        spans.append(np.stack([starts, ends]) + (at - 8))
    both = np.concatenate(spans, axis=1) if spans else np.zeros((2, 0), np.int64)
    return both[0], both[1]


def _blocks(data: bytes, start: int) -> Iterator[tuple[int, int]]:
    """Ranges of about _BLOCK bytes that end between tokens."""
    while start < len(data):
        cut = _SPACE.search(data, start + _BLOCK)
        stop = cut.start() if cut else len(data)
        yield start, stop
        start = stop


def _tokens(text: bytes) -> tuple[bytes, Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The text with 8 spaces before and 1 to 8 behind, to a multiple of 8 bytes; and the token bounds in it."""
    block = b" " * 8 + text + b" " * (8 - len(text) % 8)
    byte = np.frombuffer(block, np.uint8)
    space = (byte == 32) | (byte - np.uint8(9) < 5)
    edges = np.flatnonzero(space[1:] != space[:-1]) + 1
    return block, edges[0::2], edges[1::2]


def _checked(data: bytes, match: re.Match[bytes], name: str) -> float:
    try:
        return number(match[0])
    except ValueError as problem:
        raise error_at(data, match.start(), name, str(problem)) from None


def _short_numbers(
    block: bytes, starts: Int[np.ndarray, " n"], ends: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " odd"]]:
    """Values of the tokens `[-]digits[.digits]` of at most 8 characters behind the sign, and the indices of the others.

    Eight characters are one 64-bit word, and whole-word arithmetic reads its digits (Lemire 2018, "Quickly parsing
    eight digits"). Digits and power of ten are exact doubles, so one division rounds as float() does (Clinger 1990).
    """
    byte = np.frombuffer(block, np.uint8)
    negative = byte[starts] == ord("-")
    length = ends - starts - negative
    # The token lies in the high bytes of the little-endian word that ends with it; those below it become leading zeros.
    first = ends - 8
    aligned, shift = np.frombuffer(block, "<u8"), ((first & 7) << 3).astype(np.uint64)
    low, high = aligned.take(first >> 3), aligned.take((ends - 1) >> 3)
    word = ((low >> shift) | (high << (np.uint64(64) - shift))) ^ _each(ord("0"))  # NumPy shifts by 64 to 0
    unused = (8 - length).view(np.uint64) << np.uint64(3)
    word = (word >> unused) << unused
    point = _each(ord(".") ^ ord("0"))
    low7 = _each(0x7F)
    difference = word ^ point
    point_bit = ~(((difference & low7) + low7) | difference | low7) >> np.uint64(7)
    below = point_bit - np.uint64(1)  # the bytes before the point; all ones where there is none
    has_point = point_bit != 0
    before = np.where(has_point, word & below, np.uint64(0))
    digits = word - (point_bit * (point & np.uint64(0xFF))) + before * np.uint64(0xFF)  # close the gap
    bad = ((digits + _each(0x76)) | digits) & _each(0x80) | (point_bit & below)  # no digit, or a second point
    odd = np.flatnonzero((bad != 0) | (length > 8) | (length - has_point < 1))
    pairs = digits * np.uint64(10) + (digits >> np.uint64(8))
    mask = np.uint64(0x000000FF000000FF)
    whole = (
        (pairs & mask) * np.uint64(0x000F424000000064)
        + ((pairs >> np.uint64(16)) & mask) * np.uint64(0x0000271000000001)
    ) >> np.uint64(32)
    return whole / _POWER.take((np.bitwise_count(below) >> 3) + np.uint8(9) * negative), odd


def decimals_of(data: bytes, start: int) -> int:
    """The most digits behind a decimal point in the text; 6 where there are fewer than 4, and never above 17."""
    found = max((len(m) for m in set(re.findall(rb"\.(\d+)", data[start:]))), default=0)
    return min(found, 17) if found >= 4 else 6


def replace_spans(data: bytes, edits: Iterable[tuple[int, int, bytes]]) -> bytes:
    """The data with every span `start:end` replaced by its text; the spans are in order and do not overlap."""
    parts, at = [], 0
    for start, end, text in edits:
        parts += [data[at:start], text]
        at = end
    return b"".join([*parts, data[at:]])


def changed(values: Float[np.ndarray, "frames channels"], original: Float[np.ndarray, "frames channels"]) -> np.ndarray:
    """Flat indices of the values whose bits differ: -0.0 is not 0.0."""
    return np.flatnonzero(values.view(np.int64) != original.view(np.int64))


def host_values(values: Float[np.ndarray, "frames channels"], name: str) -> Float[np.ndarray, "frames channels"]:
    """The values as contiguous float64; raises FormatError where one is not finite, which no reader would take back."""
    values = np.ascontiguousarray(values, np.float64)
    if not np.isfinite(values).all():
        frame, channel = np.argwhere(~np.isfinite(values))[0]
        raise FormatError(f"{name}: value {channel} of frame {frame} is not finite, so it cannot be written")
    return values


def freeze(values: np.ndarray) -> np.ndarray:
    """The array, read-only: the source shares it, and must still know what the file said."""
    values.flags.writeable = False
    return values


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write beside and rename, so that a failed run leaves no half file."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_bytes(data)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
