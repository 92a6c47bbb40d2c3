"""The figures of Hou et al. 2016 that their measurements here can be laid beside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure


def sparsity(result: dict) -> Figure:
    """Fig. 4: the effect of P on the ratio."""
    return _rate_distortion({k: v for k, v in result["sparsity"].items() if k.startswith("runs")}, "sparsity P (Fig. 4)")


def clip_length(result: dict) -> Figure:
    """Fig. 7: ratio against distortion for both forms and all clip lengths."""
    return _rate_distortion(result["rate_distortion"], "ratio and distortion (Fig. 7)")


def convergence(result: dict) -> Figure:
    """Fig. 3: the objective over the iterations."""
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for d, axes in enumerate(figure.subplots(1, 3)):
        for name, curve in result["convergence"].items():
            axes.semilogy(np.array(curve)[:, d], label=name, linestyle="--" if "dwt" in name else "-")
        axes.set(title=f"{'xyz'[d]}-coordinate", xlabel="iteration", ylabel="objective (6), cm²")
        axes.grid(alpha=0.3)
    figure.axes[0].legend()
    return figure


def transforms(result: dict) -> Figure:
    """Fig. 5: distortion by the share of nonzero coefficients."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, rows in result["spatial_transforms"].items():
        axes.semilogy([100 * r["share"] for r in rows], [r["mean_cm"] for r in rows], "o-", label=name.upper())
    axes.set(title="spatial transforms (Fig. 5)", xlabel="nonzero coefficients, %", ylabel="mean error, cm")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def _rate_distortion(curves: dict[str, list[dict]], title: str) -> Figure:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, rows in curves.items():
        axes.plot([r["ratio"] for r in rows], [r["mean_cm"] for r in rows], "o-", label=name)
    axes.set(title=title, xlabel="compression ratio", ylabel="mean error, cm", xscale="log")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


FIGURES: dict[str, Callable[[dict], Figure]] = {
    "sparsity": sparsity, "clip_length": clip_length, "convergence": convergence, "transforms": transforms,
}
