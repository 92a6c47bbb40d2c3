"""The tables of `jaxmocap bench lsdt`, part by part."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from .lsdt import error_saved, of_clip
from .lsdt_packets import SHOWN_FROM, name_of

_WIDTH = 30


def text(result: dict) -> str:
    """The tables for people."""
    return "\n\n".join("\n".join(write(result)) for part, write in _TEXTS.items() if part in result)


def _frame_based(result: dict) -> list[str]:
    curves = result["frame_based"]
    lines = ["frame by frame (Fig. 6), no lookahead; ratio of the continuous file:", *_ratios(curves)]
    lines += _over(curves, "live", "lsdt-frame")
    saved = {"all": error_saved(curves["lsdt-frame"], curves["dct-frame"])}
    for clip in _clips(curves):
        saved[clip] = error_saved(of_clip(curves["lsdt-frame"], clip), of_clip(curves["dct-frame"], clip))
    lines += ["  mean error that lsdt-frame saves against dct-frame at equal ratio, least and most:"]
    lines += [
        f"    {clip:<7}" + f"{min(at):6.0%} to {max(at):4.0%}"
        for clip, points in saved.items()
        if (at := [point["saved"] for point in points])
    ]
    return [*lines, "", *_by_clip(curves)]


def _rate_distortion(result: dict) -> list[str]:
    curves = result["rate_distortion"]
    lines = ["clips and sequences (Fig. 7):", *_ratios(curves)]
    for rival in ("mdtt", "pca-rdo"):
        lines += _over(curves, "lsdt-clip runs L=240", rival)
    return [*lines, "", *_by_clip(curves)]


def _sparsity(result: dict) -> list[str]:
    found = result["sparsity"]
    clips = ", ".join(_clips(next(iter(found.values()))))
    lines = [f"sparsity P of the bases (Fig. 4), whole models trained for each; {clips} together:"]
    for codec, curves in found.items():
        lines += _ratios({f"{codec} {p}": rows for p, rows in curves.items()})
    return lines


def _table(result: dict) -> list[str]:
    rows = result["table"]
    lines = [
        "Table 2. Latency in frames, F: the whole sequence; parameters: set + looked for by the encoder; frames/s on one",
        "core, the search for 1 cm included; bytes of bones and bases in all streams; the file that both ends have.",
        f"  {'':<{_WIDTH}}latency  parameters  encode/s  decode/s  bones, bases     model  ratio at 1 cm  besides coefficients",
    ]
    return lines + [
        f"  {row['method']:<{_WIDTH}}{'F' if row['latency_frames'] is None else row['latency_frames']:>7}"
        f"{len(row['set']):>8} + {len(row['found'])}{row['encode_fps']:10,.0f}{row['decode_fps']:10,.0f}"
        f"{row['besides_bytes']:6d} ={row['besides_bytes'] / row['bytes']:5.1%}{row['model_bytes'] / 1000:7.1f} kB"
        f"{row['ratio']:12.1f}    {row['besides']}"
        for row in rows
    ]


def _packets(result: dict) -> list[str]:
    found = result["packets"]
    lines = [
        "one packet a frame, 3 bytes of framing in each: bytes a packet, and ratio. Every clip meets the mean error by itself,",
        f"from frame {SHOWN_FROM} on; all packets count. Header, step and bones come on top in lsdt-frame, nothing in live.",
        _line("mean error, cm", (f"{row['target_cm']:g}" for row in found["lsdt-frame"])),
        *[_line(f"{name}: bytes", (f"{row['bytes_a_packet']:.2f}" for row in rows)) for name, rows in found.items()],
        *[_line(f"{name}: ratio", (f"{row['ratio']:.1f}" for row in rows)) for name, rows in found.items()],
    ]
    if "frame_based" in result:
        files = {name: {row["target_cm"]: row for row in rows} for name, rows in result["frame_based"].items()}
        for name in ("lsdt-frame", "live"):
            at = (files[name].get(row["target_cm"]) for row in found["lsdt-frame"])
            lines.append(_line(f"{name}, file: ratio", (f"{row['ratio']:.1f}" if row else "-" for row in at)))
    lines += _over(found, name_of(0), "lsdt-frame") + _over(found, name_of(1), "lsdt-frame")
    return lines + ["", *_by_clip(found)]


def _speeds(result: dict) -> list[str]:
    live, cold, learning = (result["speeds"][name] for name in ("live", "cold_decode", "training"))
    lines = [f"live, one frame of {live['clip']} encoded and decoded, ms: median, 99th percentile, most"]
    for row in live["rows"]:
        for clock, times in row["a_frame"].items():
            shown = "".join(f"{times[name]:8.2f}" for name in ("median_ms", "p99_ms", "max_ms"))
            lines.append(f"  {row['repeats']} repeats, {clock + ' time':<16}{shown}")
        lines.append(f"  {row['repeats']} repeats: {row['streams']} streams at once on one core, encoded and decoded, keep up")
    return [
        *lines,
        f"cold decode of {cold['clip']}, lsdt-clip: {cold['decode_s']:.2f} s, import jax {cold['import_jax_s']:.2f} s, "
        f"{cold['ratio']:.2f} times",
        f"learning, P = 8, 300 iterations: {learning['jax_s']:.2f} s with compilation, numpy {learning['numpy_s']:.2f} s, "
        f"{learning['numpy_over_jax']:.2f} times as long",
    ]


def _convergence(result: dict) -> list[str]:
    lines = ["objective (6) at the end, x y z (Fig. 3):"]
    return lines + [
        f"  {name:<{_WIDTH}}" + "".join(f"{v:12.0f}" for v in curve[-1]) for name, curve in result["convergence"].items()
    ]


def _spatial_transforms(result: dict) -> list[str]:
    found = result["spatial_transforms"]
    return [
        "mean error in cm by share of nonzero coefficients (Fig. 5):",
        _line("", (f"{row['share']:.0%}" for row in found["lsdt"])),
        *[_line(name, (f"{row['mean_cm']:.3f}" for row in rows)) for name, rows in found.items()],
    ]


def _players(result: dict) -> list[str]:
    found = result["players"]
    lines = [f"{found['clip']} at the same ratio (Figs. 8 and 9, as players):"]
    return lines + [
        f"  {figure}  {name:<{_WIDTH}}{row['bytes']:6d} bytes {row['ratio']:7.1f}:1   mean {row['mean_cm']:.2f}, "
        f"worst joint {max(row['per_joint_cm']):.2f}, max {row['max_cm']:.2f} cm"
        for figure, rows in found["figures"].items()
        for name, row in rows.items()
    ]


def _ratios(curves: Mapping[str, list[dict]]) -> list[str]:
    head = _line("mean error, cm", (f"{row['target_cm']:g}" for row in next(iter(curves.values()))))
    return [head, *[_line(name, (f"{row['ratio']:.1f}" for row in rows)) for name, rows in curves.items()]]


def _over(curves: Mapping[str, list[dict]], name: str, rival: str) -> list[str]:
    """How many times the ratio of a rival, by error."""
    of_rival = {row["target_cm"]: row["ratio"] for row in curves[rival]}
    return [_line(f"{name} / {rival}", (f"{row['ratio'] / of_rival[row['target_cm']]:.2f}" for row in curves[name]))]


def _by_clip(curves: Mapping[str, list[dict]]) -> list[str]:
    """Ratios at 1 cm, or at the largest error."""
    at = {name: next((row for row in rows if row["target_cm"] == 1.0), rows[-1]) for name, rows in curves.items()}
    clips = next(iter(at.values()))["clips"]
    return [
        f"  clip by clip at {next(iter(at.values()))['target_cm']:g} cm:",
        _line("", (clip["clip"] for clip in clips)),
        _line("frames", (str(clip["frames"]) for clip in clips)),
        *[_line(name, (f"{clip['ratio']:.1f}" for clip in row["clips"])) for name, row in at.items()],
    ]


def _clips(curves: Mapping[str, list[dict]]) -> list[str]:
    return [clip["clip"] for clip in next(iter(curves.values()))[0]["clips"]]


def _line(name: str, cells: Iterable[str]) -> str:
    return f"  {name:<{_WIDTH}}" + "".join(f"{cell:>9}" for cell in cells)


_TEXTS: dict[str, Callable[[dict], list[str]]] = {
    "frame_based": _frame_based, "rate_distortion": _rate_distortion, "table": _table, "packets": _packets,
    "speeds": _speeds, "sparsity": _sparsity, "convergence": _convergence, "spatial_transforms": _spatial_transforms,
    "players": _players,
}  # fmt: skip
