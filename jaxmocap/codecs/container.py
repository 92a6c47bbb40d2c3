"""The `.jmc` stream: a header, a skeleton, an optional model, and chunks that decode one by one (docs/format.md).

The header is as short as it can be, since short clips are the common case: a stream of one chunk spends 20 bytes at most
on all that is neither skeleton nor coded motion. Every chunk's CRC-32 runs over the header, too, so that no byte of the
file is unprotected.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

from ..errors import CorruptStream, JaxmocapError, UnsupportedVersion
from .bitstream import ByteReader, varint
from .released import RELEASED

MAGIC = b"JMC"
_DATABASE_MAGIC = b"JMD"
VERSION = 1
SUFFIX = ".jmc"
DIGEST_BYTES = 4

_UNIT_OF_MODEL, _UNIT_UNKNOWN, _UNIT_STATED = 0, 1, 2
_FRAME_TIME_STATED, _MODEL_EMBEDDED, _MANY_CHUNKS, _MANY_LAYERS = 4, 8, 16, 32
_MODEL_NUMBERED = 64
_KNOWN_FLAGS = 3 | _FRAME_TIME_STATED | _MODEL_EMBEDDED | _MANY_CHUNKS | _MANY_LAYERS | _MODEL_NUMBERED
MOST_LAYERS = 8


@dataclass(frozen=True)
class Header:
    """All of a stream that is not coded motion.

    `codec` is the number of the codec (0..31), `params` its settings (0..7 bytes). `digest` is the start of the SHA-256
    of the model that the decoder needs, unless that model is embedded; of a released model its number is written instead.
    `frame_time` (s) and `unit_cm` are None where the model's own hold; a `unit_cm` of 0 says that nobody knows the unit.
    A chunk holds `chunk_frames` frames, the last the rest.
    With `layers` all chunks are there so many times: first as coarse as can be, then what makes them finer.
    """

    codec: int
    params: bytes
    frames: int
    chunk_frames: int
    skeleton: bytes
    digest: bytes = b""
    model: bytes | None = None
    frame_time: float | None = None
    unit_cm: float | None = None
    layers: int = 1

    @property
    def chunk_count(self) -> int:
        """Of one layer."""
        return -(-self.frames // self.chunk_frames)


@dataclass(frozen=True)
class Stream:
    """A stream whose bounds have been checked; each chunk is verified as it is taken."""

    header: Header
    data: bytes
    header_crc: int
    spans: tuple[tuple[int, int], ...]

    @property
    def layers(self) -> int:
        """How many layers are here."""
        return len(self.spans) // self.header.chunk_count

    def chunk(self, index: int, layer: int = 0) -> bytes:
        """The coded motion of one chunk; raises CorruptStream where its checksum, or the header's, does not hold."""
        start, stop = self.spans[layer * self.header.chunk_count + index]
        payload = self.data[start:stop]
        (stored,) = struct.unpack("<I", self.data[stop : stop + 4])
        if zlib.crc32(payload, self.header_crc) != stored:
            raise CorruptStream(f"chunk {index} (byte {start}) does not match its checksum: fetch the stream again")
        return payload

    def section_bytes(self) -> dict[str, int]:
        """Where the bytes go: they sum to the size of the stream."""
        coded = sum(stop - start for start, stop in self.spans)
        model = len(self.header.model or b"")
        skeleton = len(self.header.skeleton)
        frame = len(self.data) - coded - model - skeleton
        return {"framing": frame, "skeleton": skeleton, "model": model, "motion": coded}


def write_stream(header: Header, chunks: list[bytes]) -> bytes:
    """The bytes of a stream. Raises ValueError where the chunks do not fit the header."""
    if len(chunks) != header.chunk_count * header.layers or not 1 <= header.layers <= MOST_LAYERS or header.frames < 1:
        raise ValueError(
            f"{len(chunks)} chunks for {header.frames} frames in chunks of {header.chunk_frames} and {header.layers} layers"
        )
    many = header.chunk_count > 1
    unit = _UNIT_OF_MODEL if header.unit_cm is None else _UNIT_UNKNOWN if header.unit_cm == 0 else _UNIT_STATED
    flags = unit | _FRAME_TIME_STATED * (header.frame_time is not None) | _MANY_CHUNKS * many
    flags |= _MODEL_EMBEDDED * (header.model is not None) | _MANY_LAYERS * (header.layers > 1)
    number = RELEASED.index(header.digest) if header.model is None and header.digest in RELEASED else None
    flags |= _MODEL_NUMBERED * (number is not None)
    out = bytearray(MAGIC)
    out += bytes([VERSION, header.codec | len(header.params) << 5, flags]) + header.params
    out += b"" if header.model is not None else header.digest if number is None else bytes([number])
    out += varint(header.frames)
    out += varint(header.chunk_frames) if many else b""
    out += varint(header.layers) if header.layers > 1 else b""
    out += struct.pack("<d", header.frame_time) if header.frame_time is not None else b""
    out += struct.pack("<d", header.unit_cm) if unit == _UNIT_STATED else b""
    out += varint(len(header.skeleton)) + header.skeleton
    out += varint(len(header.model)) + header.model if header.model is not None else b""
    out += b"".join(varint(len(c)) for c in chunks) if len(chunks) > 1 else b""
    header_crc = zlib.crc32(out)
    for payload in chunks:
        out += payload + struct.pack("<I", zlib.crc32(payload, header_crc))
    return bytes(out)


def read_stream(data: bytes, layers: int | None = None) -> Stream:
    """A stream with all of its lengths checked, and its header verified through the checksum of the first chunk.

    With `layers` only so many are taken, and what follows them need not be there. Raises CorruptStream,
    TruncatedStream or UnsupportedVersion, and JaxmocapError where the stream has not so many layers.
    """
    reader = ByteReader(data)
    magic = reader.take(len(MAGIC))
    if magic == _DATABASE_MAGIC:
        raise CorruptStream("this is a motion database, not a stream: take files out of it with jaxmocap unpack")
    if magic != MAGIC:
        raise CorruptStream("this is no jaxmocap stream: it does not begin with 'JMC'")
    try:
        stream = _read_checked(reader, layers)
        stream.chunk(0)
    except JaxmocapError:
        if len(data) > 3 and data[3] > VERSION:
            raise UnsupportedVersion(f"the stream has format {data[3]}, this jaxmocap reads up to {VERSION}: upgrade") from None
        raise
    return stream


def _read_checked(reader: ByteReader, wanted: int | None) -> Stream:
    version = reader.byte()
    if not 1 <= version <= VERSION:
        raise UnsupportedVersion(f"the stream has format {version}, this jaxmocap reads 1 to {VERSION}: upgrade")
    codec = reader.byte()
    flags = reader.byte()
    both = _MODEL_EMBEDDED | _MODEL_NUMBERED
    if flags & ~_KNOWN_FLAGS or flags & 3 == 3 or flags & both == both:
        raise UnsupportedVersion(f"the stream sets flags {flags:#04x}, this jaxmocap knows {_KNOWN_FLAGS:#04x}: upgrade")
    params = reader.take(codec >> 5)
    digest = _read_digest(reader, flags)
    frames = reader.varint()
    chunk_frames = reader.varint() if flags & _MANY_CHUNKS else frames
    if not 0 < chunk_frames <= frames or (flags & _MANY_CHUNKS and chunk_frames == frames):
        raise CorruptStream(f"the header speaks of {frames} frames in chunks of {chunk_frames}")
    layers = reader.varint() if flags & _MANY_LAYERS else 1
    if flags & _MANY_LAYERS and not 2 <= layers <= MOST_LAYERS:
        raise CorruptStream(f"the header speaks of {layers} layers, 2 to {MOST_LAYERS} are possible")
    frame_time = _positive(reader.float64(), "frame time") if flags & _FRAME_TIME_STATED else None
    unit = flags & 3
    unit_cm = None if unit == _UNIT_OF_MODEL else 0.0 if unit == _UNIT_UNKNOWN else _positive(reader.float64(), "unit")
    skeleton = reader.take(reader.varint())
    model = reader.take(reader.varint()) if flags & _MODEL_EMBEDDED else None
    header = Header(codec & 31, params, frames, chunk_frames, skeleton, digest, model, frame_time, unit_cm, layers)
    count = header.chunk_count * layers
    if count > 1:
        if count > reader.left:
            reader.take(count)  # a length a chunk, at least: says how many bytes are missing
        lengths = [reader.varint() for _ in range(count)]
    else:
        lengths = [max(reader.left - 4, 0)]  # a single chunk is all the rest
    header_crc = zlib.crc32(reader.data[: reader.at])
    if wanted is not None and not 1 <= wanted <= layers:
        raise JaxmocapError(f"the stream has qualities 1 to {layers}, and none of number {wanted}")
    taken = lengths if wanted is None else lengths[: header.chunk_count * wanted]
    spans = []
    for length in taken:
        start = reader.at
        reader.take(length + 4)
        spans.append((start, start + length))
    if reader.left and len(taken) == len(lengths):
        raise CorruptStream(f"{reader.left} bytes follow the last chunk")
    return Stream(header, reader.data, header_crc, tuple(spans))


def _read_digest(reader: ByteReader, flags: int) -> bytes:
    if flags & _MODEL_EMBEDDED:
        return b""
    if not flags & _MODEL_NUMBERED:
        return reader.take(DIGEST_BYTES)
    number = reader.byte()
    if number >= len(RELEASED):
        raise UnsupportedVersion(f"the stream needs released model {number}, this jaxmocap knows {len(RELEASED)}: upgrade")
    return RELEASED[number]


def _positive(value: float, name: str) -> float:
    if not 1e-9 < value < 1e9:
        raise CorruptStream(f"the header gives a {name} of {value}")
    return value
