"""BVH: a hierarchy of joints, then one row of channel values a frame. There is no unit and no official specification.

Every tree that real files hold is read: several roots, any channels on any joint, any line breaks. A motion that was
read and not changed writes back byte for byte; in a changed one only the tokens of the changed values differ.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..motion import Motion
from ..skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from . import text

MAX_DEPTH = 1000  # joints above each other; real figures have about 10
_CHANNEL = {c.lower(): c for c in POSITION_CHANNELS + ROTATION_CHANNELS}
T = TypeVar("T")
_LINE = re.compile(rb"[^\r\n]*")
_WORD = re.compile(rb"\s*([{}]|[^\s{}]+)?")
_FRAMES = re.compile(rb"\s*Frames\s*:[ \t]*(\S*)", re.IGNORECASE)
_FRAME_TIME = re.compile(rb"\s*Frame\s*Time\s*:[ \t]*(\S*)", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class BvhSource(text.TextSource):
    """A BVH file's bytes and where its two header numbers stand."""

    frames_span: tuple[int, int]
    frame_time_span: tuple[int, int]


def read_bvh(path: str | Path, unit_cm: float | None = None) -> Motion:
    """Read a BVH file; see `parse_bvh`."""
    return parse_bvh(Path(path).read_bytes(), str(path), unit_cm)


def parse_bvh(data: bytes, name: str, unit_cm: float | None = None) -> Motion:
    """The motion that the bytes of a BVH file say; `name` stands in messages, `unit_cm` is centimetres per file unit.

    Raises FormatError, with file, line and mend, for anything that is not a whole BVH of finite numbers.
    """
    head = parse_header(data, name)
    count, body = head.frames, head.body
    if count == 0:
        raise text.error_at(data, head.frames_span[0], name, "Frames: says 0; wanted at least one frame")
    values = text.numbers(data, body, name)
    channels = head.skeleton.channel_count
    if len(values) != count * channels:
        raise _miscounted(data, body, name, count, channels, head.frames_span[0])
    values = text.freeze(values.reshape(count, channels))
    source = BvhSource("bvh", data, head.skeleton, values, head.frame_time, body, head.frames_span, head.frame_time_span)
    return Motion(head.skeleton, values, head.frame_time, unit_cm, source)


class Header(NamedTuple):
    """What stands before the values, which begin at `body`, and where the two numbers stand."""

    skeleton: Skeleton
    frames: int
    frame_time: float
    body: int
    frames_span: tuple[int, int]
    frame_time_span: tuple[int, int]


def parse_header(data: bytes, name: str) -> Header:
    """The part before the values. Raises FormatError, with file, line and mend."""
    text.check_text(data, name)
    skeleton, at = _Hierarchy(data, name).read()
    frames = _labelled(_FRAMES, "Frames:", data, at, name)
    seconds = _labelled(_FRAME_TIME, "Frame Time:", data, frames.end(), name)
    try:
        at = frames.start(1)
        count = text.whole_number(frames[1])
        at = seconds.start(1)
        frame_time = text.number(seconds[1])
    except ValueError as problem:
        raise text.error_at(data, at, name, str(problem)) from None
    if frame_time <= 0:
        raise text.error_at(data, at, name, f"the frame time is {frame_time}; wanted seconds above 0, such as .0083333")
    return Header(skeleton, count, frame_time, seconds.end(), frames.span(1), seconds.span(1))


def write_bvh(motion: Motion, path: str | Path) -> None:
    """Write a BVH file beside and rename it; see `format_bvh`."""
    text.write_bytes(path, format_bvh(motion))


def format_bvh(motion: Motion) -> bytes:
    """The bytes of a BVH file: those it was read from, as far as the motion is unchanged.

    New values get the file's number of decimals, or 6. Joint frames (`axes`, as in ASF) are folded into Z, Y, X
    rotations, which BVH can say. Raises FormatError for values that are not finite.
    """
    values = text.host_values(motion.values, "BVH")
    source = motion.source
    if not isinstance(source, BvhSource) or not source.same_skeleton(motion.skeleton):
        return _format_new(motion, values)
    edits = []
    if motion.frame_time != source.frame_time:
        edits.append((*source.frame_time_span, repr(float(motion.frame_time)).encode()))
    if values.shape != source.values.shape:
        rows = b"\n" + format_rows(values, text.decimals_of(source.data, source.body))
        edits = [(*source.frames_span, b"%d" % len(values)), *edits, (source.body, len(source.data), rows)]
    else:
        which = text.changed(values, source.values)
        if len(which):
            decimals = text.decimals_of(source.data, source.body)
            starts, ends = text.token_spans(source.data, source.body)
            new = [b"%.*f" % (decimals, v) for v in values.ravel()[which].tolist()]
            edits += zip(starts[which].tolist(), ends[which].tolist(), new, strict=True)
    return text.replace_spans(source.data, edits)


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: list[str] | None = None
    ends: list[list[float]] = field(default_factory=list)


class _Hierarchy:
    """Reads the words of the HIERARCHY section; line breaks only matter behind a joint's name."""

    def __init__(self, data: bytes, name: str):
        self.data, self.name = data, name
        self.at = 3 if data.startswith(b"\xef\xbb\xbf") else 0
        self.start = self.at  # of the last word
        self.joints: list[_Joint] = []
        self.open: list[int] = []

    def read(self) -> tuple[Skeleton, int]:
        """The skeleton, and the offset behind the word MOTION."""
        if self.word().upper() != b"HIERARCHY":
            raise self.error("a BVH file begins with HIERARCHY")
        while (word := self.word().upper()) != b"MOTION" or self.open:
            self.statement(word)
        if not self.joints:
            raise self.error("MOTION before any ROOT; wanted a ROOT joint")
        if not any(j.channels for j in self.joints):
            raise self.error("no joint has a channel, so nothing can move; give ROOT a CHANNELS line")
        ends = [(j, offset) for j, joint in enumerate(self.joints) for offset in joint.ends]
        skeleton = Skeleton(
            names=[j.name for j in self.joints],
            parents=[j.parent for j in self.joints],
            offsets=text.freeze(np.array([j.offset for j in self.joints], np.float64)),
            channels=[j.channels or () for j in self.joints],
            end_joints=[j for j, _ in ends],
            end_offsets=text.freeze(np.array([offset for _, offset in ends], np.float64).reshape(-1, 3)),
        )
        return skeleton, self.at

    def statement(self, word: bytes) -> None:
        if word == b"ROOT" and not self.open:
            self.begin(-1)
        elif word == b"JOINT" and self.open:
            self.begin(self.open[-1])
        elif word == b"OFFSET" and self.open and self.joints[self.open[-1]].offset is None:
            self.joints[self.open[-1]].offset = self.vector()
        elif word == b"CHANNELS" and self.open and self.joints[self.open[-1]].channels is None:
            self.channels()
        elif word == b"END" and self.open:
            self.end_site()
        elif word == b"}" and self.open:
            if self.joints[self.open.pop()].offset is None:
                raise self.error("the joint closed here has no OFFSET line; add one")
        elif not word:
            raise self.error("the file ends in the HIERARCHY: it is cut short" if self.open else "MOTION is missing")
        else:
            wanted = "OFFSET or CHANNELS once, JOINT, End Site or '}'" if self.open else "ROOT or MOTION"
            raise self.error(f"{text.show(self.data[self.start : self.at])} where {wanted} belongs")

    def begin(self, parent: int) -> None:
        if len(self.open) >= MAX_DEPTH:
            raise self.error(f"joints are nested more than {MAX_DEPTH} deep")
        self.joints.append(_Joint(self.rest_of_line(), parent))
        self.expect(b"{")
        self.open.append(len(self.joints) - 1)

    def end_site(self) -> None:
        self.rest_of_line()  # "Site", perhaps with a name, which a Skeleton has no place for
        self.expect(b"{")
        if self.word().upper() != b"OFFSET":
            raise self.error("an End Site holds one OFFSET line")
        self.joints[self.open[-1]].ends.append(self.vector())
        self.expect(b"}")

    def channels(self) -> None:
        joint = len(self.joints) - 1
        if joint != self.open[-1]:
            raise self.error("CHANNELS behind a child joint; put it before, as the order of columns depends on it")
        count = self.parsed(text.whole_number)
        found: list[str] = []
        for _ in range(min(count, len(_CHANNEL) + 1)):
            word = self.word()
            channel = _CHANNEL.get(word.decode("utf-8", "replace").lower())
            if channel is None:
                wanted = f"CHANNELS {count} needs {count} of {', '.join(_CHANNEL.values())}"
                raise self.error(f"{text.show(word)} is no channel; {wanted}")
            if channel in found:
                raise self.error(f"the joint has {channel} twice; remove one")
            found.append(channel)
        self.joints[joint].channels = found

    def vector(self) -> list[float]:
        return [self.parsed(text.number) for _ in range(3)]

    def parsed(self, convert: Callable[[bytes], T]) -> T:
        word = self.word()
        try:
            return convert(word)
        except ValueError as problem:
            raise self.error(str(problem)) from None

    def word(self) -> bytes:
        """The next word or brace; empty at the end of the file."""
        match = _WORD.match(self.data, self.at)
        assert match is not None  # the pattern matches the empty string
        self.start, self.at = match.end() - len(match[1] or b""), match.end()
        return match[1] or b""

    def expect(self, brace: bytes) -> None:
        word = self.word()
        if word != brace:
            raise self.error(f"{text.show(word)} where '{brace.decode()}' belongs")

    def rest_of_line(self) -> str:
        """A name: it may hold spaces, and ends with the line or before an opening brace."""
        match = _LINE.match(self.data, self.at)
        assert match is not None  # the pattern matches the empty string
        line = match[0].replace(b"\t", b" ").rstrip()
        brace = line.find(b" {")
        if brace < 0 and line.endswith(b"{"):
            brace = len(line) - 1
        self.at = match.end() if brace < 0 else self.at + brace
        name = (line if brace < 0 else line[:brace]).strip()
        try:
            return name.decode()
        except UnicodeDecodeError:
            return name.decode("latin-1")

    def error(self, message: str) -> FormatError:
        at_end = self.start >= len(self.data)
        return text.error_at(self.data, len(self.data.rstrip()) if at_end else self.start, self.name, message)


def _labelled(pattern: re.Pattern[bytes], label: str, data: bytes, at: int, name: str) -> re.Match[bytes]:
    match = pattern.match(data, at)
    if match is None:
        word = _WORD.match(data, at)
        assert word is not None  # the pattern matches the empty string
        found = text.show(word[1]) if word[1] else "the end of the file"
        offset = word.start(1) if word[1] else len(data.rstrip())
        raise text.error_at(data, offset, name, f"{found} where '{label}' with its number belongs")
    return match


def _miscounted(
    data: bytes, body: int, name: str, frames: int, channels: int, frames_at: int
) -> FormatError:
    """What is wrong with a file that does not hold frames x channels values: a row, its end, or the frame count."""
    rows, at = [], body
    for line in data[body:].splitlines(keepends=True):
        if count := len(line.split()):
            rows.append((at + len(line) - len(line.lstrip()), count))
        at += len(line)
    total = sum(count for _, count in rows)
    if sum(count == channels for _, count in rows) * 2 > len(rows):
        for offset, count in rows:
            if count != channels:
                cut = " (is the file cut short?)" if offset == rows[-1][0] and count < channels else ""
                return text.error_at(data, offset, name, f"{count} values, wanted {channels}, one a channel{cut}")
    if total % channels == 0 and total:
        said = f"Frames: says {frames}, but {total // channels} frames of {channels} values follow"
        return text.error_at(data, frames_at, name, f"{said}; correct the count, or the file is not whole")
    if total < frames * channels:
        said = f"the file ends after {total} values; {frames} frames of {channels} channels are {frames * channels}"
        return text.error_at(data, len(data.rstrip()), name, f"{said}: it is cut short")
    starts, _ = text.token_spans(data, body)
    said = f"values behind the last of {frames} frames of {channels} channels; remove them or correct Frames:"
    return text.error_at(data, int(starts[frames * channels]), name, said)


def _format_new(motion: Motion, values: Float[np.ndarray, "frames channels"]) -> bytes:
    """A new file, joints in depth-first order."""
    skeleton, values = without_axes(motion.skeleton, values)
    header, columns = format_header(skeleton, str(len(values)), motion.frame_time)
    return header + format_rows(values[:, columns], 6)


def format_header(skeleton: Skeleton, frames: str, frame_time: float) -> tuple[bytes, list[int]]:
    """What stands before the values, joints in depth-first order, and the order that columns have then."""
    lines, order = ["HIERARCHY"], []
    children = skeleton.children
    ends: list[list[int]] = [[] for _ in skeleton.names]
    for e, j in enumerate(skeleton.end_joints):
        ends[j].append(e)
    pending = [(j, 0) for j in reversed(skeleton.roots)]  # a stack, as trees may be deeper than Python's
    while pending:
        j, depth = pending.pop()
        pad = "\t" * depth
        if j < 0:
            lines.append(pad + "}")
            continue
        order.append(j)
        channels = skeleton.channels[j]
        lines += [
            f"{pad}{'ROOT' if depth == 0 else 'JOINT'} {_line_name(skeleton.names[j])}",
            pad + "{",
            f"{pad}\tOFFSET {_vector(skeleton.offsets[j])}",
            f"{pad}\tCHANNELS {' '.join([str(len(channels)), *channels])}",
        ]
        for e in ends[j]:
            lines += [
                f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET {_vector(skeleton.end_offsets[e])}", pad + "\t}"
            ]
        pending += [(-1, depth), *((child, depth + 1) for child in reversed(children[j]))]
    lines += ["MOTION", f"Frames: {frames}", f"Frame Time: {float(frame_time)!r}\n"]
    first = skeleton.first_column
    return "\n".join(lines).encode(), [first[j] + n for j in order for n in range(len(skeleton.channels[j]))]


def format_rows(values: Float[np.ndarray, "frames channels"], decimals: int) -> bytes:
    row = " ".join([f"%.{decimals}f"] * values.shape[1]) + "\n"
    return "".join([row % tuple(frame) for frame in values.tolist()]).encode()


def _vector(offset: Float[np.ndarray, " 3"]) -> str:
    return " ".join(repr(float(v)) for v in offset)


def _line_name(name: str) -> str:
    """The name on one line and without what would open a block."""
    return " ".join(name.replace("{", "(").replace("\0", " ").splitlines()).strip()


def without_axes(
    skeleton: Skeleton, values: Float[np.ndarray, "frames channels"]
) -> tuple[Skeleton, Float[np.ndarray, "frames channels"]]:
    """The same motion in joint frames parallel to the parent's: C R C^T as Z, Y, X rotations, in double precision."""
    if not skeleton.has_axes:
        return skeleton, values
    from scipy.spatial.transform import Rotation

    new_channels, columns = [], []
    for channels, first, axes in zip(skeleton.channels, skeleton.first_column, skeleton.axes, strict=True):
        turns = [(first + n, c) for n, c in enumerate(channels) if c in ROTATION_CHANNELS]
        moves = [(first + n, c) for n, c in enumerate(channels) if c in POSITION_CHANNELS]
        columns += [values[:, [n]] for n, _ in moves]
        new_channels.append([c for _, c in moves])
        if not turns:
            continue
        angles = values[:, [n for n, _ in turns]]
        local = Rotation.from_euler("".join(c[0] for _, c in turns), angles, degrees=True)
        frame = Rotation.from_matrix(axes)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Gimbal lock")  # any of the equal triples will do
            columns.append((frame * local * frame.inv()).as_euler("ZYX", degrees=True))
        new_channels[-1] += ["Zrotation", "Yrotation", "Xrotation"]
    plain = Skeleton(
        skeleton.names, skeleton.parents, skeleton.offsets, new_channels, skeleton.end_joints, skeleton.end_offsets
    )
    return plain, np.concatenate(columns, axis=1)
