"""Bits and varints: what is written is read back, and nothing is read that is not there."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmocap.codecs.bitstream import BitReader, BitWriter, ByteReader, varint
from jaxmocap.errors import CorruptStream, TruncatedStream

fields = st.integers(0, 40).flatmap(lambda bits: st.tuples(st.integers(0, (1 << bits) - 1), st.just(bits)))


@given(st.lists(fields))
def test_bits_come_back(written):
    writer = BitWriter()
    for value, bits in written:
        writer.write(value, bits)
    data = writer.to_bytes()
    assert len(data) == -(-sum(bits for _, bits in written) // 8)
    reader = BitReader(data)
    for value, bits in written:
        if bits:
            assert reader.peek(bits) == value
        assert reader.read(bits) == value


def test_most_significant_bit_first():
    writer = BitWriter()
    writer.write(1, 1)
    writer.write(0b10, 2)
    writer.write(0x1FF, 9)
    assert writer.to_bytes() == bytes([0b11011111, 0b11110000])


def test_bits_past_the_end():
    reader = BitReader(b"\xff")
    assert reader.peek(12) == 0xFF0
    assert reader.read(5) == 31
    with pytest.raises(TruncatedStream):
        reader.read(4)
    with pytest.raises(TruncatedStream):
        reader.skip(4)


@given(st.integers(0, (1 << 35) - 1))
def test_varint_comes_back_and_is_the_shortest(value):
    data = varint(value)
    reader = ByteReader(data)
    assert reader.varint() == value
    assert reader.left == 0
    assert len(data) == max(1, -(-value.bit_length() // 7))
    for end in range(len(data)):
        with pytest.raises(TruncatedStream):
            ByteReader(data[:end]).varint()


@pytest.mark.parametrize("value", [-1, 1 << 35])
def test_varint_refuses_what_does_not_fit(value):
    with pytest.raises(ValueError, match="35 bits"):
        varint(value)


@pytest.mark.parametrize("data", [b"\x80\x00", b"\xff\x80\x00", b"\x80\x80\x80\x80\x80\x01", b"\xff" * 5])
def test_varint_refuses_longer_ones(data):
    with pytest.raises(CorruptStream):
        ByteReader(data).varint()


def test_take_and_float64():
    reader = ByteReader(b"ab\x00\x00\x00\x00\x00\x00\xf0?")
    assert reader.take(2) == b"ab"
    assert reader.float64() == 1.0
    assert reader.take(0) == b""
    with pytest.raises(TruncatedStream, match="byte 11 was promised"):
        reader.byte()
