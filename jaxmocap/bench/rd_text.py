"""The tables of `jaxmocap bench rd`, part by part."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from .rd import ratio_at

_WIDTH = 30


def text(result: dict) -> str:
    """The tables for people."""
    return "\n\n".join("\n".join(_TEXTS[name](part)) for name, part in result.items())


def _curves(found: dict) -> list[str]:
    methods, targets = found["methods"], found["targets_cm"]
    lines = [
        "Compression ratio of the 9 test clips without their T-pose: float32 positions of 31 joints over real bytes. Codecs:",
        "whole streams, header and skeleton included, shipped model not. SZ3, zfp and xz: positions alone, no skeleton; joints",
        "that coincide once (21 of 31), all relative to the root; thinned: every m-th frame and a cubic spline, at the m that",
        "takes fewest bytes. Every clip meets the error by itself; between measured points the logarithm of the ratio is taken",
        "to be linear in that of the error.",
        _line("mean error, cm", (f"{cm:g}" for cm in targets)),
        *[_line(name, (_ratio(ratio_at(rows, cm)) for cm in targets)) for name, rows in methods.items()],
        *[f"  {name}: not measured, {package} is not installed" for name, package in found["missing"].items()],
    ]
    at = {name: next(row for row in rows if row["target_cm"] == found["clips_cm"]) for name, rows in methods.items()}
    clips = {name: row["clips"] for name, row in at.items() if "missing" not in row}
    return [
        *lines,
        "",
        f"ratio clip by clip at {found['clips_cm']:g} cm or a little below:",
        _line("", (clip["clip"] for clip in next(iter(clips.values())))),
        *[_line(name, (_ratio(clip["ratio"]) for clip in row)) for name, row in clips.items()],
    ]


def _one_clip(found: dict) -> list[str]:
    lines = [f"{found['clip']} alone (RMA, as published: 22.8:1 at 2.26 cm):"]
    return lines + [f"  {name:<{_WIDTH}}" + "   ".join(map(_at_target, rows)) for name, rows in found["methods"].items()]


def _at_target(row: dict) -> str:
    if "missing" in row:
        return f"{row['target_cm']:g} cm: {row['missing']}"
    return f"{row['target_cm']:g} cm: {row['bytes']:5d} bytes, {row['ratio']:6.1f}:1, max {row['max_cm']:5.2f} cm"


def _speeds(found: dict) -> list[str]:
    return [f"frames/s on one core at {found['mean_cm']:g} cm:"] + [
        f"  {name:<{_WIDTH}}encode {s['encode_fps']:10,.0f}   decode {s['decode_fps']:10,.0f}"
        for name, s in found["methods"].items()
    ]


def _shell(row: dict) -> list[str]:
    return [
        f"shell error bounded by {row['target_cm']:g} cm: {row['ratio']:.1f}:1, {row['bytes']} bytes; "
        f"joints: mean {row['mean_cm']:.3f}, max {row['max_cm']:.3f} cm; "
        f"shell: mean {row['shell_mean_cm']:.3f}, max {row['shell_max_cm']:.3f} cm"
    ]


def _first_frame(found: dict) -> list[str]:
    rows = found["clips"]
    costs = [row["cost"] for row in rows]
    return [
        f"bytes that keeping the T-pose costs at {found['mean_cm']:g} cm:",
        *[f"  {row['clip']}  {row['bytes_without']:6d} bytes without it, {row['cost']:+d} with it" for row in rows],
        f"  largest {max(costs)}, mean {sum(costs) / len(costs):.1f} bytes a file",
    ]


def _bounds(found: dict) -> list[str]:
    rows = found["clips"]
    size, free = sum(row["bytes"] for row in rows), sum(row["bytes_for_mean"] for row in rows)
    largest, free_largest = (max(row[name] for row in rows) for name in ("max_cm", "max_cm_for_mean"))
    worst = max(rows, key=lambda row: row["factor"])
    return [
        f"max error {found['max_cm']:g} cm, {len(rows)} whole files with their T-poses and jumps:",
        f"  {size:,} bytes, largest error of any joint {largest:.4f} cm",
        f"  {free:,} bytes for the same mean errors alone, largest error {free_largest:.2f} cm",
        f"  {size / free:.2f} times as many; worst file {worst['clip']}, {worst['factor']:.2f} times",
    ]


def _people(found: list[dict]) -> list[str]:
    lines = [
        "ratios by the shipped model where it may name the person, where it may not, and by a model that has never seen the",
        "person; and how many bytes more the last takes than the second:",
    ]
    for one in found:
        lines += [f"  {one['subject']} ({' '.join(one['clips'])}, learned from {one['files']} files):"]
        for row in one["rows"]:
            ratios = " ".join(f"{row[name]['ratio']:7.1f}" for name in ("named", "known", "stranger"))
            lines += [f"    {row['target_cm']:g} cm: {ratios} {row['cost']:+7.1%}"]
    return lines


def _rig(found: dict) -> list[str]:
    curves = found["curves"]
    targets = [row["target_cm"] for row in next(iter(curves.values()))]
    clips = " and ".join(found["clips"])
    return [
        f"another rig ({found['folder']}): files {clips}, learned from the {found['files']} others; ratio:",
        _line("mean error of each clip, cm", (f"{cm:g}" for cm in targets)),
        *[_line(name, (_ratio(row.get("ratio")) for row in rows)) for name, rows in curves.items()],
    ]


def _line(name: str, cells: Iterable[str]) -> str:
    return f"  {name:<{_WIDTH}}" + "".join(f"{cell:>8}" for cell in cells)


def _ratio(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio:.1f}"


_TEXTS: dict[str, Callable[..., list[str]]] = {
    "curves": _curves, "one_clip": _one_clip, "speeds": _speeds, "shell": _shell, "first_frame": _first_frame,
    "bounds": _bounds, "people": _people, "rig": _rig,
}  # fmt: skip
