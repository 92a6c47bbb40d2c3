"""The model of `learned`: a rig, a basis for each metric, and the integers that code their coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import FormatError
from ..artifact import Artifact
from ..rig import Rig
from .basis import Basis
from .bones import BoneModel
from .coefficients import Densities
from .constants import Constants
from .density import FrozenDensity
from .distortion import METRICS, Metric
from .spectrum import Spectrum


@dataclass(frozen=True, eq=False)
class LearnedModel:
    """`rig.expected` is the mean pose that rotation vectors are about, joint 0 less its heading."""

    rig: Rig
    bases: dict[Metric, Basis]
    densities: Densities
    constants: Constants
    bones: BoneModel

    def tensors(self) -> dict[str, np.ndarray]:
        """All arrays of the model under the names that they have in its file."""
        d = self.densities
        found = {**self.rig.tensors(), **d.slow.tensors("slow"), **d.fast.tensors("fast")}
        found |= {"logistic": d.logistic, "tail": d.tail, "constants": self.constants, **self.bones.tensors()}
        for metric, basis in self.bases.items():
            found |= {
                f"{metric}.mean": basis.mean.astype(np.float32),
                f"{metric}.synthesis": basis.synthesis.astype(np.float16),
                f"{metric}.turn_cm": np.array([basis.turn_cm], np.float32),
                f"{metric}.spectrum.slow": basis.spectrum.slow.astype(np.int16),
                f"{metric}.spectrum.fast": basis.spectrum.fast.astype(np.int16),
            }
        return found

    @staticmethod
    def load(artifact: Artifact) -> LearnedModel:
        """Raises FormatError where the artifact lacks something, or holds what is no model of `learned`."""
        try:
            return LearnedModel._load(artifact)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise FormatError(f"the model {artifact.digest[:8]} is not whole, or is not for learned: {error}") from error

    @staticmethod
    def _load(artifact: Artifact) -> LearnedModel:
        t = artifact.tensors
        bases: dict[Metric, Basis] = {
            metric: Basis(
                t[f"{metric}.mean"].astype(np.float64),
                t[f"{metric}.synthesis"].astype(np.float64),
                float(t[f"{metric}.turn_cm"][0]),
                Spectrum(t[f"{metric}.spectrum.slow"], t[f"{metric}.spectrum.fast"]),
            )
            for metric in METRICS
        }
        densities = Densities(FrozenDensity.load("slow", t), FrozenDensity.load("fast", t), t["logistic"], t["tail"])
        return LearnedModel(Rig.load(artifact.spec["rig"], t), bases, densities, t["constants"], BoneModel.load(t))
