"""Motion text read into tokens; what is read is written again and compared, so that every byte comes back."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ...errors import FormatError
from ...formats import text as motion_text
from ..lossless import NumberTable
from .digits import fields
from .layout import Layout
from .rule import FIXED, GENERAL, LARGEST, MAX_DECIMALS, MAX_SIGNIFICANT, TRIMMED, NumberRule, Numbers, split
from .scan import Rows, find_rows
from .writer import COUNT, COUNTER, END, NUMBER, Template, Writer
from .writer import NumberText as NumberText
from .writer import format_numbers as format_numbers

_SAMPLE = 24  # rows by which a rule is chosen
_DECIMAL = re.compile(rb"-?(\d+)(?:\.(\d+))?(?:e[+-](\d+))?")


def parse_numbers(data: bytes) -> NumberText | None:
    """The tokens of a motion text, or None where its bytes are better kept as they are."""
    if any(mark in data for mark in (END, COUNT, NUMBER, COUNTER)):
        return None
    rows = find_rows(data)
    return None if rows is None else _Parser(data, rows).text()


class _Parser:
    """Turns the rows that were found into a template, a table and a layout."""

    def __init__(self, data: bytes, rows: Rows):
        self.data, self.rows = data, rows
        middle = len(rows.starts) // 2
        starts, stops = rows.number_starts[middle].tolist(), rows.number_stops[middle].tolist()
        begin = rows.starts[middle] if rows.counter_stops is None else rows.counter_stops[middle]
        self.before = data[begin : starts[0]]
        self.behind = tuple(data[a:b] for a, b in zip(stops, [*starts[1:], int(rows.stops[middle])], strict=True))
        self.line = len(self.behind) + 2  # places for patches in a row
        self.missing = self._missing()

    def text(self) -> NumberText | None:
        values = self._values()
        chosen = self._rule(values)
        if chosen is None:
            return None
        rule, decimals = chosen
        template = Template(self._header(), self.rows.counter_stops is not None, self.before, self.behind, rule)
        numbers, odd = split(rule, decimals, values)
        if odd.sum() > odd.size // 8:
            return None
        for row, column in np.argwhere(odd).tolist():  # what predicts best: the number above
            for part in numbers:
                part[row, column] = part[row - 1, column] if row else 0
        zeros = numbers.negative & (numbers.integers == 0)
        table = NumberTable(self.rows.columns, numbers.integers, zeros, decimals)
        layout = self._layout(template, table, numbers)
        if layout is None:
            return None
        found = NumberText(template.pack(), layout.pack(rule, table), table)
        return found if format_numbers(found) == self.data else None

    def _header(self) -> bytes:
        count, head = self.rows.count, self.data[: self.rows.body]
        if count is None or self.data[count[0] : count[1]] != b"%d" % len(self.rows.starts):
            return head
        return head[: count[0]] + COUNT + head[count[1] :]

    def _missing(self) -> bytes:
        """What the last row lacks where the file ends in it."""
        tail, whole = self.data[self.rows.number_stops[-1, -1] : self.rows.stops[-1]], self.behind[-1]
        return whole[len(tail) :] if self.rows.stops[-1] == len(self.data) and whole.startswith(tail) else b""

    def _values(self) -> Float[np.ndarray, "rows columns"]:
        """The values of all numbers; 0 for a token that is none."""
        starts, stops = self.rows.number_starts.ravel(), self.rows.number_stops.ravel()
        body = self.rows.body
        text = np.frombuffer(self.data, np.uint8)[body:]
        inside = np.zeros(len(text) + 1, np.int8)
        inside[starts - body] = 1
        inside[stops - body] -= 1
        bare = np.where(np.cumsum(inside[:-1], dtype=np.int8) > 0, text, ord(" ")).astype(np.uint8).tobytes()
        try:
            found = motion_text.numbers(bare, 0, "")
        except FormatError:
            found = motion_text.numbers(re.sub(rb"\S+", _number_or_zero, bare), 0, "")
        return found.reshape(self.rows.number_starts.shape)

    def _tokens(self, row: int) -> list[bytes]:
        spans = zip(self.rows.number_starts[row].tolist(), self.rows.number_stops[row].tolist(), strict=True)
        return [self.data[a:b] for a, b in spans]

    def _rule(self, values: Float[np.ndarray, "rows columns"]) -> tuple[NumberRule, int] | None:
        """The rule that most numbers of a sample follow, and the decimals of its table."""
        sample = np.unique(np.linspace(0, len(values) - 1, _SAMPLE).astype(int))
        tokens = [token for row in sample.tolist() for token in self._tokens(row)]
        best, fewest = None, len(tokens) // 4 + 1
        for rule in _rules(tokens):
            decimals = _decimals(rule, float(np.median(np.abs(values[sample]), axis=0).max()))
            records = fields(rule, decimals, split(rule, decimals, values[sample])[0], np.array([b" "]))
            wrong = sum(a != b for a, b in zip(records.tobytes().translate(None, b"\0").split(), tokens, strict=True))
            if wrong < fewest:
                best, fewest = (rule, decimals), wrong
        return best

    def _layout(self, template: Template, table: NumberTable, numbers: Numbers) -> Layout | None:
        """None where too much is odd: a quarter of the text."""
        patches = dict(self._asides())
        spare = len(self.data) // 4 - sum(map(len, patches.values()))
        rule = template.rule
        none = (np.broadcast_to(np.uint64(0), table.integers.shape), np.broadcast_to(np.int64(0), table.integers.shape))
        extra, tiny = (numbers.extra, numbers.tiny) if rule.kind == GENERAL or rule.digits != table.decimals else none
        layout = Layout(len(self.missing), (), self._counts(), (), extra, tiny)
        writer = Writer(template, layout, table)
        wrong = [row for span, _ in writer.spans() for row in self._wrong(writer, span, rule)]
        trimmed = []
        if rule.kind == FIXED and wrong:
            differ = self._differ(writer, np.array(wrong), writer.trimmed)
            trimmed = [row for row, differs in zip(wrong, differ, strict=True) if not differs]
        for row in sorted(set(wrong) - set(trimmed)):
            found = self._patches(writer, row, rule)
            if rule.kind == FIXED and len(other := self._patches(writer, row, writer.trimmed)) < len(found):
                found = other
                trimmed.append(row)
            patches |= found
            spare -= sum(map(len, found.values()))
            if spare < 0:
                return None
        return Layout(layout.cut, _spans(sorted(trimmed)), layout.counts, tuple(sorted(patches.items())), extra, tiny)

    def _asides(self) -> Iterator[tuple[int, bytes]]:
        """What stands between rows."""
        starts = [*self.rows.starts.tolist(), len(self.data)]
        stops = [self.rows.body, *self.rows.stops.tolist()]
        for row, (stop, start) in enumerate(zip(stops, starts, strict=True)):
            if start > stop:
                yield row * self.line, self.data[stop:start]

    def _counts(self) -> tuple[tuple[int, int], ...]:
        if self.rows.counter_stops is None:
            return ()
        spans = zip(self.rows.starts.tolist(), self.rows.counter_stops.tolist(), strict=True)
        found = [int(self.data[a:b]) for a, b in spans]
        return tuple((row, n) for row, (n, above) in enumerate(zip(found, [0, *found], strict=False)) if n != above + 1)

    def _row(self, row: int) -> bytes:
        """The bytes of a row, as if the last one were whole."""
        said = self.data[self.rows.starts[row] : self.rows.stops[row]]
        return said + self.missing if row == len(self.rows.starts) - 1 else said

    def _wrong(self, writer: Writer, span: slice, rule: NumberRule) -> list[int]:
        """The rows of a block that the writer writes otherwise."""
        text = self.data[self.rows.starts[span.start] : self.rows.stops[span.stop - 1]]
        text += self.missing if span.stop == len(self.rows.starts) else b""
        if writer.text(span, rule) == text:
            return []
        rows = np.arange(span.start, span.stop)
        return rows[self._differ(writer, rows, rule)].tolist()

    def _differ(self, writer: Writer, rows: np.ndarray, rule: NumberRule) -> list[bool]:
        records = writer.records(rows, rule)
        fronts = [writer.front(slice(row, row + 1)).tobytes() for row in rows.tolist()]
        said = [(front + record.tobytes()).translate(None, b"\0") for front, record in zip(fronts, records, strict=True)]
        return [text != self._row(row) for text, row in zip(said, rows.tolist(), strict=True)]

    def _patches(self, writer: Writer, row: int, rule: NumberRule) -> dict[int, bytes]:
        """The tokens of a row that are not as the rule has them; the row itself where that would not do."""
        rows = slice(row, row + 1)
        records, tokens = writer.records(rows, rule), self._tokens(row)
        front = writer.front(rows).tobytes().translate(None, b"\0")
        if front + b"".join(a + b for a, b in zip(tokens, self.behind, strict=True)) != self._row(row):
            return {row * self.line + 1: self._row(row)}
        cells = records.view(np.uint8).reshape(len(tokens), -1)[:, : -writer.literals.itemsize]
        said = [cell.tobytes().translate(None, b"\0") for cell in cells]
        places = range(row * self.line + 2, (row + 1) * self.line)
        return {place: token for place, token, text in zip(places, tokens, said, strict=True) if token != text}


def _rules(tokens: list[bytes]) -> Iterator[NumberRule]:
    """What may have written these tokens; those that need the fewest bytes first."""
    found = [match for match in map(_DECIMAL.fullmatch, tokens) if match]
    decimals = [len(match[2] or b"") for match in found if not match[3]]
    if decimals:
        common = max(set(decimals), key=decimals.count)
        for kind, digits in ((FIXED, common), (TRIMMED, max(decimals))):
            if digits <= MAX_DECIMALS:
                yield NumberRule(kind, digits)
    ends = b".0" if any(match[2] == b"0" for match in found) else b""
    if decimals and ends and max(decimals) <= MAX_DECIMALS:
        yield NumberRule(TRIMMED, max(decimals), ends)
    significant = [len((m[1] + (m[2] or b"" if m[2] != b"0" else b"")).lstrip(b"0")) for m in found]
    exponents = [len(match[3]) for match in found if match[3]]
    if significant and 1 <= max(significant) <= MAX_SIGNIFICANT:
        yield NumberRule(GENERAL, max(significant), ends, min(max(min(exponents, default=2), 2), 3))


def _decimals(rule: NumberRule, largest: float) -> int:
    """As many as a table has room for; of six significant digits the last two are left to the layout below 1."""
    decimals = max(rule.digits - 2, 0) if rule.kind == GENERAL else rule.digits
    while decimals and largest * 10.0**decimals > LARGEST // 4:
        decimals -= 1
    return decimals


def _number_or_zero(match: re.Match[bytes]) -> bytes:
    try:
        motion_text.number(match[0])
    except ValueError:
        return b"0" * len(match[0])
    return match[0]


def _spans(rows: list[int]) -> tuple[tuple[int, int], ...]:
    """Rows in order as (start, stop)."""
    if not rows:
        return ()
    cuts = np.flatnonzero(np.diff(rows) > 1) + 1
    return tuple((int(part[0]), int(part[-1]) + 1) for part in np.split(np.array(rows), cuts))
