"""`exact`: NumPy and XLA walk alike, odd tables come back, and damage is refused."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmocap.codecs.archive.database import Database
from jaxmocap.codecs.archive.packing import pack
from jaxmocap.codecs.artifact import load_artifact, make_artifact, parse_artifact
from jaxmocap.codecs.bitstream import ByteReader, varint
from jaxmocap.codecs.exact import Exact, lanes, signs
from jaxmocap.codecs.exact.fit import fit_lanes, untrained
from jaxmocap.codecs.exact.model import RigModel, from_artifact, to_artifact
from jaxmocap.codecs.exact.rig_fit import fit_rig, plain_rig
from jaxmocap.codecs.exact.tables import decode_tables, encode_table
from jaxmocap.codecs.exact.wave import LaneModel
from jaxmocap.codecs.lossless import NumberTable
from jaxmocap.errors import CorruptStream, FormatError, ModelMismatch
from jaxmocap.formats import write_motion
from jaxmocap.synthesis import walk

POSITIONS = ("Hips Xposition", "Hips Yposition", "Hips Zposition")
HINGE = ("Knee Zrotation", "Knee Yrotation", "Knee Xrotation")
RIG = (*POSITIONS, *HINGE, "Head Zrotation", "Tip Xposition")
DEGREE = 10_000  # at four decimals


def table(integers: np.ndarray, columns: Sequence[str], decimals: int = 4, seed: int = 0) -> NumberTable:
    """With signs of zeros at random."""
    integers = np.asarray(integers, np.int32).reshape(-1, len(columns))
    coin = np.random.default_rng(seed).random(integers.shape) < 0.5
    return NumberTable(tuple(columns), integers, (integers == 0) & coin, decimals)


def smooth(frames: int, count: int, seed: int, size: float = 1.0) -> np.ndarray:
    """Angles in degrees that wander within about 40."""
    rng = np.random.default_rng([seed, count])
    time = np.arange(frames)[:, None, None] / 120
    waves = np.sin(time * rng.uniform(0.5, 9, (count, 6)) + rng.uniform(0, 7, (count, 6)))
    return size * (waves * rng.uniform(2, 12, (count, 6))).sum(2)


def hinge(angle: np.ndarray) -> np.ndarray:
    """Z, Y and X angles in degrees of a joint with one skew axis, R = Rz Ry Rx."""
    n = np.array([0.48, -0.6, 0.64])
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    a = np.radians(angle)[:, None, None]
    r = np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * (cross @ cross)
    euler = np.arctan2(r[:, 1, 0], r[:, 0, 0]), np.arcsin(-r[:, 2, 0]), np.arctan2(r[:, 2, 1], r[:, 2, 2])
    return np.degrees(np.stack(euler, 1))


def figure(frames: int, seed: int) -> NumberTable:
    """A rest pose, and then a body that moves, with a knee that keeps its laws, and a tip that is where it is."""
    free = smooth(frames, 5, seed, 1.5)
    body = np.concatenate([free[:, :3], hinge(free[:, 3]), free[:, 4:], np.full((frames, 1), 7.0)], 1)
    body[0, 3:7] = 0
    body[0, :3] = body[1, :3]
    return table(np.rint(body * DEGREE), RIG, seed=seed)


def spine(frames: int, seed: int) -> NumberTable:
    """Three joints of which the middle one nearly follows from its neighbours."""
    lower, upper = np.split(smooth(frames, 6, seed), 2, axis=1)
    middle = 0.548 * lower + 0.978 * upper * (1 + lower / 500)
    columns = [f"{joint} {axis}rotation" for joint in ("LowerBack", "Spine", "Spine1") for axis in "ZYX"]
    return table(np.rint(np.concatenate([lower, middle, upper], 1) * DEGREE), columns)


@pytest.fixture(scope="module")
def figures() -> list[NumberTable]:
    return [figure(900, 1), figure(700, 2)]


@pytest.fixture(scope="module")
def learned(figures: list[NumberTable]) -> RigModel:
    return fit_rig(figures)


def assert_same(found: NumberTable, expected: NumberTable):
    assert (found.columns, found.decimals) == (expected.columns, expected.decimals)
    assert found.integers.dtype == np.int32 and found.negative_zeros.dtype == bool
    np.testing.assert_array_equal(found.integers, expected.integers)
    np.testing.assert_array_equal(found.negative_zeros, expected.negative_zeros)


def there_and_back(model: RigModel, given: NumberTable) -> int:
    """Checks that a table comes back, and gives the size of its payload."""
    data = encode_table(model, given, False)
    reader = ByteReader(data)
    assert_same(decode_tables(model, [reader], False)[0], given)
    assert not reader.left
    return len(data)


def damaged(data: bytes, rng: np.random.Generator, rounds: int):
    """The data cut, with a byte that is another, with bytes between, behind and overwritten; often near the beginning."""
    for _ in range(rounds):
        place = int(rng.integers(0, len(data) if rng.random() < 0.6 else min(12, len(data))))
        noise = rng.integers(0, 256, 8).astype(np.uint8).tobytes()
        yield data[:place]
        yield data[:place] + bytes([data[place] ^ (noise[0] or 1)]) + data[place + 1 :]
        yield data[:place] + noise[:1] + data[place:]
        yield data[:place] + noise + data[place + 8 :]
    yield data + b"\0"


# Lanes


def lane_values(frames: int, count: int, seed: int) -> np.ndarray:
    return np.rint(smooth(frames, count, seed) * 300).astype(np.int32)


def hostile(count: int, moving: int) -> LaneModel:
    """A model whose weights overflow whatever they can."""
    rng = np.random.default_rng(count)
    ends = np.array([-(1 << 15), (1 << 15) - 1])
    below = np.tri(count, k=-1)
    weights = (rng.choice(ends, (moving, moving)) * below[:moving, :moving]).astype(np.int16)
    shared = (rng.choice([-128, 127], (count, count)) * below).astype(np.int8)
    own, start = rng.choice(ends, (count, 6)).astype(np.int16), rng.integers(0, 240, (count, 3)).astype(np.int16)
    return LaneModel(weights, own, shared, start, untrained(count, moving).frequencies)


LANE_MODELS = {
    "untrained": untrained(4, 3),
    "trained": fit_lanes([lane_values(300, 4, 1), lane_values(200, 4, 2), lane_values(5, 4, 3)], 3),
    "hostile": hostile(4, 3),
}


@pytest.mark.parametrize("name", LANE_MODELS)
@pytest.mark.parametrize("frames", [1, 2, 3, 509, 530])
def test_plain_and_compiled_walks_are_the_same(name: str, frames: int):
    """Blocks are 512 steps, and a step more for every lane but the first."""
    model, values = LANE_MODELS[name], lane_values(frames, 4, frames)
    plain, compiled = (lanes.residuals(model, values, x) for x in (False, True))
    for a, b in zip(plain, compiled, strict=True):
        assert a.dtype == b.dtype == np.int32
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", LANE_MODELS)
def test_overflow_is_the_same(name: str):
    values = np.random.default_rng(0).integers(-(1 << 31), 1 << 31, (100, 4)).astype(np.int32)
    values[50:] = np.array([[-(1 << 31)], [(1 << 31) - 1]] * 25)
    plain, compiled = (lanes.residuals(LANE_MODELS[name], values, x) for x in (False, True))
    for a, b in zip(plain, compiled, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", ["untrained", "trained"])
@pytest.mark.parametrize("frames", [1, 2, 530])
def test_lanes_come_back_by_either_walk(name: str, frames: int):
    model, rest = LANE_MODELS[name], bytes(range(1, 12))
    rng = np.random.default_rng(frames)
    calm, wild = lane_values(frames, 4, 7), rng.integers(-lanes.LIMIT // 8, lanes.LIMIT // 8, (frames, 4)).astype(np.int32)
    for values in (calm, wild):
        data, more = lanes.encode(model, values, rest, False)
        assert lanes.encode(model, values, rest, True) == (data, more)
        assert more == rest[8:]  # four lanes hold 16 bits each
        for compiled in (False, True):
            found, begun = lanes.decode(model, ByteReader(data), frames, 8, compiled)
            np.testing.assert_array_equal(found, values)
            assert found.dtype == np.int32 and begun == rest[:8]


def test_the_largest_differences_come_back():
    most = lanes.LIMIT // 2 - 1
    changes = np.random.default_rng(1).choice([-most, most], (60, 4))
    changes[:, 3] = np.arange(60) % 2 * most
    values = np.cumsum(np.cumsum(changes[:, :3], 0), 0)
    values = np.concatenate([values, changes[:, 3:]], 1).astype(np.int32)  # the sums run over, and that does no harm
    values[1:2, :3] = values[:1, :3] - most
    values[2:, :3] = values[1:2, :3]
    for model in (LANE_MODELS["untrained"], LANE_MODELS["trained"]):
        for compiled in (False, True):
            data, _ = lanes.encode(model, values, b"", compiled)
            np.testing.assert_array_equal(lanes.decode(model, ByteReader(data), 60, 0, compiled)[0], values)


@pytest.mark.parametrize("compiled", [False, True])
def test_damaged_lanes(compiled: bool):
    model = LANE_MODELS["trained"]
    data, _ = lanes.encode(model, lane_values(530, 4, 5), b"", False)
    for size in range(0, len(data), 101):
        with pytest.raises(CorruptStream):
            lanes.decode(model, ByteReader(data[:size]), 530, 0, compiled)
    with pytest.raises(CorruptStream):
        lanes.decode(model, ByteReader(data + b"\0"), 530, 0, compiled)
    with pytest.raises(CorruptStream, match="more words than there are"):
        lanes.decode(model, ByteReader(data), 1 << 20, 0, compiled)
    rng = np.random.default_rng(0)
    for wrong in damaged(data, rng, 3):
        try:
            found, _ = lanes.decode(model, ByteReader(wrong), 530, 0, compiled)
        except CorruptStream:
            continue
        assert found.shape == (530, 4)


def test_a_trained_model_is_smaller_and_few_frames_teach_nothing():
    values = lane_values(300, 4, 9)
    sizes = {name: len(lanes.encode(LANE_MODELS[name], values, b"", False)[0]) for name in ("trained", "untrained")}
    assert sizes["trained"] < 0.95 * sizes["untrained"]
    for files in ([values[:5]], [values[:, :0]]):
        assert fit_lanes(files, min(3, files[0].shape[1])).count == files[0].shape[1]


# Signs of zeros

def _planes(frames: int) -> st.SearchStrategy[list[bytes]]:
    alike = st.sampled_from([b"+" * frames, b"-" * frames, b"1" * frames])
    return st.lists(alike | st.binary(min_size=frames, max_size=frames), min_size=4, max_size=4)


planes = st.integers(0, 12).flatmap(_planes)


def _zeros_and_signs(planes: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    columns = [np.frombuffer(plane, np.uint8) for plane in planes]
    zeros = np.stack([(c == ord("+")) | (c == ord("-")) | (c & 1 == 0) for c in columns], 1)
    return zeros, zeros & np.stack([(c == ord("-")) | (c & 2 == 2) for c in columns], 1)


@settings(max_examples=200)
@given(planes, st.lists(st.integers(0, 3), min_size=4, max_size=4))
def test_signs_come_back(planes: list[bytes], usual: list[int]):
    zeros, negative = _zeros_and_signs(planes)
    data = signs.encode(zeros, negative, usual)
    reader = ByteReader(data)
    np.testing.assert_array_equal(signs.decode(reader, zeros, usual), negative)
    assert not reader.left
    for size in range(len(data)):
        with pytest.raises(CorruptStream):
            signs.decode(ByteReader(data[:size]), zeros, usual)


@settings(max_examples=200)
@given(planes, st.binary(max_size=12))
def test_any_bytes_are_signs_or_refused(planes: list[bytes], data: bytes):
    zeros, _ = _zeros_and_signs(planes)
    try:
        negative = signs.decode(ByteReader(data), zeros, [0, 0, 0, 0])
    except CorruptStream:
        return
    assert not negative[~zeros].any()


def test_what_is_usual_costs_a_byte():
    coin = np.random.default_rng(0).random(50) < 0.5
    negative = np.stack([np.zeros(50, bool), np.ones(50, bool), np.arange(50) > 20, coin, coin], 1)
    zeros = np.ones_like(negative)
    usual = signs.modes(zeros, negative)
    assert usual == [signs.PLUS, signs.MINUS, signs.RUNS, signs.BITS, signs.FIRST_COPY + 3]
    assert len(signs.encode(zeros, negative, usual)) == 1 + 3 + 7


# Tables


def far(values: Sequence[int]) -> np.ndarray:
    """One column of positions beside still ones."""
    return np.stack([np.array(values, np.int64), np.zeros(len(values)), np.ones(len(values))], 1)


CALM = np.rint(smooth(80, 3, 3) * 100)
ODD_POSITIONS = {
    "no frame": CALM[:0],
    "one frame": CALM[:1],
    "two frames": CALM[:2],
    "three frames": CALM[:3],
    "a step at once": far([0, 1 << 28]),
    "and on": far([0, 1 << 27, 1 << 28, 3 << 27]),
    "ends of the numbers": far([-(1 << 31), (1 << 31) - 1, 0, (1 << 31) - 1, -(1 << 31)]),
    "one that is far": far([5] * 30 + [1 << 30] + [5] * 30),
    "huge, and calm": CALM + (1 << 31) - 1_000_000,
    "all noise": np.random.default_rng(0).integers(-(1 << 31), 1 << 31, (40, 3)),
    "still": np.full((60, 3), -4),
    "all the same but the first": np.concatenate([[[9, 9, 9]], np.full((20, 3), 4)]),
}


@pytest.mark.parametrize("name", ODD_POSITIONS)
def test_odd_positions(name: str):
    odd, calm = table(ODD_POSITIONS[name], POSITIONS), table(CALM, POSITIONS)
    still = table(np.zeros((80, 3)), POSITIONS)
    for taught_by in ([odd], [calm, calm], [still], [calm, odd, still]):
        there_and_back(plain_rig(taught_by), odd)


TURN = 360 * DEGREE


def odd_figures() -> dict[str, np.ndarray]:
    """Bodies that break what their rig says, each in one way."""
    body = figure(70, 5).integers.astype(np.int64)
    odd = {name: body.copy() for name in ("rest", "stray", "other rest", "no rest", "180", "past 180", "knee at 180")}
    odd["stray"][47, 7] += 1
    odd["other rest"][0, 5] = 12345
    odd["no rest"][0] = body[1]
    odd["180"][50:60, 6] = [-180 * DEGREE, 180 * DEGREE, 180 * DEGREE - 1, -180 * DEGREE, 0] * 2
    odd["past 180"][:, 6] += np.arange(70) * 9 * DEGREE
    odd["knee at 180"][9, 4] = 180 * DEGREE
    odd["turning"] = body.copy()
    odd["turning"][:, 6] = (np.arange(70) * 7 * DEGREE + TURN // 2) % TURN - TURN // 2
    odd["lawless"] = body.copy()
    odd["lawless"][:, 3:6] = np.rint(smooth(70, 3, 8) * DEGREE)
    odd["all noise"] = np.random.default_rng(1).integers(-(1 << 31), 1 << 31, body.shape)
    return odd | {f"{n} frames": body[:n] for n in range(4)}


@pytest.mark.parametrize("name", odd_figures())
def test_odd_figures(name: str, learned: RigModel):
    odd = table(odd_figures()[name], RIG)
    there_and_back(learned, odd)
    there_and_back(plain_rig([odd]), odd)


def test_odd_figures_together(figures: list[NumberTable], learned: RigModel):
    """Laws are applied to many tables at once, each with its own exceptions."""
    given = [*figures, *(table(x, RIG) for x in odd_figures().values()), figures[0]]
    readers = [ByteReader(encode_table(learned, x, False)) for x in given]
    for found, expected in zip(decode_tables(learned, readers, False), given, strict=True):
        assert_same(found, expected)


def test_a_rig_learns_what_holds(figures: list[NumberTable], learned: RigModel):
    assert len(learned.laws) == 2 and set(learned.constant) == {7} and learned.rest[3:7].tolist() == [0] * 4
    sizes = {name: there_and_back(learned, table(x, RIG)) for name, x in odd_figures().items()}
    assert sizes["rest"] < 0.75 * sizes["lawless"]
    assert sizes["turning"] < 1.05 * sizes["rest"]
    plain = plain_rig(figures)
    assert not plain.laws and there_and_back(learned, figures[0]) < 0.8 * there_and_back(plain, figures[0])


def test_a_learned_rig_goes_through_its_artifact(figures: list[NumberTable], learned: RigModel):
    again = from_artifact(to_artifact(learned, "corpus"))
    assert encode_table(again, figures[1], False) == encode_table(learned, figures[1], False)
    assert to_artifact(again, "corpus").data == to_artifact(learned, "corpus").data


def test_a_model_is_parsed_once(learned: RigModel):
    data = to_artifact(learned, "corpus").data
    assert from_artifact(parse_artifact(data, "one")) is from_artifact(parse_artifact(data, "two"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"laws": [{"law": "spiral"}]}, "laws of the kind 'spiral' are not known"),
        ({"laws": [{"law": "constrained"}]}, "KeyError\\('joint'\\)"),
        ({"laws": [{"law": "polynomial", "targets": [0, 1, 2], "inputs": [3], "scales": [1], "degree": 1}]}, "reshape"),
        ({"laws": None}, "TypeError"),
        ({"columns": 8}, "TypeError"),
        ({"codec": "newer"}, "for the codec 'newer'"),
    ],
)
def test_a_model_of_another_make_is_refused(change: dict, message: str, learned: RigModel):
    good = to_artifact(learned, "corpus")
    with pytest.raises(FormatError, match=message):
        from_artifact(make_artifact(good.spec | change, good.tensors))


def test_a_model_without_a_tensor_is_refused(learned: RigModel):
    good = to_artifact(learned, "corpus")
    for name in good.tensors:
        with pytest.raises(FormatError, match=f"KeyError\\('{name}'\\)"):
            from_artifact(make_artifact(good.spec, {n: x for n, x in good.tensors.items() if n != name}))


def test_plain_and_compiled_tables_are_the_same(figures: list[NumberTable], learned: RigModel):
    data = encode_table(learned, figures[1], True)
    assert data == encode_table(learned, figures[1], False)
    assert_same(decode_tables(learned, [ByteReader(data)], True)[0], figures[1])


@pytest.mark.parametrize("decimals", [0, 2, 5, 6, 12])
def test_other_decimals(decimals: int):
    body = figure(60, 4).integers
    limit = min(180 * 10**decimals, 2**31 - 1)
    other = np.clip(np.rint(body * 10.0 ** (decimals - 4)), -limit, limit).astype(np.int32)
    given = table(other, RIG, decimals)
    there_and_back(plain_rig([given]), given)
    there_and_back(fit_rig([given]), given)


def test_columns_without_channel_names(figures: list[NumberTable]):
    columns = tuple(f"{name.split()[0]} {n}" for n, name in enumerate(RIG))
    given = table(figures[1].integers, columns)
    model = fit_rig([given])
    assert not model.laws
    there_and_back(model, given)
    for rows in (0, 3):
        bare = NumberTable((), np.zeros((rows, 0), np.int32), np.zeros((rows, 0), bool), 4)
        there_and_back(plain_rig([bare]), bare)


# The codec


def decoded(codec: Exact, shared: bytes, payloads: list[bytes]) -> list[NumberTable]:
    return codec.decode(shared, payloads.__getitem__, range(len(payloads)))


def test_several_rigs_in_one_call(figures: list[NumberTable]):
    """Frames enough to learn one rig; the others are few, or still, or in crumbs."""
    still = table(np.full((2000, 3), 8), POSITIONS, 2)
    crumbs = [table(np.rint(smooth(n % 7, 3, n) * 100), POSITIONS) for n in range(520)]
    given = [figures[0], still, crumbs[0], figures[1], *crumbs[1:], table(figures[0].integers, RIG, 5)]
    shared, payloads = Exact().encode(given)
    for found, expected in zip(decoded(Exact(), shared, payloads), given, strict=True):
        assert_same(found, expected)
    assert shared[0] == 4
    opened: list[int] = []
    (found,) = Exact().decode(shared, lambda n: opened.append(n) or payloads[n], [3])
    assert_same(found, figures[1])
    assert opened == [3]
    assert sum(len(payloads[n]) for n in (0, 3)) < 1.05 * sum(there_and_back(fit_rig(figures), f) for f in figures)


def test_a_given_model_is_taken_where_it_fits(figures: list[NumberTable], learned: RigModel):
    artifact = to_artifact(learned, "corpus")
    other = table(CALM, POSITIONS)
    shared, payloads = Exact(artifact).encode([figures[0], other])
    assert payloads[0] == b"\0" + encode_table(learned, figures[0], False)
    assert shared.startswith(b"\2\0\1")
    for found, expected in zip(decoded(Exact(artifact), shared, payloads), (figures[0], other), strict=True):
        assert_same(found, expected)
    with pytest.raises(CorruptStream, match="need the archive's model"):
        decoded(Exact(), shared, payloads)
    with pytest.raises(FormatError, match="for the codec 'lsdt-clip'"):
        Exact(load_artifact("lsdt-clip")).encode([other])


def test_a_database_tells_a_wrong_model(tmp_path: Path, learned: RigModel):
    write_motion(walk(1, 0.2), tmp_path / "walk.bvh")
    given, other = to_artifact(learned, "corpus"), to_artifact(learned, "another")
    (tmp_path / "own.jmc").write_bytes(pack({"walk.bvh": tmp_path / "walk.bvh"}, "exact", given).data)
    (tmp_path / "shipped.jmc").write_bytes(pack({"walk.bvh": tmp_path / "walk.bvh"}, "exact").data)
    for name in ("own", "shipped"):
        assert Database.open(tmp_path / f"{name}.jmc").read("walk.bvh") == (tmp_path / "walk.bvh").read_bytes()
    with pytest.raises(ModelMismatch, match="the stream needs the model"):
        Database.open(tmp_path / "shipped.jmc", other).read("walk.bvh")


def test_damage_is_refused_or_gives_numbers(figures: list[NumberTable], learned: RigModel):
    """Nothing but CorruptStream may come of it; checksums of payloads are the archive's."""
    rng = np.random.default_rng(6)
    codec = Exact(to_artifact(learned, "corpus"))
    odd = [table(x, RIG) for n, x in odd_figures().items() if n in ("rest", "stray", "past 180", "lawless", "all noise")]
    given = [*odd, *(table(ODD_POSITIONS[n], POSITIONS) for n in ("still", "all noise", "one that is far"))]
    shared, payloads = codec.encode(given)
    for payload in payloads:
        for wrong in damaged(payload, rng, 6):
            try:
                (found,) = codec.decode(shared, lambda n, wrong=wrong: wrong, [0])
            except CorruptStream:
                continue
            assert found.integers.shape == found.negative_zeros.shape
    for wrong in damaged(shared, rng, 60):
        if wrong == shared:
            continue
        with pytest.raises(CorruptStream):
            decoded(codec, wrong, payloads)


def test_frames_that_cost_nothing():
    """Tables whose every column is what the rig has it: any number of frames, but not more than bytes vouch for."""
    still = table(np.ones((100_000, 3)), POSITIONS)
    assert there_and_back(plain_rig([still]), still) < 40
    with pytest.raises(CorruptStream, match="do not go with"):
        decode_tables(plain_rig([still]), [ByteReader(varint(1 << 32) + varint(1) + b"\0")], False)


# The same bytes everywhere

_HASH = """
import hashlib, sys
import test_exact as t
tables = [getattr(t, sys.argv[1])(frames, frames) for frames in (900, 800)]
shared, payloads = t.Exact().encode(tables)
model = t.to_artifact(t.fit_rig(tables), "corpus").data
print(hashlib.sha256(shared + b"".join(payloads) + model).hexdigest())
"""


@pytest.mark.parametrize("name", ["figure", "spine"])
def test_the_number_of_threads_changes_nothing(name: str):
    clean = {key: value for key, value in os.environ.items() if "THREADS" not in key and key != "NPROC"}
    hashes = set()
    for threads in ({"OMP_NUM_THREADS": "1", "NPROC": "1"}, {"OMP_NUM_THREADS": "2"}):
        command, here = [sys.executable, "-c", _HASH, name], Path(__file__).parent
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=here, env=clean | threads)
        hashes.add(done.stdout.strip())
    assert len(hashes) == 1 and len(hashes.pop()) == 64
