"""The figures of Hou et al. 2016 that their measurements here can be laid beside."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from .lsdt import of_clip

Curves = Mapping[str, list[dict]]


def bases(result: dict) -> Figure:
    """Fig. 2: matrices whose columns are basis functions, each divided by its largest value; grey is zero."""
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for axes, (name, basis) in zip(figure.subplots(1, len(result["bases"])), result["bases"].items(), strict=True):
        columns = np.array(basis).T
        axes.imshow(columns / np.abs(columns).max(0), cmap="gray", vmin=-1, vmax=1, interpolation="nearest")
        axes.set(title=name.upper(), xlabel="basis function", ylabel="joint", xticks=[], yticks=[])
    return figure


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


def sparsity(result: dict) -> Figure:
    """Fig. 4: the effect of P on ratio and distortion, frame by frame above, by clips below; clip by clip, and together."""
    found = result["sparsity"]
    chosen = [*_clips(next(iter(found.values()))), None]
    figure = Figure(figsize=(3 * len(chosen), 6), layout="constrained")
    for row, (codec, curves) in zip(figure.subplots(len(found), len(chosen), squeeze=False), found.items(), strict=True):
        for axes, clip in zip(row, chosen, strict=True):
            _draw(axes, curves, clip)
            axes.set_title(f"{codec}, {clip or 'all clips'}")
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


def frame_based(result: dict) -> Figure:
    """Fig. 6: methods without lookahead."""
    return _clip_by_clip(result["frame_based"])


def clip_based(result: dict) -> Figure:
    """Fig. 7: methods that wait for a clip or for the whole sequence."""
    return _clip_by_clip(result["rate_distortion"])


def clip_length(result: dict) -> Figure:
    """Fig. 7 of all clips together."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    _draw(axes, result["rate_distortion"], None)
    axes.set(title="ratio and distortion (Fig. 7)")
    axes.legend()
    return figure


def table(result: dict) -> Figure:
    """Table 2."""
    head = ("method", "latency,\nframes", "parameters,\nset + found", "encode,\nframes/s", "decode,\nframes/s",
            "also needed,\nand from where", "ratio\nat 1 cm")  # fmt: skip
    cells = [
        (row["method"], "all" if row["latency_frames"] is None else str(row["latency_frames"]),
         f"{len(row['set'])} + {len(row['found'])}", f"{row['encode_fps']:,.0f}", f"{row['decode_fps']:,.0f}", row["besides"],
         f"{row['ratio']:.1f}")
        for row in result["table"]
    ]  # fmt: skip
    figure = Figure(figsize=(9, 0.32 * (len(cells) + 2)), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    widths = [0.2, 0.1, 0.12, 0.11, 0.11, 0.27, 0.09]
    drawn = axes.table(cells, colLabels=head, cellLoc="left", colWidths=widths, loc="center")
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(8)
    for (row, _), cell in drawn.get_celld().items():
        cell.set(height=(2 if row == 0 else 1) / (len(cells) + 2), linewidth=0.4)
    return figure


def _clip_by_clip(curves: Curves) -> Figure:
    panels = [*_clips(curves), None]
    columns = min(len(panels), 5)
    lines = -(-len(panels) // columns)
    figure = Figure(figsize=(3.2 * columns, 3.2 * lines), layout="constrained")
    for axes, clip in zip(figure.subplots(lines, columns, squeeze=False).flat, panels, strict=False):
        _draw(axes, curves, clip)
        axes.set_title(clip or "all clips")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


def _draw(axes: Axes, curves: Curves, clip: str | None) -> None:
    """Distortion over ratio of one clip, or of all together."""
    for name, rows in curves.items():
        rows = rows if clip is None else of_clip(rows, clip)
        line = "--" if "paper" in name else "-"
        axes.loglog([r["ratio"] for r in rows], [r["mean_cm"] for r in rows], f"o{line}", markersize=3, label=name)
    axes.set(xlabel="compression ratio", ylabel="mean error, cm")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)


def _clips(curves: Curves) -> list[str]:
    return [clip["clip"] for clip in next(iter(curves.values()))[0]["clips"]]


FIGURES: dict[str, tuple[str, Callable[[dict], Figure]]] = {
    "fig2_bases": ("bases", bases),
    "fig3_convergence": ("convergence", convergence),
    "fig4_sparsity": ("sparsity", sparsity),
    "fig5_transforms": ("spatial_transforms", transforms),
    "fig6_frame_based": ("frame_based", frame_based),
    "fig7_clip_based": ("rate_distortion", clip_based),
    "table2": ("table", table),
}
