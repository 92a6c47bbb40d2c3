"""The figure of `jaxmocap bench rd`: ratio against mean error, all methods."""

from __future__ import annotations

from matplotlib.figure import Figure


def curves(result: dict) -> Figure:
    """Peers that take all frames are dashed, in the colour of their thinned selves."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.subplots()
    colours: dict[str, str] = {}
    for name, rows in result["curves"]["methods"].items():
        peer = name.removesuffix(", thinned")
        colour = colours.setdefault(peer, f"C{len(colours)}")
        points = [row for row in rows if "missing" not in row]
        dashed = f"{peer}, thinned" in result["curves"]["methods"] and name == peer
        line = "--" if dashed else "-"
        axes.loglog([r["mean_cm"] for r in points], [r["ratio"] for r in points], f"o{line}", color=colour, label=name)
    axes.set(xlabel="mean joint error, cm", ylabel="float32 positions of all joints / bytes")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure
