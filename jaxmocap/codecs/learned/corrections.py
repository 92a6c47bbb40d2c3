"""Corrections: single bumps of single components, of a frame's length or many, beside the levels of the whole clip.

What the lowest band holds is spread over the clip, so that no level of it mends one moment. A bump is what one sample
does that is added to the motion, or to its slow part, half as many samples an octave.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import CorruptStream
from ...transforms.wavelet import merge
from ..entropy import integers
from ..entropy.range_coder import Decoder, Encoder, RangeEncoder
from .bands import band_rows
from .golomb import read_unsigned, write_unsigned

HEIGHT = 0.5  # steps
_COUNT_ORDER, _SIZE_ORDER = 2, 0
_RARE = np.array([[(1 << 16) - (1 << 10), 1 << 10]])


class Corrections(NamedTuple):
    """`octave` 0 are the longest bumps, and the last a frame alone. Each is about `level` half steps high.

    They are sorted by octave, row and component.
    """

    octave: Int[np.ndarray, " bumps"]
    row: Int[np.ndarray, " bumps"]
    component: Int[np.ndarray, " bumps"]
    level: Int[np.ndarray, " bumps"]

    def shift(self, frames: int, octaves: int, components: int, step: float) -> Float[np.ndarray, "frames components"]:
        """What they add to every frame, in cm."""
        total = np.zeros((sample_counts(frames, octaves)[0], components))
        for octave, rows in enumerate(sample_counts(frames, octaves)):
            if rows > len(total):
                total = merge(total, np.zeros((rows - len(total), components)))
            here = self.octave == octave
            height = HEIGHT * step * 2.0 ** ((octaves - octave) / 2)
            np.add.at(total, (self.row[here], self.component[here]), self.level[here] * height)
        return total


NO_CORRECTIONS = Corrections(*(np.zeros(0, np.int64) for _ in range(4)))


def sample_counts(frames: int, octaves: int) -> list[int]:
    """How many samples the slow part of so many frames has at every octave, the coarsest first, and the motion itself."""
    return np.cumsum(band_rows(frames, octaves)).tolist()


def encode_corrections(encoder: Encoder, corrections: Corrections, frames: int, octaves: int, components: int) -> None:
    """Places by the gaps between them; where there are none, all but nothing."""
    encoder.encode_each(np.array([int(len(corrections.level) > 0)]), _RARE)
    if not len(corrections.level):
        return
    for octave, rows in enumerate(sample_counts(frames, octaves)):
        here = corrections.octave == octave
        place = corrections.row[here] * components + corrections.component[here]
        write_unsigned(encoder, len(place), _COUNT_ORDER)
        order = _gap_order(rows * components, len(place))
        for gap, level in zip(np.diff(place, prepend=-1).tolist(), corrections.level[here].tolist(), strict=True):
            write_unsigned(encoder, gap - 1, order)
            write_unsigned(encoder, abs(level) - 1, _SIZE_ORDER)
            encoder.encode_bits(int(level < 0), 1)


def correction_bytes(corrections: Corrections, frames: int, octaves: int, components: int) -> int:
    """What they take by themselves."""
    encoder = RangeEncoder()
    encode_corrections(encoder, corrections, frames, octaves, components)
    return len(encoder.finish())


def decode_corrections(decoder: Decoder, frames: int, octaves: int, components: int) -> Corrections:
    """Raises CorruptStream where a bump lies outside the motion."""
    found: list[tuple[int, int, int, int]] = []
    if not decoder.decode_each(_RARE)[0]:
        return NO_CORRECTIONS
    for octave, rows in enumerate(sample_counts(frames, octaves)):
        count, place = read_unsigned(decoder, _COUNT_ORDER), -1
        if count > rows * components:
            raise CorruptStream(f"{count} corrections, where there are {rows * components} places")
        order = _gap_order(rows * components, count)
        for _ in range(count):
            place += 1 + read_unsigned(decoder, order)
            size = 1 + read_unsigned(decoder, _SIZE_ORDER)
            if place >= rows * components or size >= integers.LIMIT:
                raise CorruptStream(f"a correction by {size} at place {place} of {rows * components}")
            found.append((octave, *divmod(place, components), -size if decoder.decode_bits(1) else size))
    return Corrections(*np.array(found, np.int64).reshape(-1, 4).T)


def _gap_order(places: int, count: int) -> int:
    """That of the shortest code for gaps between so many of so many places."""
    return max((places // (count + 1)).bit_length() - 1, 0)
