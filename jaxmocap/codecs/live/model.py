"""The model of `live`: a rig, a basis for each metric, what is known of their components, and the networks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import FormatError
from ..artifact import Artifact
from ..learned.basis import Basis
from ..learned.bones import BoneModel
from ..learned.density import FrozenDensity
from ..learned.distortion import METRICS, Metric
from ..learned.spectrum import Spectrum
from ..rig import Rig
from .tracker import Prior


@dataclass(frozen=True, eq=False)
class LiveModel:
    """`network` looks a frame ahead. `packets` is the density of what stands in a packet, with no past to look at, and
    `classes` how often that is how busy, by octaves of the step."""

    rig: Rig
    bases: dict[Metric, Basis]
    priors: dict[Metric, Prior]
    network: FrozenDensity
    packets: FrozenDensity
    classes: np.ndarray
    logistic: np.ndarray
    tail: np.ndarray
    bones: BoneModel

    def tensors(self) -> dict[str, np.ndarray]:
        """All arrays of the model under the names that they have in its file."""
        found = {**self.rig.tensors(), **self.network.tensors("network"), **self.packets.tensors("packets")}
        found |= {"classes": self.classes.astype(np.int32), "logistic": self.logistic, "tail": self.tail}
        found |= self.bones.tensors()
        for metric, basis in self.bases.items():
            prior = self.priors[metric]
            found |= {
                f"{metric}.mean": basis.mean.astype(np.float32),
                f"{metric}.synthesis": basis.synthesis.astype(np.float16),
                f"{metric}.turn_cm": np.array([basis.turn_cm], np.float32),
                f"{metric}.speed": prior.speed.astype(np.int16),
                f"{metric}.spread": prior.spread.astype(np.int16),
                f"{metric}.embedding": prior.embedding.astype(np.int16),
            }
        return found

    @staticmethod
    def load(artifact: Artifact) -> LiveModel:
        """Raises FormatError where the artifact lacks something, or holds what is no model of `live`."""
        try:
            return LiveModel._load(artifact)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise FormatError(f"the model {artifact.digest[:8]} is not whole, or is not for live: {error}") from error

    @staticmethod
    def _load(artifact: Artifact) -> LiveModel:
        t = artifact.tensors
        bases: dict[Metric, Basis] = {}
        priors: dict[Metric, Prior] = {}
        for metric in METRICS:
            synthesis = t[f"{metric}.synthesis"].astype(np.float64)
            mean, turn_cm = t[f"{metric}.mean"].astype(np.float64), float(t[f"{metric}.turn_cm"][0])
            bases[metric] = Basis(mean, synthesis, turn_cm, NO_SPECTRUM)
            speed, spread, embedding = (t[f"{metric}.{name}"].astype(np.int64) for name in ("speed", "spread", "embedding"))
            priors[metric] = Prior(speed, spread, embedding)
        network, packets = FrozenDensity.load("network", t), FrozenDensity.load("packets", t)
        rig, bones = Rig.load(artifact.spec["rig"], t), BoneModel.load(t)
        return LiveModel(rig, bases, priors, network, packets, t["classes"], t["logistic"], t["tail"], bones)


NO_SPECTRUM = Spectrum(np.zeros((1, 0), np.int16), np.zeros((1, 0), np.int16))
