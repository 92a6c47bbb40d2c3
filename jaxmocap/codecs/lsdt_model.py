"""The model of `lsdt-clip`: a rig, the learned bases, and the integers that code their coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import FormatError
from .artifact import Artifact
from .clips import Bases
from .coefficients_paper import PaperCodes
from .coefficients_runs import RunTables
from .entropy.tables import pack_tables, unpack_tables
from .rig import Rig

CLIP_FRAMES = (60, 120, 240)


@dataclass(frozen=True)
class LsdtModel:
    """`tables[L]` and `codes[L]` are those learned on clips of L frames."""

    rig: Rig
    bases: Bases
    tables: dict[int, RunTables]
    codes: dict[int, PaperCodes]

    def tensors(self) -> dict[str, np.ndarray]:
        """All arrays of the model under the names that they have in its file."""
        found = {"basis": self.bases.synthesis, **self.rig.tensors()}
        for frames, tables in self.tables.items():
            found |= {
                f"runs.{frames}.scale": tables.scale.astype(np.int16),
                f"runs.{frames}.count": pack_tables(tables.count),
                f"runs.{frames}.run": pack_tables(tables.run),
                f"runs.{frames}.value": pack_tables(tables.value),
            }
        for frames, codes in self.codes.items():
            found |= {f"paper.{frames}.position": codes.position, f"paper.{frames}.value": codes.value}
        return found

    @staticmethod
    def load(artifact: Artifact) -> LsdtModel:
        """Raises FormatError where the artifact lacks something, or holds what is no model of `lsdt-clip`."""
        try:
            return LsdtModel._load(artifact)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise FormatError(f"the model {artifact.digest[:8]} is not whole, or is not for lsdt-clip: {error}") from error

    @staticmethod
    def _load(artifact: Artifact) -> LsdtModel:
        t = artifact.tensors
        tables = {
            frames: RunTables(
                t[f"runs.{frames}.scale"], *(unpack_tables(t[f"runs.{frames}.{name}"]) for name in ("count", "run", "value"))
            )
            for frames in CLIP_FRAMES
        }
        codes = {f: PaperCodes(t[f"paper.{f}.position"], t[f"paper.{f}.value"]) for f in CLIP_FRAMES}
        return LsdtModel(Rig.load(artifact.spec["rig"], t), Bases(t["basis"], t["basis"]), tables, codes)


def nearest(length: int) -> int:
    """Whose tables suit a clip of `length` frames best: the trained length nearest by ratio."""
    return 60 if length * length < 60 * 120 else 120 if length * length < 120 * 240 else 240
