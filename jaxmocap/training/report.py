"""The curves of a training run as one picture."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw(report: dict) -> bytes:
    """A PNG of what the report of a trainer says."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    _DRAWINGS[report["codec"]](figure, report)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()


def _draw_lsdt(figure: Figure, report: dict) -> None:
    """The objective of each coordinate over the iterations, and nonzero coefficients a frame over the step."""
    left, right = figure.subplots(1, 2)
    objective = np.array(report["objective"])
    for curve, name in zip(objective.T, "xyz", strict=True):
        left.semilogy(curve, label=name)
    left.set(title="objective (6) as the bases are learned", xlabel="iteration", ylabel="cm²")
    left.legend()
    left.grid(alpha=0.3)
    _draw_nonzeros(right, report)


def _draw_dct(figure: Figure, report: dict) -> None:
    """Nonzero coefficients a frame over the step."""
    _draw_nonzeros(figure.subplots(), report)


def _draw_nonzeros(axes: Axes, report: dict) -> None:
    axes.loglog(report["steps_cm"], report["nonzeros_a_frame"], "o-")
    axes.set(title="what is left to code", xlabel="quantiser step, cm", ylabel="nonzero coefficients a frame")
    axes.grid(alpha=0.3)


def _draw_exact(figure: Figure, report: dict) -> None:
    """Where the bits of a frame go, column by column."""
    axes = figure.subplots()
    bits = report["bits_a_frame"]
    axes.bar(range(len(bits)), list(bits.values()))
    axes.set_xticks(range(len(bits)), list(bits), rotation=90, fontsize=5)
    axes.set(title=f"{sum(bits.values()):.0f} bits a frame", ylabel="bits a value")
    axes.grid(alpha=0.3, axis="y")


def _draw_learned(figure: Figure, report: dict) -> None:
    """Bits a level of the lowest band and of the octaves over all epochs, as trained and on what is held out."""
    for axes, which in zip(figure.subplots(1, 2), ("slow", "fast"), strict=True):
        curves = [np.array(curve) for name, curve in report["curves"].items() if name.endswith(f".{which}")]
        for n, name in enumerate(("trained", "held out")):
            axes.plot(np.concatenate(curves)[:, n], "o-", label=name)
        axes.set(title={"slow": "lowest band", "fast": "octaves"}[which], xlabel="epoch", ylabel="bits a level")
        axes.legend()
        axes.grid(alpha=0.3)


def _draw_live(figure: Figure, report: dict) -> None:
    """The loss of the network, over updates, and bits a level of packets, over epochs."""
    for axes, name in zip(figure.subplots(1, 2), ("network", "packets"), strict=True):
        axes.plot(report["curves"][name], "o-")
        axes.set(title=name, ylabel={"network": "loss", "packets": "bits a level"}[name])
        axes.set_xlabel({"network": "25 steps", "packets": "epoch"}[name])
        axes.grid(alpha=0.3)


_DRAWINGS = {
    "learned": _draw_learned,
    "live": _draw_live,
    "lsdt-clip": _draw_lsdt,
    "lsdt-frame": _draw_lsdt,
    "dct-frame": _draw_dct,
    "exact": _draw_exact,
}
