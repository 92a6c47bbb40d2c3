"""What a stream says before its motion: whose bones, which basis, which channels stand still.

A rig that the model knows costs the bones of its person; any other brings its skeleton whole, and a basis of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ...errors import CorruptStream
from ...motion import Motion
from ..bitstream import ByteReader, varint
from ..quantise import PER_OCTAVE
from ..rig import bones_of, read_skeleton, with_bones, write_skeleton
from . import bands
from .basis import Basis
from .bones import FINENESSES, is_somebody, read_bones, write_bones
from .distortion import Metric
from .encoder import Source, rough_bytes
from .figure import in_cm
from .model import LearnedModel
from .own import read_own, write_own
from .own_fit import fit_own
from .pose_vectors import PoseVectors

CHUNK_FRAMES = 8192
HAS_CONSTANTS, OWN_BASIS = 0x40, 0x20
_FINENESS = 0x0F
KNOWN_FLAGS = HAS_CONSTANTS | OWN_BASIS | _FINENESS


@dataclass(frozen=True, eq=False)
class Setting:
    """The figure that decodes, in cm, and its basis; `sections` are its bytes, `flags` say which and how fine bones are."""

    figure: PoseVectors
    basis: Basis
    flags: int
    sections: tuple[bytes, ...]
    constants: bytes = b""


def write_known(
    motion: Motion, scale: float, model: LearnedModel, metric: Metric, mean_cm: float
) -> tuple[Setting, list[Source]]:
    """Of a motion of the model's rig, whose unit is `scale` cm; bones as fine as pays at this mean error."""
    original = PoseVectors(in_cm(motion.skeleton, scale), model.rig.expected)
    basis = model.bases[metric]
    sources = _sources(motion, scale, original, original, basis, metric, model)
    fineness = _bone_fineness(sources, model, mean_cm)
    section, figure = _bones(original, model, fineness)
    fineness = 0 if is_somebody(section) else fineness
    return Setting(figure, basis, fineness, (section,)), [replace(source, decoding=figure) for source in sources]


def write_own_setting(
    motion: Motion, scale: float, model: LearnedModel, metric: Metric, mean_cm: float
) -> tuple[Setting, list[Source]]:
    """Of a motion of any other rig: its skeleton, and a basis fitted to it."""
    fineness = _usual_fineness(mean_cm)
    section = write_skeleton(motion.skeleton, None, scale, fineness * PER_OCTAVE)
    skeleton = _whole(section, model, fineness)
    own, basis = fit_own(motion, skeleton, scale, metric, model, mean_cm)
    pose = own.mean_pose(skeleton)
    figure, original = PoseVectors(skeleton, pose), PoseVectors(in_cm(motion.skeleton, scale), pose)
    setting = Setting(figure, basis, OWN_BASIS | fineness, (section, write_own(own, model.densities.tail)))
    return setting, _sources(motion, scale, original, figure, basis, metric, model)


def read_setting(data: bytes, flags: int, model: LearnedModel, metric: Metric) -> Setting:
    """Raises CorruptStream or TruncatedStream."""
    fineness = flags & _FINENESS
    count = 1 + bool(flags & OWN_BASIS) + bool(flags & HAS_CONSTANTS)
    sections = _split_sections(data, count)
    constants = sections[-1] if flags & HAS_CONSTANTS else b""
    if not flags & OWN_BASIS:
        bones = read_bones(sections[0], model.bones, fineness, model.densities.tail)
        figure = PoseVectors(with_bones(model.rig.skeleton, bones), model.rig.expected)
        return Setting(figure, model.bases[metric], flags, tuple(sections), constants)
    skeleton = _whole(sections[0], model, fineness)
    own = read_own(sections[1], skeleton, model.densities.tail)
    figure = PoseVectors(skeleton, own.mean_pose(skeleton))
    return Setting(figure, own.basis(skeleton, model, metric), flags, tuple(sections), constants)


def join_sections(sections: Iterable[bytes]) -> bytes:
    """One after another; all but the last are preceded by their length."""
    *first, last = sections
    return b"".join(varint(len(s)) + s for s in first) + last


def _split_sections(data: bytes, count: int) -> list[bytes]:
    reader = ByteReader(data)
    sections = [reader.take(reader.varint()) for _ in range(count - 1)]
    return [*sections, reader.take(reader.left)]


def _sources(
    motion: Motion, scale: float, original: PoseVectors, decoding: PoseVectors, basis: Basis, metric: Metric,
    model: LearnedModel,
) -> list[Source]:  # fmt: skip
    """Every chunk of the motion."""
    octaves = bands.octave_count(motion.frame_time)
    starts = range(0, motion.frame_count, CHUNK_FRAMES)
    parts = (original.analyse(motion.frames(n, n + CHUNK_FRAMES), scale) for n in starts)
    return [Source(original, decoding, *part, octaves, basis, metric, model.densities) for part in parts]


def _usual_fineness(mean_cm: float) -> int:
    """Bones are multiples of about a third of the error."""
    return int(np.clip(round(math.log2(mean_cm / 3)) + 13, 2, FINENESSES - 2))


def _bone_fineness(sources: list[Source], model: LearnedModel, mean_cm: float) -> int:
    """The fineness of bones that costs least: their bytes, and those that their error takes from what levels may err."""
    finenesses = range(_usual_fineness(mean_cm) - 2, _usual_fineness(mean_cm) + 2)
    if is_somebody(_bones(sources[0].original, model, finenesses[0])[0]):
        return finenesses[0]
    levels = sum(rough_bytes(source, mean_cm) for source in sources)

    def cost(fineness: int) -> float:
        section, figure = _bones(sources[0].original, model, fineness)
        errors = replace(sources[0], decoding=figure).distortion.errors(sources[0].coefficients)
        return len(section) + levels * (float(errors.mean()) / mean_cm) ** 2 / 2

    return min(finenesses, key=cost)


def _bones(original: PoseVectors, model: LearnedModel, fineness: int) -> tuple[bytes, PoseVectors]:
    """The bones' bytes, and the figure that decodes from them."""
    section = write_bones(bones_of(original.skeleton), model.bones, fineness, model.densities.tail)
    bones = read_bones(section, model.bones, fineness, model.densities.tail)
    return section, PoseVectors(with_bones(original.skeleton, bones), original.mean)


def _whole(section: bytes, model: LearnedModel, fineness: int):
    """A skeleton in cm that was written whole."""
    skeleton, _, rest, known = read_skeleton(section, model.rig, 1.0, fineness * PER_OCTAVE)
    if known or rest:
        raise CorruptStream("the stream's skeleton is not written whole, as one with a basis of its own must be")
    return skeleton
