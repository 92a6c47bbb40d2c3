"""`jaxmocap unpack`: the files of a database, or some of them."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from ..errors import CorruptStream, JaxmocapError
from .base import Command, Input, Output, Report, load_model, table
from .database import file_progress, open_database


@dataclass(kw_only=True)
class Unpack(Command):
    """Unpack a database, or some of its files. What is damaged is named; all else comes out."""

    input: Input
    """A database."""
    output: Output
    """The folder to write to."""
    files: tyro.conf.Positional[tuple[str, ...]] = ()
    """Files and folders of the database. Default: all."""
    model: Path | None = None
    """The model that the database needs, where it is neither shipped nor embedded."""

    def run(self) -> Report:
        from ..codecs.archive.index import FOLDER, shown
        from ..codecs.archive.unpacking import chosen, unpack

        began = time.perf_counter()
        database = open_database(self.input, load_model(self.model))
        damaged, files, frames, size = [], 0, 0, 0
        entries = chosen(database, self.files)
        with file_progress(len(entries)) as done:
            for file in unpack(database, self.output, entries):
                done()
                if isinstance(file.data, JaxmocapError):
                    damaged.append(shown(file.entry.name))
                    print(f"jaxmocap: {self.input}: {file.data}", file=sys.stderr)
                else:
                    files, frames, size = files + (file.entry.kind != FOLDER), frames + file.frames, size + len(file.data)
        if damaged:
            raise CorruptStream(f"{self.input}: not written, as they are damaged: {', '.join(damaged)}; files written: {files}")
        return {"files": files, "frames": frames, "text_bytes": size, "seconds": time.perf_counter() - began}

    def text(self, report: Report) -> str:
        return table([
            (str(self.output), f"{report['text_bytes']:,} bytes"),
            ("files", report["files"]),
            ("frames", report["frames"]),
            ("seconds", report["seconds"]),
        ])
