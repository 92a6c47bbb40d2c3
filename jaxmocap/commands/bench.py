"""`jaxmocap bench`: the papers' tables and figures, side by side with peers, on this machine."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from ..errors import JaxmocapError
from .base import Command, Report

PartOfRd = Literal["curves", "one_clip", "speeds", "shell", "first_frame", "bounds", "people", "rig"]
PartOfLsdt = Literal[
    "bases", "convergence", "sparsity", "spatial_transforms", "frame_based", "rate_distortion", "players", "packets", "speeds"
]
PARTS: dict[str, tuple[str, ...]] = {"rd": get_args(PartOfRd), "lsdt": get_args(PartOfLsdt)}
FIGURES = Path("lsdt-figures")


@dataclass(kw_only=True)
class Bench(Command):
    """Measure on real motion."""

    names: tyro.conf.Positional[tuple[Literal["lossless", "lsdt", "rd"], ...]]
    """What to measure."""
    parts: tuple[Literal[PartOfRd, PartOfLsdt], ...] = ()
    """Only these parts of rd, of which people and rig train, or of lsdt, of which sparsity trains. Default: all, and of
    lsdt all that are tables."""
    figures: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Draw the figures and Table 2 of the LSDT paper from lsdt, into the folder of --output or else lsdt-figures; all parts."""
    data: Path | None = None
    """The folder with cmu_bvh. Default: JAXMOCAP_DATA, or ../shared/data."""
    output: Path | None = None
    """A folder for the report (JSON) and the plots (PNG)."""

    def run(self) -> Report:
        from ..bench import BENCHES
        from ..bench.data import data_folder

        if self.figures and "lsdt" not in self.names:
            raise JaxmocapError("--figures are those of lsdt, which is not among what is measured")
        parts = {name: self._parts_of(name) for name in self.names}
        folder = data_folder(self.data)
        results: Report = {"machine": {"cores": os.cpu_count(), "python": platform.python_version()}}
        for name in self.names:
            results[name] = BENCHES[name].measure(folder, *parts[name])
            if self._output is not None:
                BENCHES[name].save(results[name], self._output)
        return results

    @property
    def _output(self) -> Path | None:
        return self.output or (FIGURES if self.figures else None)

    def _parts_of(self, name: str) -> list[tuple[str, ...] | Path | None]:
        """What is passed on to a benchmark that has parts. Raises JaxmocapError where none of those named is of it."""
        if name not in PARTS:
            if self.parts and not set(self.names) & set(PARTS):
                raise JaxmocapError(f"--parts are those of {' and '.join(PARTS)}, not of {name}")
            return []
        chosen = tuple(part for part in self.parts if part in PARTS[name])
        if self.parts and not chosen:
            raise JaxmocapError(f"--parts names none of {name}, which has {', '.join(PARTS[name])}")
        if name == "lsdt":
            return [chosen or PARTS[name] if self.figures else chosen, self._output and self._output / "lsdt.partial"]
        return [chosen]

    def text(self, report: Report) -> str:
        from ..bench import BENCHES

        return "\n\n".join(BENCHES[name].text(report[name]) for name in self.names)
