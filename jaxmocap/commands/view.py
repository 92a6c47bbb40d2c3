"""`jaxmocap view`: a player in one HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..errors import JaxmocapError
from .base import Command, Input, Output, Report, load_motion, table, without_first


@dataclass(kw_only=True)
class View(Command):
    """Write a player of one motion, or of two side by side with the error between them."""

    a: Input
    """A motion file or a stream."""
    b: tyro.conf.Positional[Path | None] = None
    """Another one of the same joints."""
    output: Output
    """The HTML file to write."""
    unit_cm: float | None = None
    """Centimetres per file unit."""
    start: int = 0
    """Leave out so many frames at the front; of A alone where B lacks just those."""
    model: Path | None = None
    """The model that a stream needs, where it is neither shipped nor embedded."""

    def run(self) -> Report:
        from ..formats.text import write_bytes
        from ..viewer import motion_player

        a = load_motion(self.a, self.unit_cm, self.model)
        b = None if self.b is None else load_motion(self.b, self.unit_cm, self.model)
        of_both = b is None or a.frame_count - b.frame_count != self.start
        a = without_first(a, self.start, self.a.name)
        if b is not None:
            b = without_first(b, self.start if of_both else 0, str(self.b))
        titles = (self.a.name, self.b.name if self.b is not None else "")
        try:
            page = motion_player(a, b, titles)
        except ValueError as error:
            raise JaxmocapError(f"{self.a} and {self.b} cannot be shown together: {error}") from error
        write_bytes(self.output, page.encode())
        return {"output": str(self.output), "bytes": len(page.encode()), "frames": a.frame_count}

    def text(self, report: Report) -> str:
        return table([(str(self.output), f"{report['bytes']:,} bytes; open it in a browser")])
