"""`jaxmocap bench lsdt`: all of bench/lsdt.py in one run, as text, JSON and plots."""

from __future__ import annotations

import functools
import json
import sys
from pathlib import Path
from typing import Literal

from ..codecs import LsdtClip, Target, load_artifact
from . import lsdt
from .data import test_motions, train_corpus


def measure(data: Path) -> dict:
    """Everything, on the test split of `data`."""
    shipped = load_artifact("lsdt-clip")
    motions, corpus = test_motions(data), train_corpus(data)

    def codec(form: Literal["runs", "paper"], clip_frames: int, artifact=shipped):
        def make(target: Target) -> LsdtClip:
            return LsdtClip(artifact, clip_frames, form, target)

        return make

    result: dict = {"rate_distortion": {}, "sparsity": {}}
    for form in ("runs", "paper"):
        for clip_frames in (60, 120, 240):
            _say(f"{form}, L = {clip_frames}")
            rows = lsdt.rate_distortion(motions, codec(form, clip_frames))
            result["rate_distortion"][f"{form} L={clip_frames}"] = rows
    _say("cold start, learning speed, convergence")
    result["cold_decode"] = lsdt.cold_decode(motions["09_06"])
    samples = lsdt.training_samples(corpus)
    result["training_speed"] = lsdt.training_speed(samples)
    result["convergence"] = lsdt.convergence(samples)
    result["spatial_transforms"] = lsdt.spatial_transforms(motions, shipped.tensors["basis"])
    _say("models for P = 2, 5, 8, 11")
    for sparsity, artifact in lsdt.sparsity_models(corpus).items():
        for form in ("runs", "paper"):
            rows = lsdt.rate_distortion(motions, codec(form, 240, artifact))
            result["sparsity"][f"{form} P={sparsity}"] = rows
    return result


def text(result: dict) -> str:
    """The tables for people."""
    lines = ["Compression ratio of the 9 test clips (float32 positions of 31 joints; real bytes, header and skeleton included)"]
    lines += _ratios({**result["rate_distortion"], **{f"{k} L=240": v for k, v in result["sparsity"].items()}})
    best = result["rate_distortion"]["runs L=240"]
    lines += ["", "runs L=240, clip by clip at 1 cm:"]
    one = next(row for row in best if row["target_cm"] == 1.0)
    lines += [
        f"  {c['clip']}  {c['frames']:5d} frames  {c['bytes']:6d} bytes  {c['ratio']:7.1f}:1  mean {c['mean_cm']:.3f}  "
        f"max {c['max_cm']:.2f} cm" for c in one["clips"]
    ]
    lines += ["", f"speed, runs L=240, frames/s at 1 cm: encode {one['encode_fps']:,.0f}, decode {one['decode_fps']:,.0f}"]
    cold, speed = result["cold_decode"], result["training_speed"]
    lines += [
        f"cold decode of 09_06: {cold['decode_s']:.2f} s, import jax {cold['import_jax_s']:.2f} s, {cold['ratio']:.2f} times"
    ]
    lines += [
        f"learning, P = 8, 300 iterations: {speed['jax_s']:.2f} s with compilation, numpy {speed['numpy_s']:.2f} s, "
        f"{speed['numpy_over_jax']:.2f} times as long"
    ]
    lines += ["", "objective (6) at the end, x y z:"]
    lines += [f"  {name:<14}" + "".join(f"{v:12.0f}" for v in curve[-1]) for name, curve in result["convergence"].items()]
    lines += ["", "mean error in cm by share of nonzero coefficients (Fig. 5):"]
    lines += ["  " + " " * 6 + "".join(f"{r['share']:8.0%}" for r in result["spatial_transforms"]["lsdt"])]
    lines += [
        f"  {name:<6}" + "".join(f"{r['mean_cm']:8.3f}" for r in rows)
        for name, rows in result["spatial_transforms"].items()
    ]
    return "\n".join(lines)


def save(result: dict, folder: Path) -> None:
    """The report as lsdt.json, and the figures as PNG."""
    from . import lsdt_plots

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lsdt.json").write_text(json.dumps(result, indent=1) + "\n")
    for name, draw in lsdt_plots.FIGURES.items():
        draw(result).savefig(folder / f"{name}.png", dpi=110)


def _ratios(curves: dict[str, list[dict]]) -> list[str]:
    targets = [row["target_cm"] for row in next(iter(curves.values()))]
    lines = ["  " + f"{'mean error, cm':<18}" + "".join(f"{t:8g}" for t in targets)]
    return lines + [f"  {name:<18}" + "".join(f"{row['ratio']:8.1f}" for row in rows) for name, rows in curves.items()]


_say = functools.partial(print, file=sys.stderr, flush=True)
