"""`mrpa` and its comparators: every number comes back, streams that were cut or damaged are refused, and recurrence pays."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmocap.codecs.bitstream import ByteReader
from jaxmocap.codecs.entropy import lanes
from jaxmocap.codecs.lossless import NumberTable
from jaxmocap.codecs.mrpa import float_coding, float_tables
from jaxmocap.codecs.mrpa.alpha_parallelogram import App
from jaxmocap.codecs.mrpa.codec import Mrpa, PathSegmentation, Patterns, analyse, joint_angles
from jaxmocap.codecs.mrpa.float_coding import FIRST_SCALE, Floats, Stream
from jaxmocap.codecs.mrpa.forest_index import Links, pack_links, read_links
from jaxmocap.errors import CorruptStream

COLUMNS = ("Hips Xposition", "Hips Zrotation", "Hips Yrotation", "LeftFoot Zrotation", "LeftArm Xrotation")
CODECS = {"mrpa": Mrpa(), "non-som": Mrpa(Patterns(segmentation=PathSegmentation())), "app": App()}


def motion(frames: int, seed: int, columns: tuple[str, ...] = COLUMNS, decimals: int = 4) -> NumberTable:
    """A smooth random motion with zeros of both signs."""
    rng = np.random.default_rng(seed)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(frames, len(columns))), 0), 0) * 400
    integers = np.rint(smooth).astype(np.int32)
    integers[rng.random(integers.shape) < 0.05] = 0
    return NumberTable(columns, integers, (integers == 0) & (rng.random(integers.shape) < 0.5), decimals)


def database() -> list[NumberTable]:
    other = ("a", "lfoot 1", "lfoot 2")
    huge = motion(70, 6)
    huge.integers[3, 2], huge.integers[40, 0], huge.integers[41, 0] = -(2**31), 2**31 - 1, 2**23
    again = motion(300, 0)
    nothing = NumberTable((), np.zeros((3, 0), np.int32), np.zeros((3, 0), bool), 4)
    short = [motion(0, 3), motion(2, 4), nothing, motion(5, 5, other, 5)]
    return [motion(300, 0), motion(1, 1), motion(80, 2, other, 6), huge, again, *short]


def decoded(codec, tables, which):
    shared, payloads = codec.encode(tables)
    opened: list[int] = []

    def payload(n: int) -> bytes:
        opened.append(n)
        return payloads[n]

    return codec.decode(shared, payload, which), opened


def assert_same(a: NumberTable, b: NumberTable):
    assert (a.columns, a.decimals) == (b.columns, b.decimals)
    assert a.integers.dtype == np.int32 and a.negative_zeros.dtype == bool
    np.testing.assert_array_equal(a.integers, b.integers)
    np.testing.assert_array_equal(a.negative_zeros, b.negative_zeros)


@pytest.mark.parametrize("name", CODECS)
def test_every_number_comes_back(name: str):
    tables = database()
    found, opened = decoded(CODECS[name], tables, range(len(tables)))
    assert len(opened) == len(set(opened))
    for a, b in zip(found, tables, strict=True):
        assert_same(a, b)
    found, opened = decoded(CODECS[name], tables, [4, 1])
    assert_same(found[0], tables[4])
    assert_same(found[1], tables[1])
    assert set(opened) <= {0, 1, 3, 4}  # neither other rigs nor later tables


@pytest.mark.parametrize("name", CODECS)
def test_encoding_is_repeatable_and_takes_no_table_at_all(name: str):
    codec = CODECS[name]
    assert codec.encode(database()) == codec.encode(database())
    shared, payloads = codec.encode([])
    assert payloads == [] and codec.decode(shared, payloads.__getitem__, []) == []


def test_a_motion_that_comes_again_leans_on_the_first():
    noise = np.random.default_rng(0).normal(size=(400, len(COLUMNS))) * 3000
    first = NumberTable(COLUMNS, np.rint(np.cumsum(noise, 0)).astype(np.int32), np.zeros((400, len(COLUMNS)), bool), 4)
    again = NumberTable(COLUMNS, first.integers + 2, first.negative_zeros, 4)
    patterns = Patterns(radius=0.5)  # of a walk that goes half a degree a frame
    _, alone = Mrpa(patterns).encode([first])
    shared, payloads = Mrpa(patterns).encode([first, again])
    assert len(payloads[1]) < 0.5 * len(alone[0])
    opened: list[int] = []
    found = Mrpa().decode(shared, lambda n: opened.append(n) or payloads[n], [1])
    assert_same(found[0], again)
    assert sorted(opened) == [0, 1]
    analysis = analyse([first, again], patterns)
    assert analysis.index_entries >= 1 and 100 < analysis.predicted_frames <= 400


@pytest.mark.parametrize("name", CODECS)
def test_cut_payloads_are_refused(name: str):
    table = motion(60, 7)
    shared, (payload,) = CODECS[name].encode([table])
    for size in range(0, len(payload), 37):
        with pytest.raises(CorruptStream):
            CODECS[name].decode(shared, lambda n, size=size: payload[:size], [0])
    with pytest.raises(CorruptStream):
        CODECS[name].decode(shared, lambda n: payload + b"\0", [0])
    for size in range(0, len(shared), 11):
        with pytest.raises(CorruptStream):
            CODECS[name].decode(shared[:size], lambda n: payload, [0])


@pytest.mark.parametrize("name", CODECS)
def test_damage_is_refused_or_gives_numbers(name: str):
    """Checksums are the archive's; here nothing but CorruptStream may come of damage."""
    shared, (payload,) = CODECS[name].encode([motion(40, 8)])
    rng = np.random.default_rng(1)
    for place in rng.integers(0, len(payload), 25).tolist():
        damaged = bytearray(payload)
        damaged[place] ^= int(rng.integers(1, 256))
        try:
            (found,) = CODECS[name].decode(shared, lambda n, d=bytes(damaged): d, [0])
        except CorruptStream:
            continue
        assert found.integers.shape == (40, len(COLUMNS))


def test_numpy_and_jax_decode_alike():
    rng = np.random.default_rng(2)
    value = rng.integers(-(1 << 22), 1 << 22, (50, 7)).astype(np.int32) >> rng.integers(0, 22, (50, 7)).astype(np.int32)
    prediction = value + (rng.normal(size=(50, 7)) * 200).astype(np.int32)
    actual = Floats(value, (value < 0) | (value == 0) & (rng.random((50, 7)) < 0.5))
    predicted = Floats(prediction, prediction < 0)
    scale = np.full((50, 7), FIRST_SCALE, np.int32)
    coded = float_coding.symbols(predicted, actual, scale)
    tables = float_tables.read(float_tables.learn([coded]))
    classes, tokens = (coded.class_context, coded.group), (coded.mantissa_context, coded.token)
    starts = np.stack([tables.class_starts[classes], tables.token_starts[tokens]], 1).reshape(-1, 7).astype(np.uint16)
    frequencies = np.stack([tables.classes[classes], tables.tokens[tokens]], 1).reshape(-1, 7).astype(np.uint16)
    states, words = lanes.encode(starts, frequencies, np.zeros(7, np.uint16))
    words = np.append(words, np.zeros(14, np.uint16)).astype(np.uint32)
    bits = np.frombuffer(lanes.pack_bits(np.ravel(coded.raw), np.ravel(coded.raw_bits)).ljust(4096, b"\0"), "<u4")
    for xp in (np, jnp):
        stream = Stream(lanes.Decoding(xp.asarray(states), xp.int32(0)), xp.int32(0))
        for n in range(50):
            row = Floats(xp.asarray(prediction[n]), xp.asarray(predicted.negative[n]))
            args = (xp.asarray(words), xp.asarray(bits), _on(xp, tables), row, xp.asarray(scale[n]))
            found, stream = float_coding.decode(xp, stream, *args)
            np.testing.assert_array_equal(found.value, actual.value[n])
            np.testing.assert_array_equal(found.negative, actual.negative[n])


def _on(xp, tables):
    names = ("classes", "tokens", "class_starts", "token_starts", "class_of", "token_of")
    return float_coding.Tables(*(xp.asarray(getattr(tables, name)) for name in names))


def test_the_index_comes_back():
    rng = np.random.default_rng(3)
    starts = np.arange(12) * 40
    parent = np.array([-1, 0, 0, -1, 1, 3, 1, -1, 7, 4, 0, -1])
    back = np.where(parent >= 0, starts - starts[parent] + 3 * (parent > 0), 0)
    links = Links(starts, parent, back, (rng.integers(0, 5, (12, 4)) * (parent >= 0)[:, None]).astype(np.uint8))
    data = pack_links(links)
    found = read_links(ByteReader(data), 480, 4)
    for a, b in zip(vars(found).values(), vars(links).values(), strict=True):
        np.testing.assert_array_equal(a, b)
    for size in range(len(data)):
        with pytest.raises(CorruptStream):
            read_links(ByteReader(data[:size]), 480, 4)
    with pytest.raises(CorruptStream):
        read_links(ByteReader(data), 400, 4)  # the last segment begins behind the end


def test_joints_and_weights_by_name():
    columns = (*(f"root {n}" for n in range(1, 7)), "lfemur 1", "ltoes 1", "ltoes 2", "RightFoot Xrotation")
    angles, weights = joint_angles(columns, np.arange(10, dtype=np.float32)[None])
    np.testing.assert_array_equal(angles[0], [[3, 4, 5], [6, 0, 0], [7, 8, 0], [9, 0, 0]])
    np.testing.assert_allclose(weights, [0.7, 0.7, 0.3, 0.3])


def read_numbers(file: Path) -> NumberTable:
    head, _, body = file.read_text().partition("Frame Time:")
    columns, joint = [], ""
    for words in (line.split() for line in head.splitlines()):
        joint = words[1] if words and words[0] in ("ROOT", "JOINT") else joint
        columns += [f"{joint} {channel}" for channel in words[2:]] if words and words[0] == "CHANNELS" else []
    rows = np.array([line.split() for line in body.splitlines()[1:] if line.strip()], np.float64)
    integers = np.rint(rows * 1e4).astype(np.int32)
    return NumberTable(tuple(columns), integers, (integers == 0) & np.signbit(rows), 4)


def test_runs_are_smaller_than_published(data_dir: Path):
    files = sorted((data_dir / "cmu_bvh" / "09").glob("*.bvh"))
    tables = [read_numbers(file) for file in files]
    sizes = {}
    for name in ("mrpa", "app"):
        shared, payloads = CODECS[name].encode(tables)
        sizes[name] = len(shared) + sum(map(len, payloads))
    found, _ = decoded(Mrpa(), tables, [3])
    assert_same(found[0], tables[3])
    text = sum(file.stat().st_size for file in files)
    assert text / (sizes["mrpa"] + 20_000) > 4.01  # the rest of an archive: headers of the texts, odd tokens, index
    assert sizes["mrpa"] < sizes["app"]
