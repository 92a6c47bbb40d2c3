"""The laws of number codecs, over the registry and the comparators: every number comes back, and each table alone."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxmocap.codecs.archive.database import NUMBER_CODECS, resolved_model
from jaxmocap.codecs.exact import Exact
from jaxmocap.codecs.lossless import AbstractNumberCodec, NumberTable
from jaxmocap.codecs.mrpa.alpha_parallelogram import App
from jaxmocap.codecs.mrpa.codec import Mrpa, PathSegmentation, Patterns
from jaxmocap.codecs.number_text.text import parse_numbers
from jaxmocap.errors import CorruptStream
from jaxmocap.formats.bvh import format_bvh
from jaxmocap.synthesis import walk

CODECS: dict[str, Callable[[], AbstractNumberCodec]] = {
    **{name: lambda name=name, make=make: make(resolved_model(name, None)) for name, make in NUMBER_CODECS.items()},
    "exact without a model": Exact,
    "non-som": lambda: Mrpa(Patterns(segmentation=PathSegmentation())),
    "app": App,
}
RIGS = [
    ("Hips Xposition", "Hips Zrotation", "Hips Yrotation", "Hips Xrotation"),
    ("root 1", "lfemur 1"),
    ("Hips Xposition",),
]
_END = 2**31 - 1
_number = st.one_of(st.integers(-3, 3), st.integers(-1800000, 1800000), st.sampled_from([-_END - 1, -_END, _END, 1 << 27]))


@st.composite
def tables(draw: st.DrawFn) -> NumberTable:
    columns = draw(st.sampled_from(RIGS))
    row = st.lists(_number, min_size=len(columns), max_size=len(columns))
    integers = np.array(draw(st.lists(row, max_size=5)), np.int64).reshape(-1, len(columns)).astype(np.int32)
    signs = st.lists(st.booleans(), min_size=integers.size, max_size=integers.size)
    negative = np.array(draw(signs), bool).reshape(integers.shape)
    return NumberTable(columns, integers, (integers == 0) & negative, draw(st.sampled_from([0, 4, 6, 12])))


@pytest.fixture(scope="module")
def walks() -> list[NumberTable]:
    """Walks of two people as their texts say them, one of them in the decimals that the shipped rig has, and one leg."""
    found = []
    for seed, seconds in ((1, 0.4), (2, 0.3), (1, 0.25)):
        text = parse_numbers(format_bvh(walk(seed, seconds)))
        assert text is not None
        found.append(text.table)
    last = found[-1]
    coarse = np.rint(last.integers / 10.0 ** (last.decimals - 4)).astype(np.int32)
    negative = (coarse == 0) & ((last.integers < 0) | last.negative_zeros)
    leg = [NumberTable(last.columns[6:15], last.integers[:, 6:15], last.negative_zeros[:, 6:15], last.decimals)]
    return [*found, NumberTable(last.columns, coarse, negative, 4), *leg]


@pytest.fixture(params=CODECS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def assert_same(found: NumberTable, table: NumberTable):
    assert (found.columns, found.decimals) == (table.columns, table.decimals)
    assert found.integers.dtype == np.int32 and found.negative_zeros.dtype == bool
    np.testing.assert_array_equal(found.integers, table.integers)
    np.testing.assert_array_equal(found.negative_zeros, table.negative_zeros)


def check(codec: AbstractNumberCodec, given: list[NumberTable]):
    """All together, and each alone; a table leans on tables of its own rig at most."""
    shared, payloads = codec.encode(given)
    assert len(payloads) == len(given)
    for found, table in zip(codec.decode(shared, payloads.__getitem__, range(len(given))), given, strict=True):
        assert_same(found, table)
    for n, table in enumerate(given):
        opened: set[int] = set()
        (found,) = codec.decode(shared, lambda k: opened.add(k) or payloads[k], [n])  # noqa: B023
        assert_same(found, table)
        assert all(given[k].columns == table.columns and given[k].decimals == table.decimals for k in opened)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(tables(), max_size=3))
def test_any_numbers_come_back(name: str, given: list[NumberTable]):
    check(CODECS[name](), given)


def test_motion_comes_back(name: str, walks: list[NumberTable]):
    check(CODECS[name](), walks)


def test_same_bytes_twice(name: str, walks: list[NumberTable]):
    assert CODECS[name]().encode(walks) == CODECS[name]().encode(walks)


def test_motion_gets_smaller(name: str, walks: list[NumberTable]):
    shared, payloads = CODECS[name]().encode(walks[:1])
    assert len(shared) + len(payloads[0]) < 0.6 * walks[0].integers.nbytes


def test_exact_reads_what_it_is_asked_for_alone(walks: list[NumberTable]):
    codec = CODECS["exact"]()
    shared, payloads = codec.encode(walks)
    opened: list[int] = []
    codec.decode(shared, lambda k: opened.append(k) or payloads[k], [2, 0])
    assert opened == [2, 0]


def test_damage_is_refused_or_gives_numbers(name: str, walks: list[NumberTable]):
    """Nothing but CorruptStream may come of payloads that were cut, or of which a byte is another."""
    codec = CODECS[name]()
    shared, payloads = codec.encode(walks[3:])
    rng = np.random.default_rng(0)
    places = [*range(6), *rng.integers(0, len(payloads[1]), 12).tolist()]
    for place in places:
        with pytest.raises(CorruptStream):
            codec.decode(shared, [payloads[0], payloads[1][:place]].__getitem__, [1])
        damaged = bytearray(payloads[1])
        damaged[place] ^= int(rng.integers(1, 256))
        try:
            (found,) = codec.decode(shared, [payloads[0], bytes(damaged)].__getitem__, [1])
        except CorruptStream:
            continue
        assert found.integers.shape == found.negative_zeros.shape
        assert not found.negative_zeros[found.integers != 0].any()
