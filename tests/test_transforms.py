"""Transforms: laws that all of them keep, and oracles: scipy, numpy, wavelets by hand, Algorithm 1 in numpy."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft

from jaxmocap import transforms
from jaxmocap.formats.bvh import read_bvh
from jaxmocap.kinematics import positions_cm
from jaxmocap.transforms import (
    AbstractTransform,
    Cdf97,
    Chain,
    Dct,
    Haar,
    Lsdt,
    Pca,
    constant,
    dct_matrix,
    fit_lsdt,
    fit_pca,
    growing,
    haar_matrix,
)
from jaxmocap.transforms.lsdt import keep_largest

FRAMES, CHANNELS = 37, 6
UNIT_CM = 5.6444
TEST = ("09_06", "09_01", "02_05", "02_10", "05_02", "05_12", "06_03", "06_14", "01_05")


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def orthogonal(size: int, seed: int = 0) -> np.ndarray:
    return np.linalg.qr(noise(size, size, seed=seed))[0]


# Signals are (frames, channels); an Lsdt maps (groups, frames, channels).
BUILD = {
    Dct: lambda: Dct(),
    Haar: lambda: Haar(),
    Cdf97: lambda: Cdf97(1),
    Pca: lambda: Pca(jnp.asarray(noise(CHANNELS)), jnp.asarray(orthogonal(CHANNELS)), jnp.ones(CHANNELS)),
    Lsdt: lambda: Lsdt(jnp.stack([jnp.asarray(orthogonal(CHANNELS, seed)) for seed in range(3)])),
    Chain: lambda: Chain((Dct(), BUILD[Lsdt]())),
}
ORTHONORMAL = (Dct, Haar, Lsdt, Chain)


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def signal(kind: type) -> jax.Array:
    return jnp.asarray(noise(*((3,) if kind in (Lsdt, Chain) else ()), FRAMES, CHANNELS, seed=1))


def test_every_exported_transform_is_in_the_registry():
    exported = {c for c in vars(transforms).values() if inspect.isclass(c) and issubclass(c, AbstractTransform)}
    assert exported - {AbstractTransform} == set(BUILD)


# Laws


@pytest.mark.parametrize("kind", BUILD)
def test_the_inverse_undoes_the_transform_both_ways(kind, double):
    transform, x = BUILD[kind](), signal(kind)
    np.testing.assert_allclose(transform.inverse(transform.forward(x)), x, atol=1e-12)
    np.testing.assert_allclose(transform.forward(transform.inverse(x)), x, atol=1e-12)


@pytest.mark.parametrize("kind", ORTHONORMAL)
def test_orthonormal_transforms_keep_lengths_and_angles(kind, double):
    transform, x = BUILD[kind](), signal(kind)
    y = x[..., ::-1, :] + 0.3
    np.testing.assert_allclose((transform.forward(x) * transform.forward(y)).sum(), (x * y).sum(), rtol=1e-12)
    np.testing.assert_allclose((transform.forward(x) ** 2).sum(), (x**2).sum(), rtol=1e-12)


@pytest.mark.parametrize("kind", BUILD)
def test_compiled_batched_and_differentiated(kind):
    transform, x = BUILD[kind](), signal(kind)
    two = jnp.stack([x, x[..., ::-1, :]])
    for f in (lambda t, x: t.forward(x), lambda t, x: t.inverse(x)):
        loop = [f(transform, one) for one in two]
        np.testing.assert_allclose(jax.jit(f)(transform, x), loop[0], atol=1e-5)
        batch = jax.jit(jax.vmap(f, (None, 0)))(transform, two)
        np.testing.assert_allclose(batch, loop, atol=1e-5)
        np.testing.assert_allclose(jax.jit(f)(transform, two), batch, atol=1e-5)  # leading axes are a batch as they are
        gradient = jax.jit(jax.grad(lambda x, f=f: (f(transform, x) ** 3).sum()))(x)
        assert jnp.isfinite(gradient).all() and jnp.abs(gradient).max() > 0


@pytest.mark.parametrize("kind", [Pca, Lsdt])
def test_fitted_transforms_have_gradients_in_their_parameters(kind):
    gradient = jax.jit(jax.grad(lambda t, x: (t.forward(x) ** 3).sum()))(BUILD[kind](), signal(kind))
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert jnp.abs(gradient.basis).max() > 0


def test_a_chain_applies_the_first_first(double):
    parts, x = (Dct(), BUILD[Pca]()), signal(Dct)
    np.testing.assert_allclose(Chain(parts).forward(x), parts[1].forward(parts[0].forward(x)), atol=1e-12)
    np.testing.assert_allclose(Chain(parts).inverse(x), parts[0].inverse(parts[1].inverse(x)), atol=1e-12)


# DCT


@pytest.mark.parametrize("frames", [1, 2, 16, 512, 513, 1200])
def test_the_dct_is_scipys(frames, double):
    x = noise(2, frames, 3)
    there, back = (np.asarray(f(x, axis=1, norm="ortho")) for f in (scipy.fft.dct, scipy.fft.idct))
    np.testing.assert_allclose(Dct().forward(jnp.asarray(x)), there, atol=1e-11)
    np.testing.assert_allclose(Dct().inverse(jnp.asarray(x)), back, atol=1e-11)


def test_the_dct_matrix_is_scipys():
    np.testing.assert_allclose(dct_matrix(31), np.asarray(scipy.fft.dct(np.eye(31), axis=0, norm="ortho")), atol=1e-14)


# Wavelets


def haar_by_hand(x: list[float], levels: int) -> list[float]:
    """Averages and differences of pairs over the square root of two; an odd last sample goes up as it is."""
    details: list[float] = []
    for _ in range(levels):
        pairs = [(x[n], x[n + 1]) for n in range(0, len(x) - 1, 2)]
        details = [(a - b) / 2**0.5 for a, b in pairs] + details
        x = [(a + b) / 2**0.5 for a, b in pairs] + (x[-1:] if len(x) % 2 else [])
    return x + details


@pytest.mark.parametrize("length", [1, 2, 5, 31, 32, 33])
def test_the_haar_matrix_is_the_transform_by_hand_and_orthogonal(length):
    matrix = haar_matrix(length, 3)
    x = noise(length)
    np.testing.assert_allclose(matrix @ x, haar_by_hand(x.tolist(), 3), atol=1e-13)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(length), atol=1e-13)


def test_haar_over_frames_is_its_matrix(double):
    x = noise(33, 4)
    np.testing.assert_allclose(Haar(2).forward(jnp.asarray(x)), haar_matrix(33, 2) @ x, atol=1e-12)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 7, 8, 15, 31, 32, 33, 100])
def test_the_97_wavelet_rebuilds_every_length(frames, double):
    x = jnp.asarray(noise(frames, 2))
    y = jax.jit(Cdf97(4).forward)(x)
    assert y.shape == x.shape
    np.testing.assert_allclose(jax.jit(Cdf97(4).inverse)(y), x, atol=1e-12)


def test_the_97_wavelet_is_nearly_orthonormal(double):
    matrix = np.asarray(jax.jit(Cdf97(1).forward)(jnp.eye(64)))
    inside = (matrix @ matrix.T)[8:24, 8:24]
    assert np.abs(inside - np.eye(16)).max() < 0.1
    singular = np.linalg.svd(np.asarray(jax.jit(Cdf97(3).forward)(jnp.eye(64))), compute_uv=False)
    assert singular.max() < 1.5 and singular.min() > 0.5


def test_the_97_wavelet_sees_no_detail_in_cubics(double):
    t = jnp.linspace(-1.0, 1.0, 64)[:, None]
    powers = jnp.concatenate([t**0, t, t**2, t**3, t**4], 1)
    y = jax.jit(Cdf97(1).forward)(powers)
    np.testing.assert_allclose(y[34:-2, :4], 0, atol=1e-12)  # four vanishing moments, away from the mirrored ends
    assert jnp.abs(y[34:-2, 4]).min() > 1e-8
    np.testing.assert_allclose(y[32:, 0], 0, atol=1e-12)  # a constant has none at the ends either
    np.testing.assert_allclose(y[:32, 0], np.sqrt(2), rtol=1e-9)  # averages gain as in an orthonormal wavelet


# PCA


def test_pca_is_the_singular_value_decomposition(double):
    x = noise(200, 5) @ np.diag([5.0, 3.0, 2.0, 1.0, 0.5]) @ orthogonal(5) + noise(5)
    u, s, vt = np.linalg.svd(x - x.mean(0), full_matrices=False)
    pca = fit_pca(jnp.asarray(x))
    np.testing.assert_allclose(pca.variance, s**2 / 200, rtol=1e-9)
    np.testing.assert_allclose(np.abs(pca.basis @ vt.T), np.eye(5), atol=1e-9)
    assert (np.take_along_axis(np.asarray(pca.basis), np.abs(pca.basis).argmax(1)[:, None], 1) > 0).all()
    two = fit_pca(jnp.asarray(x), 2)
    best = (u[:, :2] * s[:2]) @ vt[:2] + x.mean(0)
    np.testing.assert_allclose(two.inverse(two.forward(jnp.asarray(x))), best, atol=1e-9)
    coefficients = np.asarray(pca.forward(jnp.asarray(x)))
    np.testing.assert_allclose(np.cov(coefficients.T, bias=True), np.diag(pca.variance), atol=1e-9)


def test_pca_refuses_more_components_than_channels():
    for components in (0, 6):
        with pytest.raises(ValueError, match="components is"):
            fit_pca(jnp.zeros((10, 5)), components)


# LSDT


def largest(g: np.ndarray, count: int) -> np.ndarray:
    """Every column's `count` entries of largest magnitude (eq. 8)."""
    kept = np.zeros_like(g)
    at = np.argsort(-np.abs(g), axis=0, kind="stable")[:count]
    np.put_along_axis(kept, at, np.take_along_axis(g, at, 0), 0)
    return kept


def algorithm_1(m: np.ndarray, basis: np.ndarray, sparsity: int, iterations: int) -> tuple[np.ndarray, list[float]]:
    """Algorithm 1 of Hou et al. 2016, line by line, of samples in columns; and the objective (6) before each line 3."""
    objective = []
    for _ in range(iterations):
        g = basis @ m
        e = largest(g, sparsity)
        objective.append(((g - e) ** 2).sum())
        u, _, vt = np.linalg.svd(m @ e.T)
        basis = vt.T @ u.T
    return basis, objective


@pytest.fixture(scope="module")
def samples(data_dir) -> np.ndarray:
    """Frames of the training split in cm, (3, samples, joints), each coordinate by itself."""
    files = [f for f in sorted((data_dir / "cmu_bvh").rglob("*.bvh")) if f.stem not in TEST]
    poses = [np.asarray(positions_cm(read_bvh(f, UNIT_CM).frames(1)))[::12] for f in files[::10]]
    return np.concatenate(poses).transpose(2, 0, 1)


INITIAL = pytest.mark.parametrize("initial", [dct_matrix(31), haar_matrix(31)], ids=["dct", "haar"])


@INITIAL
def test_lsdt_is_algorithm_1(initial, double):
    codes = largest(noise(31, 600), 8) + 0.1 * noise(31, 600, seed=1)
    m = np.stack([orthogonal(31, seed) @ codes for seed in range(2)])  # every basis vector is in use: one solution
    fit = fit_lsdt(jnp.asarray(m.swapaxes(1, 2)), jnp.asarray(initial), constant(8, 20))
    for group in range(2):
        basis, objective = algorithm_1(m[group], initial, 8, 20)
        np.testing.assert_allclose(fit.objective[:-1, group], objective, rtol=1e-9)
        np.testing.assert_allclose(fit.transform.basis[group], basis, atol=1e-8)


@INITIAL
def test_lsdt_is_algorithm_1_on_real_poses_but_for_vectors_not_in_use(samples, initial, double):
    # Where no sample's largest coefficients use a basis vector, (10) leaves it open and the SVD decides.
    m = samples[:, ::4].astype(np.float64)
    fit = fit_lsdt(jnp.asarray(m), jnp.asarray(initial), constant(8, 9))
    for group in range(3):
        _, objective = algorithm_1(m[group].T, initial, 8, 10)
        np.testing.assert_allclose(fit.objective[:2, group], objective[:2], rtol=1e-9)
        np.testing.assert_allclose(fit.objective[:, group], objective, rtol=0.1)


def test_lsdt_never_loses_under_a_constant_schedule_and_stays_orthogonal(samples):
    fit = fit_lsdt(jnp.asarray(samples, jnp.float32), jnp.asarray(dct_matrix(31)), constant(8, 60))
    objective = np.asarray(fit.objective)
    assert objective.shape == (61, 3)
    assert (np.diff(objective, axis=0) <= 1e-5 * objective[0]).all()
    assert (objective[-1] < 0.5 * objective[0]).all()
    basis = fit.transform.basis
    np.testing.assert_allclose(basis @ jnp.swapaxes(basis, 1, 2), np.tile(np.eye(31), (3, 1, 1)), atol=1e-5)


def test_lsdt_with_a_growing_schedule_ends_low_from_every_basis_and_beats_dct_and_dwt(samples):
    x = jnp.asarray(samples, jnp.float32)
    starts = [jnp.asarray(b, jnp.float32) for b in (dct_matrix(31), haar_matrix(31))]
    fits = [fit_lsdt(x, start, growing(8, 300)) for start in starts]
    a, b = (np.asarray(fit.objective[-1]) for fit in fits)
    np.testing.assert_allclose(a, b, rtol=0.01)
    stuck = np.mean([np.asarray(fit_lsdt(x, start, constant(8, 300)).objective[-1]) for start in starts], 0)
    assert (np.maximum(a, b) < 0.9 * stuck).all()
    flat = samples.transpose(0, 2, 1)
    codes = {
        "lsdt": np.asarray(fits[0].transform.forward(x)).transpose(0, 2, 1),
        "dct": dct_matrix(31) @ flat,
        "dwt": haar_matrix(31) @ flat,
    }
    for share in range(1, 21):  # the 31 joints are at 21 places
        lost = {name: sum(((g - largest(g, share)) ** 2).sum() for g in groups) for name, groups in codes.items()}
        assert lost["lsdt"] < lost["dct"] and lost["lsdt"] < lost["dwt"], share


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exactly_the_largest_are_kept(dtype, double):
    g = noise(31, 200).astype(dtype)
    for count in (1, 8, 30, 31):
        np.testing.assert_array_equal(keep_largest(jnp.asarray(g), jnp.asarray(count)), largest(g, count))


@pytest.mark.parametrize("column", [np.ones(31), -np.ones(31), np.zeros(31), np.tile([2.0, -2, 1], 11)[:31]])
def test_ties_are_broken_not_kept(column):
    g = np.tile(column[:, None], (1, 4)).astype(np.float32)
    for count in (1, 8, 20):
        kept = np.asarray(keep_largest(jnp.asarray(g), jnp.asarray(count)))
        np.testing.assert_array_equal(kept, largest(g, count))  # the first of equals, as a stable sort has it
        assert (np.count_nonzero(kept, axis=0) == (count if column.any() else 0)).all()


def test_a_weight_of_two_is_a_sample_twice(double):
    m = noise(2, 150, 12, seed=4)
    weights = np.random.default_rng(0).integers(1, 4, 150)
    weighted = fit_lsdt(jnp.asarray(m), jnp.asarray(dct_matrix(12)), constant(4, 15), jnp.asarray(weights, float))
    repeated = fit_lsdt(jnp.asarray(m.repeat(weights, 1)), jnp.asarray(dct_matrix(12)), constant(4, 15))
    np.testing.assert_allclose(weighted.objective, repeated.objective, rtol=1e-9)
    np.testing.assert_allclose(weighted.transform.basis, repeated.transform.basis, atol=1e-8)


def test_lsdt_takes_all_coordinates_at_once(samples):
    x = jnp.asarray(samples[:, ::3].transpose(1, 2, 0).reshape(1, -1, 93), jnp.float32)
    fit = fit_lsdt(x, jnp.eye(93), growing(8, 20))
    y = fit.transform.forward(x)
    assert y.shape == x.shape
    np.testing.assert_allclose(fit.transform.inverse(y), x, atol=1e-3 * float(jnp.abs(x).max()))
    lost = ((np.asarray(y[0]).T - largest(np.asarray(y[0]).T, 8)) ** 2).sum()
    np.testing.assert_allclose(lost, fit.objective[-1, 0], rtol=1e-3)
    assert lost < ((np.asarray(x[0]).T - largest(np.asarray(x[0]).T, 8)) ** 2).sum() / 10


def test_lsdt_refuses_a_basis_of_another_size():
    with pytest.raises(ValueError, match="initial has shape"):
        fit_lsdt(jnp.zeros((1, 5, 4)), jnp.eye(3), constant(2, 3))


def test_schedules():
    np.testing.assert_array_equal(constant(8, 3), [8, 8, 8])
    ramp = growing(8, 300)
    assert (ramp[:90] == 1).all() and (np.diff(ramp) >= 0).all() and (ramp[210:] == 8).all() and ramp.max() == 8
