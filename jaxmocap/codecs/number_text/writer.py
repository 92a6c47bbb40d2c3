"""Motion text written: a template that files share, a table of integers, and a layout of all that is not in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...errors import CorruptStream
from ..lossless import NumberTable
from .digits import counters, fields
from .layout import Layout
from .rule import FIXED, TRIMMED, NumberRule

_BLOCK = 1 << 14  # numbers written at a time: small enough that their digits stay in the cache
# In a template: how many rows there are, a number, the number of the row, and the end of the header.
COUNT, NUMBER, COUNTER, END = b"\1", b"\2", b"\3", b"\0"
_PATCH = b"\1"  # in a body, until the patches are put in


@dataclass(frozen=True, eq=False)
class NumberText:
    """A motion text. The `template` is what stands in front of the numbers, one row without its numbers, and their rule."""

    template: bytes
    layout: bytes
    table: NumberTable


@dataclass(frozen=True)
class Template:
    """The header up to the numbers, and the literals of a row: in front of its first number and behind each."""

    header: bytes
    counted: bool
    before: bytes
    behind: tuple[bytes, ...]
    rule: NumberRule

    def pack(self) -> bytes:
        pattern = COUNTER * self.counted + self.before + b"".join(NUMBER + literal for literal in self.behind)
        return self.header + END + pattern + self.rule.pack()

    @staticmethod
    def unpack(data: bytes) -> Template:
        header, mark, pattern = data[:-3].partition(END)
        before, *behind = pattern.split(NUMBER)
        counted = before.startswith(COUNTER)
        try:
            if not mark or not behind:
                raise ValueError("it has no row")
            return Template(header, counted, before[counted:], tuple(behind), NumberRule.unpack(data[-3:]))
        except ValueError as error:
            raise CorruptStream(f"the template of a motion text is damaged: {error}") from error


def format_numbers(text: NumberText) -> bytes:
    """The bytes that were parsed. Raises CorruptStream where template, layout and table do not go together."""
    template = Template.unpack(text.template)
    rows, columns = text.table.integers.shape
    if columns != len(template.behind):
        raise CorruptStream(f"a table of {columns} columns for a row of {len(template.behind)} numbers")
    layout = Layout.unpack(text.layout, template.rule, text.table)
    header = template.header.replace(COUNT, b"%d" % rows)
    writer = Writer(template, layout, text.table)
    body = b"".join(writer.text(span, rule) for span, rule in writer.spans())
    parts = body.split(_PATCH)
    if len(parts) != len(layout.patches) + 1:
        raise CorruptStream("the patches of a motion text lie beside it")
    patched = [piece for part, (_, patch) in zip(parts, [*layout.patches, (0, b"")], strict=True) for piece in (part, patch)]
    whole = b"".join([header, *patched])
    return whole[: len(whole) - layout.cut]


class Writer:
    """Writes rows of a table as a template and a layout say."""

    def __init__(self, template: Template, layout: Layout, table: NumberTable):
        self.template, self.layout, self.table = template, layout, table
        self.literals = np.array(template.behind)
        self.places = np.array([place for place, _ in layout.patches], np.int64)
        self.block = max(1, _BLOCK // len(template.behind))
        self.trimmed = NumberRule(TRIMMED, template.rule.digits)

    def spans(self) -> Iterator[tuple[slice, NumberRule]]:
        """All rows in blocks of one rule."""
        rows = len(self.table.integers)
        edges = [edge for span in self.layout.trimmed for edge in span]
        if self.template.rule.kind != FIXED and edges or edges != sorted(set(edges)) or any(e > rows for e in edges):
            raise CorruptStream("the trimmed rows of a motion text are none")
        for turn, (start, stop) in enumerate(zip([0, *edges], [*edges, rows], strict=True)):
            for at in range(start, stop, self.block):
                yield slice(at, min(at + self.block, stop)), self.trimmed if turn % 2 else self.template.rule

    def text(self, rows: slice, rule: NumberRule) -> bytes:
        """The bytes of some rows, with a mark for every patch."""
        records, line = self.records(rows, rule), len(self.literals) + 2
        front = self.front(rows)
        numbers = records.view(np.uint8).reshape(len(records), -1)
        low, high = np.searchsorted(self.places, [rows.start * line, rows.stop * line])
        last = rows.stop == len(self.table.integers)
        for place in self.places[low:high].tolist():
            row, kind = divmod(place - rows.start * line, line)
            if kind == 0:
                front[row, 0] = ord(_PATCH)
            elif kind == 1:
                front[row, 1:], numbers[row] = 0, 0
                front[row, 1] = ord(_PATCH)
            else:
                width = records.dtype.itemsize - self.literals.itemsize
                numbers[row, (kind - 2) * records.dtype.itemsize :][:width] = 0
                numbers[row, (kind - 2) * records.dtype.itemsize] = ord(_PATCH)
        end = _PATCH * int((self.places[high:] == rows.stop * line).sum()) if last else b""
        return np.concatenate([front, numbers], axis=1).tobytes().translate(None, b"\0") + end

    def records(self, rows: slice | np.ndarray, rule: NumberRule) -> np.ndarray:
        return fields(rule, self.table.decimals, self.layout.rows(self.table, rows), self.literals)

    def front(self, rows: slice) -> np.ndarray:
        """What stands in front of each row's first number, behind two bytes for marks."""
        count = rows.stop - rows.start
        parts = [np.zeros((count, 2), np.uint8)]
        if self.template.counted:
            parts.append(counters(self.counts(rows)))
        parts.append(np.broadcast_to(np.frombuffer(self.template.before, np.uint8), (count, len(self.template.before))))
        return np.concatenate(parts, axis=1)

    def counts(self, rows: slice) -> np.ndarray:
        """The numbers of some rows; the first is 1 where the layout does not say otherwise."""
        runs = np.array([(0, 1), *self.layout.counts], np.int64)
        at = np.arange(rows.start, rows.stop)
        run = runs[np.searchsorted(runs[:, 0], at, side="right") - 1]
        return (run[:, 1] + at - run[:, 0]).astype(np.uint64)
