"""`jaxmocap pack`: a folder to a lossless database."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from .base import Command, Input, Output, Report, load_model, table
from .database import file_progress


@dataclass(kw_only=True)
class Pack(Command):
    """Pack a folder into one file, from which every file comes back byte for byte."""

    input: Input
    """A folder, with whatever is in it, or a file. Motion text (BVH, AMC) packs best."""
    output: Output
    """The database to write."""
    codec: str = "exact"
    """What codes the numbers of motion text: exact or mrpa."""
    model: Path | None = None
    """A trained model, which then travels in the database. Default: the one shipped for the codec, if any."""

    def run(self) -> Report:
        from ..codecs.archive.packing import find_files, pack
        from ..formats.text import write_bytes

        began = time.perf_counter()
        files = find_files(self.input, leave_out=self.output)
        with file_progress(2 * len(files)) as done:
            packed = pack(files, self.codec, load_model(self.model), done)
        write_bytes(self.output, packed.data)
        return {
            "codec": self.codec,
            "files": packed.files,
            "frames": packed.frames,
            "text_bytes": packed.text_bytes,
            "stream_bytes": len(packed.data),
            "ratio": packed.text_bytes / len(packed.data),
            "seconds": time.perf_counter() - began,
        }

    def text(self, report: Report) -> str:
        return table([
            (str(self.output), f"{report['stream_bytes']:,} bytes, {report['ratio']:.2f}:1 of {report['text_bytes']:,}"),
            ("files", report["files"]),
            ("frames", report["frames"]),
            ("seconds", report["seconds"]),
        ])
