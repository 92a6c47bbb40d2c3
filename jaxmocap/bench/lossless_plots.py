"""The figures of Wang et al. 2020 that the measurements here can be laid beside, and what is gained for how much time."""

from __future__ import annotations

from collections.abc import Callable

from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = {"files": "C0", "text": "C2", "numbers": "C1"}


def valid_path(result: dict) -> Figure:
    """Figs. 5 and 6: predicted frames, index entries and ratio against ValidPathThr."""
    return _thresholds(
        result, "ValidPathThr",
        {"predicted_frames": "predicted frames (Fig. 5)", "index_entries": "index entries (Fig. 5)", "ratio": "ratio (Fig. 6)"},
    )


def iou(result: dict) -> Figure:
    """Figs. 7 and 8: predicted frames and ratio against IoUThr."""
    return _thresholds(result, "IoUThr", {"predicted_frames": "predicted frames (Fig. 7)", "ratio": "ratio (Fig. 8)"})


def length(result: dict) -> Figure:
    """Table 3 as curves: the ratio against LengthThr."""
    figure = Figure(figsize=(5, 3.6), layout="constrained")
    axes = figure.subplots()
    for one in result["length_ratios"]:
        axes.plot([r["value"] for r in one["rows"]], [r["ratio"] for r in one["rows"]], "o-", label=one["file"])
    _finish(axes, "LengthThr, frames", "ratio (Table 3)")
    axes.legend()
    return figure


def ratios(result: dict) -> Figure:
    """Table 4: ratios measured here and as published."""
    databases = result["databases"]
    figure = Figure(figsize=(6 * len(databases), 6), layout="constrained")
    for axes, (name, found) in zip(figure.subplots(1, len(databases), squeeze=False)[0], databases.items(), strict=True):
        rows = [r for r in found["rows"] if "ratio" in r] + [found["held_out"]]
        bars = [(f"{r['name']} ({r['kind']})", r["ratio"], COLOURS[r["kind"]]) for r in rows]
        bars += [(f"{k}, published", v[0], "C7") for k, v in found["published"].items()]
        bars.sort(key=lambda bar: bar[1])
        axes.barh([b[0] for b in bars], [b[1] for b in bars], color=[b[2] for b in bars])
        axes.set(title=f"{name} (Table 4)", xlabel="bytes of text / bytes")
        axes.grid(alpha=0.3, axis="x")
    return figure


def speed(result: dict) -> Figure:
    """Table 5: the ratio against frames/s of decompression."""
    databases = result["databases"]
    figure = Figure(figsize=(6 * len(databases), 4.5), layout="constrained")
    for axes, (name, found) in zip(figure.subplots(1, len(databases), squeeze=False)[0], databases.items(), strict=True):
        for kind, colour in COLOURS.items():
            rows = [r for r in found["rows"] if r["kind"] == kind and r.get("decompress_fps")]
            axes.semilogx([r["decompress_fps"] for r in rows], [r["ratio"] for r in rows], "o", color=colour, label=kind)
            for r in rows:
                axes.annotate(r["name"].split(",")[0], (r["decompress_fps"], r["ratio"]), fontsize=7)
        _finish(axes, "decompression, frames/s on one core", "bytes of text / bytes")
        axes.set_title(f"{name} (Table 5)")
        axes.legend()
    return figure


def _thresholds(result: dict, name: str, curves: dict[str, str]) -> Figure:
    found = result["thresholds"]
    figure = Figure(figsize=(4 * len(curves), 3.6), layout="constrained")
    for axes, (key, label) in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        axes.plot([r["value"] for r in found[name]], [r[key] for r in found[name]], "o-")
        _finish(axes, name, label)
    figure.suptitle(f"{found['file']}, {found['frames']} frames")
    return figure


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)


FIGURES: dict[str, Callable[[dict], Figure]] = {
    "valid_path": valid_path, "iou": iou, "length": length, "ratios": ratios, "speed": speed,
}
