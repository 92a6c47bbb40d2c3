"""What the codecs of whole sequences share: bases fitted to the motion travel in its stream, behind the skeleton."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream, JaxmocapError
from .adaptive_levels import Plane, Surroundings, code_levels
from .artifact import Artifact
from .base import Target
from .container import Header
from .entropy import integers
from .entropy.adaptive import Writer
from .joint_positions import Decode, Source
from .lsdt_model import LsdtModel
from .places import Places
from .quantise import STEPS, quantise
from .rig import Rig, read_skeleton, write_skeleton

CHUNK_FRAMES = 1920
# A component stays where each of its bits takes so many squared steps off the distortion; which is best depends on how
# much bases weigh in the stream, so all are tried.
WORTHS = (0.1, 0.06, 0.17)
_AHEAD = 2  # steps beyond the one found: error grows with the step but for the components that come and go
_MOST_ENTRIES = 1 << 18  # of a basis: a crafted skeleton could ask for any number


@functools.lru_cache(maxsize=8)
def rig_of(artifact: Artifact) -> Rig:
    """The rig of an lsdt-clip model. Raises FormatError where it is none."""
    return LsdtModel.load(artifact).rig


def places_at(source: Source, index: int) -> Places:
    """The places of the skeleton as it will decode: bones too short for the step lose their length."""
    section = write_skeleton(source.motion.skeleton, source.rig, source.scale, index)
    return Places.of(read_skeleton(section, source.rig, source.scale, index)[0])


def levels_of(coefficients: Float[np.ndarray, "..."], step: float) -> Int[np.ndarray, "..."]:
    """Quantised. Raises JaxmocapError where the step is too fine for coefficients as large as these."""
    if not np.abs(coefficients).max(initial=0.0) < step * (integers.LIMIT // 4):
        raise JaxmocapError(
            f"a step of {step:.3g} cm is too fine for joints as far away as in this motion; is the unit right?"
        )
    return np.asarray(quantise(coefficients.astype(np.float32), step))


class CodedSequence(Protocol):
    """One way to code a motion, at any step."""

    def decoded(self, index: int) -> Float[np.ndarray, "frames joints 3"]:
        """Joint positions in cm."""
        ...


Way = TypeVar("Way", bound=CodedSequence)


def level_bits(levels: Int[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """About how many bits levels take: those that are zero next to none."""
    magnitude = np.abs(levels)
    return np.where(magnitude > 0, 5 + 2 * np.log2(np.maximum(magnitude, 1)), 0)


def worth_keeping(gain: Float[np.ndarray, " components"], bits: Float[np.ndarray, " components"], bit: float) -> int:
    """How many of the first components to keep, so that the squared error they take away is most, less `bit` for a bit."""
    return int(np.argmax(np.cumsum(gain - bit * bits))) + 1


def smallest(
    source: Source,
    ways: Sequence[Way],
    write: Callable[[Way, int], bytes],
    decode: Decode,
    artifact: Artifact,
    target: Target,
) -> bytes:
    """Of some ways to code a sequence, the first at a given step, or the one that meets a target in the fewest bytes."""
    if target.kind == "step":
        index = source.coarsest_step(ways[0].decoded, target)
        return source.measured(lambda at: write(ways[0], at), decode, artifact, index, target)
    found = [(way, source.coarsest_step(way.decoded, target)) for way in ways]
    way, index = min(found, key=lambda pair: len(write(*pair)))
    ahead = min(index + _AHEAD, STEPS - 1)
    return source.measured(functools.partial(write, way), decode, artifact, ahead, target)


def encode_chunks(planes: list[Plane], per_chunk: int, around: Surroundings) -> list[bytes]:
    """Levels, so many planes a chunk."""
    chunks = []
    for n in range(0, len(planes), per_chunk):
        writer = Writer()
        code_levels(writer, planes[n : n + per_chunk], around)
        chunks.append(writer.finish())
    return chunks


def check_header(header: Header, codec: int, name: str, settings: int) -> None:
    """Raises CorruptStream where the header is not one of this codec's, with so many bytes of settings."""
    if header.codec != codec or len(header.params) != settings:
        raise CorruptStream(f"this is no {name} stream: codec {header.codec}, {len(header.params)} bytes of settings")
    if header.layers != 1:
        raise CorruptStream(f"the stream has {header.layers} layers, where {name} has one")
    if header.chunk_frames != min(CHUNK_FRAMES, header.frames):
        raise CorruptStream(f"the stream has chunks of {header.chunk_frames} frames, wanted {CHUNK_FRAMES}")


def check_basis(count: int, n: int) -> None:
    """Raises CorruptStream where a basis cannot have so many vectors of n entries."""
    if not 0 < count <= n or count * n > _MOST_ENTRIES:
        raise CorruptStream(f"the stream's basis has {count} vectors of {n} entries")
