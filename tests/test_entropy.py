"""Entropy coding: two range coders that agree byte for byte, frequency tables, integers, Huffman codes."""

import heapq
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmocap.codecs.bitstream import BitReader, BitWriter
from jaxmocap.codecs.entropy import integers, range_coder
from jaxmocap.codecs.entropy.huffman import MAX_LENGTH, HuffmanCode, code_lengths
from jaxmocap.codecs.entropy.range_coder import PythonDecoder, PythonEncoder
from jaxmocap.codecs.entropy.tables import TOTAL, FrequencyTable, pack_tables, unpack_tables
from jaxmocap.errors import CorruptStream, TruncatedStream

TABLES = [
    FrequencyTable(np.array([40000, 20000, 5000, 536])),
    FrequencyTable(np.array([1, TOTAL - 1])),
    FrequencyTable(np.array([TOTAL - 47] + [1] * 47)),
    FrequencyTable.from_counts(np.arange(48) ** 3),
    FrequencyTable(np.full(48, TOTAL // 48) + (np.arange(48) < TOTAL % 48)),
]
needs_constriction = pytest.mark.skipif(range_coder.constriction is None, reason="constriction has no wheel here")

# A symbol under a table, or so many raw bits.
_symbol = st.integers(0, len(TABLES) - 1).flatmap(
    lambda t: st.tuples(st.just(t), st.integers(0, len(TABLES[t].frequencies) - 1))
)
_raw = st.integers(1, 30).flatmap(lambda bits: st.tuples(st.just(-bits), st.integers(0, (1 << bits) - 1)))
messages = st.lists(st.one_of(_symbol, _raw), max_size=60)


def encoded(coder, message) -> bytes:
    for table, value in message:
        if table < 0:
            coder.encode_bits(value, -table)
        else:
            coder.encode(value, TABLES[table])
    return coder.finish()


def decoded(coder, message):
    return [(t, coder.decode_bits(-t) if t < 0 else coder.decode(TABLES[t])) for t, _ in message]


@needs_constriction
@settings(max_examples=200)
@given(messages)
def test_both_range_coders_write_and_read_the_same(message):
    data = encoded(PythonEncoder(), message)
    assert encoded(range_coder.ConstrictionEncoder(), message) == data
    assert decoded(PythonDecoder(data), message) == message
    assert decoded(range_coder.ConstrictionDecoder(data), message) == message


@given(messages)
def test_ending_is_the_shortest(message):
    data = encoded(PythonEncoder(), message)
    assert not data.endswith(b"\0")
    if data:
        below = int.from_bytes(data[:-1], "big")
        for shorter in {below, min(below + 1, (1 << 8 * len(data[:-1])) - 1)}:
            assert not _decodes(shorter.to_bytes(len(data) - 1, "big"), message)


def _decodes(data: bytes, message) -> bool:
    try:
        return decoded(PythonDecoder(data), message) == message
    except CorruptStream:
        return False


@given(messages)
def test_size_is_near_the_entropy(message):
    bits = sum(-t if t < 0 else 16 - np.log2(TABLES[t].frequencies[v]) for t, v in message)
    assert 8 * len(encoded(PythonEncoder(), message)) <= bits * 1.001 + 16


def test_empty_message_takes_no_bytes():
    assert encoded(PythonEncoder(), []) == b""
    assert encoded(range_coder.RangeEncoder(), []) == b""


def test_all_symbols_of_all_tables_and_all_numbers_of_raw_bits():
    message = [(t, s) for t, table in enumerate(TABLES) for s in range(len(table.frequencies))]
    message += [(-bits, value) for bits in range(1, 31) for value in (0, 1, (1 << bits) - 1)]
    data = encoded(range_coder.RangeEncoder(), message)
    assert decoded(PythonDecoder(data), message) == message
    assert encoded(PythonEncoder(), message) == data


def test_example_of_the_format_specification():
    symbols = [(0, s) for s in (0, 1, 2, 3, 0, 0, 1)]
    message = [*symbols, (-14, 0b10110011100011), (0, 3), (0, 3), (0, 2), (-1, 1)]
    data = encoded(range_coder.RangeEncoder(), message)
    assert data == bytes.fromhex("8EA3FA6EF2F945")
    assert decoded(PythonDecoder(data), message) == message


def test_carry_runs_through_many_words():
    """Improbable last symbols push the interval up against the next word time and again."""
    message = [(1, 1), *[(2, 47)] * 200, *[(-30, (1 << 30) - 1)] * 40, (1, 0)]
    data = encoded(PythonEncoder(), message)
    assert decoded(PythonDecoder(data), message) == message
    assert encoded(range_coder.RangeEncoder(), message) == data


@settings(max_examples=200)
@given(st.binary(max_size=40))
def test_any_bytes_decode_or_are_refused_alike(data):
    message = [(0, 0), (2, 0), (-7, 0), (3, 0), (-30, 0)] * 4
    decoders = {PythonDecoder, range_coder.RangeDecoder}
    results = []
    for decoder in decoders:
        try:
            results.append(decoded(decoder(data), message))
        except CorruptStream:
            results.append(None)
    assert all(r == results[0] for r in results)


@pytest.mark.parametrize("frequencies", [[TOTAL, 0], [TOTAL - 1], [TOTAL + 1, -1], [TOTAL, 1], [], [[TOTAL]]])
def test_frequency_table_is_validated(frequencies):
    with pytest.raises(ValueError, match="at least 1 and sum to 65536"):
        FrequencyTable(np.array(frequencies, np.int64))


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=48))
def test_from_counts_is_near_the_counts(counts):
    frequencies = FrequencyTable.from_counts(np.array(counts)).frequencies
    assert frequencies.min() >= 1
    assert frequencies.sum() == TOTAL
    if sum(counts):
        ideal = 1 + np.array(counts) / sum(counts) * (TOTAL - len(counts))
        assert np.abs(frequencies - ideal).max() <= len(counts)


def test_tables_through_a_model_file():
    rows = pack_tables(TABLES[2:])
    assert rows.dtype == np.uint16
    for before, after in zip(TABLES[2:], unpack_tables(rows), strict=True):
        assert np.array_equal(before.frequencies, after.frequencies)
    assert unpack_tables(pack_tables([FrequencyTable(np.array([TOTAL]))]))[0].frequencies.tolist() == [TOTAL]


def test_integers_split_and_join():
    values = np.concatenate([np.arange(100_001), [integers.LIMIT - 1]])
    symbols, raws, bits = (a.tolist() for a in integers.split(values))
    assert all(0 <= raw < 1 << n for raw, n in zip(raws, bits, strict=True))
    assert [integers.raw_bits(s) for s in symbols] == bits
    assert [integers.join(s, raw) for s, raw in zip(symbols, raws, strict=True)] == values.tolist()
    assert symbols == sorted(symbols)
    assert symbols[-1] == integers.SYMBOLS - 1


@pytest.mark.parametrize("value", [-1, integers.LIMIT])
def test_integers_out_of_range(value):
    with pytest.raises(ValueError, match="integers must lie in"):
        integers.split(np.array([0, value]))


def optimal_bits(weights) -> int:
    """The cost of Huffman's code, as the sum of all merged weights."""
    heap, cost = sorted(weights), 0
    while len(heap) > 1:
        merged = heapq.heappop(heap) + heapq.heappop(heap)
        cost += merged
        heapq.heappush(heap, merged)
    return cost


@given(st.lists(st.integers(0, 1000), min_size=2, max_size=64))
def test_huffman_lengths_are_optimal(counts):
    weights = np.array(counts) + 1
    lengths = code_lengths(np.array(counts)).astype(np.int64)
    assert (2.0**-lengths).sum() == 1
    if lengths.max() < MAX_LENGTH:
        assert (weights * lengths).sum() == optimal_bits(weights.tolist())
    p = weights / weights.sum()
    assert -(p * np.log2(p)).sum() <= (p * lengths).sum() + 1e-9
    assert (p * lengths).sum() < -(p * np.log2(p)).sum() + 1


@pytest.mark.parametrize("counts", [[5, 1, 1, 0], [9, 9, 9, 9, 9], [0, 100, 3, 7, 20], [1, 2, 4, 8, 16]])
def test_huffman_against_all_prefix_codes(counts):
    weights = np.array(counts) + 1
    candidates = itertools.product(range(1, len(counts)), repeat=len(counts))
    best = min((weights * c).sum() for c in candidates if sum(2.0**-n for n in c) <= 1)
    assert (weights * code_lengths(np.array(counts))).sum() == best


def test_huffman_length_limit():
    fibonacci = [1, 1]
    while len(fibonacci) < 40:
        fibonacci.append(fibonacci[-1] + fibonacci[-2])
    lengths = code_lengths(np.array(fibonacci)).astype(np.int64)
    assert lengths.max() == MAX_LENGTH
    HuffmanCode(lengths)


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=40), st.data())
def test_huffman_round_trip(counts, data):
    code = HuffmanCode(code_lengths(np.array(counts)))
    symbols = data.draw(st.lists(st.integers(0, len(counts) - 1), max_size=50))
    writer = BitWriter()
    for s in symbols:
        code.write(writer, s)
    reader = BitReader(writer.to_bytes())
    assert [code.read(reader) for _ in symbols] == symbols


def test_huffman_refuses_bits_that_begin_no_code():
    code = HuffmanCode(np.array([1, 3, 3]))
    assert [code.read(BitReader(bytes([b]))) for b in (0x00, 0x80, 0xA0)] == [0, 1, 2]
    with pytest.raises(CorruptStream, match="no encoder wrote"):
        code.read(BitReader(b"\xc0"))
    reader = BitReader(b"\x01")
    reader.skip(7)
    with pytest.raises(TruncatedStream):
        code.read(reader)


@pytest.mark.parametrize("lengths", [[0, 1], [1, 1, 1], [MAX_LENGTH + 1, 1], [-1, 1]])
def test_huffman_lengths_are_validated(lengths):
    with pytest.raises(ValueError, match="Kraft"):
        HuffmanCode(np.array(lengths))
