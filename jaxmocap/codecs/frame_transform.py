"""The spatial transform of a stream that is coded frame by frame: the model's, or one that travels with the stream."""

from __future__ import annotations

import abc
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream
from . import own_basis
from .bitstream import ByteReader, varint
from .clips import Bases
from .entropy.huffman import HuffmanCode, code_lengths
from .frame_coefficients import FrameCodes
from .frame_model import FrameModel


class AbstractSpatialTransform(abc.ABC):
    """What tells one codec from the other: its name and number, and the basis for a rig that no model knows.

    Such a basis is made of entries, signed bytes that travel with the stream: none of them where a formula gives it.
    """

    name: str
    number: int

    @abc.abstractmethod
    def entries(self, positions: Float[np.ndarray, "frames joints 3"]) -> Int[np.ndarray, "3 joints columns"]:
        """The entries of the basis for a motion, a row a component."""

    @abc.abstractmethod
    def columns(self, joints: int) -> int:
        """How many entries a component has."""

    @abc.abstractmethod
    def bases(self, entries: Int[np.ndarray, "3 components columns"], joints: int) -> Bases:
        """The basis of entries. Raises LinAlgError where they are none."""


@dataclass(frozen=True)
class Coding:
    """A spatial basis and the codes of its levels. `own` is what a stream has to say of both: nothing of the model's."""

    bases: Bases
    codes: FrameCodes
    own: bytes = b""


def known(model: FrameModel) -> Coding:
    """The model's own basis and codes."""
    return Coding(model.bases, model.codes)


def of_entries(entries: np.ndarray, joints: int, transform: AbstractSpatialTransform, model: FrameModel) -> Coding:
    """A basis for a rig that no model knows, with all of its components, and codes that expect nothing of these."""
    flat = np.full((3, joints), max(1, (joints - 1).bit_length()))
    return Coding(transform.bases(entries, joints), model.codes.with_positions(flat))


def fit_to_levels(
    chunks: list[Int[np.ndarray, "frames 3 components"]],
    entries: np.ndarray,
    joints: int,
    transform: AbstractSpatialTransform,
    model: FrameModel,
) -> Coding:
    """The components of it that hold any nonzero level, with codes for these, and the section that says so."""
    used = int(np.flatnonzero(np.concatenate(chunks).any((0, 1))).max(initial=0)) + 1
    later = np.concatenate([chunk[1:, :, :used] for chunk in chunks])
    lengths = np.stack([code_lengths((later[:, d] != 0).sum(0)) for d in range(3)])
    own = varint(used) + own_basis.pack([entries[:, :used], lengths])
    return Coding(transform.bases(entries[:, :used], joints), model.codes.with_positions(lengths), own)


def read_own(data: bytes, joints: int, transform: AbstractSpatialTransform, model: FrameModel) -> Coding:
    """Raises CorruptStream where the section is not a basis over so many joints."""
    reader = ByteReader(data)
    used = reader.varint()
    if not 0 < used <= joints:
        raise CorruptStream(f"the stream's basis has {used} components for {joints} joints")
    entries, lengths = own_basis.unpack(reader, [(3, used, transform.columns(joints)), (3, used)])
    try:
        _ = [HuffmanCode(of_coordinate) for of_coordinate in lengths]
        return Coding(transform.bases(entries, joints), model.codes.with_positions(lengths))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise CorruptStream(f"the stream's basis is none: {error}") from error
