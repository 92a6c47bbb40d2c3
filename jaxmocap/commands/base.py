"""What all commands share: the form of a report, and files that may be motions or streams."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..errors import JaxmocapError

if TYPE_CHECKING:
    from ..codecs.artifact import Artifact
    from ..motion import Motion

Report = dict[str, object]
Input = tyro.conf.Positional[Path]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


@dataclass(kw_only=True)
class Command(abc.ABC):
    """A command; `run` does the work and gives what `--json` prints."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object instead of text."""

    @property
    def writes_stdout(self) -> bool:
        """Whether standard output is where the command's data go, so that a report belongs elsewhere."""
        return False

    @abc.abstractmethod
    def run(self) -> Report:
        """Do it. Raises JaxmocapError or OSError for bad input."""

    @abc.abstractmethod
    def text(self, report: Report) -> str:
        """The report for people."""


def load_motion(path: Path, unit_cm: float | None = None, model: Path | None = None) -> Motion:
    """A motion file, or the motion of a stream."""
    from ..codecs.container import SUFFIX

    if path.suffix.lower() == SUFFIX:
        from ..codecs import decode

        return decode(path.read_bytes(), load_model(model))
    return read_file(path, unit_cm)


def read_file(path: Path, unit_cm: float | None) -> Motion:
    """A motion file. Raises JaxmocapError where the unit is none."""
    from ..formats import read_motion

    return read_motion(path, checked_unit(unit_cm))


def checked_unit(unit_cm: float | None) -> float | None:
    """The unit as it was given. Raises JaxmocapError where it is no length."""
    if unit_cm is not None and not 0 < unit_cm < float("inf"):
        raise JaxmocapError(f"--unit-cm is {unit_cm}, wanted centimetres per file unit above 0")
    return unit_cm


def load_model(model: Path | None) -> Artifact | None:
    """The model of a file or the id of a shipped one, or None."""
    from ..codecs.artifact import load_artifact

    return None if model is None else load_artifact(model)


def without_first(motion: Motion, count: int, name: str) -> Motion:
    """The motion without its first frames. Raises JaxmocapError where none is left."""
    if count < 0 or count >= motion.frame_count:
        raise JaxmocapError(f"{name}: cannot leave out the first {count} of {motion.frame_count} frames")
    return motion.frames(count) if count else motion


def unit_name(motion: Motion) -> str:
    return "file units" if motion.unit_cm is None else "cm"


def table(rows: list[tuple[str, object]]) -> str:
    """Names and values in two columns."""
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {_shown(value)}" for name, value in rows)


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)
