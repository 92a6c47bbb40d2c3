"""`jaxmocap compare`: the error of one motion against another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import JaxmocapError
from .base import Command, Input, Report, load_motion, table, unit_name, without_first


@dataclass(kw_only=True)
class Compare(Command):
    """Measure how far B is from A, joint by joint."""

    a: Input
    """The original: a motion file or a stream."""
    b: Input
    """The other one."""
    unit_cm: float | None = None
    """Centimetres per file unit."""
    start: int = 0
    """Leave out so many frames at the front; of A alone where B lacks just those."""
    model: Path | None = None
    """The model that a stream needs, where it is neither shipped nor embedded."""

    def run(self) -> Report:
        from ..metrics import compare

        a, b = (load_motion(path, self.unit_cm, self.model) for path in (self.a, self.b))
        of_both = a.frame_count - b.frame_count != self.start
        a = without_first(a, self.start, self.a.name)
        b = without_first(b, self.start if of_both else 0, self.b.name)
        try:
            return {"frames": a.frame_count, "unit": unit_name(a), "names": list(a.skeleton.names), **compare(a, b)}
        except ValueError as error:
            raise JaxmocapError(f"{self.a} and {self.b} cannot be compared: {error}") from error

    def text(self, report: Report) -> str:
        unit = report["unit"]
        rows: list[tuple[str, object]] = [("frames", report["frames"])]
        for key in ("mean_cm", "max_cm", "rms_cm", "arms", "shell_mean_cm", "shell_max_cm"):
            value = report[key]
            rows.append((f"{key.removesuffix('_cm').replace('_', ' ')}, {unit}", "not defined" if value is None else value))
        names, errors = report["names"], report["per_joint_cm"]
        assert isinstance(names, list) and isinstance(errors, list)
        worst = sorted(zip(errors, names, strict=True), reverse=True)[:3]
        rows.append(("worst joints", ", ".join(f"{name} {error:.3g}" for error, name in worst)))
        return table(rows)
