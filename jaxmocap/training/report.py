"""The curves of a training run as one picture."""

from __future__ import annotations

import io

import numpy as np


def draw(report: dict) -> bytes:
    """A PNG: the objective of each coordinate over the iterations, and nonzero coefficients a frame over the step."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    objective = np.array(report["objective"])
    for curve, name in zip(objective.T, "xyz", strict=True):
        left.semilogy(curve, label=name)
    left.set(title="objective (6) as the bases are learned", xlabel="iteration", ylabel="cm²")
    left.legend()
    right.loglog(report["steps_cm"], report["nonzeros_a_frame"], "o-")
    right.set(title="what is left to code", xlabel="quantiser step, cm", ylabel="nonzero coefficients a frame")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()
