"""What codes the coefficients of a stream: the bases and tables of the model, or a basis that travels with the stream.

For a skeleton that no model knows, LSDT is fitted to the motion itself, kept in 8 bits an entry, cut to the components
that hold anything, and written into the stream. The entropy tables are the model's: they speak of no joints.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream
from ..transforms.dct import dct_matrix
from ..transforms.lsdt import fit_lsdt, growing
from .bitstream import ByteReader, varint
from .clips import Bases
from .coefficients_paper import PaperCodes
from .coefficients_runs import BANDS, RunTables
from .entropy.huffman import HuffmanCode, code_lengths
from .lsdt_model import LsdtModel, nearest
from .quantise import PER_OCTAVE

_FIT_FRAMES = 2048
_ITERATIONS = 100
_ENTRY_STEPS = 127
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
    joints = positions.shape[1]
    chosen = positions[np.linspace(0, len(positions) - 1, _FIT_FRAMES).astype(int)]
    samples = jnp.asarray(chosen.transpose(2, 0, 1), jnp.float32)
    schedule = growing(min(8, joints), _ITERATIONS)
    basis = np.asarray(fit_lsdt(samples, jnp.asarray(dct_matrix(joints), jnp.float32), schedule).transform.basis)
    energy = (np.einsum("dij,dnj->din", basis, samples) ** 2).sum(-1)
    order = np.argsort(-energy, axis=1)
    entries = np.rint(np.take_along_axis(basis, order[:, :, None], 1) * _ENTRY_STEPS).astype(np.int8)
    return from_own(OwnBasis(entries), model)


def from_own(own: OwnBasis, model: LsdtModel) -> Coding:
    """Rounded rows are not orthogonal: analysis by their pseudo-inverse makes synthesis the best fit all the same."""
    synthesis = own.entries.astype(np.float64) / _ENTRY_STEPS
    analysis = np.linalg.pinv(synthesis).transpose(0, 2, 1)
    return Coding(model, Bases(analysis.astype(np.float32), synthesis.astype(np.float32)), own)


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
    raw = b"".join(np.asarray(part, np.int8).tobytes() for part in (own.entries, *statistics))
    return varint(own.entries.shape[1]) + zlib.compress(raw, 9, wbits=-15)


def read_own(data: bytes, joints: int, model: LsdtModel, form: str) -> Coding:
    """Raises CorruptStream where the section is not a basis over so many joints."""
    reader = ByteReader(data)
    count = reader.varint()
    if not 0 < count <= joints:
        raise CorruptStream(f"the stream's basis has {count} components for {joints} joints")
    statistics = [(3, count), (BANDS,)] if form == "runs" else [(3, count)]
    shapes = [(3, count, joints), *statistics]
    sizes = [int(np.prod(shape)) for shape in shapes]
    try:
        raw = zlib.decompressobj(wbits=-15).decompress(reader.take(reader.left), sum(sizes) + 1)
    except zlib.error as error:
        raise CorruptStream(f"the stream's basis cannot be unpacked: {error}") from error
    if len(raw) != sum(sizes):
        raise CorruptStream(f"the stream's basis has {len(raw)} bytes, wanted {sum(sizes)}")
    parts = np.split(np.frombuffer(raw, np.int8), np.cumsum(sizes)[:-1])
    entries, *numbers = (p.reshape(shape).astype(np.int64) for p, shape in zip(parts, shapes, strict=True))
    own = OwnBasis(entries, *numbers) if form == "runs" else OwnBasis(entries, position_lengths=numbers[0])
    try:
        if own.position_lengths is not None:
            _ = [HuffmanCode(lengths) for lengths in own.position_lengths]
        return from_own(own, model)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise CorruptStream(f"the stream's basis is none: {error}") from error
