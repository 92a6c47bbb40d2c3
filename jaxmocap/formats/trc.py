"""TRC: marker positions as tab-separated text (Motion Analysis, OpenSim), with the unit and the rate in its header."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import FormatError
from ..motion import Motion
from . import text
from .npz import global_positions

_LINE = re.compile(rb"[^\r\n]+")
_MM = 0.1
_UNIT_CM = {"mm": _MM, "cm": 1.0, "m": 100.0, "in": 2.54, "unknown": None}


@dataclass(frozen=True, eq=False)
class TrcSource(text.TextSource):
    """A TRC file's bytes, and the unit its numbers are in."""

    unit_cm: float | None


def read_trc(path: str | Path, unit_cm: float | None = None) -> Motion:
    """Read a TRC file; see `parse_trc`."""
    return parse_trc(Path(path).read_bytes(), str(path), unit_cm)


def parse_trc(data: bytes, name: str, unit_cm: float | None = None) -> Motion:
    """The positions-only motion that the bytes of a TRC file say; `unit_cm`, where given, overrides the header's unit.

    Raises FormatError, with file, line and mend: also for a marker that is missing in a frame, as a blank field says.
    """
    text.check_text(data, name)
    lines = list(_lines(data))
    if len(lines) < 6 or not lines[0][1].lstrip(b"\xef\xbb\xbf").startswith(b"PathFileType"):
        raise FormatError(f"{name}, line 1: wanted PathFileType, two header lines, two of marker names, then frames")
    (_, keys), (at, said), (names_at, names) = lines[1], lines[2], lines[3]
    header = dict(zip((k.decode("utf-8", "replace").lower() for k in keys.split()), said.split(), strict=False))
    markers = [f.strip().decode("utf-8", "replace") for f in _fields(names)[2:] if f.strip()]
    try:
        rate, unit_name = text.number(header["datarate"]), header["units"].decode("utf-8", "replace").lower()
        frames, count = text.whole_number(header["numframes"]), text.whole_number(header["nummarkers"])
        unit = _UNIT_CM[unit_name]
    except KeyError as missing:
        wanted = f"DataRate, NumFrames, NumMarkers and Units, which is one of {', '.join(_UNIT_CM)}"
        raise text.error_at(data, at, name, f"the header lacks {missing}; wanted {wanted}") from None
    except ValueError as problem:
        raise text.error_at(data, at, name, str(problem)) from None
    if not rate > 0 or not math.isfinite(1 / rate):
        raise text.error_at(data, at, name, f"DataRate is {rate}; wanted frames a second above 0")
    if count != len(markers) or count == 0:
        raise text.error_at(data, names_at, name, f"{len(markers)} marker names, NumMarkers says {count}")
    if frames != len(lines) - 5:
        raise text.error_at(data, at, name, f"NumFrames says {frames}, but {len(lines) - 5} rows follow; correct it")
    rows = np.array([_row(data, at, line, markers, name) for at, line in lines[5:]])
    unit_cm = unit if unit_cm is None else unit_cm
    motion = Motion.from_positions(rows.reshape(frames, count, 3), markers, 1 / rate, unit_cm=unit_cm)
    values = text.freeze(motion.values)
    source = TrcSource("trc", data, motion.skeleton, values, 1 / rate, lines[5][0], motion.unit_cm)
    return Motion(motion.skeleton, values, 1 / rate, motion.unit_cm, source)


def write_trc(motion: Motion, path: str | Path) -> None:
    """Write the joint positions beside and rename; see `format_trc`."""
    text.write_bytes(path, format_trc(motion))


def format_trc(motion: Motion) -> bytes:
    """The bytes of a TRC file: those it was read from, as far as the motion is unchanged.

    A new file is in millimetres, or in "unknown" units where the motion has none, with 6 decimals. Rotations are lost.
    """
    values = text.host_values(motion.values, "TRC")
    source = motion.source
    if (
        not isinstance(source, TrcSource)
        or not source.same_skeleton(motion.skeleton)
        or values.shape != source.values.shape
        or (motion.frame_time, motion.unit_cm) != (source.frame_time, source.unit_cm)
    ):
        return _format_new(motion)
    decimals = text.decimals_of(source.data, source.body)
    flat, changed = values.ravel(), set(text.changed(values, source.values).tolist())
    spans = (span for span in _value_spans(source) if span[2] in changed)
    return text.replace_spans(source.data, ((start, end, b"%.*f" % (decimals, flat[at])) for start, end, at in spans))


def _lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Offset and text of the lines that are not blank."""
    return ((m.start(), m[0]) for m in _LINE.finditer(data) if not m[0].isspace())


def _fields(line: bytes) -> list[bytes]:
    return line.split(b"\t") if b"\t" in line else line.split()


def _row(data: bytes, at: int, line: bytes, markers: list[str], name: str) -> list[float]:
    fields = [f.strip() for f in _fields(line)]
    wanted = 2 + 3 * len(markers)
    while len(fields) > wanted and not fields[-1]:
        fields.pop()
    if len(fields) > wanted:
        raise text.error_at(data, at, name, f"{len(fields)} fields, wanted {wanted}: frame, time, x y z of each marker")
    gap = fields.index(b"") if b"" in fields else len(fields)
    if gap < wanted:
        lost = f"marker {markers[(gap - 2) // 3]!r} is missing" if gap > 1 else "the frame number or time is missing"
        raise text.error_at(data, at, name, f"{lost} (a blank field); fill the gap before")
    try:
        return text.row_numbers(fields)[2:]
    except ValueError as problem:
        raise text.error_at(data, at, name, str(problem)) from None


def _value_spans(source: TrcSource) -> Iterator[tuple[int, int, int]]:
    """Start and end of every coordinate in the text, and its flat index in the motion's values."""
    index = 0
    for at, line in _lines(source.data):
        if at < source.body:
            continue
        for field in list(re.finditer(rb"[^\t\s]+", line))[2:]:
            yield at + field.start(), at + field.end(), index
            index += 1


def _format_new(motion: Motion) -> bytes:
    names = [" ".join(n.split()) or f"joint{j}" for j, n in enumerate(motion.skeleton.names)]
    positions = global_positions(motion)
    frames, joints, _ = positions.shape
    unit = "unknown" if motion.unit_cm is None else "mm"
    if motion.unit_cm is not None:
        positions = positions * (motion.unit_cm / _MM)
    rate = repr(1 / motion.frame_time)
    head = [
        "PathFileType\t4\t(X/Y/Z)\tjaxmocap.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{joints}\t{unit}\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{j}\tY{j}\tZ{j}" for j in range(1, joints + 1)),
        "",
    ]
    form = "\t".join(["%d", "%.6f"] + ["%.6f"] * (3 * joints))
    rows = positions.reshape(frames, -1).tolist()
    lines = [form % (n + 1, n * motion.frame_time, *row) for n, row in enumerate(rows)]
    return "\n".join([*head, *lines, ""]).encode()
