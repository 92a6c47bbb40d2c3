"""The temporal transform: what lies below 3.75 Hz as one cosine transform of the whole clip, what lies above as octaves.

Slow motion is stationary enough for a transform over the whole clip; fast motion comes in bursts, which wavelets hold
together. The wavelet is the 9/7 of Cohen, Daubechies and Feauveau. Takes numpy arrays and JAX's.
"""

from __future__ import annotations

import functools
import math

from jaxtyping import Float

from ...components import A, namespace
from ...transforms.dct import dct_matrix
from ...transforms.wavelet import merge, split

_SLOW_RATE = 7.5  # Hz, near which the lowest band is sampled
MOST_OCTAVES = 7


def octave_count(frame_time: float) -> int:
    """How many octaves of wavelets there are above the lowest band."""
    return min(max(round(-math.log2(frame_time * _SLOW_RATE)), 0), MOST_OCTAVES)


def band_rows(frames: int, octaves: int) -> list[int]:
    """Rows of the lowest band, then of every octave above it. Short clips have empty octaves."""
    details = []
    for _ in range(octaves):
        details.insert(0, frames // 2)
        frames = (frames + 1) // 2
    return [frames, *details]


def forward(x: Float[A, "frames channels"], octaves: int) -> list[A]:
    """The lowest band by frequency, then `octaves` from coarse to fine by time: each (rows, channels)."""
    slow, details = x, []
    for _ in range(octaves):
        slow, detail = split(slow) if len(slow) > 1 else (slow, slow[:0])
        details.insert(0, detail)
    return [_cosines(len(slow), slow) @ slow, *details]


def inverse(bands: list[A]) -> Float[A, "frames channels"]:
    """The signal of its bands."""
    x = _cosines(len(bands[0]), bands[0]).T @ bands[0]
    for detail in bands[1:]:
        x = merge(x, detail) if len(detail) else x
    return x


def _cosines(rows: int, like: A) -> A:
    return namespace(like).asarray(_matrix(rows), like.dtype)


_matrix = functools.lru_cache(maxsize=16)(dct_matrix)
