"""A basis that travels with its stream: LSDT fitted to the motion itself, kept in 8 bits an entry."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..errors import CorruptStream
from ..transforms.dct import dct_matrix
from ..transforms.lsdt import fit_lsdt, growing
from .bitstream import ByteReader
from .clips import Bases

_FIT_FRAMES = 2048
_ITERATIONS = 100
_ENTRY_STEPS = 127


def fit_entries(positions: Float[np.ndarray, "frames joints 3"]) -> Int[np.ndarray, "3 joints joints"]:
    """LSDT fitted to a motion, in 1/127, components in order of their energy."""
    joints = positions.shape[1]
    chosen = positions[np.linspace(0, len(positions) - 1, _FIT_FRAMES).astype(int)]
    samples = jnp.asarray(chosen.transpose(2, 0, 1), jnp.float32)
    schedule = growing(min(8, joints), _ITERATIONS)
    basis = np.asarray(fit_lsdt(samples, jnp.asarray(dct_matrix(joints), jnp.float32), schedule).transform.basis)
    energy = (np.einsum("dij,dnj->din", basis, samples) ** 2).sum(-1)
    order = np.argsort(-energy, axis=1)
    return np.rint(np.take_along_axis(basis, order[:, :, None], 1) * _ENTRY_STEPS).astype(np.int8)


def bases_of(entries: Int[np.ndarray, "3 components joints"]) -> Bases:
    """Rounded rows are not orthogonal: analysis by their pseudo-inverse makes synthesis the best fit all the same.

    Raises LinAlgError where there is none.
    """
    synthesis = entries.astype(np.float64) / _ENTRY_STEPS
    analysis = np.linalg.pinv(synthesis).transpose(0, 2, 1)
    return Bases(analysis.astype(np.float32), synthesis.astype(np.float32))


def pack(parts: Sequence[np.ndarray]) -> bytes:
    """Arrays of signed bytes, one after another, deflated."""
    return zlib.compress(b"".join(np.asarray(part, np.int8).tobytes() for part in parts), 9, wbits=-15)


def unpack(reader: ByteReader, shapes: Sequence[tuple[int, ...]]) -> list[Int[np.ndarray, "..."]]:
    """The arrays of these shapes from the rest of a section. Raises CorruptStream where it holds anything else."""
    sizes = [int(np.prod(shape)) for shape in shapes]
    try:
        raw = zlib.decompressobj(wbits=-15).decompress(reader.take(reader.left), sum(sizes) + 1)
    except zlib.error as error:
        raise CorruptStream(f"the stream's basis cannot be unpacked: {error}") from error
    if len(raw) != sum(sizes):
        raise CorruptStream(f"the stream's basis has {len(raw)} bytes, wanted {sum(sizes)}")
    parts = np.split(np.frombuffer(raw, np.int8), np.cumsum(sizes)[:-1])
    return [p.reshape(shape).astype(np.int64) for p, shape in zip(parts, shapes, strict=True)]
