"""`jaxmocap bench rd`: rd.py and rd_training.py in parts, as text, JSON and a plot."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ..codecs import Target
from ..formats import read_motion
from . import rd, rd_training
from .data import TEST, UNIT_CM, test_motions, train_corpus
from .rd_text import text as text

TARGETS_CM = (0.01, 0.03, 0.1, 0.3, 0.5, 1.0, 1.6, 2.4)
BEYOND_CM = 3.0  # measured so that the last target lies between two points
MEAN_CM = 1.0  # where one error has to do
ONE, ONE_CM = "09_06", (1.0, 2.26)
SPEEDS = ("learned", "lsdt-clip runs")
SHELL_MAX_CM, MAX_CM = 1.0, 0.5
SUBJECTS = ("01", "02", "05", "06", "09")
TRAINED_CM = (0.3, 1.0, 2.4)
RIG = "cmu_daz/martial"


def measure(data: Path, parts: Sequence[str] = ()) -> dict:
    """All parts, or some, on `data`."""
    result = {}
    for name in parts or PARTS:
        _say(name)
        result[name] = PARTS[name](data)
    return result


def curves(data: Path) -> dict:
    """Every method at every mean error."""
    motions = test_motions(data)
    made, missing = rd.methods()
    found = {}
    for name, method in made.items():
        _say(f"  {name}")
        found[name] = rd.curve(motions, method, (*TARGETS_CM, BEYOND_CM))
    return {"targets_cm": TARGETS_CM, "clips_cm": MEAN_CM, "methods": found, "missing": missing}


def one_clip(data: Path) -> dict:
    """The clip of which a ratio is published (Lin et al. 2011, Table 3), by every method."""
    motion = {ONE: test_motions(data)[ONE]}
    return {"clip": ONE, "methods": {name: rd.curve(motion, method, ONE_CM) for name, method in rd.methods()[0].items()}}


def speeds(data: Path) -> dict:
    """Frames/s of the test clips."""
    motions = test_motions(data)
    return {"mean_cm": MEAN_CM, "methods": {name: rd.speed(motions, rd.COLUMNS[name], MEAN_CM) for name in SPEEDS}}


def shell(data: Path) -> dict:
    """The shell as the metric, its largest error bounded."""
    return rd.pooled(test_motions(data), rd.by_codec({**rd.LEARNED, "metric": "shell"}), Target("max", SHELL_MAX_CM))


def first_frame(data: Path) -> dict:
    """The test clips with their T-pose and without."""
    files = {name: data / "cmu_bvh" / name[:2] / f"{name}.bvh" for name in TEST}
    method = rd.by_codec(rd.LEARNED)
    rows = [rd.first_frame_row(name, read_motion(file, UNIT_CM), method, MEAN_CM) for name, file in files.items()]
    return {"mean_cm": MEAN_CM, "clips": rows}


def bounds(data: Path) -> dict:
    """Every file of the five subjects whole, with its T-pose and jumps."""
    method, rows = rd.by_codec(rd.LEARNED), []
    for file in sorted((data / "cmu_bvh").glob("*/*.bvh")):
        _say(f"  {file.stem}")
        rows.append(rd.bound_row(file.stem, read_motion(file, UNIT_CM), method, MAX_CM))
    return {"max_cm": MAX_CM, "clips": rows}


def people(data: Path) -> list[dict]:
    """Each subject left out of training."""
    corpus, motions, rows = train_corpus(data), test_motions(data), []
    for subject in SUBJECTS:
        _say(f"  without {subject}")
        rows.append(rd_training.person_left_out(subject, corpus, motions, rd.LEARNED, TRAINED_CM))
    return rows


def rig(data: Path) -> dict:
    """A rig that the shipped model does not know."""
    return {"folder": RIG, **rd_training.rig(data / RIG, rd.LEARNED, rd.peers()[0], TRAINED_CM)}


def save(result: dict, folder: Path) -> None:
    """The report as rd.json, and the curves as rd.png."""
    from . import rd_plots

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rd.json").write_text(json.dumps(result, indent=1) + "\n")
    if "curves" in result:
        rd_plots.curves(result).savefig(folder / "rd.png", dpi=110)


PARTS: dict[str, Callable[[Path], list | dict]] = {
    "curves": curves, "one_clip": one_clip, "speeds": speeds, "shell": shell, "first_frame": first_frame, "bounds": bounds,
    "people": people, "rig": rig,
}  # fmt: skip
_say = functools.partial(print, file=sys.stderr, flush=True)
