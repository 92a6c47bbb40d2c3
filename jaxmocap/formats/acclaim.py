"""Acclaim AMC: a line of values a bone, a block of lines a frame, about the skeleton of an ASF file (see `asf`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..motion import Motion
from . import text
from .asf import Asf, format_asf, parse_asf
from .asf import read_asf as read_asf


@dataclass(frozen=True, eq=False)
class AmcSource(text.TextSource):
    """An AMC file's bytes with the ASF that it needs."""

    asf: Asf
    radians: bool


def read_amc(
    path: str | Path, asf: str | Path | None = None, unit_cm: float | None = None, frame_time: float = 1 / 120
) -> Motion:
    """Read an AMC file with its ASF: `asf`, or the one beside it that `find_asf` finds.

    AMC holds no frame rate: `frame_time` is in seconds, 120 Hz being that of the CMU database. Raises FormatError, with
    file, line and mend, for what is not a whole AMC of that skeleton.
    """
    path = Path(path)
    asf_path = find_asf(path) if asf is None else Path(asf)
    skeleton = parse_asf(asf_path.read_bytes(), str(asf_path))
    return parse_amc(path.read_bytes(), str(path), skeleton, unit_cm, frame_time)


def find_asf(path: Path) -> Path:
    """The ASF beside an AMC: of the same stem, else of the subject ("05" of "05_01"), else the only one there is."""
    for stem in (path.stem, path.stem.split("_")[0]):
        if (beside := path.with_name(f"{stem}.asf")).is_file():
            return beside
    found = sorted(path.parent.glob("*.asf"))
    if len(found) == 1:
        return found[0]
    said = f"an AMC needs the ASF of its skeleton; put {path.stem}.asf beside it"
    raise FormatError(f"{path}: {said} (.asf files there: {len(found)})")


def parse_amc(data: bytes, name: str, asf: Asf, unit_cm: float | None = None, frame_time: float = 1 / 120) -> Motion:
    """The motion that the bytes of an AMC file say about a skeleton; see `read_amc`."""
    text.check_text(data, name)
    reader = _AmcReader(data, name, asf)
    for at, words in text.lines(data):
        reader.line(at, words)
    reader.close_frame()
    if not reader.rows:
        raise FormatError(f"{name}: no frames; wanted the number of a frame, then a line a bone")
    values = np.stack(reader.rows)
    moved = asf.shift != 0  # adding 0 would lose the sign of -0.0
    with np.errstate(over="ignore"):
        if reader.radians:
            values[:, asf.rotates] = np.rad2deg(values[:, asf.rotates])
        values[:, moved] += asf.shift[moved]
    if not np.isfinite(values).all():
        frame = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise FormatError(f"{name}: a value of the frame at position {frame} is too large once in degrees or shifted")
    values = text.freeze(values)
    source = AmcSource("amc", data, asf.skeleton, values, frame_time, reader.body, asf, reader.radians)
    return Motion(asf.skeleton, values, frame_time, unit_cm, source)


class _AmcReader:
    """Takes the lines of an AMC one by one; `rows` are the finished frames, in the columns of the skeleton."""

    def __init__(self, data: bytes, name: str, asf: Asf):
        self.data, self.name, self.asf = data, name, asf
        self.radians = asf.radians
        self.rows: list[np.ndarray] = []
        self.body = self.frame_at = 0
        self.number: int | None = None
        self.row: list[float] = []
        self.seen: set[bytes] = set()
        self.moving = {bone for bone, columns in asf.columns.items() if columns}

    def line(self, at: int, words: list[bytes]) -> None:
        try:
            if len(words) == 1 and words[0].isdigit():
                self.begin_frame(at, text.whole_number(words[0]))
            elif self.number is None:
                self.directive(words[0])
            else:
                self.bone(words)
        except ValueError as problem:
            if isinstance(problem, FormatError):
                raise
            raise text.error_at(self.data, at, self.name, str(problem)) from None

    def directive(self, word: bytes) -> None:
        if not word.startswith(b":"):
            raise ValueError(f"{text.show(word)} where a ':' directive or the number of the first frame belongs")
        if word.upper() in (b":DEGREES", b":RADIANS"):
            self.radians = word.upper() == b":RADIANS"

    def begin_frame(self, at: int, number: int) -> None:
        self.close_frame()
        if self.number is None:
            self.body = at
        elif number != self.number + 1:
            raise ValueError(f"frame {number} follows frame {self.number}; wanted frame {self.number + 1}")
        self.number, self.frame_at = number, at
        self.row, self.seen = [0.0] * self.asf.skeleton.channel_count, set()

    def bone(self, words: list[bytes]) -> None:
        bone, columns = words[0], self.asf.columns.get(words[0])
        if columns is None:
            raise ValueError(f"bone {text.show(bone)} is not in the ASF; is it the ASF of this motion?")
        if len(words) - 1 != len(columns):
            raise ValueError(f"{text.show(bone)} has {len(words) - 1} values; its dof in the ASF has {len(columns)}")
        if bone in self.seen:
            raise ValueError(f"{text.show(bone)} stands twice in frame {self.number}; remove one")
        self.seen.add(bone)
        for column, value in zip(columns, text.row_numbers(words[1:]), strict=True):
            self.row[column] = value

    def close_frame(self) -> None:
        if self.number is None:
            return
        if lacking := sorted(self.moving - self.seen):
            said = f"frame {self.number} lacks {', '.join(map(text.show, lacking[:5]))}"
            raise text.error_at(self.data, self.frame_at, self.name, f"{said}: every bone with a dof needs a line")
        self.rows.append(np.array(self.row))


def write_amc(motion: Motion, path: str | Path) -> None:
    """Write an AMC file, and its ASF as `<stem>.asf` unless the one beside it is already the same; see `format_amc`."""
    path = Path(path)
    amc, asf = format_amc(motion), _asf_bytes(motion)
    try:
        beside = find_asf(path).read_bytes()
    except FormatError:
        beside = None
    if beside != asf:
        text.write_bytes(path.with_suffix(".asf"), asf)
    text.write_bytes(path, amc)


def format_amc(motion: Motion) -> bytes:
    """The bytes of an AMC file: those it was read from, as far as the motion is unchanged.

    New values get the file's number of decimals, or 6. AMC does not say the frame time. Raises FormatError for values
    that are not finite and for a skeleton that ASF cannot say (see `format_asf`).
    """
    values = text.host_values(motion.values, "AMC")
    source = motion.source
    if not isinstance(source, AmcSource) or not source.same_skeleton(motion.skeleton):
        asf = parse_asf(format_asf(motion.skeleton), "the ASF of this motion")
        return b"# written by jaxmocap\n:FULLY-SPECIFIED\n:DEGREES\n" + _amc_rows(values, asf, False, 6)
    if values.shape != source.values.shape:
        decimals = _decimals(source)
        return source.data[: source.body] + _amc_rows(values, source.asf, source.radians, decimals)
    changed = set(text.changed(values, source.values).tolist())
    if not changed:
        return source.data
    decimals, raw = _decimals(source), _file_values(values, source.asf, source.radians).ravel()
    spans = (span for span in _value_spans(source) if span[2] in changed)
    return text.replace_spans(source.data, ((start, end, b"%.*f" % (decimals, raw[at])) for start, end, at in spans))


def _decimals(source: AmcSource) -> int:
    return text.decimals_of(source.data, source.body) + 2 * source.radians  # a radian is 57 degrees


def _asf_bytes(motion: Motion) -> bytes:
    source = motion.source
    if isinstance(source, AmcSource) and source.same_skeleton(motion.skeleton):
        return source.asf.data
    return format_asf(motion.skeleton)


def _value_spans(source: AmcSource) -> Iterator[tuple[int, int, int]]:
    """Start and end of every value in the text, and its flat index in the motion's values."""
    frame = -1
    for at, words in text.lines(source.data):
        if at < source.body:
            continue
        if len(words) == 1 and words[0].isdigit():
            frame += 1
            continue
        start = source.data.index(words[0], at) + len(words[0])
        for word, column in zip(words[1:], source.asf.columns[words[0]], strict=True):
            start = source.data.index(word, start)
            yield start, start + len(word), frame * source.asf.skeleton.channel_count + column
            start += len(word)


def _file_values(
    values: Float[np.ndarray, "frames channels"], asf: Asf, radians: bool
) -> Float[np.ndarray, "frames channels"]:
    """The values as AMC says them, still in the skeleton's columns."""
    raw = values - asf.shift
    return np.where(asf.rotates, np.deg2rad(raw), raw) if radians else raw


def _amc_rows(values: Float[np.ndarray, "frames channels"], asf: Asf, radians: bool, decimals: int) -> bytes:
    bones = [(bone.decode("utf-8", "surrogateescape"), columns) for bone, columns in asf.columns.items() if columns]
    form = "\n".join(" ".join([bone.replace("%", "%%")] + [f"%.{decimals}f"] * len(columns)) for bone, columns in bones)
    order = [column for _, columns in bones for column in columns]
    rows = _file_values(values, asf, radians)[:, order].tolist()
    said = "".join(f"{n}\n{form % tuple(row)}\n" for n, row in enumerate(rows, 1))
    return said.encode("utf-8", "surrogateescape")
