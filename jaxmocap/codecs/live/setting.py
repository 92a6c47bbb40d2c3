"""What a live stream says before its motion: whose bones. A rig that no model knows is written whole, and its basis is
the joints' own axes, each as precise as it moves the figure: nothing can be learned of a motion that is yet to come.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ...errors import CorruptStream
from ...skeleton import Skeleton
from ..learned.basis import Basis
from ..learned.bones import read_bones, write_bones
from ..learned.contexts import OCTAVE, PATH
from ..learned.distortion import Metric
from ..learned.figure import in_cm
from ..learned.own import lever_arms, plain
from ..learned.pose_vectors import PoseVectors
from ..quantise import PER_OCTAVE
from ..rig import bones_of, read_skeleton, with_bones, write_skeleton
from .model import NO_SPECTRUM, LiveModel
from .tracker import EMBEDDING, Prior, to_cm

OWN_RIG, FINENESS = 0x10, 0x0F
_OWN_SPEED, _OWN_SPREAD = -3 * OCTAVE, 2 * OCTAVE  # an eighth of a centimetre a frame, and four


@dataclass(frozen=True, eq=False)
class Setting:
    """The figure that decodes, in cm, its basis and what to expect; `section` is its bytes, `flags` say how to read them."""

    figure: PoseVectors
    basis: Basis
    prior: Prior
    flags: int
    section: bytes

    def values(
        self, places: Int[np.ndarray, "frames components"], direction: int, scale: float
    ) -> Float[np.ndarray, "frames channels"]:
        """Channel values in degrees and file units, which are `scale` cm, of places in 2^-14 cm."""
        return self.figure.values(*self.basis.vectors(to_cm(places), direction), scale)


def write_setting(skeleton: Skeleton, scale: float, model: LiveModel, metric: Metric, fineness: int) -> Setting:
    """For a skeleton whose unit is `scale` cm, to multiples of 2^(fineness - 13) cm."""
    if model.rig.skeleton.same_rig(skeleton):
        section, flags = write_bones(bones_of(skeleton) * scale, model.bones, fineness, model.tail), fineness
    else:
        section, flags = write_skeleton(skeleton, None, scale, fineness * PER_OCTAVE), OWN_RIG | fineness
    return read_setting(section, flags, model, metric)


def read_setting(section: bytes, flags: int, model: LiveModel, metric: Metric) -> Setting:
    """Raises CorruptStream or TruncatedStream."""
    fineness = flags & FINENESS
    if not flags & OWN_RIG:
        bones = read_bones(section, model.bones, fineness, model.tail)
        figure = PoseVectors(with_bones(model.rig.skeleton, bones), model.rig.expected)
        return Setting(figure, model.bases[metric], model.priors[metric], flags, section)
    skeleton, _, rest, known = read_skeleton(section, model.rig, 1.0, fineness * PER_OCTAVE)
    if known or rest:
        raise CorruptStream("the stream's skeleton is not written whole, as one that no model knows must be")
    figure = plain(skeleton)
    return Setting(figure, *_own_basis(figure), flags, section)


def figure_of(skeleton: Skeleton, scale: float, setting: Setting) -> PoseVectors:
    """The original figure, about the mean pose of the one that decodes."""
    return PoseVectors(in_cm(skeleton, scale), setting.figure.mean)


def _own_basis(figure: PoseVectors) -> tuple[Basis, Prior]:
    arms = lever_arms(figure, np.zeros((len(figure.sliding), 3)))
    turn_cm = float(arms[1:4].mean()) if figure.has_heading else 1.0
    count = PATH + figure.size
    speed, spread = np.full(count, _OWN_SPEED), np.full(count, _OWN_SPREAD)
    basis = Basis(np.zeros(figure.size), np.diag(1 / arms), turn_cm, NO_SPECTRUM)
    return basis, Prior(speed, spread, np.zeros((count, EMBEDDING), np.int64))
