"""`jaxmocap ls`: what a database holds."""

from __future__ import annotations

from dataclasses import dataclass

from .base import Command, Input, Report
from .database import open_database


@dataclass(kw_only=True)
class Ls(Command):
    """List the files of a database; nothing is decoded."""

    input: Input
    """A database."""

    def run(self) -> Report:
        from ..codecs.archive.index import FOLDER, KINDS, NUMBERS

        archive = open_database(self.input).archive
        text_bytes = sum(entry.size for entry in archive.entries)
        return {
            "codec": archive.shared.codec,
            "files": sum(entry.kind != FOLDER for entry in archive.entries),
            "text_bytes": text_bytes,
            "stream_bytes": len(archive.data),
            "ratio": text_bytes / len(archive.data),
            "entries": [
                {"name": e.name, "kind": KINDS[min(e.kind, NUMBERS)], "bytes": e.size, "stored": e.stored}
                for e in archive.entries
            ],
        }

    def text(self, report: Report) -> str:
        from ..codecs.archive.index import shown

        entries = report["entries"]
        assert isinstance(entries, list)
        lines = [_line(e["bytes"], e["stored"], e["kind"], shown(e["name"])) for e in entries]
        total = _line(report["text_bytes"], report["stream_bytes"], "in all", f"{report['files']} files, with index and tables")
        return "\n".join([f"{'bytes':>13} {'stored':>11} {'ratio':>7}  kind     name", *lines, total])


def _line(size: object, stored: object, kind: str, name: str) -> str:
    assert isinstance(size, int) and isinstance(stored, int)
    ratio = f"{size / stored:.2f}" if stored else "-"
    return f"{size:>13,} {stored:>11,} {ratio:>7}  {kind:<7}  {name}"
