"""`jaxmocap bench lossless`: all of bench/lossless.py in one run, as text, JSON and plots."""

from __future__ import annotations

import functools
import json
import sys
from pathlib import Path

from ..codecs.archive.database import NUMBER_CODECS, resolved_model
from ..codecs.exact.codec import Exact
from ..codecs.lossless import AbstractNumberCodec
from ..codecs.mrpa.alpha_parallelogram import App
from ..codecs.mrpa.codec import Mrpa, PathSegmentation, Patterns
from . import lossless
from .lossless_folder import Folder, one_core, read_folder

DATABASES = {"run": "09", "modern dance": "05"}
SUBJECTS = ("01", "02", "05", "06", "09")
COMPARED: dict[str, AbstractNumberCodec] = {
    "exact, no shipped model": Exact(),
    "non-som": Mrpa(Patterns(segmentation=PathSegmentation())),
    "app": App(),
}
CORPORA = ("cmu_bvh", "cmu_amc", "cmu_daz/martial")
CORPUS_PEERS = ("xz -9e", "brotli 11", "pcodec, delta 2")
# The paper's walk has 344 frames, its basketball 722, as these; its cartwheel of 2460 frames is not in the data, a dance is.
WALK, BASKETBALL, DANCE = "02/02_01.bvh", "06/06_02.bvh", "05/05_12.bvh"
# Tables 4 and 5 of Wang et al. 2020: ratio, seconds to compress, seconds to decompress.
PUBLISHED = {
    "run": {
        "gzip": (2.79, 0.51, 0.27), "rar": (2.82, 0.54, 0.22), "Non-SOM": (3.56, None, None), "APP": (3.62, 0.39, 0.07),
        "MRPA": (4.01, 0.44, 0.10), "L3C": (5.17, 10.36, 10.17),
    },
    "modern dance": {
        "gzip": (2.78, 1.85, 0.29), "rar": (2.87, 1.08, 0.28), "Non-SOM": (3.64, None, None), "APP": (3.78, 2.03, 0.35),
        "MRPA": (3.96, 2.91, 0.61), "L3C": (5.21, 55.77, 55.05),
    },
}  # fmt: skip


def measure(data: Path) -> dict:
    """Everything, on the folders of `data`."""
    with one_core():
        bvh = data / "cmu_bvh"
        subjects = {name: read_folder(bvh / name) for name in SUBJECTS}
        result: dict = {"databases": {}, "corpora": {}}
        for name, subject in DATABASES.items():
            _say(f"database {name!r}: subject {subject}")
            result["databases"][name] = database(name, subject, subjects)
        dance = subjects["05"]
        result["one_file"] = [lossless.one_of_many(dance, list(dance.files)[1], codec) for codec in NUMBER_CODECS]
        for name in CORPORA:
            _say(name)
            result["corpora"][name] = corpus(read_folder(data / name))
        _say("thresholds")
        walk = read_folder(bvh / WALK)
        result["thresholds"] = {"file": WALK, "frames": walk.frames} | {
            name: lossless.threshold_rows(walk, name) for name in lossless.THRESHOLDS
        }
        result["length_ratios"] = [
            {"file": file, "frames": one.frames, "rows": lossless.threshold_rows(one, "LengthThr")}
            for file, one in ((file, read_folder(bvh / file)) for file in (BASKETBALL, DANCE))
        ]
    return result


def database(name: str, subject: str, subjects: dict[str, Folder]) -> dict:
    """A column of Tables 4 and 5: the archives, their numbers alone, what a model of other people does, and peers."""
    folder = subjects[subject]
    registered = {codec: make(resolved_model(codec, None)) for codec, make in NUMBER_CODECS.items()}
    numbers = [lossless.codec_row(folder, codec, made) for codec, made in registered.items()]
    compared = [lossless.codec_row(folder, codec, made) for codec, made in COMPARED.items()]
    archives = {codec: lossless.archive_row(folder, codec) for codec in NUMBER_CODECS}
    archived = [lossless.with_rest(folder, made, archives["mrpa"]["rest_bytes"]) for made in compared]
    others = [file for other, f in subjects.items() if other != subject for file in f.files.values()]
    return {
        **_sizes(folder),
        "subject": subject,
        "rows": [*archives.values(), *archived, *numbers, *compared, *lossless.peer_rows(folder)],
        "held_out": lossless.held_out_row(folder, "exact, learned from other people", others),
        "published": PUBLISHED[name],
    }


def corpus(folder: Folder) -> dict:
    """A whole folder, packed once: its seconds hold the compilation. Number peers are also shown in a database's place."""
    archive = lossless.archive_row(folder, "exact", runs=1)
    peers = lossless.peer_rows(folder, CORPUS_PEERS)
    numbers = [made for made in peers if made["kind"] == "numbers" and "missing" not in made]
    archived = [lossless.with_rest(folder, made, archive["rest_bytes"]) for made in numbers]
    return {**_sizes(folder), "rows": [archive, *archived, *peers]}


def _sizes(folder: Folder) -> dict:
    return {
        "files": len(folder.files),
        "frames": folder.frames,
        "text_bytes": folder.text_bytes,
        "float32_bytes": folder.float32_bytes,
    }


def text(result: dict) -> str:
    """The tables for people."""
    lines = [
        "Lossless. ratio: bytes of the text files over all bytes; float32: frames x columns x 4 over the same.",
        "files: whole databases, as on disk; text: the files one after another; numbers: without headers and without what the",
        "layout of the text holds, such as digits beyond the columns' decimals, and for peers without the signs of zeros.",
        "Seconds are those of the processor, on one core; packing verifies by unpacking.",
        "The shipped model of exact has learned from the train split, most files of every subject; where no model is shipped,",
        "one is learned from the files themselves, stored and counted; the model of other people has not seen the subject.",
    ]
    for name, found in result["databases"].items():
        lines += ["", f"{name} (subject {found['subject']}): {_about(found)}", *table(found["rows"])]
        lines += [_held_out(found["held_out"]), *_published(found["published"])]
    lines += ["", "one file of a database:"] + [
        f"  {r['codec']:<8}{r['file']} {r['one_s']:.3f} s, all {r['files']} {r['all_s']:.3f} s" for r in result["one_file"]
    ]
    for name, found in result["corpora"].items():
        lines += ["", f"{name}: {_about(found)}", *table(found["rows"])]
    lines += ["", *_thresholds(result["thresholds"]), "", "LengthThr and ratio (Table 3):"]
    for one in result["length_ratios"]:
        ratios = "  ".join(f"{r['value']} {r['ratio']:.3f}" for r in one["rows"])
        lines += [f"  {one['file']}, {one['frames']} frames: {ratios}"]
    return "\n".join(lines)


def save(result: dict, folder: Path) -> None:
    """The report as lossless.json, and the figures as PNG."""
    from . import lossless_plots

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lossless.json").write_text(json.dumps(result, indent=1) + "\n")
    for name, draw in lossless_plots.FIGURES.items():
        draw(result).savefig(folder / f"lossless_{name}.png", dpi=110)


def _about(found: dict) -> str:
    return f"{found['files']} files, {found['frames']:,} frames, {found['text_bytes']:,} bytes"


def table(rows: list[dict]) -> list[str]:
    """Rows as lines, below a head."""
    head = f"  {'':<36}{'of':<8}{'bytes':>12}{'ratio':>8}{'float32':>9}"
    return [f"{head}{'compress s':>13}{'frames/s':>11}{'decompress s':>14}{'frames/s':>12}", *map(_line, rows)]


def _line(row: dict) -> str:
    start = f"  {row['name']:<36}{row['kind']:<8}"
    if "missing" in row:
        return f"{start}not measured: {row['missing']} is not installed (pip install 'jaxmocap[bench]')"
    start += f"{row['bytes']:>12,}{row['ratio']:>8.2f}{row['ratio_float32']:>9.2f}"
    if row["compress_s"] is None:
        return start
    start += f"{row['compress_s']:>13.2f}{row['compress_fps']:>11,.0f}"
    return f"{start}{row['decompress_s']:>14.3f}{row['decompress_fps']:>12,.0f}"


def _held_out(row: dict) -> str:
    inside = f"a model of {row['model_bytes']:,} bytes; {row['ratio_with_model']:.2f} with that inside"
    return f"{_line(row)}  and {inside}"


def _published(found: dict) -> list[str]:
    lines = []
    for n, what in enumerate(("ratio", "compress s", "decompress s")):
        values = "  ".join(f"{name} {figures[n]}" for name, figures in found.items() if figures[n] is not None)
        lines += [f"  published {what:<14}{values}"]
    return lines


def _thresholds(found: dict) -> list[str]:
    lines = [f"thresholds of mrpa (Tables 1 and 2, Figs. 5 to 8), {found['file']}, {found['frames']} frames:"]
    for name in lossless.THRESHOLDS:
        lines += [f"  {name:<14}{'inputs':>8}{'predicted':>11}{'entries':>9}{'ratio':>8}  segments"]
        lines += [
            f"  {r['value']:<14g}{r['input_segments']:>8}{r['predicted_frames']:>11}{r['index_entries']:>9}{r['ratio']:>8.3f}  "
            + _segments(r["segments"]) for r in found[name]
        ]
    return lines


def _segments(found: list[list[int]], most: int = 5) -> str:
    shown = " ".join(f"[{a}-{b}]" for a, b in found[:most])
    return shown if len(found) <= most else f"{shown} ... {len(found)} in all"


_say = functools.partial(print, file=sys.stderr, flush=True)
