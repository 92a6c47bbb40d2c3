"""What codes the coefficients of a stream: the bases and tables of the model, or a basis that travels with the stream.

For a skeleton that no model knows, LSDT is fitted to the motion itself, kept in 8 bits an entry, cut to the components
that hold anything, and written into the stream. The entropy tables are the model's: they speak of no joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream
from . import own_basis
from .bitstream import ByteReader, varint
from .clips import Bases
from .coefficients_paper import PaperCodes
from .coefficients_runs import BANDS, RunTables
from .entropy.huffman import HuffmanCode, code_lengths
from .lsdt_model import LsdtModel, nearest
from .quantise import PER_OCTAVE

_PER_SCALE = PER_OCTAVE // 4  # scales travel in quarter octaves


@dataclass(frozen=True)
class OwnBasis:
    """A basis as it travels: entries in 1/127, and what each form needs to code its coefficients.

    `runs` needs expected magnitudes, the sum of one number a component and one a band; `paper` the lengths of the
    position codes.
    """

    entries: Int[np.ndarray, "3 components joints"]
    component_scale: Int[np.ndarray, "3 components"] | None = None
    band_scale: Int[np.ndarray, " bands"] | None = None
    position_lengths: Int[np.ndarray, "3 components"] | None = None


@dataclass(frozen=True)
class Coding:
    """Bases, and the tables for clips of any length."""

    model: LsdtModel
    bases: Bases
    own: OwnBasis | None = None

    @property
    def components(self) -> int:
        return self.bases.synthesis.shape[1]

    def tables(self, length: int) -> RunTables:
        tables = self.model.tables[nearest(length)]
        if self.own is None or self.own.component_scale is None or self.own.band_scale is None:
            return tables
        scale = self.own.component_scale[:, None, :].astype(np.int64) + self.own.band_scale[None, :, None]
        return RunTables(scale * _PER_SCALE, tables.count, tables.run, tables.value)

    def codes(self, length: int) -> PaperCodes:
        codes = self.model.codes[nearest(length)]
        if self.own is None or self.own.position_lengths is None:
            return codes
        return PaperCodes(self.own.position_lengths, codes.value)


def known(model: LsdtModel) -> Coding:
    """The model's own bases."""
    return Coding(model, model.bases)


def fit(positions: Float[np.ndarray, "frames joints 3"], model: LsdtModel) -> Coding:
    """LSDT fitted to a motion, components in order of their energy."""
    return from_own(OwnBasis(own_basis.fit_entries(positions)), model)


def from_own(own: OwnBasis, model: LsdtModel) -> Coding:
    """The coding of a basis that travels. Raises LinAlgError where it is none."""
    return Coding(model, own_basis.bases_of(own.entries), own)


def fit_to_levels(
    coding: Coding, levels: Int[np.ndarray, "clips 3 frequencies components"], band: np.ndarray, index: int
) -> Coding:
    """The components that hold any nonzero level, with the statistics of the levels; `band` is that of each frequency."""
    own = coding.own
    assert own is not None
    used = max(1, int(np.flatnonzero((levels != 0).any((0, 1, 2)))[-1]) + 1) if levels.any() else 1
    levels = levels[..., :used]
    # A level below one half counts as a quarter of a step: what is rounded to zero is not nothing.
    magnitude = np.maximum(np.abs(levels), 0.25)
    by_component = np.log2(magnitude.mean((0, 2))) + index / PER_OCTAVE - 7
    held = np.unique(band)  # a clip has no frequency in some of the lowest bands
    by_band = np.log2([magnitude[:, :, band == b].mean() / magnitude.mean() for b in held])
    component_scale = np.clip(np.rint(4 * by_component), -127, 127).astype(np.int8)
    band_scale = np.clip(np.rint(4 * np.interp(np.arange(BANDS), held, by_band)), -127, 127).astype(np.int8)
    positions = np.stack([code_lengths((levels[:, d] != 0).sum((0, 1))) for d in range(3)])
    return from_own(OwnBasis(own.entries[:, :used], component_scale, band_scale, positions), coding.model)


def write_own(own: OwnBasis, form: str) -> bytes:
    """The basis as it follows the skeleton in a stream, with what the form needs: magnitudes, or code lengths."""
    statistics = (own.component_scale, own.band_scale) if form == "runs" else (own.position_lengths,)
    return varint(own.entries.shape[1]) + own_basis.pack([own.entries, *(part for part in statistics if part is not None)])


def read_own(data: bytes, joints: int, model: LsdtModel, form: str) -> Coding:
    """Raises CorruptStream where the section is not a basis over so many joints."""
    reader = ByteReader(data)
    count = reader.varint()
    if not 0 < count <= joints:
        raise CorruptStream(f"the stream's basis has {count} components for {joints} joints")
    statistics = [(3, count), (BANDS,)] if form == "runs" else [(3, count)]
    entries, *numbers = own_basis.unpack(reader, [(3, count, joints), *statistics])
    own = OwnBasis(entries, *numbers) if form == "runs" else OwnBasis(entries, position_lengths=numbers[0])
    try:
        if own.position_lengths is not None:
            _ = [HuffmanCode(lengths) for lengths in own.position_lengths]
        return from_own(own, model)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise CorruptStream(f"the stream's basis is none: {error}") from error
