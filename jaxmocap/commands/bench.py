"""`jaxmocap bench`: the papers' tables and figures, side by side with peers, on this machine."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ..errors import JaxmocapError
from .base import Command, Report

Part = Literal["curves", "one_clip", "speeds", "shell", "first_frame", "bounds", "people", "rig"]


@dataclass(kw_only=True)
class Bench(Command):
    """Measure on real motion."""

    names: tyro.conf.Positional[tuple[Literal["lossless", "lsdt", "rd"], ...]]
    """What to measure."""
    parts: tuple[Part, ...] = ()
    """Only these parts of rd, of which people and rig train. Default: all."""
    data: Path | None = None
    """The folder with cmu_bvh. Default: JAXMOCAP_DATA, or ../shared/data."""
    output: Path | None = None
    """A folder for the report (JSON) and the plots (PNG)."""

    def run(self) -> Report:
        from ..bench import BENCHES
        from ..bench.data import data_folder

        if self.parts and "rd" not in self.names:
            raise JaxmocapError("--parts are those of rd, which is not among what is measured")
        folder = data_folder(self.data)
        results: Report = {"machine": {"cores": os.cpu_count(), "python": platform.python_version()}}
        for name in self.names:
            results[name] = BENCHES[name].measure(folder, *([self.parts] if name == "rd" else []))
            if self.output is not None:
                BENCHES[name].save(results[name], self.output)
        return results

    def text(self, report: Report) -> str:
        from ..bench import BENCHES

        return "\n\n".join(BENCHES[name].text(report[name]) for name in self.names)
