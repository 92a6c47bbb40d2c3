"""Rate and distortion with models trained for the purpose: without a person, and on another rig."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..codecs import Target
from ..codecs.artifact import Artifact, load_artifact
from ..formats import read_motion
from ..motion import Motion
from ..training import TRAINERS
from ..training.corpus import Corpus
from . import rd
from .rd import Config, Method

RIG_TEST = ("09", "10")


def trained(codec: str, corpus: Corpus) -> Artifact:
    """A model of a corpus; interrupted, the training goes on where it was when it is called again."""
    checkpoint = Path(tempfile.gettempdir(), f"jaxmocap-bench-{codec}-{corpus.digest()[:16]}.partial")
    artifact, _ = TRAINERS[codec](corpus, checkpoint)
    checkpoint.unlink(missing_ok=True)
    return artifact


def person_left_out(
    subject: str, corpus: Corpus, motions: Mapping[str, Motion], config: Config, targets_cm: Sequence[float]
) -> dict:
    """The clips of a subject by a model that has never seen it, and by the shipped one; `cost` is what that takes more.

    Both write the bones; `named` is the shipped model that may say whose they are. The names of files and clips begin
    with the subject.
    """
    others = replace(corpus, files=tuple(f for f in corpus.files if not f.stem.startswith(f"{subject}_")))
    theirs = {name: motion for name, motion in motions.items() if name.startswith(f"{subject}_")}
    shipped, stranger = load_artifact(str(config["codec"])), trained(str(config["codec"]), others)
    models = {"named": shipped, "known": rd.nameless(shipped), "stranger": stranger}
    rows = []
    for cm in targets_cm:
        found = {name: rd.pooled(theirs, rd.by_codec(config, model), Target("mean", cm)) for name, model in models.items()}
        rows.append({"target_cm": cm, **found, "cost": found["stranger"]["bytes"] / found["known"]["bytes"] - 1})
    return {"subject": subject, "files": len(others.files), "clips": list(theirs), "rows": rows}


def rig_split(folder: Path) -> tuple[Corpus, dict[str, Motion]]:
    """What a model of a rig learns from, and two clips it does not; the first frames are T-poses."""
    files = sorted(folder.glob("*.bvh"))
    motions = {f.stem: read_motion(f, 1.0).frames(1) for f in files if f.stem in RIG_TEST}
    return Corpus(tuple(f for f in files if f.stem not in RIG_TEST), 1.0, 1), motions


def rig(folder: Path, config: Config, peers: Mapping[str, Method], targets_cm: Sequence[float]) -> dict:
    """Two clips of another rig: by its own model, by the shipped one that does not know it, and by peers."""
    corpus, motions = rig_split(folder)
    own = trained(str(config["codec"]), corpus)
    methods = {"trained on its rig": rd.by_codec(config, own), "basis in the stream": rd.by_codec(config), **peers}
    return {
        "files": len(corpus.files),
        "clips": list(motions),
        "curves": {name: rd.curve(motions, method, targets_cm) for name, method in methods.items()},
    }
