"""`mdtt` and `pca-rdo`: bases, equalisation and adaptive coding against oracles, and streams that must decode for ever."""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmocap.codecs import Target, adaptive_levels, decode, load_artifact, make, mdtt, pca_rdo
from jaxmocap.codecs.basis_coding import CodedBasis, Coordinates, code_basis, precision, quantise_basis
from jaxmocap.codecs.container import read_stream
from jaxmocap.codecs.entropy import integers
from jaxmocap.codecs.entropy.adaptive import Reader, Writer, code_signed, code_unsigned, law
from jaxmocap.codecs.equalisation import equalise, sensitivity
from jaxmocap.codecs.joint_positions import Figure, Source, chunk_length
from jaxmocap.codecs.pca_shape import pose_space, read_shape, write_shape
from jaxmocap.codecs.places import Places
from jaxmocap.codecs.sequence import places_at, rig_of
from jaxmocap.formats import read_motion
from jaxmocap.kinematics import positions_cm
from jaxmocap.metrics import compare
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.synthesis import walk

GOLDEN = Path(__file__).parent / "golden"
MODEL = load_artifact(GOLDEN / "lsdt-clip-aa734c9d.safetensors")
STREAMS = [(codec, stream) for codec in ("mdtt", "pca-rdo") for stream in ("walk", "several-chunks", "own-rig")]
UNIT_CM = 5.6444
RNG = np.random.default_rng(11)


# Adaptive coding


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 4000), st.integers(1 - integers.LIMIT, integers.LIMIT - 1))))
def test_adaptive_integers_come_back(items):
    writer = Writer()
    for context, mean, value in items:
        code_signed(writer, context, law(mean), value)
        code_unsigned(writer, 9, law(mean), abs(value))
    reader = Reader(writer.finish())
    for context, mean, value in items:
        assert code_signed(reader, context, law(mean), 0) == value
        assert code_unsigned(reader, 9, law(mean), 0) == abs(value)


@pytest.mark.parametrize("mean", [4, 16, 100, 1000])
def test_laws_are_geometric(mean):
    """Chances of magnitudes by the closed form; the mean of the law is the one asked for."""
    m = mean / 16
    theta = (math.sqrt(1 + m * m) - 1) / m
    chances = np.array(law(mean)) / 65536
    assert chances[0] == pytest.approx(1 - (1 - theta) / (1 + theta), abs=1e-3)
    np.testing.assert_allclose(chances[1:8], theta, atol=1e-3)
    np.testing.assert_allclose(chances[8:12], theta ** np.array([4, 4, 8, 8]), atol=2e-3)
    k = np.arange(-4000, 4001)
    assert ((1 - theta) / (1 + theta) * theta ** np.abs(k) * np.abs(k)).sum() == pytest.approx(m, rel=1e-6)


def test_chances_adapt():
    """Far from the law that a context began with, integers come to cost what their own law asks for."""
    values = RNG.geometric(0.02, 4000) - 1
    writer = Writer()
    for v in values.tolist():
        code_unsigned(writer, 0, law(4), v)
    entropy = (-math.log2(0.02) - 0.98 / 0.02 * math.log2(0.98)) * len(values) / 8
    assert len(writer.finish()) < 1.06 * entropy


@pytest.mark.parametrize(("around", "components"), [(mdtt.AROUND, (5, 2, 9)), (pca_rdo.AROUND, (4, 4, 4))])
def test_levels_come_back(around, components):
    shapes = [(n, k) for n in (30, 30, 1, 7) for k in components]
    planes = [np.rint(RNG.laplace(scale=30 / np.arange(1, n + 1)[:, None], size=(n, k))).astype(np.int64) for n, k in shapes]
    planes[1][:] = 0
    planes[4][0] += 1_500_000
    writer = Writer()
    adaptive_levels.code_levels(writer, planes, around)
    blank = [np.zeros(shape, np.int64) for shape in shapes]
    for plane, found in zip(planes, adaptive_levels.code_levels(Reader(writer.finish()), blank, around), strict=True):
        np.testing.assert_array_equal(plane, found)


def test_surroundings_save_bits():
    """Smooth magnitudes cost less in their order than shuffled."""
    scale = 40 * np.exp(-np.arange(200) / 20)[:, None] * np.exp(-np.arange(8) / 2)
    planes = [np.rint(RNG.laplace(scale=scale)).astype(np.int64) for _ in range(12)]
    shuffled = [RNG.permutation(p.ravel()).reshape(p.shape) for p in planes]
    sizes = []
    for given_ in (planes, shuffled):
        writer = Writer()
        adaptive_levels.code_levels(writer, given_, mdtt.AROUND)
        sizes.append(len(writer.finish()))
    assert sizes[0] < 0.6 * sizes[1]


# Bases


def orthonormal(count: int, n: int) -> np.ndarray:
    return np.linalg.qr(RNG.normal(size=(n, n)))[0][:count]


@pytest.mark.parametrize(("count", "n"), [(1, 1), (3, 3), (1, 8), (8, 21), (21, 21)])
def test_bases_decode_orthonormal(count, n):
    coded = quantise_basis(orthonormal(count, n), np.linspace(16, 3, count).astype(int))
    np.testing.assert_allclose(coded.rows() @ coded.rows().T, np.eye(count), atol=1e-12)
    space = Coordinates(np.arange(n) - 1, RNG.integers(1, 5, n))
    writer = Writer()
    code_basis(writer, coded, space)
    found = code_basis(Reader(writer.finish()), CodedBasis.blank(count, n), space)
    np.testing.assert_array_equal(found.entries, coded.entries)
    np.testing.assert_array_equal(found.exponents, coded.exponents)


@pytest.mark.parametrize("entries", [np.zeros(5, np.int64), np.array([0, 0, 0, 0, 3]), np.array([1 << 23, 0, 0, 0, 0])])
def test_any_entries_make_a_basis(entries):
    coded = CodedBasis(np.full(3, 3), np.stack([entries, np.r_[entries[1:], 0], np.zeros(5, np.int64)]))
    np.testing.assert_allclose(coded.rows() @ coded.rows().T, np.eye(3), atol=1e-12)


def test_fine_bases_span_what_the_svd_spans():
    matrix = RNG.normal(size=(300, 12)) * 2.0 ** -np.arange(12)
    _, weight, vectors = np.linalg.svd(matrix, full_matrices=False)
    for kept in (1, 4, 9):
        rows = quantise_basis(vectors[:kept], np.full(kept, 40)).rows()
        np.testing.assert_allclose(rows.T @ rows, vectors[:kept].T @ vectors[:kept], atol=1e-5)


def test_precision_balances_entries_and_coefficients():
    """What rounding a vector's entries loses is of the order of what rounding its coefficients does."""
    step, weight = 0.5, np.array([400.0, 90.0, 20.0])
    vectors = orthonormal(3, 20)
    data = RNG.normal(size=(500, 3)) @ np.diag(weight / math.sqrt(500)) @ vectors
    rows = quantise_basis(vectors, precision(weight, step)).rows()
    lost = ((data - data @ rows.T @ rows) ** 2).sum()
    entries = 20 + 19 + 18
    assert lost < 2 * entries * step**2 / 12
    assert (np.diff(precision(weight, step)) < 0).all()


# Places and equalisation


def test_places_of_the_rig():
    """Of the 31 joints of the CMU rig 21 differ in place."""
    skeleton = rig_of(load_artifact("lsdt-clip")).skeleton
    places = Places.of(skeleton)
    assert (places.count, places.counts.sum()) == (21, 31)
    at = np.asarray(positions_cm(walk(seed=1, seconds=0.2)))
    np.testing.assert_allclose(places.spread(places.gather(at)), at, atol=1e-5)
    assert all(p < n for n, p in enumerate(places.parents))


def test_joints_that_can_move_have_places_of_their_own():
    channels = [POSITION_CHANNELS + ROTATION_CHANNELS, ROTATION_CHANNELS, POSITION_CHANNELS, ()]
    skeleton = Skeleton(list("abcd"), [-1, 0, 0, 2], np.zeros((4, 3)), channels)
    assert Places.of(skeleton).of_joint.tolist() == [0, 0, 1, 1]


def test_scales_of_points_go_by_how_many_joints_are_there():
    """Where nothing but positions decodes, a mean of norms asks for scales that go as the number of joints at a place."""
    skeleton = Skeleton(list("abc"), [-1, 0, 1], np.ones((3, 3)), [POSITION_CHANNELS] * 3)
    places = Places.of(skeleton)
    shared = Places(places.first, places.parents, np.array([1, 2, 4]), places.of_joint)
    assert equalise(skeleton, shared, np.zeros((5, 3, 3)), None, 0.1).tolist() == [0, 4, 8]


def test_equalisation_brings_the_effects_in_line():
    """The law, checked against finite differences on other noise than it was made with: q dD/dq is the same for all."""
    motion = walk(seed=2, seconds=1.0)
    skeleton, places = motion.skeleton, Places.of(motion.skeleton)
    positions = np.asarray(positions_cm(motion), np.float64) / motion.scale
    error = 0.0005 * skeleton.height()
    allowed = 2.0 ** (-equalise(skeleton, places, positions, None, error) / 4)
    noise = np.random.default_rng(5).normal(size=(len(positions), places.count, 3)) * error
    after = sensitivity(skeleton, places, positions, None, noise, allowed)
    before = sensitivity(skeleton, places, positions, None, noise, np.ones(places.count))
    assert after.std() / after.mean() < 0.15 < 0.5 < before.std() / before.mean()


# Codecs


def source_of(motion) -> Source:
    return Source.of(motion, rig_of(load_artifact("lsdt-clip")))


def test_mdtt_bases_are_those_of_the_svd():
    """At a fine step the bases are the right singular vectors of all clips' spectra together, by numpy."""
    source = source_of(walk(seed=3, seconds=4.5))
    coded = mdtt._Sequence(mdtt._Spectra(source), 0.01).at(40)
    places = places_at(source, 40)
    root = np.sqrt(places.counts)
    for d in range(3):
        frames = source.positions[:, places.first, d].astype(np.float64) * root
        vectors = np.linalg.svd(frames, full_matrices=False)[2][:4]  # a temporal DCT is orthogonal, and changes none
        np.testing.assert_allclose(np.abs(coded.bases[d].rows()[:4] @ vectors.T), np.eye(4), atol=0.02)


@pytest.mark.parametrize("codec", ["mdtt", "pca-rdo"])
def test_fewer_components_at_coarser_steps(codec):
    source = source_of(walk(seed=3, seconds=3.0))
    if codec == "mdtt":
        spectra = mdtt._Spectra(source)
        counts = [mdtt._Sequence(spectra, 0.1).at(index).bases[0].count for index in (40, 120, 200)]
    else:
        poses = pca_rdo._Poses(source)
        counts = [pca_rdo._Sequence(poses, 30, 0.1).at(index).shape.pose.count for index in (40, 120, 200)]
    assert counts == sorted(counts, reverse=True) and counts[0] > counts[2] >= 1


def test_pca_shape_comes_back():
    source = source_of(walk(seed=3, seconds=1.2))
    coded = pca_rdo._Sequence(pca_rdo._Poses(source), 30, 0.1).at(120)
    found = read_shape(write_shape(coded.shape, coded.places), coded.places, 30)
    for name in ("scales", "mean"):
        np.testing.assert_array_equal(getattr(found, name), getattr(coded.shape, name))
    np.testing.assert_array_equal(found.pose.entries, coded.shape.pose.entries)
    np.testing.assert_array_equal(found.time.entries, coded.shape.time.entries)


def test_pose_coordinates_follow_their_parents():
    places = Places.of(rig_of(load_artifact("lsdt-clip")).skeleton)
    space = pose_space(places, np.arange(places.count) % 5)
    assert space.parents[:3].tolist() == [-1, -1, -1]
    assert space.parents[3:6].tolist() == [0, 1, 2]
    ratio = np.sqrt(space.squares.astype(float))
    np.testing.assert_allclose(ratio[::3] / ratio[0], 2.0 ** (np.arange(places.count) % 5 / 4), rtol=1e-5)


@pytest.mark.parametrize(("codec", "clip"), [("mdtt", "09/09_06"), ("mdtt", "02/02_05"), ("pca-rdo", "09/09_06")])
def test_real_motion(data_dir, codec, clip):
    motion = read_motion(data_dir / "cmu_bvh" / f"{clip}.bvh", UNIT_CM).frames(1)
    made = make({"codec": codec, "target": {"kind": "mean", "cm": 1.0}})
    data = made.encode(motion)
    error = compare(motion, made.decode(data))["mean_cm"]
    assert isinstance(error, float) and 0.9 < error <= 1.0
    assert motion.frame_count * motion.skeleton.joint_count * 12 / len(data) > 100


def test_mdtt_gains_with_length():
    """The bases are paid once: of a walk twice as long the second half costs less than the first."""
    made = mdtt.Mdtt(load_artifact("mdtt"), Target("step", 8.0))
    half, whole = (len(made.encode(walk(seed=3, seconds=s))) for s in (4.0, 8.0))
    assert whole < 1.8 * half


@pytest.mark.parametrize("codec", ["mdtt", "pca-rdo"])
def test_motions_with_few_places(codec):
    """Fewer frames than components, one joint, and a joint that stays at the origin."""
    skeleton = Skeleton(["a"], [-1], np.zeros((1, 3)), [POSITION_CHANNELS + ROTATION_CHANNELS])
    still = walk(seed=1, seconds=0.1).frames(0, 3)
    one = type(still)(skeleton, np.zeros((3, 6)), 1 / 120, 1.0)
    for motion in (still, one):
        made = make({"codec": codec, "target": {"kind": "max", "cm": 0.1}})
        error = compare(motion, made.decode(made.encode(motion)))["max_cm"]
        assert isinstance(error, float) and error <= 0.1


# Golden streams


def levels_of(data: bytes, codec: str) -> np.ndarray:
    """All integers of a stream: of bases, and of levels, chunk after chunk."""
    stream = read_stream(data)
    header = stream.header
    figure = Figure.of(header, rig_of(MODEL), header.params[-1])
    places = Places.of(figure.skeleton)
    lengths = [chunk_length(header, n) for n in range(header.chunk_count)]
    if codec == "mdtt":
        bases, around = mdtt._read_bases(figure.own, places), mdtt.AROUND
        found = [b.entries for b in bases]
        shapes = [[(f, b.count) for f in mdtt.clip_lengths(length) for b in bases] for length in lengths]
    else:
        clip_frames, around = pca_rdo.CLIP_FRAMES[header.params[0]], pca_rdo.AROUND
        shape = read_shape(figure.own, places, clip_frames)
        found = [shape.scales, shape.mean, shape.pose.entries, shape.time.entries]
        shapes = [[(shape.time.count, shape.pose.count)] * -(-length // clip_frames) for length in lengths]
    for n, of_chunk in enumerate(shapes):
        blank = [np.zeros(shape, np.int64) for shape in of_chunk]
        found += adaptive_levels.code_levels(Reader(stream.chunk(n)), blank, around)
    return np.concatenate([f.ravel() for f in found])


@pytest.mark.parametrize(("codec", "name"), STREAMS)
def test_golden_streams_decode_for_ever(codec, name):
    expected = json.loads((GOLDEN / codec / f"{name}.json").read_text())
    data = (GOLDEN / codec / f"{name}.jmc").read_bytes()
    integers_ = levels_of(data, codec)
    assert int((integers_ != 0).sum()) == expected["nonzeros"]
    assert hashlib.sha256(integers_.astype("<i8").tobytes()).hexdigest() == expected["integers_sha256"]
    motion = decode(data, artifact=MODEL)
    shape = [motion.frame_count, motion.skeleton.joint_count, motion.frame_time, motion.unit_cm]
    assert shape == expected["shape"]
    at = np.asarray(positions_cm(motion))
    for frame, joint, place in expected["positions_cm"]:
        np.testing.assert_allclose(at[frame, joint], place, rtol=0, atol=1e-3)
