"""`jaxmocap bench lsdt`: the figures of Hou et al. 2016, packets and speeds, part by part, as text, JSON, plots and players."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..codecs import CODECS, AbstractCodec, Target, load_artifact, make
from ..formats import read_motion
from ..formats.text import write_bytes
from ..training.lsdt import train_lsdt
from ..training.lsdt_frame import train_lsdt_frame
from . import lsdt, lsdt_methods, lsdt_packets, lsdt_players, lsdt_speeds
from .data import UNIT_CM, test_motions, train_corpus
from .lossless_folder import one_core
from .lsdt_methods import CLIP_BASED, FRAME_BASED, Method
from .lsdt_text import text as text

FRAME_TARGETS_CM = (0.1, 0.3, 0.5, 1.0, 1.6, 2.4)
CLIP_TARGETS_CM = (0.3, 0.5, 1.0, 1.6, 2.4)
PACKET_TARGETS_CM = (0.3, 0.5, 1.0)
MEAN_CM = 1.0  # where one error has to do
COLD, FAST, SEEN = "09_06", "02_05", "05_02"  # the clips of the cold start, of speeds and of players
FOUR = ("09_01", "02_05", "05_02", "06_14")  # those of Fig. 4, long and short
PICTURES = ("bases", "players")  # parts without a table


def measure(data: Path, parts: Sequence[str] = (), partial: Path | None = None) -> dict:
    """All parts that have a table, or those named, on `data`, on one core.

    What is done lies in the file `partial`, if one is named, until all is, so that a run that was cut short goes on there.
    """
    names = parts or [name for name in PARTS if name not in PICTURES]
    result = _kept(partial, data)
    with one_core():
        for name in names:
            if name not in result:
                _say(name)
                result[name] = PARTS[name](data)
                _keep(partial, data, result)
    if partial is not None:
        partial.unlink(missing_ok=True)
    result = {name: result[name] for name in names}
    curves = {**result.get("frame_based", {}), **result.get("rate_distortion", {})}
    return {**result, "table": lsdt_methods.table(curves, MEAN_CM)} if curves else result


def _keep(partial: Path | None, data: Path, result: dict) -> None:
    if partial is not None:
        partial.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(partial, json.dumps({"of": _measured(data), "parts": result}).encode())


def _kept(partial: Path | None, data: Path) -> dict:
    """The parts that a run before has left, if it was one with these models and this data."""
    if partial is None or not partial.is_file():
        return {}
    kept = json.loads(partial.read_bytes())
    return kept["parts"] if kept["of"] == _measured(data) else {}


def _measured(data: Path) -> list[str]:
    return [str(data), *(load_artifact(name).digest for name in CODECS)]


def bases(_: Path) -> dict[str, list]:
    """Fig. 2."""
    return lsdt.bases(load_artifact("lsdt-clip").tensors["basis"])


def convergence(data: Path) -> dict[str, list]:
    """Fig. 3."""
    return lsdt.convergence(lsdt.training_samples(train_corpus(data)))


def sparsity(data: Path) -> dict[str, dict]:
    """Fig. 4: whole models for each P, of both schemes, on four clips."""
    motions, corpus = {name: m for name, m in test_motions(data).items() if name in FOUR}, train_corpus(data)
    found: dict[str, dict] = {}
    for name, train in (("lsdt-frame", train_lsdt_frame), ("lsdt-clip", train_lsdt)):
        _say(f"  models of {name} for P = {', '.join(map(str, lsdt.SPARSITIES))}")
        for p, artifact in lsdt.sparsity_models(corpus, load_artifact(name), train).items():

            def codec(target: Target, name=name, artifact=artifact) -> AbstractCodec:
                return make({"codec": name, "target": target}, artifact)

            found.setdefault(name, {})[f"P={p}"] = lsdt.rate_distortion(motions, codec, CLIP_TARGETS_CM)
    return found


def spatial_transforms(data: Path) -> dict[str, list]:
    """Fig. 5."""
    return lsdt.spatial_transforms(test_motions(data), load_artifact("lsdt-clip").tensors["basis"])


def frame_based(data: Path) -> dict[str, list]:
    """Fig. 6, and ours."""
    return _curves(data, FRAME_BASED, FRAME_TARGETS_CM)


def rate_distortion(data: Path) -> dict[str, list]:
    """Fig. 7: clips and sequences, and ours."""
    return _curves(data, CLIP_BASED, CLIP_TARGETS_CM)


def players(data: Path) -> dict:
    """Figs. 8 and 9."""
    file = data / "cmu_bvh" / SEEN[:2] / f"{SEEN}.bvh"
    return {"clip": SEEN, "file": str(file), "figures": lsdt_players.measure(_clip(file))}


def packets(data: Path) -> dict[str, list]:
    """One packet a frame."""
    return lsdt_packets.rows(test_motions(data), PACKET_TARGETS_CM)


def speeds(data: Path) -> dict:
    """Of a frame in `live`, and of a cold start and learning in `lsdt-clip`."""
    motions = test_motions(data)
    return {
        "live": {"clip": FAST, "rows": lsdt_speeds.measure(motions[FAST], lsdt_packets.REPEATS)},
        "cold_decode": {"clip": COLD, **lsdt.cold_decode(motions[COLD])},
        "training": lsdt.training_speed(lsdt.training_samples(train_corpus(data))),
    }


def save(result: dict, folder: Path) -> None:
    """The report as lsdt.json, the figures as PNG, and Figures 8 and 9 as players."""
    from . import lsdt_plots

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lsdt.json").write_text(json.dumps(result, indent=1) + "\n")
    for name, (part, draw) in lsdt_plots.FIGURES.items():
        if part in result:
            draw(result).savefig(folder / f"{name}.png", dpi=110)
    if "players" in result:
        motion = _clip(Path(result["players"]["file"]))
        for name, page in lsdt_players.pages(motion, result["players"]["figures"]):
            (folder / name).write_text(page, "utf-8")


def _clip(file: Path):
    return read_motion(file, UNIT_CM).frames(1)


def _curves(data: Path, methods: Mapping[str, Method], targets: Sequence[float]) -> dict[str, list]:
    motions, found = test_motions(data), {}
    for name, method in methods.items():
        _say(f"  {name}")
        found[name] = lsdt.rate_distortion(motions, method.codec, targets)
    return found


PARTS: dict[str, Callable[[Path], dict]] = {
    "bases": bases, "convergence": convergence, "sparsity": sparsity, "spatial_transforms": spatial_transforms,
    "frame_based": frame_based, "rate_distortion": rate_distortion, "players": players, "packets": packets, "speeds": speeds,
}  # fmt: skip
_say = functools.partial(print, file=sys.stderr, flush=True)
