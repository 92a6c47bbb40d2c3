"""The rig model of `exact`: what a rig teaches, as an artifact that is shipped, or learned and stored in an archive."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

from ...errors import FormatError
from ..artifact import Artifact, make_artifact
from .laws import AbstractLaw, law_from_spec, law_spec
from .wave import LaneModel

CODEC = "exact"


@dataclass(frozen=True, eq=False)
class RigModel:
    """What a rig teaches; `columns` and `decimals` say which tables it is for.

    `rest` is the row of the rest pose, which files may begin with. Columns that have no lane always have the value of `mean`.
    `moving` are the columns whose lanes are extrapolated; then come the `targets` of laws that leave mere rounding. The `laws`
    stand in an order in which all their inputs are known. `signs`: the usual modes of the zeros' signs. `header`: text that
    files of the rig share.
    """

    columns: tuple[str, ...]
    decimals: int
    rest: Int32[np.ndarray, " columns"]
    mean: Int32[np.ndarray, " columns"]
    moving: tuple[int, ...]
    laws: tuple[AbstractLaw, ...]
    lanes: LaneModel
    signs: tuple[int, ...]
    header: bytes = b""

    @property
    def targets(self) -> tuple[int, ...]:
        """Of the laws that leave mere rounding: a lane each."""
        return tuple(t for law in self.laws if not law.smooth for t in law.targets)

    @property
    def constant(self) -> tuple[int, ...]:
        coded = {*self.moving, *self.targets}
        return tuple(c for c in range(len(self.columns)) if c not in coded)

    def turns(self, column: int) -> bool:
        """True for angles in degrees."""
        return is_angle(self.columns[column])

    def fits(self, columns: Sequence[str], decimals: int) -> bool:
        return tuple(columns) == self.columns and decimals == self.decimals


def is_angle(column: str) -> bool:
    """True for a column of angles in degrees, which turn round at 180."""
    return column.endswith("rotation")


def to_artifact(model: RigModel, corpus: str) -> Artifact:
    """`corpus` is the digest of the files that taught it."""
    spec = {
        "codec": CODEC,
        "corpus": corpus,
        "columns": list(model.columns),
        "decimals": model.decimals,
        "laws": [law_spec(law) for law in model.laws],
    }
    lanes = model.lanes
    tensors = {
        "rest": model.rest,
        "mean": model.mean,
        "moving": np.array(model.moving, np.int32),
        "signs": np.array(model.signs, np.int32),
        "header": np.frombuffer(model.header, np.uint8),
        "lanes.weights": lanes.weights,
        "lanes.own": lanes.own,
        "lanes.shared": lanes.shared,
        "lanes.start": lanes.start,
        "lanes.frequencies": lanes.frequencies,
        **{f"law.{n}": np.array(law.numbers) for n, law in enumerate(model.laws)},
    }
    return make_artifact(spec, tensors)


@functools.lru_cache(maxsize=16)
def from_artifact(artifact: Artifact) -> RigModel:
    """Raises FormatError where the artifact is of another codec, or says what this version cannot read."""
    if artifact.spec.get("codec") != CODEC:
        raise FormatError(f"the model is for the codec {artifact.spec.get('codec')!r}, wanted one for {CODEC!r}")
    try:
        return _parsed(artifact.spec, artifact.tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"the model for {CODEC!r} is malformed, or made by a newer jaxmocap: {error!r}") from error


def _parsed(spec: dict, tensors: dict[str, np.ndarray]) -> RigModel:
    names = ("weights", "own", "shared", "start", "frequencies")
    return RigModel(
        tuple(spec["columns"]),
        spec["decimals"],
        tensors["rest"],
        tensors["mean"],
        tuple(tensors["moving"].tolist()),
        tuple(law_from_spec(s, tensors[f"law.{n}"].tolist()) for n, s in enumerate(spec["laws"])),
        LaneModel(*(tensors[f"lanes.{n}"] for n in names)),
        tuple(tensors["signs"].tolist()),
        tensors["header"].tobytes(),
    )
