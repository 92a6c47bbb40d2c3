"""Training of `exact`: the laws of a rig first, then how its lanes move."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..codecs.artifact import Artifact
from ..codecs.exact import lanes
from ..codecs.exact.laws import AbstractLaw, law_from_spec, law_spec
from ..codecs.exact.model import RigModel, to_artifact
from ..codecs.exact.rig_fit import fit_laws, learned_rig
from ..codecs.exact.tables import Exceptions, law_residuals, to_lanes
from ..codecs.lossless import NumberTable
from ..codecs.number_text.text import NumberText, parse_numbers
from ..errors import FormatError
from .corpus import Corpus
from .loop import Stage, State, run


def train_exact(corpus: Corpus, checkpoint: Path) -> tuple[Artifact, dict]:
    """The rig model of a corpus, and a report: bits a frame of every column that is coded.

    Raises FormatError where files are no motion text, where they have several rigs, or frames are to be left out.
    """
    if corpus.start:
        raise FormatError("--start leaves frames out, and exact has to know all of them: leave it at 0")
    texts = [_text(file) for file in corpus.files]
    tables = [text.table for text in texts]
    for file, table in zip(corpus.files, tables, strict=True):
        if (table.columns, table.decimals) != (tables[0].columns, tables[0].decimals):
            raise FormatError(f"{file}: another rig than {corpus.files[0].name}; a model is for one: train them apart")
    stages = [Stage("laws", 1, lambda state, _: _packed(fit_laws(tables)))]
    laws = _unpacked(run(stages, checkpoint, f"exact {corpus.digest()}"))
    model = learned_rig(tables, laws, texts[0].template)
    artifact = to_artifact(model, corpus.digest())
    report = {
        "codec": "exact",
        "digest": artifact.digest,
        "files": len(tables),
        "frames": sum(len(table.integers) for table in tables),
        "laws": [law_spec(law) for law in laws],
        "bits_a_frame": _bits(model, tables),
    }
    return artifact, report


def _text(file: Path) -> NumberText:
    text = parse_numbers(file.read_bytes())
    if text is None:
        raise FormatError(f"{file}: no motion text with a row of numbers a frame; take it out of the corpus")
    return text


def _packed(laws: tuple[AbstractLaw, ...]) -> State:
    specs = json.dumps([law_spec(law) for law in laws]).encode()
    return {"specs": np.frombuffer(specs, np.uint8)} | {f"law.{n}": np.array(law.numbers) for n, law in enumerate(laws)}


def _unpacked(state: State) -> tuple[AbstractLaw, ...]:
    specs = json.loads(state["specs"].tobytes())
    return tuple(law_from_spec(spec, state[f"law.{n}"].tolist()) for n, spec in enumerate(specs))


def _bits(model: RigModel, tables: list[NumberTable]) -> dict[str, float]:
    """The code lengths of every column's residuals, without the first two frames of a file."""
    total, frames = np.zeros(model.lanes.count), 0
    for table in tables:
        body = table.integers[1:]
        values = to_lanes(model, body, law_residuals(model, body), Exceptions())
        cost = lanes.code_lengths(model.lanes, values)[2:]
        total += cost.sum(0)
        frames += len(cost)
    names = [model.columns[c] for c in (*model.moving, *model.targets)]
    return dict(zip(names, (total / max(frames, 1)).round(3).tolist(), strict=True))
