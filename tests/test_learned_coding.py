"""The integers of `learned`: contexts, densities, levels, jumps, bones and constants come back as they were, everywhere."""

import hashlib
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxmocap.codecs.artifact import load_artifact
from jaxmocap.codecs.entropy import integers
from jaxmocap.codecs.entropy.range_coder import PythonDecoder, PythonEncoder, RangeDecoder, RangeEncoder
from jaxmocap.codecs.learned import bands
from jaxmocap.codecs.learned.bones import FINENESSES, read_bones, write_bones
from jaxmocap.codecs.learned.coefficients import (
    Levels,
    active_components,
    band_contexts,
    decode_levels,
    encode_levels,
    level_bits,
)
from jaxmocap.codecs.learned.constants import with_constants, write_constants
from jaxmocap.codecs.learned.contexts import magnitude
from jaxmocap.codecs.learned.density import FrozenDensity, stop_frequencies
from jaxmocap.codecs.learned.golomb import read_signed, read_unsigned, write_signed, write_unsigned
from jaxmocap.codecs.learned.jumps import Jumps, decode_jumps, encode_jumps, find_jumps
from jaxmocap.codecs.learned.model import LearnedModel
from jaxmocap.codecs.learned.steps import STEPS, index_of
from jaxmocap.codecs.rig import bones_of
from jaxmocap.errors import CorruptStream
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, Skeleton

MODEL = LearnedModel.load(load_artifact("learned"))
DENSITIES, SPECTRUM = MODEL.densities, MODEL.bases["joints"].spectrum
TAIL = DENSITIES.tail
COMPONENTS = SPECTRUM.components
MOST = integers.LIMIT + 2  # the largest level: what lies beyond 3 has a symbol below the limit
MOST_CONTEXT = 16 * 24
ONE_CM = index_of(1.0)


def random_levels(frames: int, octaves: int, seed: int, size: float = 3.0) -> Levels:
    """Laplacian, and smaller the higher the component and the octave."""
    random = np.random.default_rng(seed)
    falling = size * np.exp2(-np.arange(COMPONENTS) / 6)
    rows = bands.band_rows(frames, octaves)
    return [np.rint(random.laplace(size=(n, COMPONENTS)) * falling / (1 + b)).astype(np.int64) for b, n in enumerate(rows)]


def coded(levels: Levels, step_index: int, encoder_class=RangeEncoder) -> bytes:
    encoder = encoder_class()
    encode_levels(encoder, levels, SPECTRUM, step_index, DENSITIES)
    return encoder.finish()


def assert_levels_return(levels: Levels, frames: int, step_index: int) -> None:
    data = coded(levels, step_index)
    read = decode_levels(RangeDecoder(data), frames, len(levels) - 1, SPECTRUM, step_index, DENSITIES)
    for a, b in zip(read, levels, strict=True):
        np.testing.assert_array_equal(a, b)


# Networks.


def some_contexts(density: FrozenDensity) -> np.ndarray:
    """Any, and those that drive each unit of the first layer farthest."""
    weight = density.weights[0].astype(np.int64)
    random = np.random.default_rng(0).integers(-MOST_CONTEXT, MOST_CONTEXT + 1, (500, len(weight)))
    return np.concatenate([random, MOST_CONTEXT * np.sign(weight.T), -MOST_CONTEXT * np.sign(weight.T)])


@pytest.mark.parametrize("which", ["slow", "fast"])
def test_networks_are_the_same_in_numpy_and_compiled(which: str):
    density: FrozenDensity = getattr(DENSITIES, which)
    contexts = some_contexts(density)
    outputs = density(contexts)
    np.testing.assert_array_equal(jax.jit(density.__call__)(jnp.asarray(contexts, jnp.int32)), outputs)
    assert len(np.unique(outputs, axis=0)) > 100
    frequencies = stop_frequencies(outputs, DENSITIES.logistic)
    assert frequencies.min() >= 1 and (frequencies.sum(1) == 65536).all()


@pytest.mark.parametrize("which", ["slow", "fast"])
def test_networks_fit_into_32_bits(which: str):
    """With the largest contexts, whatever their signs."""
    density: FrozenDensity = getattr(DENSITIES, which)
    most = MOST_CONTEXT
    for weight, bias in zip(density.weights, density.biases, strict=True):
        assert (np.abs(weight.astype(np.int64)).sum(0) * most + np.abs(bias.astype(np.int64))).max() < 1 << 31
        most = 1 << 12


_DIGEST = """
import hashlib, sys
import jax, jax.numpy as jnp, numpy as np
sys.path.insert(0, sys.argv[1])
from test_learned_coding import DENSITIES, some_contexts
for density in (DENSITIES.slow, DENSITIES.fast):
    outputs = jax.jit(density.__call__)(jnp.asarray(some_contexts(density), jnp.int32))
    print(hashlib.sha256(np.asarray(outputs, np.int32).tobytes()).hexdigest())
"""


@pytest.mark.parametrize("flags", ["--xla_cpu_multi_thread_eigen=false", "--xla_cpu_enable_fast_math=true"])
def test_networks_are_the_same_however_they_are_compiled(flags: str):
    environment = {**os.environ, "XLA_FLAGS": flags}
    command = [sys.executable, "-c", _DIGEST, os.path.dirname(__file__)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    wanted = [d(some_contexts(d)).astype(np.int32).tobytes() for d in (DENSITIES.slow, DENSITIES.fast)]
    assert done.stdout.split() == [hashlib.sha256(x).hexdigest() for x in wanted]


def test_contexts_are_whole_numbers_within_bounds_and_the_same_compiled():
    levels = random_levels(64, 3, 1)
    levels[0][3, 2], levels[1][0, 0] = MOST, -MOST
    counts = active_components(levels)
    for band, count, contexts in zip(levels, counts, band_contexts(levels, SPECTRUM, 0, counts), strict=True):
        size = magnitude(band[:, :count])
        inputs = contexts.inputs_of(size)
        assert inputs.dtype == np.int64 and np.abs(inputs).max() <= MOST_CONTEXT
        compiled = jax.jit(contexts.inputs_of)(jnp.asarray(size, jnp.int32))
        np.testing.assert_array_equal(compiled, inputs)


def test_magnitudes_are_logarithms():
    size = np.concatenate([np.arange(5000), np.geomspace(5000, 1 << 18, 500).astype(np.int64)])
    np.testing.assert_allclose(magnitude(-size), 16 * np.log2(1 + size), atol=1.0)
    assert (np.diff(magnitude(size)) >= 0).all()
    assert magnitude(np.array(MOST)) <= MOST_CONTEXT


# Levels.

SIZES = st.sampled_from([0.0, 0.5, 3.0, 200.0])


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 48), st.integers(0, 5), st.integers(0, STEPS - 1), st.integers(0, 99), SIZES)
@example(1, 0, 0, 0, 3.0)
@example(1, 7, STEPS - 1, 0, 200.0)
@example(2, 4, ONE_CM, 0, 0.0)
@example(3, 7, ONE_CM, 1, 3.0)
def test_levels_return(frames: int, octaves: int, step_index: int, seed: int, size: float):
    assert_levels_return(random_levels(frames, octaves, seed, size), frames, step_index)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 24), st.integers(0, 4), st.data())
def test_levels_of_any_size_return(frames: int, octaves: int, data: st.DataObject):
    """A few at any place, up to the largest there are."""
    levels = [np.zeros((rows, COMPONENTS), np.int64) for rows in bands.band_rows(frames, octaves)]
    for band in levels:
        for _ in range(data.draw(st.integers(0, 2)) if len(band) else 0):
            place = data.draw(st.integers(0, len(band) - 1)), data.draw(st.integers(0, COMPONENTS - 1))
            band[place] = data.draw(st.sampled_from([-MOST, MOST]) | st.integers(-MOST, MOST))
    assert_levels_return(levels, frames, data.draw(st.integers(0, STEPS - 1)))


@pytest.mark.parametrize("frames", [1, 2, 3, 40])
def test_plain_integers_code_the_same_bytes(frames: int):
    """Where constriction has no wheel."""
    levels = random_levels(frames, 4, frames)
    levels[0][0, 0] = MOST
    data = coded(levels, ONE_CM)
    assert coded(levels, ONE_CM, PythonEncoder) == data
    for decoder in (PythonDecoder(data), RangeDecoder(data)):
        for a, b in zip(decode_levels(decoder, frames, 4, SPECTRUM, ONE_CM, DENSITIES), levels, strict=True):
            np.testing.assert_array_equal(a, b)


def test_lengths_are_about_what_they_are_thought_to_be():
    levels = random_levels(200, 4, 5)
    assert 8 * len(coded(levels, ONE_CM)) == pytest.approx(level_bits(levels, SPECTRUM, ONE_CM, DENSITIES), rel=0.03)


def test_bytes_that_nobody_wrote_are_levels_or_refused():
    random = np.random.default_rng(0)
    refused = 0
    for n in range(60):
        data = random.bytes(n) if n % 3 else b"\xff" * n
        try:
            levels = decode_levels(RangeDecoder(data), 20, 3, SPECTRUM, int(random.integers(STEPS)), DENSITIES)
        except CorruptStream:
            refused += 1
        else:
            assert [len(band) for band in levels] == bands.band_rows(20, 3)
    assert 0 < refused < 60


# Bands.


@pytest.mark.parametrize("octaves", range(8))
def test_bands_of_any_length_return(octaves: int):
    for frames in range(1, 71):
        x = np.random.default_rng(frames).normal(size=(frames, 2))
        parts = bands.forward(x, octaves)
        assert [len(p) for p in parts] == bands.band_rows(frames, octaves)
        np.testing.assert_allclose(bands.inverse(parts), x, atol=1e-9)


def test_octaves_are_those_of_the_frame_rate():
    assert [bands.octave_count(1 / rate) for rate in (1, 7.5, 15, 30, 60, 120, 240, 1e5)] == [0, 0, 1, 2, 3, 4, 5, 7]


# Golomb.


@given(st.lists(st.tuples(st.integers(-(1 << 22), 1 << 22), st.integers(0, 6)), max_size=9))
def test_golomb_integers_return(values: list[tuple[int, int]]):
    encoder = RangeEncoder()
    for value, order in values:
        write_signed(encoder, value, order)
        write_unsigned(encoder, abs(value), order)
    decoder = RangeDecoder(encoder.finish())
    for value, order in values:
        assert (read_signed(decoder, order), read_unsigned(decoder, order)) == (value, abs(value))


def test_golomb_integers_without_end_are_refused():
    encoder = RangeEncoder()
    for _ in range(30):
        encoder.encode_bits(1, 1)
    with pytest.raises(CorruptStream, match="beyond all measure"):
        read_unsigned(RangeDecoder(encoder.finish()), 0)


# Jumps.


@settings(max_examples=50, deadline=None)
@given(st.sets(st.integers(1, 299), max_size=5), st.integers(0, STEPS - 1), st.integers(0, 99))
def test_jumps_return(frames: set[int], step_index: int, seed: int):
    size = np.exp2(np.random.default_rng(seed).uniform(0, 22, (len(frames), COMPONENTS)))
    sign = np.random.default_rng(seed + 1).integers(-1, 2, size.shape)
    jumps = Jumps(np.array(sorted(frames), np.int64), sign * size.astype(np.int64))
    encoder = RangeEncoder()
    encode_jumps(encoder, jumps, SPECTRUM, step_index, DENSITIES)
    data = encoder.finish()
    read = decode_jumps(RangeDecoder(data), 300, SPECTRUM, step_index, DENSITIES)
    np.testing.assert_array_equal(read.frames, jumps.frames)
    np.testing.assert_array_equal(read.levels, jumps.levels)
    if frames:
        with pytest.raises(CorruptStream, match="jump"):
            decode_jumps(RangeDecoder(data), max(frames), SPECTRUM, step_index, DENSITIES)


def test_jumps_are_found_and_taken_out():
    time = np.arange(100)
    still = np.stack([np.sin(time / 20), np.cos(time / 30), time / 50])[:, None].repeat(4, 1) * 20
    torn = still.copy()
    torn[..., :1] += 50
    torn[..., 70:] -= 12
    frames = find_jumps(torn)
    assert frames.tolist() == [1, 70]
    assert not len(find_jumps(still)) and not len(find_jumps(still[..., :1]))
    y = torn.reshape(12, 100).T
    smooth = y - Jumps.over(y, frames, 0.5).shift(100, 0.5)
    assert np.abs(np.diff(smooth, axis=0)).max() <= 1.0
    assert np.abs(np.diff(y, axis=0)).max() > 10
    np.testing.assert_array_equal(smooth[-1], y[-1])


# Bones.


@pytest.mark.parametrize("fineness", range(FINENESSES))
def test_bones_return_as_fine_as_asked_for(fineness: int):
    mean = bones_of(MODEL.rig.skeleton)
    random = np.random.default_rng(fineness)
    for scale, spread in ((1.0, 0.0), (0.9, 0.5), (1.5, 30.0), (0.0, 0.0), (10.0, 1.0)):
        bones = mean * scale + spread * random.normal(size=mean.shape)
        data = write_bones(bones, MODEL.bones, fineness, TAIL)
        read = read_bones(data, MODEL.bones, fineness, TAIL)
        assert np.abs(read - bones).max() <= 2.0 ** (fineness - 14)


def test_finer_bones_take_more_bytes():
    bones = bones_of(MODEL.rig.skeleton) * 1.01 + np.random.default_rng(0).normal(size=(len(MODEL.bones.mean), 3))
    sizes = [len(write_bones(bones, MODEL.bones, fineness, TAIL)) for fineness in range(FINENESSES)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < sizes[0] / 2


def test_bones_that_nobody_wrote_are_bones_or_refused():
    random = np.random.default_rng(0)
    refused = 0
    for n in range(100):
        try:
            read = read_bones(b"\xff" * n if n % 2 else random.bytes(n), MODEL.bones, n % FINENESSES, TAIL)
        except CorruptStream:
            refused += 1
        else:
            assert read.shape == MODEL.bones.mean.shape and np.isfinite(read).all()
    assert 0 < refused < 100


# Constants.


def points(values: np.ndarray) -> Motion:
    joints = values.shape[1] // 3
    skeleton = Skeleton([f"j{n}" for n in range(joints)], [-1] * joints, np.zeros((joints, 3)), [POSITION_CHANNELS] * joints)
    return Motion(skeleton, values, 0.01)


NAN = np.nan
USUAL = {"of this rig": np.array([1.5, NAN, 0.0, NAN, -7.25, 2.0]), "of another": np.array([1.5, NAN]), "none": np.zeros(0)}


@pytest.mark.parametrize("usual", USUAL.values(), ids=USUAL)
def test_constants_return_exactly_and_nothing_else_is_touched(usual: np.ndarray):
    """Whatever holds still, at the usual value, at zero or elsewhere: each channel of each kind in turn."""
    random = np.random.default_rng(0)
    known = usual if len(usual) == 6 else np.full(6, NAN)
    for kinds in random.integers(0, 4, (60, 6)):
        of_kind = [np.nan_to_num(known), np.zeros(6), np.full(6, 3.0), np.zeros(6)]
        values = np.choose(kinds, of_kind)[None] + (kinds == 3)[None] * random.normal(size=(5, 6))
        about = values + 0.01
        decoded = with_constants(about, write_constants(points(values), usual), usual)
        exact = (kinds != 3) & (values[0] == np.nan_to_num(known))
        np.testing.assert_array_equal(decoded, np.where(exact[None], values, about))


def test_usual_constants_take_no_bytes():
    usual = USUAL["of this rig"]
    values = np.where(np.isnan(usual), np.arange(1, 6)[:, None], usual)
    assert write_constants(points(values), usual) == b""
    assert write_constants(points(np.zeros((5, 6))), usual) != b""


@pytest.mark.parametrize("data", [b"\xff", b"\x00", bytes(3), b"\x03\x00", b"\xff" * 9])
def test_constants_that_nobody_wrote_are_refused(data: bytes):
    with pytest.raises(CorruptStream, match="constant channels"):
        with_constants(np.zeros((2, 30)), data, np.zeros(0))
