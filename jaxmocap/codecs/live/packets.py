"""One frame as one packet, which can be read without any other: three bytes of framing, then a range-coded string.

The framing is a number, modulo 4050, and a checksum. The string holds, now and then, a symbol of the fountain from which a
receiver learns whose motion it is, or at first that itself; how fine this frame's step is; the places of the few components
whose turn it is to be told anew, or of all; and the levels of the others. Frames before it may be told again, in case they
were lost. The length of a packet is not in it: datagrams have one.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ...errors import CorruptStream
from ..entropy.range_coder import PythonDecoder, PythonEncoder
from ..entropy.tables import FrequencyTable
from ..learned.steps import STEPS
from .events import Density, read_integer, read_moved, write_integer, write_moved
from .fountain import SYMBOL_BITS
from .tracker import FINEST_STEP, REFRESH_FRAMES, refreshed

FRAMING_BYTES = 3
NUMBERS = 75 * REFRESH_FRAMES  # as many whole turns as 12 bits can count
OFFSETS = 16
NO_OFFSET = OFFSETS // 2
PER_OFFSET = 4  # sixteenths of an octave
_NOTHING, _SYMBOL, _HELLO = range(3)  # what a packet tells of whose motion it is
_NEWS = FrequencyTable.from_counts(np.array([223, 32, 1]))
_IS_WHOLE = FrequencyTable.from_counts(np.array([255, 1]))
_OFFSETS = FrequencyTable.from_counts(np.array([1, 1, 1, 1, 1, 2, 4, 16, 200, 16, 4, 2, 1, 1, 1, 1]))
_LENGTH_BITS = 12
MOST_BYTES = 1 << 12
MOST_REPEATS = 3


@dataclass(frozen=True, eq=False)
class Frame:
    """The integers of a packet. `places` are of all components where `whole`, else of those whose turn it is."""

    offset: int
    whole: bool
    places: Int[np.ndarray, " places"]
    levels: Int[np.ndarray, " components"]


def step_of(step_index: int, offset: int) -> int:
    """The index of a frame's step, where the stream's is `step_index`."""
    return min(max(step_index + PER_OFFSET * (offset - NO_OFFSET), FINEST_STEP), STEPS - 1)


def write_packet(number: int, frames: Sequence[Frame], step_index: int, density: Density, news: bytes | int | None) -> bytes:
    """The frame of this number, and those before it that are told again, from late to early.

    `news` is the hello, or a symbol of its fountain, if it is its turn.
    """
    encoder = PythonEncoder()
    _write_news(encoder, news)
    for back, frame in enumerate(frames):
        _write_frame(encoder, number - back, frame, step_index, density)
    return framed(number, encoder.finish())


def _write_frame(encoder: PythonEncoder, number: int, frame: Frame, step_index: int, density: Density) -> None:
    index = step_of(step_index, frame.offset)
    encoder.encode(frame.offset, _OFFSETS)
    encoder.encode(int(frame.whole), _IS_WHOLE)
    components = np.arange(len(frame.levels)) if frame.whole else refreshed(number, len(frame.levels))
    for component, place in zip(components.tolist(), frame.places.tolist(), strict=True):
        write_integer(encoder, abs(place), density.place(index, component))
        if place:
            encoder.encode_bits(int(place < 0), 1)
    if not frame.whole:
        write_moved(encoder, frame.levels, index, density)


def framed(number: int, payload: bytes) -> bytes:
    number %= NUMBERS
    return (number << 12 | _check(number, payload)).to_bytes(FRAMING_BYTES, "big") + payload


def unframed(packet: bytes) -> tuple[int, bytes]:
    """Number, modulo 4050, and payload. Raises CorruptStream where the packet is damaged."""
    if not FRAMING_BYTES <= len(packet) <= MOST_BYTES:
        raise CorruptStream(f"a packet has {len(packet)} bytes, wanted {FRAMING_BYTES} to {MOST_BYTES}")
    head, payload = int.from_bytes(packet[:FRAMING_BYTES], "big"), packet[FRAMING_BYTES:]
    if head & 0xFFF != _check(head >> 12, payload):
        raise CorruptStream("a packet does not match its checksum")
    if head >> 12 >= NUMBERS:
        raise CorruptStream(f"a packet has the number {head >> 12}, wanted less than {NUMBERS}")
    return head >> 12, payload


def read_news(payload: bytes) -> bytes | int | None:
    """The hello, or a symbol of its fountain, which can be read before anything else is known. Raises CorruptStream."""
    return _read_news(PythonDecoder(payload))


def _write_news(encoder: PythonEncoder, news: bytes | int | None) -> None:
    encoder.encode(_NOTHING if news is None else _SYMBOL if isinstance(news, int) else _HELLO, _NEWS)
    if isinstance(news, int):
        encoder.encode_bits(news, SYMBOL_BITS)
    elif news is not None:
        encoder.encode_bits(len(news), _LENGTH_BITS)
        for byte in news:
            encoder.encode_bits(byte, 8)


def _read_news(decoder: PythonDecoder) -> bytes | int | None:
    kind = decoder.decode(_NEWS)
    if kind == _HELLO:
        return bytes(decoder.decode_bits(8) for _ in range(decoder.decode_bits(_LENGTH_BITS)))
    return decoder.decode_bits(SYMBOL_BITS) if kind == _SYMBOL else None


def read_frames(number: int, payload: bytes, count: int, step_index: int, density: Density) -> list[Frame]:
    """The frame of this number, and those before it that are told again, `count` at most: a whole frame is the first of all.

    Raises CorruptStream where no encoder wrote such bytes.
    """
    decoder = PythonDecoder(payload)
    _read_news(decoder)
    frames = [_read_frame(decoder, number, step_index, density)]
    while len(frames) < count and not frames[-1].whole:
        frames.append(_read_frame(decoder, number - len(frames), step_index, density))
    return frames


def _read_frame(decoder: PythonDecoder, number: int, step_index: int, density: Density) -> Frame:
    count = len(density.prior.speed)
    offset, whole = decoder.decode(_OFFSETS), bool(decoder.decode(_IS_WHOLE))
    index = step_of(step_index, offset)
    components = range(count) if whole else refreshed(number, count).tolist()
    places = [_read_place(decoder, density.place(index, component)) for component in components]
    levels = np.zeros(count, np.int64) if whole else read_moved(decoder, count, index, density)
    return Frame(offset, whole, np.array(places, np.int64), levels)


def _read_place(decoder: PythonDecoder, table: FrequencyTable) -> int:
    size = read_integer(decoder, table)
    return -size if size and decoder.decode_bits(1) else size


def _check(number: int, payload: bytes) -> int:
    return zlib.crc32(payload, number) & 0xFFF
