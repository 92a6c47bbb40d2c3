"""The error-bounded compressors of arrays that `learned` is laid beside: SZ3, zfp, and quantise, delta, xz.

Each is a function that imports its package and gives an ArrayCoder; it raises ImportError where that is missing.
"""

from __future__ import annotations

import functools
import itertools
import lzma
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int

from .rd_positions import ArrayCoder, Channels

_INT16 = (-(1 << 15), (1 << 15) - 1)
_BLOCK = (4, 4)  # zfp's blocks are 4 x 4 x 4: 64 successive frames of a channel
_SCALE = struct.Struct("<f")
_BOUND = struct.Struct("<fB")  # bound, order of the differences
_LZMA = {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "dict_size": 1 << 20, "lp": 0, "pb": 0}


def sz3() -> ArrayCoder:
    """SZ3 3.4, interpolation over one dimension: all channels one after another, every second one backwards.

    Of 1 to 3 dimensions in any order this is best by far. Its ways are linear and cubic interpolation with three weights of
    the levels, the last two those of QoZ further out than SZ3 tries by itself.
    """
    from pysz import sz

    def compress(channels: Channels, bound: float, kind: str, alpha: float, beta: float) -> bytes:
        line = np.ascontiguousarray(_turned(channels).reshape(-1), np.float32)
        return sz.compress(line, _sz3_config(bound, kind, alpha, beta))[0].tobytes()

    def decompress(data: bytes, shape: tuple[int, int]) -> Channels:
        line, _ = sz.decompress(np.frombuffer(data, np.uint8).copy(), np.float32, (shape[0] * shape[1],))
        return _turned(line.reshape(shape).astype(np.float64))

    weights = ((1.0, 1.0), (1.1, 3.0), (1.5, 8.0))
    ways = itertools.product(("LINEAR", "CUBIC"), weights)
    return ArrayCoder(tuple(functools.partial(compress, kind=k, alpha=a, beta=b) for k, (a, b) in ways), decompress)


def _sz3_config(bound: float, kind: str, alpha: float, beta: float):
    """Settings that the Python package passes on from a file only."""
    from pysz import szConfig

    config = szConfig()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "sz3.ini")
        file.write_text(
            f"[GlobalSettings]\nCmprAlgo = ALGO_INTERP\nErrorBoundMode = ABS\nAbsErrorBound = {bound!r}\n"
            f"[AlgoSettings]\nInterpolationAlgo = INTERP_ALGO_{kind}\nInterpolationAlpha = {alpha}\n"
            f"InterpolationBeta = {beta}\nInterpolationAnchorStride = 0\n"
        )
        config.loadcfg(str(file))
    return config


def _turned(channels: Channels) -> Channels:
    """Every second channel backwards."""
    turned = channels.copy()
    turned[1::2] = channels[1::2, ::-1]
    return turned


def zfp() -> ArrayCoder:
    """zfp at fixed accuracy, less the mean of each channel; of ten layouts that of 64 frames a block is best by far.

    zfp takes only powers of two for a bound: the channels are scaled instead.
    """
    import zfpy

    def compress(channels: Channels, bound: float) -> bytes:
        mean = np.clip(np.rint(channels.mean(1)), *_INT16).astype("<i2")
        padded = np.pad(channels - mean[:, None], ((0, 0), (0, -channels.shape[1] % 16)), "edge")
        blocks = np.ascontiguousarray(padded.reshape(-1, *_BLOCK) / bound, np.float32)
        return _SCALE.pack(bound) + mean.tobytes() + zfpy.compress_numpy(blocks, tolerance=1.0)

    def decompress(data: bytes, shape: tuple[int, int]) -> Channels:
        (scale,) = _SCALE.unpack_from(data)
        mean = np.frombuffer(data, "<i2", shape[0], _SCALE.size)
        blocks = zfpy.decompress_numpy(data[_SCALE.size + mean.nbytes :])
        return blocks.reshape(shape[0], -1)[:, : shape[1]].astype(np.float64) * scale + mean[:, None]

    return ArrayCoder((compress,), decompress)


def quantise_delta_xz() -> ArrayCoder:
    """A uniform quantiser, first or second differences in time channel by channel, LZMA without xz's 60 bytes around it."""

    def compress(channels: Channels, bound: float, order: int) -> bytes:
        levels = np.rint(channels / np.float32(2 * bound)).astype(np.int64)
        differences = np.diff(levels, n=order, axis=1, prepend=np.zeros((len(levels), order), np.int64))
        return _BOUND.pack(2 * bound, order) + _squeezed(_to_bytes(differences.reshape(-1)))

    def decompress(data: bytes, shape: tuple[int, int]) -> Channels:
        step, order = _BOUND.unpack_from(data)
        levels = _from_bytes(_unsqueezed(data[_BOUND.size :]), shape[0] * shape[1]).reshape(shape)
        for _ in range(order):
            levels = levels.cumsum(1)
        return levels * step

    return ArrayCoder(tuple(functools.partial(compress, order=order) for order in (1, 2)), decompress)


def _squeezed(data: bytes) -> bytes:
    """The smaller of two settings, and a byte that says which."""
    made = [bytes([lc]) + lzma.compress(data, lzma.FORMAT_RAW, filters=[{**_LZMA, "lc": lc}]) for lc in (0, 3)]
    return min(made, key=len)


def _unsqueezed(data: bytes) -> bytes:
    return lzma.decompress(data[1:], lzma.FORMAT_RAW, filters=[{**_LZMA, "lc": data[0]}])


def _to_bytes(values: Int[np.ndarray, "values"]) -> bytes:
    """Sign in the lowest bit, one byte a value, 255 for those that follow in four."""
    folded = (values << 1) ^ (values >> 63)
    large = folded >= 255
    return np.where(large, 255, folded).astype(np.uint8).tobytes() + folded[large].astype("<u4").tobytes()


def _from_bytes(data: bytes, count: int) -> Int[np.ndarray, "values"]:
    folded = np.frombuffer(data, np.uint8, count).astype(np.int64)
    folded[folded == 255] = np.frombuffer(data, "<u4", offset=count)
    return (folded >> 1) ^ -(folded & 1)


PEERS: dict[str, Callable[[], ArrayCoder]] = {"SZ3": sz3, "zfp": zfp, "quantise, delta, xz": quantise_delta_xz}
