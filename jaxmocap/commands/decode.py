"""`jaxmocap decode`: a stream, or some of its frames, to a motion file."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from ..errors import JaxmocapError
from .base import Command, Input, Output, Report, load_model, table


@dataclass(kw_only=True)
class Decode(Command):
    """Decompress a stream."""

    input: Input
    """A .jmc stream."""
    output: Output
    """The file to write: .bvh, .npz or .trc."""
    frames: str | None = None
    """A:B, as in Python: frame B is not included; either may be left out, and negative ones count from the end."""
    quality: int | None = None
    """Of a progressive stream, from 1, the coarsest: bytes beyond it need not be there. Default: the finest."""
    model: Path | None = None
    """The model that the stream needs, where it is neither shipped nor embedded."""

    def run(self) -> Report:
        from ..codecs import decode
        from ..formats import write_motion

        began = time.perf_counter()
        chosen = _slice(self.frames)
        try:
            motion = decode(self.input.read_bytes(), load_model(self.model), chosen, self.quality)
        except JaxmocapError as error:
            raise type(error)(f"{self.input}: {error}") from error
        except ValueError as error:
            raise JaxmocapError(f"{self.input}: {error}") from error
        write_motion(motion, self.output)
        return {
            "frames": motion.frame_count,
            "joints": motion.skeleton.joint_count,
            "bytes": self.output.stat().st_size,
            "seconds": time.perf_counter() - began,
        }

    def text(self, report: Report) -> str:
        size = f"{report['bytes']:,} bytes"
        return table([(str(self.output), size), ("frames", report["frames"]), ("seconds", report["seconds"])])


def _slice(text: str | None) -> slice | None:
    if text is None:
        return None
    try:
        start, stop = text.split(":")
        return slice(int(start) if start else None, int(stop) if stop else None)
    except ValueError as error:
        raise JaxmocapError(f"--frames is {text!r}, wanted A:B, such as 120:240") from error
