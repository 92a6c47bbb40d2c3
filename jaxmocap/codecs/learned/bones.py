"""The bones of a person of a known rig, in about 15 bytes: how they stray from the rig's mean, scaled to the person.

Every component of every bone strays by its own measure, which the model knows, and often as its mirror image did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ...errors import CorruptStream
from ..entropy.range_coder import RangeDecoder, RangeEncoder
from .coefficients import decode_signs, decode_sizes, encode_signs, encode_sizes, tail_frequencies
from .density import tail_rows_of

FINENESSES = 16
_FINEST = -13  # the step of fineness 0 is 2^-13 cm
_FIXED_POINT = 16
_SIZE_BITS = 8
_SIZE = 1 << _SIZE_BITS - 1
MOST_PEOPLE = 32  # of the corpus: sizes below this, which nobody has, name one of them
_NAMES = ("mean", "spread", "partner", "mirror", "people")


@dataclass(frozen=True, eq=False)
class BoneModel:
    """`mean` holds x, y, z of every bone in 2^-16 cm; `spread` is 16 log2 of how far each strays, in cm.

    `partner[b]` is an earlier bone that strays alike (-1: none), `mirror[b]` the signs with which it does. `people` are
    those of the corpus, in 2^-16 cm: who is one of them costs one byte.
    """

    mean: Int[np.ndarray, "bones 3"]
    spread: Int[np.ndarray, "bones 3"]
    partner: Int[np.ndarray, " bones"]
    mirror: Int[np.ndarray, "bones 3"]
    people: Int[np.ndarray, "people bones 3"]

    def tensors(self) -> dict[str, np.ndarray]:
        return {
            "bones.mean": self.mean.astype(np.int32), "bones.spread": self.spread.astype(np.int16),
            "bones.partner": self.partner.astype(np.int16), "bones.mirror": self.mirror.astype(np.int8),
            "bones.people": self.people.astype(np.int32),
        }  # fmt: skip

    @staticmethod
    def load(tensors: dict[str, np.ndarray]) -> BoneModel:
        return BoneModel(*(tensors[f"bones.{name}"].astype(np.int64) for name in _NAMES))

    def predicted(self, size: int, octave: int) -> Int[np.ndarray, "bones 3"]:
        """The mean at a size (128: as it is), in multiples of 2^octave cm, by integers alone."""
        shift = _SIZE_BITS - 1 + _FIXED_POINT + octave
        return self.mean * size + (1 << shift - 1) >> shift


def write_bones(bones: Float[np.ndarray, "bones 3"], model: BoneModel, fineness: int, tail: np.ndarray) -> bytes:
    """Bones in cm, to multiples of 2^(fineness - 13) cm."""
    octave = fineness + _FINEST
    person = _known_person(bones, model, octave)
    if person is not None:
        encoder = RangeEncoder()
        encoder.encode_bits(person, _SIZE_BITS)
        return encoder.finish()
    mean_length = np.linalg.norm(model.mean, axis=1) / (1 << _FIXED_POINT)
    used = mean_length > 0
    ratio = np.median(np.linalg.norm(bones[used], axis=1) / mean_length[used]) if used.any() else 1.0
    size = int(np.clip(np.rint(_SIZE * ratio), MOST_PEOPLE, 2 * _SIZE - 1))
    strayed = np.rint(np.ldexp(bones, -octave)).astype(np.int64) - model.predicted(size, octave)
    encoder = RangeEncoder()
    encoder.encode_bits(size, _SIZE_BITS)
    for b, own in enumerate(strayed):
        levels = own - _of_partner(model, strayed, b)
        encode_sizes(encoder, np.abs(levels), _frequencies(model, b, octave, tail))
        encode_signs(encoder, levels[levels != 0])
    return encoder.finish()


def read_bones(data: bytes, model: BoneModel, fineness: int, tail: np.ndarray) -> Float[np.ndarray, "bones 3"]:
    """In cm. Raises CorruptStream where no encoder wrote such bytes."""
    octave = fineness + _FINEST
    decoder = RangeDecoder(data)
    size = decoder.decode_bits(_SIZE_BITS)
    if size < MOST_PEOPLE:
        if size >= len(model.people):
            raise CorruptStream(f"the stream's skeleton is of person {size}, the model knows {len(model.people)}")
        return np.ldexp(model.people[size].astype(np.float64), -_FIXED_POINT)
    strayed = np.zeros_like(model.mean)
    for b in range(len(strayed)):
        sizes = decode_sizes(decoder, _frequencies(model, b, octave, tail))
        strayed[b] = decode_signs(decoder, sizes) + _of_partner(model, strayed, b)
    return np.ldexp((model.predicted(size, octave) + strayed).astype(np.float64), octave)


def is_somebody(data: bytes) -> bool:
    """True where these bytes name a person of the corpus, whose bones have no fineness."""
    return RangeDecoder(data).decode_bits(_SIZE_BITS) < MOST_PEOPLE


def _known_person(bones: np.ndarray, model: BoneModel, octave: int) -> int | None:
    """Whoever of the corpus has these bones, to what they would be rounded to."""
    apart = np.abs(np.ldexp(model.people[:MOST_PEOPLE].astype(np.float64), -_FIXED_POINT) - bones[None]).max((1, 2))
    return int(apart.argmin()) if len(apart) and apart.min() <= np.ldexp(0.5, octave) else None


def _of_partner(model: BoneModel, strayed: np.ndarray, b: int) -> np.ndarray | int:
    return model.mirror[b] * strayed[model.partner[b]] if model.partner[b] >= 0 else 0


def _frequencies(model: BoneModel, b: int, octave: int, tail: np.ndarray) -> Int[np.ndarray, "3 symbols"]:
    return tail_frequencies(tail, tail_rows_of(model.spread[b] - 16 * octave))
