"""`jaxmocap export`: a learned basis and its tables for a program in another language."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .base import Command, Output, Report, table


@dataclass(kw_only=True)
class Export(Command):
    """Export a model."""

    model: tyro.conf.Positional[Path]
    """A model file, or the id of a shipped one, such as lsdt-clip."""
    kind: Annotated[Literal["safetensors", "npz", "c"], tyro.conf.arg(name="format")]
    """safetensors, npz, or a C header."""
    output: Output
    """The file to write."""

    def run(self) -> Report:
        from ..codecs.artifact import load_artifact
        from ..formats.text import write_bytes
        from ..training.export import export_model

        artifact = load_artifact(self.model)
        data = export_model(artifact, self.kind)
        write_bytes(self.output, data)
        return {"output": str(self.output), "bytes": len(data), "digest": artifact.digest}

    def text(self, report: Report) -> str:
        return table([(str(self.output), f"{report['bytes']:,} bytes"), ("model", report["digest"])])
