"""The model of `lsdt-frame` and of `dct-frame`: a rig, a spatial basis a coordinate, and the Huffman codes of its levels."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ..errors import FormatError
from .artifact import Artifact
from .clips import Bases
from .frame_coefficients import FrameCodes
from .rig import Rig


@dataclass(frozen=True)
class FrameModel:
    """`codes` are those learned from levels of the closed loop in this basis, which is orthogonal."""

    rig: Rig
    bases: Bases
    codes: FrameCodes

    def tensors(self) -> dict[str, np.ndarray]:
        """All arrays of the model under the names that they have in its file."""
        codes = {"frame.position": self.codes.position, "frame.value": self.codes.value}
        return {"basis": self.bases.synthesis, **codes, **self.rig.tensors()}

    @staticmethod
    @functools.lru_cache(maxsize=8)
    def load(artifact: Artifact, codec: str) -> FrameModel:
        """Raises FormatError where the artifact lacks something, or holds no model of this codec."""
        try:
            if artifact.spec["codec"] != codec:
                raise ValueError(f"it is for {artifact.spec['codec']}")
            t = artifact.tensors
            codes = FrameCodes(t["frame.position"], t["frame.value"])
            return FrameModel(Rig.load(artifact.spec["rig"], t), Bases(t["basis"], t["basis"]), codes)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise FormatError(f"the model {artifact.digest[:8]} is not whole, or is not for {codec}: {error}") from error
