"""The alpha parallelogram predictor: Wang, Pan, Zhang, Lau, Song, Information Sciences 232, 2013. The comparator of `mrpa`.

A channel moves with one that is known before it, of its joint or of the joint before: x(t) = x(t-1) + alpha (y(t) -
y(t-1)). Which one, and alpha out of a table, are chosen for every channel of a rig. Floats are coded as in `mrpa`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, Int32

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..lossless import AbstractNumberCodec, NumberTable
from . import float_streams, float_tables
from . import groups as number_groups
from .float_coding import Floats, Tables, no_floats
from .float_streams import CHUNK, ORDER, Steps, TableDecoder, inner_frames, own_steps
from .groups import Group
from .steps import cost

ALPHAS = np.arange(-16, 17)  # eighths
_STILL = 16  # where alpha is 0
_NO_WEIGHT = 8  # all of the prediction is the parallelogram's


class Alphas(NamedTuple):
    """For every channel how many channels before it its neighbour is, 0 for none, and the place of its alpha."""

    back: Int[np.ndarray, " lanes"]
    alpha: Int[np.ndarray, " lanes"]

    def levels(self) -> list[Int[np.ndarray, " n"]]:
        """Channels without a neighbour, then those whose neighbours are among these, and so on."""
        level = np.zeros(len(self.back), int)
        for c, back in enumerate(self.back):
            level[c] = level[c - back] + 1 if back else 0
        return [np.flatnonzero(level == n) for n in range(level.max(initial=-1) + 1)]

    def steps(self, channels: Int[np.ndarray, " n"], moved: Int32[np.ndarray, "frames lanes"]) -> Steps:
        """How channels are predicted whose neighbours' steps are known."""
        alpha = ALPHAS[self.alpha[channels]].astype(np.int32)
        other = alpha * moved[:, channels - self.back[channels]] + 4 >> 3
        return Steps(other, np.full(other.shape, _NO_WEIGHT, np.uint8), inner_frames(len(moved)))


class App(AbstractNumberCodec):
    """The codec. A payload holds one stream a level of `Alphas`, each with its length before it."""

    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        return number_groups.encode(tables, _encode_group)

    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        return number_groups.decode(shared, payload, which, _decode_group)


def choose_alphas(columns: Sequence[str], moved: Int32[np.ndarray, "frames lanes"]) -> Alphas:
    """The neighbour and the alpha that leave every channel the least."""
    joints = [name.rpartition(" ")[0] for name in columns]
    names = list(dict.fromkeys(joints))
    place = [names.index(joint) for joint in joints]
    back, alpha = np.zeros(len(columns), int), np.full(len(columns), _STILL)
    for c in range(len(columns)):
        least = cost(moved[:, c : c + 1], 0 * moved[:, c : c + 1])[0]
        for other in (k for k in range(c) if place[c] - 1 <= place[k] <= place[c] and moved[:, k].any()):
            tried = cost(moved[:, c : c + 1], moved[:, other : other + 1] * ALPHAS.astype(np.int32) + 4 >> 3)
            if tried.min() < least:
                least, back[c], alpha[c] = tried.min(), c - other, tried.argmin()
    return Alphas(back, alpha)


def _encode_group(group: Group, tables: Sequence[Floats]) -> tuple[bytes, list[bytes]]:
    if not sum(group.frames) or not group.columns:
        return b"", [b""] * len(tables)
    moved = [own_steps(table.value, inner_frames(len(table.value))) for table in tables]
    alphas = choose_alphas(group.columns, np.concatenate(moved))
    streams = []
    for table, steps in zip(tables, moved, strict=True):
        streams.append([])
        for channels in alphas.levels() if len(steps) else []:
            part = Floats(table.value[:, channels], table.negative[:, channels])
            prediction = float_streams.predictions(part, alphas.steps(channels, steps), _no_coefficients(len(channels)))
            streams[-1].append((part, float_streams.split(part, prediction)))
    packed = float_tables.learn([symbols for parts in streams for _, symbols in parts])
    frequencies = float_tables.read(packed)
    section = b"".join(map(varint, alphas.back.tolist())) + alphas.alpha.astype(np.uint8).tobytes() + packed
    return section, [b"".join(map(_sized, _encoded(parts, frequencies))) for parts in streams]


def _encoded(parts, frequencies: Tables) -> Iterator[bytes]:
    return (float_streams.encode(part, symbols, frequencies) for part, symbols in parts)


def _sized(data: bytes) -> bytes:
    return varint(len(data)) + data


def _no_coefficients(lanes: int) -> np.ndarray:
    return np.zeros((ORDER, lanes), np.int8)


def _decode_group(
    group: Group, section: bytes, payload: Callable[[int], bytes], members: Sequence[int]
) -> dict[int, Floats]:
    lanes = len(group.columns)
    if not sum(group.frames) or not lanes:
        return {m: no_floats(group.frames[m], lanes) for m in members}
    reader = ByteReader(section)
    alphas = Alphas(np.array([reader.varint() for _ in range(lanes)]), np.frombuffer(reader.take(lanes), np.uint8))
    if (alphas.back > np.arange(lanes)).any() or (alphas.alpha >= len(ALPHAS)).any():
        raise CorruptStream("a channel's neighbour or alpha is none that there is")
    tables = float_tables.read(reader.take(reader.left))
    return {m: _decode_table(payload(m), group.frames[m], alphas, tables) for m in members}


def _decode_table(data: bytes, frames: int, alphas: Alphas, tables: Tables) -> Floats:
    found = no_floats(frames, len(alphas.back))
    reader = ByteReader(data)
    for channels in alphas.levels() if frames else []:
        steps = alphas.steps(channels, own_steps(found.value, inner_frames(frames)))
        decoder = TableDecoder(reader.take(reader.varint()), _no_coefficients(len(channels)), tables)
        for at in range(1, frames, CHUNK):
            piece = decoder.frames(Steps(*(a[at : at + CHUNK] for a in steps)))
            found.value[at : at + CHUNK, channels], found.negative[at : at + CHUNK, channels] = piece
        found.value[0, channels], found.negative[0, channels] = decoder.first()
    if reader.left:
        raise CorruptStream(f"{reader.left} bytes follow the last channels of a payload")
    return found
