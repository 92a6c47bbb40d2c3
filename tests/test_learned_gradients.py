"""Gradients through `learned`, and the training that uses them, held to finite differences and to the codec itself."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxmocap.codecs.learned import bands
from jaxmocap.codecs.learned.basis import Basis, direction_of
from jaxmocap.codecs.learned.coefficients import Densities, level_bits
from jaxmocap.codecs.learned.contexts import FAST_INPUTS, SLOW_INPUTS, fast_contexts, slow_contexts
from jaxmocap.codecs.learned.density import Density, logistic_table, tail_table
from jaxmocap.codecs.learned.differentiable import Transform, Vectors, quantised, rate, reconstruct, vectors_of
from jaxmocap.codecs.learned.figure import in_cm
from jaxmocap.codecs.learned.jumps import Jumps
from jaxmocap.codecs.learned.klt import jacobian_moment, weighted_klt
from jaxmocap.codecs.learned.payload import Coded, read_layers, write_layers
from jaxmocap.codecs.learned.pose_vectors import PoseVectors
from jaxmocap.codecs.learned.spectrum import Spectrum, fit_spectrum
from jaxmocap.codecs.learned.steps import index_of, step_cm
from jaxmocap.formats import read_motion
from jaxmocap.kinematics import pose
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.training.learned.augmentation import mirror_axis, mirrored, resampled, sides_of, warp_times
from jaxmocap.training.learned.refinement import Clip, Refinement, draw_batch

FRAMES, STEP_INDEX = 64, index_of(1.0)
KEYS = jax.random.key(3)
TURNS = ROTATION_CHANNELS[::-1]
T = TypeVar("T")
levels_of, bits_of = eqx.filter_jit(quantised), eqx.filter_jit(rate)


class Case(NamedTuple):
    motion: Motion
    figure: PoseVectors
    vectors: tuple[np.ndarray, np.ndarray]
    basis: Basis
    densities: Densities
    octaves: int


def little_figure() -> Skeleton:
    names = ["Hips", "LeftLeg", "LeftFoot", "RightLeg", "RightFoot", "Chest", "LArm", "RArm"]
    offsets = [[0, 0, 0], [9, -4, 0], [2, -40, 1], [-9.5, -4, 0], [-2, -41, 1], [0, 30, 0], [25, 3, 0], [-25, 3, 1]]
    channels = [(*POSITION_CHANNELS, *TURNS), *[TURNS] * 7]
    return Skeleton(names, [-1, 0, 1, 0, 3, 0, 5, 5], np.array(offsets, float), channels, [2, 4], np.array([[0, -4, 12.0]] * 2))


def dance(seed: int, frames: int = FRAMES) -> Motion:
    """A few slow sines in every channel."""
    random = np.random.default_rng(seed)
    s = little_figure()
    time = np.arange(frames)[:, None, None] / 120
    lowest, highest = [[0.2], [0.0], [0.0]], [[3.0], [1.0], [15.0]]
    rate, start, size = random.uniform(lowest, highest, (3, 3 * s.channel_count)).reshape(3, 1, 3, -1)
    return Motion(s, (size * np.sin(2 * np.pi * (rate * time + start))).sum(1), 1 / 30, 1.0)


@pytest.fixture(scope="module")
def case() -> Case:
    """A motion, and a basis and spectrum that suit it. The densities are half trained: they fall with the tail alone."""
    motion = dance(0)
    still = np.tile(np.eye(3), (motion.skeleton.joint_count, 1, 1))
    figure = PoseVectors(in_cm(motion.skeleton, 1.0), still)
    path, body = figure.analyse(motion, 1.0)
    moment, radius = jacobian_moment(figure, "joints", body)
    synthesis = weighted_klt(moment, np.cov(body.T))
    octaves = bands.octave_count(motion.frame_time)
    nothing = Spectrum(np.zeros((1, 3 + len(synthesis)), int), np.zeros((1, 3 + len(synthesis)), int))
    basis = Basis(body.mean(0), synthesis, radius**0.5, nothing)
    spectrum = fit_spectrum([bands.forward(basis.coefficients(path, body, direction_of(path)), octaves)])
    densities = Densities(
        Density.init(SLOW_INPUTS, 8, jax.random.key(0)).freeze(), Density.init(FAST_INPUTS, 8, jax.random.key(1)).freeze(),
        logistic_table(), tail_table(),
    )  # fmt: skip
    return Case(motion, figure, (path, body), Basis(basis.mean, synthesis, basis.turn_cm, spectrum), densities, octaves)


def transform_of(case: Case, step: float = 1.0) -> Transform:
    return Transform.of(case.basis, case.densities, step)


def vectors(case: Case) -> Vectors:
    return Vectors(*(jnp.asarray(x, float) for x in case.vectors))


def squares(x: Vectors) -> Array:
    return (x.path**2).sum() + (x.body**2).sum()


def assert_has_gradient(f: Callable[[T], Array], x: T, seed: int) -> None:
    """Central differences along random directions, in each leaf of `x` apart, are what `f` has for gradient."""
    both = eqx.filter_jit(eqx.filter_value_and_grad(f))  # one program for all: compiling is what takes time
    _, gradient = both(x)
    random = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(eqx.filter(x, eqx.is_array))
    slopes = jax.tree.leaves(eqx.filter(gradient, eqx.is_array))
    static = eqx.filter(x, eqx.is_array, inverse=True)
    for n, (leaf, slope) in enumerate(zip(leaves, slopes, strict=True)):
        direction = jnp.asarray(random.normal(size=leaf.shape))
        size = 1e-6 * float(jnp.abs(leaf).max() + 1e-3)

        def at(move: float, n: int = n, direction=direction) -> float:
            moved = [leaf + move * direction if k == n else leaf for k, leaf in enumerate(leaves)]
            return float(both(eqx.combine(jax.tree.unflatten(structure, moved), static))[0])

        measured = (at(size) - at(-size)) / (2 * size)
        assert np.isclose(float((slope * direction).sum()), measured, rtol=2e-3, atol=1e-4), (n, slope.shape)


def test_gradients_of_rate_are_finite_differences(case: Case):
    with jax.enable_x64(True):
        at = (transform_of(case, 0.7), vectors(case))
        assert_has_gradient(lambda x: rate(*x, case.octaves, KEYS), at, 0)


def test_gradients_of_reconstruction_are_finite_differences(case: Case):
    with jax.enable_x64(True):
        at = (transform_of(case, 0.7), vectors(case))

        def size(x):
            p = reconstruct(x[0], case.figure, x[1], case.octaves, KEYS)
            return (p.positions**2).mean() + (p.ends**2).mean() + p.rotations[..., 0].sum() * 1e-2

        assert_has_gradient(size, at, 1)


def test_vectors_of_channels_are_those_of_the_codec_and_have_gradients(case: Case):
    with jax.enable_x64(True):
        values = jnp.asarray(case.motion.values)
        found = jax.jit(lambda x: vectors_of(case.figure, x, 1.0))(values)
        for a, b in zip(found, case.vectors, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
        assert_has_gradient(lambda x: squares(vectors_of(case.figure, x, 1.0)), values, 2)


@pytest.mark.parametrize("index", [STEP_INDEX - 40, STEP_INDEX + 8])
def test_rate_of_rounded_levels_is_what_the_coder_expects(case: Case, index: int):
    transform = transform_of(case, step_cm(index))
    coded = levels_of(transform, vectors(case), case.octaves)
    levels = [np.rint(x).astype(np.int64) for x in coded.levels]
    wanted = level_bits(levels, case.basis.spectrum, index, case.densities)
    assert any(x.any() for x in levels)
    assert float(bits_of(transform, vectors(case), case.octaves)) == pytest.approx(wanted, rel=0.03)


def test_reconstruction_is_what_the_codec_decodes(case: Case):
    coded = levels_of(transform_of(case), vectors(case), case.octaves)
    none = Jumps(np.zeros(0, np.int64), np.zeros((0, case.basis.components), np.int64))
    written = Coded(STEP_INDEX, int(coded.direction), none, [np.rint(x).astype(np.int64) for x in coded.levels])
    data = write_layers([written], case.basis, case.densities)
    (read,) = read_layers(data, FRAMES, case.octaves, case.basis, case.densities)
    decoded = case.figure.values(*case.basis.vectors(read.coefficients(), read.direction), 1.0)
    wanted = pose(case.motion.with_values(decoded))
    found = eqx.filter_jit(reconstruct)(transform_of(case), case.figure, vectors(case), case.octaves)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)


def test_rounding_passes_gradients_and_keys_can_be_mapped_over(case: Case):
    at = (transform_of(case), vectors(case))
    gradient = eqx.filter_jit(eqx.filter_grad(lambda x: rate(x[0], x[1], case.octaves)))(at)
    sizes = [float(jnp.abs(x).max()) for x in jax.tree.leaves(eqx.filter(gradient, eqx.is_array))]
    assert np.isfinite(sizes).all() and gradient[0].log_step < 0 and jnp.abs(gradient[1].body).max() > 0
    keys = jax.random.split(KEYS, 2)
    bits = jax.jit(jax.vmap(lambda key: rate(at[0], at[1], case.octaves, key)))(keys)
    assert bits[0] != bits[1]
    np.testing.assert_allclose(bits[1], bits_of(at[0], at[1], case.octaves, keys[1]), rtol=1e-4)


def test_contexts_of_floats_are_those_of_integers():
    random = np.random.default_rng(0)
    sizes, parents, prior = (random.integers(0, 60, shape) for shape in ((9, 7), (4, 8), (9, 7)))
    prior = prior - 20
    numbers = (jnp.asarray(x, jnp.float32) for x in (prior, parents))
    of_floats, of_parents = numbers
    pairs = [
        (slow_contexts(prior, 40), slow_contexts(of_floats, jnp.asarray(40.0))),
        (fast_contexts(prior, 40, 1, parents), fast_contexts(of_floats, jnp.asarray(40.0), 1, of_parents)),
    ]
    for whole, smooth in pairs:
        wanted, found = whole.inputs_of(sizes), smooth.smooth_inputs(jnp.asarray(sizes, jnp.float32))
        # The expected magnitude has steps, which the smooth one goes through.
        assert wanted.shape == found.shape and np.abs(wanted - np.asarray(found)).max() <= 8
        np.testing.assert_allclose(smooth.expected, whole.expected, atol=7)
        assert (np.abs(wanted - np.asarray(found)) < 1).mean() > 0.5


def test_thawed_networks_freeze_to_the_same(case: Case):
    again = case.densities.slow.thaw().freeze()
    for a, b in zip([*again.weights, *again.biases], [*case.densities.slow.weights, *case.densities.slow.biases], strict=True):
        np.testing.assert_array_equal(a, b)


def refined(case: Case) -> tuple[Refinement, list[Clip]]:
    clips = []
    for motion in (dance(0, 200), mirrored(dance(0, 200))):
        path, body = PoseVectors(in_cm(motion.skeleton, 1.0), case.figure.mean).analyse(motion, 1.0)
        clips.append((path, body))
    return Refinement(case.figure, "joints", case.octaves, case.basis, case.densities, 12, 1e-2), clips


def test_steps_lower_the_loss_and_repeat(case: Case):
    refinement, clips = refined(case)
    state, key = refinement.start(), jax.random.key(5)
    batch = draw_batch(clips, 2, FRAMES, key)
    losses = []
    for _ in range(12):
        state, metrics = refinement.step(state, batch, key)
        losses.append(float(metrics.loss))
    assert np.isfinite(losses).all() and losses[-1] < 0.995 * losses[0]
    again, _ = refinement.step(refinement.start(), draw_batch(clips, 2, FRAMES, key), key)
    once, _ = refinement.step(refinement.start(), batch, key)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(once), strict=True):
        np.testing.assert_array_equal(a, b)
    basis = refinement.finish(state, clips)
    assert basis.synthesis.shape == case.basis.synthesis.shape and basis.spectrum.components == basis.components
    turned = basis.synthesis @ case.basis.analysis
    assert np.abs(turned - np.eye(len(turned))).max() > 0.02
    np.testing.assert_allclose(turned @ turned.T, np.eye(len(turned)), atol=0.01)


def test_other_keys_draw_other_crops(case: Case):
    _, clips = refined(case)
    a, b = (draw_batch(clips, 2, FRAMES, jax.random.key(n)) for n in (0, 1))
    assert a.path.shape == (2, FRAMES, 3) and not np.array_equal(a.body, b.body)


@pytest.mark.parametrize("where", ["made", "cmu_bvh/02/02_03.bvh", "cmu_daz/martial/03.bvh"])
def test_mirrored_motion_has_mirrored_positions(where: str, request: pytest.FixtureRequest):
    motion = dance(1) if where == "made" else read_motion(request.getfixturevalue("data_dir") / where).frames(1, 30)
    partner, image = sides_of(motion.skeleton), mirrored(motion)
    assert mirror_axis(motion.skeleton) == 0 and (partner != np.arange(len(partner))).sum() >= 6
    wanted = np.array(pose(motion).positions)[:, partner] * np.array([-1.0, 1.0, 1.0], np.float32)
    np.testing.assert_allclose(pose(image).positions, wanted, atol=1e-4)
    back = mirrored(image)
    np.testing.assert_array_equal(back.values, motion.values)
    np.testing.assert_array_equal(back.skeleton.offsets, motion.skeleton.offsets)
    np.testing.assert_array_equal(back.skeleton.end_offsets, motion.skeleton.end_offsets)


def test_a_rig_without_sides_is_refused():
    s = little_figure()
    crooked = Skeleton(s.names, s.parents, np.abs(s.offsets) + 5, s.channels)
    with pytest.raises(ValueError, match="mirror images"):
        mirror_axis(crooked)
    one_sided = Skeleton(s.names, [-1, 0, 1, 0, 1, 0, 5, 5], s.offsets, s.channels)
    with pytest.raises(ValueError, match="left side"):
        sides_of(one_sided)


def test_warped_motion_keeps_to_its_course():
    times = np.asarray(warp_times(240, jax.random.key(0)))
    speed = np.diff(times)
    assert times[0] == 0 and 0.85 <= speed.min() < 0.98 < 1.02 < speed.max() <= 1.15 and np.abs(np.diff(speed)).max() < 0.01
    frames = np.arange(300)[:, None]
    np.testing.assert_allclose(resampled(frames**2 - 3.0 * frames, times[5:])[:, 0], times[5:] ** 2 - 3 * times[5:], rtol=1e-4)
    np.testing.assert_array_equal(resampled(frames, np.array([7.0, 280.0, 400.0]))[:, 0], [7, 280, 299])
