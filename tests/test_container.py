"""The `.jmc` container: all headers come back, every damaged stream is refused, nothing is allocated on a promise."""

import dataclasses
import time
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmocap.codecs.bitstream import varint
from jaxmocap.codecs.container import MAGIC, Header, Stream, read_stream, write_stream
from jaxmocap.errors import CorruptStream, JaxmocapError, TruncatedStream, UnsupportedVersion

REFUSED = (CorruptStream, TruncatedStream, UnsupportedVersion)
_numbers = st.floats(1.1e-9, 0.9e9)


@st.composite
def streams(draw) -> tuple[Header, list[bytes]]:
    frames = draw(st.integers(1, 1 << 34))
    chunk_frames = draw(st.integers(-(-frames // 8), frames))
    model = draw(st.none() | st.binary(max_size=300))
    header = Header(
        codec=draw(st.integers(0, 31)),
        params=draw(st.binary(max_size=7)),
        frames=frames,
        chunk_frames=chunk_frames,
        skeleton=draw(st.binary(max_size=200)),
        digest=b"" if model is not None else draw(st.binary(min_size=4, max_size=4)),
        model=model,
        frame_time=draw(st.none() | _numbers),
        unit_cm=draw(st.none() | st.just(0.0) | _numbers),
        layers=draw(st.sampled_from([1, 1, 2, 3, 8])),
    )
    return header, [draw(st.binary(max_size=200)) for _ in range(header.chunk_count * header.layers)]


@given(streams())
def test_round_trip(stream):
    header, chunks = stream
    data = write_stream(header, chunks)
    assert data.startswith(MAGIC)
    read = read_stream(data)
    assert read.header == header
    assert all_chunks(read) == chunks
    sections = read.section_bytes()
    assert sum(sections.values()) == len(data)
    assert sections["skeleton"] == len(header.skeleton)
    assert sections["model"] == len(header.model or b"")
    assert sections["motion"] == sum(map(len, chunks))


@settings(max_examples=30)
@given(streams())
def test_every_prefix_and_every_flipped_bit_is_refused(stream):
    header, chunks = stream
    data = write_stream(header, chunks)
    for end in range(len(data)):
        with pytest.raises(CorruptStream):
            read_all(data[:end])
    for n in range(len(data)):
        with pytest.raises(REFUSED):
            read_all(data[:n] + bytes([data[n] ^ 1 << n % 8]) + data[n + 1 :])


def read_all(data: bytes) -> list[bytes]:
    return all_chunks(read_stream(data))


def all_chunks(stream: Stream) -> list[bytes]:
    return [stream.chunk(n, layer) for layer in range(stream.layers) for n in range(stream.header.chunk_count)]


SMALL = Header(codec=1, params=b"ab", frames=900, chunk_frames=300, skeleton=b"bones", digest=b"1234")
DATA = write_stream(SMALL, [b"one", b"", b"three"])
ONE_CHUNK = write_stream(dataclasses.replace(SMALL, chunk_frames=900), [b"payload"])


@pytest.mark.parametrize("data", [DATA, ONE_CHUNK])
def test_trailing_bytes_are_refused(data):
    for more in (b"\0", b"junk", data):
        with pytest.raises(CorruptStream):
            read_stream(data + more)


def test_fixed_cost_of_one_chunk():
    """The most that `frames` may take in a stream of one chunk of lsdt-clip is two bytes."""
    sections = read_stream(ONE_CHUNK).section_bytes()
    assert sections == {"framing": 19, "skeleton": 5, "model": 0, "motion": 7}


def test_newer_version_asks_to_upgrade():
    for data in (DATA, DATA[:40]):
        with pytest.raises(UnsupportedVersion, match="format 2.*reads.*1.*upgrade"):
            read_stream(data[:3] + b"\x02" + data[4:])
    with pytest.raises(UnsupportedVersion):
        read_stream(DATA[:3] + b"\x00" + DATA[4:])


@given(streams())
def test_layers_are_read_without_those_that_follow(stream):
    header, chunks = stream
    data = write_stream(header, chunks)
    front = len(data) - sum(len(c) + 4 for c in chunks)
    for layers in range(1, header.layers + 1):
        first = chunks[: header.chunk_count * layers]
        prefix = data[: front + sum(len(c) + 4 for c in first)]
        assert all_chunks(read_stream(prefix, layers)) == first == all_chunks(read_stream(data, layers))
        with pytest.raises(CorruptStream):
            all_chunks(read_stream(prefix[:-1], layers))


@pytest.mark.parametrize("layers", [0, 3, 99])
def test_layers_that_a_stream_has_not_are_refused(layers):
    data = write_stream(dataclasses.replace(SMALL, chunk_frames=900, layers=2), [b"coarse", b"fine"])
    with pytest.raises(JaxmocapError, match="qualities 1 to 2"):
        read_stream(data, layers)


@pytest.mark.parametrize("flags", [3, 64, 64 | 8, 128])
def test_reserved_flags_ask_to_upgrade(flags):
    with pytest.raises(UnsupportedVersion, match="upgrade"):
        read_stream(DATA[:5] + bytes([flags]) + DATA[6:])


def test_other_files_are_no_streams():
    for data in (b"HIERARCHY", b"", b"JM", b"\x89PNG\r\n"):
        with pytest.raises(CorruptStream):
            read_stream(data)


_START = b"JMC\x01\x01"
_HUGE = varint((1 << 35) - 1)


@pytest.mark.parametrize(
    "data",
    [
        _START + b"\x00" + b"1234" + varint(9) + _HUGE,  # skeleton
        _START + b"\x08" + varint(9) + varint(0) + _HUGE,  # model
        _START + b"\x10" + b"1234" + _HUGE + varint(1) + varint(0),  # chunks
        _START + b"\x10" + b"1234" + varint(2) + varint(1) + varint(0) + _HUGE + varint(0),  # payload
    ],
)
def test_huge_lengths_allocate_nothing(data):
    data += bytes(100)
    tracemalloc.start()
    began = time.monotonic()
    try:
        with pytest.raises(TruncatedStream):
            read_stream(data)
        assert tracemalloc.get_traced_memory()[1] < 1 << 18
    finally:
        tracemalloc.stop()
    assert time.monotonic() - began < 1


@pytest.mark.parametrize("frames, chunk_frames", [(0, 0), (5, 0), (5, 5), (5, 6)])
def test_chunks_must_suit_the_frames(frames, chunk_frames):
    data = _START + b"\x10" + b"1234" + varint(frames) + varint(chunk_frames) + bytes(50)
    with pytest.raises(CorruptStream, match="chunks of"):
        read_stream(data)


@pytest.mark.parametrize("number", [-1.0, float("nan"), float("inf"), 1e-10, 1e10])
@pytest.mark.parametrize("field", ["frame_time", "unit_cm"])
def test_numbers_must_be_sensible(field, number):
    data = write_stream(dataclasses.replace(SMALL, **{field: number}), [b"one", b"", b"three"])
    with pytest.raises(CorruptStream, match="the header gives"):
        read_stream(data)


def test_writing_refuses_the_wrong_number_of_chunks():
    with pytest.raises(ValueError, match="2 chunks for 900 frames"):
        write_stream(SMALL, [b"", b""])
