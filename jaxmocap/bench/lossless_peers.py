"""The lossless compressors that the archive is laid beside: of text, and of columns of numbers.

Each is a function that imports its package and gives (compress, decompress); it raises ImportError where that is missing.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

Matrix = Int32[np.ndarray, "frames columns"]
_COUNT = struct.Struct("<I")
_DECIMALS = 4  # of the numbers in the files that floats are made of


@dataclass(frozen=True)
class TextPeer:
    """Both undo each other."""

    compress: Callable[[bytes], bytes]
    decompress: Callable[[bytes], bytes]


@dataclass(frozen=True)
class NumberPeer:
    """Both undo each other; parts, one a column or one for all, go one after another and their sizes are not counted."""

    compress: Callable[[Matrix], list[bytes]]
    decompress: Callable[[Sequence[bytes]], Matrix]


def gzip9() -> TextPeer:
    return TextPeer(lambda text: gzip.compress(text, 9, mtime=0), gzip.decompress)


def bzip2() -> TextPeer:
    return TextPeer(lambda text: bz2.compress(text, 9), bz2.decompress)


def xz() -> TextPeer:
    return TextPeer(lambda text: lzma.compress(text, preset=9 | lzma.PRESET_EXTREME), lzma.decompress)


def zstd() -> TextPeer:
    """Level 22, matches as far back as 128 MiB."""
    import zstandard

    parameters = zstandard.ZstdCompressionParameters.from_level(22, window_log=27, enable_ldm=True)
    compressor, decompressor = zstandard.ZstdCompressor(compression_params=parameters), zstandard.ZstdDecompressor()
    return TextPeer(compressor.compress, decompressor.decompress)


def brotli() -> TextPeer:
    """Quality 11, the largest window."""
    import brotli

    return TextPeer(lambda text: brotli.compress(text, quality=11, lgwin=24), brotli.decompress)


def ppmd() -> TextPeer:
    """7-Zip's variant H; of orders 3 to 24 in variants H and I, 4 in H is best on subject 09."""
    import pyppmd

    order, memory = 4, 1 << 28

    def compress(text: bytes) -> bytes:
        encoder = pyppmd.Ppmd7Encoder(order, memory)
        return _COUNT.pack(len(text)) + encoder.encode(text) + encoder.flush()

    def decompress(data: bytes) -> bytes:
        return pyppmd.Ppmd7Decoder(order, memory).decode(data[_COUNT.size :], *_COUNT.unpack_from(data))

    return TextPeer(compress, decompress)


def pcodec() -> NumberPeer:
    """Second differences, level 12."""
    from pcodec import ChunkConfig, DeltaSpec, standalone  # pyright: ignore[reportAttributeAccessIssue]

    config = ChunkConfig(compression_level=12, delta_spec=DeltaSpec.try_consecutive(2))
    return NumberPeer(
        lambda matrix: [standalone.simple_compress(np.ascontiguousarray(column), config) for column in matrix.T],
        lambda parts: np.stack([standalone.simple_decompress(part) for part in parts], 1),
    )


def fpzip() -> NumberPeer:
    """Each column by itself, which is better than two dimensions in either order; float64 where float32 would not do."""
    import fpzip

    def compress(matrix: Matrix) -> list[bytes]:
        exact = np.float32 if np.abs(matrix).max(initial=0) < 1 << 23 else np.float64
        values = (matrix / 10**_DECIMALS).astype(exact)
        return [fpzip.compress(np.ascontiguousarray(column)) for column in values.T]

    def decompress(parts: Sequence[bytes]) -> Matrix:
        values = np.stack([fpzip.decompress(part).ravel() for part in parts], 1)
        return np.rint(values * 10**_DECIMALS).astype(np.int32)

    return NumberPeer(compress, decompress)


def planes() -> NumberPeer:
    """Second differences column by column, their sign in the lowest bit, byte planes, brotli 11."""
    text = brotli()

    def compress(matrix: Matrix) -> list[bytes]:
        differences = np.diff(matrix, n=2, axis=0, prepend=np.zeros((2, matrix.shape[1]), np.int32)).T
        folded = np.ascontiguousarray((differences << 1) ^ (differences >> 31)).astype("<i4")
        return [text.compress(_COUNT.pack(matrix.shape[1]) + folded.view(np.uint8).reshape(-1, 4).T.tobytes())]

    def decompress(parts: Sequence[bytes]) -> Matrix:
        data = text.decompress(parts[0])
        split = np.frombuffer(data, np.uint8, offset=_COUNT.size).reshape(4, -1).T
        folded = np.ascontiguousarray(split).view("<u4").reshape(_COUNT.unpack_from(data)[0], -1).T
        differences = (folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32)
        return differences.cumsum(0, np.int32).cumsum(0, np.int32)

    return NumberPeer(compress, decompress)


TEXT: dict[str, Callable[[], TextPeer]] = {
    "gzip -9": gzip9, "bzip2 -9": bzip2, "xz -9e": xz, "zstd 22, long": zstd, "brotli 11": brotli, "PPMd H, order 4": ppmd,
}
NUMBERS: dict[str, Callable[[], NumberPeer]] = {
    "fpzip, float32 columns": fpzip, "pcodec, delta 2": pcodec, "2nd differences, planes, brotli 11": planes,
}
