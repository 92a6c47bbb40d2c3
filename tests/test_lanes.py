"""rANS in lanes: what goes in comes out, NumPy and JAX walk alike, and what was cut is noticed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmocap.codecs.bitstream import ByteReader
from jaxmocap.codecs.entropy import lanes
from jaxmocap.codecs.entropy.lanes import TOTAL, Decoding
from jaxmocap.errors import CorruptStream, TruncatedStream

STEPS, LANES = 150, 5
# Where the intervals of a few tables begin and the last one ends: skewed, even, near certain, and certain, which codes nothing.
TABLES = [[0, 9000, 15000, 16380, TOTAL], [0, 4096, 8192, 12288, TOTAL], [0, 1, TOTAL], [0, TOTAL]]


def message(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tables, and what begins and ends the intervals of random symbols of them, (steps, lanes)."""
    rng = np.random.default_rng(seed)
    table = rng.integers(0, len(TABLES), (STEPS, LANES))
    point = rng.integers(0, TOTAL, table.shape)
    begin, end = np.empty_like(point), np.empty_like(point)
    for n, edges in enumerate(TABLES):
        symbol = np.searchsorted(edges, point, "right") - 1
        begin, end = (np.where(table == n, np.array(edges)[symbol + k], x) for k, x in ((0, begin), (1, end)))
    return table, begin, end


def encoded(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rest = np.random.default_rng([seed, 1]).integers(0, 1 << 16, LANES).astype(np.uint16)
    _, begin, end = message(seed)
    return *lanes.encode(begin.astype(np.uint16), (end - begin).astype(np.uint16), rest), rest


def stepped(xp, words, state: Decoding, table):
    """A step of decoding: the new state, and the interval of every lane."""
    edges = np.full((len(TABLES), 6), 2 * TOTAL, np.uint32)
    for n, known in enumerate(TABLES):
        edges[n, : len(known)] = known
    rows = xp.asarray(edges)[table]
    slot = lanes.slots(state)
    begin = xp.where(rows <= slot[:, None], rows, 0).max(1)
    end = xp.where(rows > slot[:, None], rows, np.uint32(2 * TOTAL)).min(1)
    return lanes.advance(xp, state, words, begin, end - begin), (begin, end)


def decoded(seed: int, states, words) -> tuple[np.ndarray, np.ndarray, Decoding]:
    padded = np.append(words, np.zeros(LANES, np.uint16)).astype(np.uint32)
    state, found = Decoding(states, np.array(0, np.int32)), []
    for row in message(seed)[0]:
        state, interval = stepped(np, padded, state, row)
        found.append(interval)
    begin, end = np.array(found).transpose(1, 0, 2)
    return begin, end, state


@pytest.mark.parametrize("seed", range(5))
def test_symbols_and_rest_come_back(seed: int):
    states, words, rest = encoded(seed)
    begin, end, state = decoded(seed, states, words)
    np.testing.assert_array_equal(begin, message(seed)[1])
    np.testing.assert_array_equal(end, message(seed)[2])
    np.testing.assert_array_equal(lanes.rest(state), rest)
    assert state.at == len(words)
    bits = np.log2(TOTAL / (end - begin)).sum()
    spent = 16 * len(words) + np.log2(states).sum() - np.log2(rest + 65536.0).sum()
    assert abs(spent - bits) < 0.01 * bits


def test_a_scan_decodes_like_numpy():
    walk = jax.jit(lambda words, state, table: jax.lax.scan(lambda s, row: stepped(jnp, words, s, row), state, table))
    for seed in range(5):
        states, words, _ = encoded(seed)
        padded = jnp.asarray(np.resize(np.append(words, np.zeros(1000, np.uint16)), 1000).astype(np.uint32))
        state, (begin, end) = walk(padded, Decoding(jnp.asarray(states), jnp.int32(0)), message(seed)[0])
        expected = decoded(seed, states, words)
        np.testing.assert_array_equal(begin, expected[0])
        np.testing.assert_array_equal(end, expected[1])
        np.testing.assert_array_equal(state.states, expected[2].states)
        assert state.states.dtype == jnp.uint32 and state.at == len(words)


def test_no_symbols_leave_the_rest():
    rest = np.array([0, 1, 65535], np.uint16)
    states, words = lanes.encode(np.zeros((0, 3), np.uint16), np.zeros((0, 3), np.uint16), rest)
    assert len(words) == 0
    np.testing.assert_array_equal(lanes.rest(Decoding(states, np.array(0, np.int32))), rest)


@pytest.mark.parametrize("seed", range(3))
def test_missing_words_are_noticed(seed: int):
    states, words, _ = encoded(seed)
    for size in range(len(words)):
        state = decoded(seed, states, words[:size])[2]
        if state.at == size:
            with pytest.raises(CorruptStream, match="do not end where"):
                lanes.rest(state)


_state = st.integers(16, 31).flatmap(lambda bits: st.integers(1 << bits, (2 << bits) - 1))


@given(st.lists(_state, max_size=20))
def test_states(states: list[int]):
    data = lanes.pack_states(np.array(states, np.uint32))
    reader = ByteReader(data)
    found = lanes.unpack_states(reader, len(states))
    assert found.dtype == np.uint32 and found.tolist() == states and not reader.left
    assert len(data) <= 2 + sum(4 + n.bit_length() - 1 for n in states) / 8
    for size in range(len(data)):
        with pytest.raises(TruncatedStream):
            lanes.unpack_states(ByteReader(data[:size]), len(states))


@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 32)), max_size=40))
def test_bits(pairs: list[tuple[int, int]]):
    values, counts = np.array(pairs, np.int64).reshape(-1, 2).T
    data = lanes.pack_bits(values, counts)
    assert len(data) == -(-int(counts.sum()) // 8)
    assert lanes.unpack_bits(data, counts).tolist() == [value & (1 << count) - 1 for value, count in pairs]


def test_bits_are_taken_alike_from_a_stream():
    rng = np.random.default_rng(4)
    counts = rng.integers(0, 29, (STEPS, LANES)).astype(np.int32)
    values = rng.integers(0, 1 << 28, counts.shape) & (1 << counts) - 1
    data = lanes.pack_bits(values.ravel(), counts.ravel())
    words = np.frombuffer(data + bytes(-len(data) % 4 + 4 * LANES), "<u4").astype(np.uint32)
    at, rows = np.int32(0), []
    for row in counts:
        bits, at = lanes.take_bits(np, at, words, row)
        rows.append(bits)
    np.testing.assert_array_equal(rows, values)
    assert at == counts.sum()

    def step(at, row):
        bits, at = lanes.take_bits(jnp, at, jnp.asarray(words), row)
        return at, bits

    end, scanned = jax.lax.scan(step, jnp.int32(0), jnp.asarray(counts))
    np.testing.assert_array_equal(scanned, values)
    assert end == at


def test_prefix_sums_are_exact():
    x = np.random.default_rng(5).integers(0, 1 << 16, 250).astype(np.int32)
    np.testing.assert_array_equal(lanes.prefix_sums(np, x), np.cumsum(x))
    np.testing.assert_array_equal(lanes.prefix_sums(jnp, jnp.asarray(x)), np.cumsum(x))
    assert lanes.prefix_sums(np, x).dtype == lanes.prefix_sums(jnp, jnp.asarray(x)).dtype == np.int32
