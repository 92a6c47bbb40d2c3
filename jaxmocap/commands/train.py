"""`jaxmocap train`: a model from a corpus."""

from __future__ import annotations

import json as json_module
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from .base import Command, Output, Report, checked_unit, table


@dataclass(kw_only=True)
class Train(Command):
    """Learn a transform from motion files of one rig. Interrupted, it resumes where it was."""

    corpus: tyro.conf.Positional[tuple[Path, ...]]
    """Files, and folders with all motion files below them."""
    output: Output
    """The model to write; its report (JSON, and curves as PNG) is written beside it."""
    codec: str = "lsdt-clip"
    """The codec that the model is for."""
    unit_cm: float | None = None
    """Centimetres per file unit."""
    start: int = 0
    """Leave out so many frames at the front of each file."""

    def run(self) -> Report:
        from ..errors import JaxmocapError
        from ..formats.text import write_bytes
        from ..training import TRAINERS
        from ..training.corpus import Corpus
        from ..training.report import draw

        if self.codec not in TRAINERS:
            raise JaxmocapError(f"--codec is {self.codec!r}, wanted one of {', '.join(TRAINERS)}")
        began = time.perf_counter()
        corpus = Corpus.of(self.corpus, checked_unit(self.unit_cm), self.start)
        checkpoint = self.output.with_name(self.output.name + ".partial")
        artifact, report = TRAINERS[self.codec](corpus, checkpoint)
        report["seconds"] = time.perf_counter() - began
        write_bytes(self.output, artifact.data)
        write_bytes(self.output.with_suffix(".json"), json_module.dumps(report, indent=1).encode())
        write_bytes(self.output.with_suffix(".png"), draw(report))
        checkpoint.unlink(missing_ok=True)
        return {"model": str(self.output), "bytes": len(artifact.data), **report}

    def text(self, report: Report) -> str:
        return table([
            (str(self.output), f"{report['bytes']:,} bytes"),
            ("digest", report["digest"]),
            ("files", report["files"]),
            ("frames", report["frames"]),
            ("report", f"{self.output.with_suffix('.json')}, {self.output.with_suffix('.png')}"),
            ("seconds", report["seconds"]),
        ])
