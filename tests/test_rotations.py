"""Rotations against scipy, and the laws that hold whatever the angles."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from jaxmocap import rotations as rot

ORDERS = ["".join(o) for o in product("XYZ", repeat=3) if o[0] != o[1] and o[1] != o[2]]
TURNS = Rotation.random(200, rng=np.random.default_rng(0))
DEGENERATE = Rotation.from_euler(
    "ZYX", [(z, y, x) for z in (0, 90, 180, -90) for y in (0, 90, 180, -90) for x in (0, 90, 180, -90)], degrees=True
)
ALL = Rotation.concatenate([TURNS, DEGENERATE])

components = st.floats(-4.0, 4.0).map(lambda x: round(x, 3))
vectors = arrays(np.float64, 3, elements=components)
batches = arrays(np.float64, (8, 3), elements=components)
laws = settings(max_examples=30, deadline=None)
exp, log, swing, six = map(jax.jit, (rot.from_rotation_vector, rot.to_rotation_vector, rot.swing, rot.from_sixd))
multiply, apply = map(jax.jit, (rot.multiply, rot.apply))


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def matrices(rotation: Rotation = ALL) -> jax.Array:
    return jnp.asarray(rotation.as_matrix())


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def assert_rotation(m: jax.Array | np.ndarray, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(m @ np.swapaxes(m, -1, -2), np.broadcast_to(np.eye(3), m.shape), atol=atol)
    np.testing.assert_allclose(np.linalg.det(m), 1.0, atol=atol)


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_agree_with_scipy(order):
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (100, 3))
    expected = Rotation.from_euler(order, angles)
    m = rot.from_euler(jnp.asarray(angles), order)
    np.testing.assert_allclose(m, expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rot.to_euler(m, order), expected.as_euler(order), atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_give_the_rotation_back_even_at_and_near_the_lock(order):
    off = (0, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
    middles = [sign * (lock + d) for sign in (1, -1) for lock in (0, np.pi / 2, np.pi) for d in off]
    angles = np.array([(a, b, c) for a in (0, 0.7, -2.9) for b in middles for c in (0, 1.1, 3.0)])
    m = rot.from_euler(jnp.asarray(angles), order)
    trip = lambda r: rot.from_euler(rot.to_euler(r, order), order)  # noqa: E731
    np.testing.assert_allclose(trip(m), m, atol=3e-12)
    single = m.astype(jnp.float32)
    np.testing.assert_allclose(trip(single), single, atol=3e-6)


@pytest.mark.parametrize("order", ["ZYX", "XYX"])
def test_euler_lock_puts_the_third_angle_to_zero(order):
    lock = np.pi / 2 if order == "ZYX" else 0.0
    m = rot.from_euler(jnp.array([0.4, lock, 0.3]), order)
    first, middle, last = rot.to_euler(m, order)
    assert last == 0.0
    np.testing.assert_allclose(middle, lock, atol=1e-8)
    np.testing.assert_allclose(abs(first), 0.1 if order == "ZYX" else 0.7, atol=1e-12)


def test_euler_takes_any_number_of_axes():
    np.testing.assert_array_equal(rot.from_euler(jnp.zeros((2, 0)), ""), np.tile(np.eye(3), (2, 1, 1)))
    two = rot.from_euler(jnp.array([0.3, 0.8]), "XZ")
    np.testing.assert_allclose(two, Rotation.from_euler("XZ", [0.3, 0.8]).as_matrix(), atol=1e-15)


@pytest.mark.parametrize("order", ["XXY", "XYY", "XY", "xyz", "XYZX"])
def test_euler_order_is_checked(order):
    with pytest.raises(ValueError, match="order"):
        rot.to_euler(jnp.eye(3), order)


def test_euler_columns_are_counted():
    with pytest.raises(ValueError, match="2 columns"):
        rot.from_euler(jnp.zeros((5, 2)), "XYZ")


def test_quaternions_agree_with_scipy():
    q = rot.to_quaternion(matrices())
    expected = ALL.as_quat(scalar_first=True)
    assert (q[:, 0] >= 0).all()
    # q and -q are one rotation: at half turns scipy may take the other.
    np.testing.assert_allclose(np.abs((np.asarray(q) * expected).sum(-1)), 1.0, atol=1e-14)
    np.testing.assert_allclose(rot.from_quaternion(jnp.asarray(expected)), ALL.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rot.from_quaternion(3.7 * q), ALL.as_matrix(), atol=1e-13)


def test_rotation_vectors_agree_with_scipy():
    np.testing.assert_allclose(log(matrices())[: len(TURNS)], TURNS.as_rotvec(), atol=1e-12)
    v = log(matrices())
    assert np.linalg.norm(v, axis=-1).max() < np.pi + 1e-12
    np.testing.assert_allclose(exp(v), ALL.as_matrix(), atol=1e-12)
    long = np.random.default_rng(2).normal(size=(50, 3)) * 4
    np.testing.assert_allclose(
        rot.from_rotation_vector(jnp.asarray(long)), Rotation.from_rotvec(long).as_matrix(), atol=1e-13
    )


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-6, 0.99e-4, 1.01e-4, 1e-3, np.pi - 1e-7])
def test_small_and_large_rotation_vectors_come_back(size):
    v = size * np.array([[2, -1, 2], [0, 0, 3], [-3, 0, 0]]) / 3
    m = rot.from_rotation_vector(jnp.asarray(v))
    np.testing.assert_allclose(m, Rotation.from_rotvec(v).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rot.to_rotation_vector(m), v, atol=1e-14)


@laws
@given(batches, batches)
def test_product_and_inverse(a, b):
    x, y = exp(a), exp(b)
    assert_rotation(x)
    xy = multiply(x, y)
    np.testing.assert_allclose(xy, np.asarray(x) @ np.asarray(y), atol=1e-14)
    np.testing.assert_allclose(rot.transpose(xy), multiply(rot.transpose(y), rot.transpose(x)), atol=1e-14)
    np.testing.assert_allclose(apply(xy, b), apply(x, apply(y, b)), atol=1e-13)
    np.testing.assert_allclose(apply(rot.transpose(x), apply(x, b)), b, atol=1e-13)


@laws
@given(batches)
def test_exponential_and_logarithm(v):
    m = exp(v)
    back = log(m)
    np.testing.assert_allclose(exp(back), m, atol=1e-12)
    np.testing.assert_allclose(apply(m, back), back, atol=1e-12)
    angle = np.arccos(np.clip((np.trace(m, axis1=-2, axis2=-1) - 1) / 2, -1, 1))
    np.testing.assert_allclose(np.linalg.norm(back, axis=-1), angle, atol=1e-6)


@laws
@given(batches, batches)
def test_swing_turns_a_to_b_by_the_smallest_angle(a, b):
    m = np.asarray(swing(a, b))
    assert_rotation(m)
    zero = ~a.any(1) | ~b.any(1)
    np.testing.assert_array_equal(m[zero], np.broadcast_to(np.eye(3), m[zero].shape))
    x, y, m = unit(a[~zero]), unit(b[~zero]), m[~zero]
    np.testing.assert_allclose((m @ x[..., None])[..., 0], y, atol=3e-8)
    angle = 2 * np.arctan2(np.linalg.norm(x - y, axis=1), np.linalg.norm(x + y, axis=1))
    np.testing.assert_allclose(Rotation.from_matrix(m).magnitude(), angle, atol=1e-7)


@pytest.mark.parametrize("dtype, atol", [(np.float64, 3e-8), (np.float32, 6e-4)])
def test_swing_survives_opposite_directions(dtype, atol):
    """Good to the root of the precision, where the axis is lost to rounding."""
    a = np.array([(1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1, 1), (-0.6, 0.8, 0), (3, -2, 1)], dtype)
    for off in (0.0, 1e-10, 1e-7, 1e-4, 1e-3, 1e-2):
        b = -a + dtype(off) * np.array([0.3, -0.5, 0.8], dtype)
        m = swing(a, b)
        assert m.dtype == dtype
        np.testing.assert_allclose(apply(m, unit(a)), unit(b), atol=atol)
        assert_rotation(m, 8 * float(np.finfo(dtype).eps))


@laws
@given(arrays(np.float64, 6, elements=components))
def test_sixd_projects_onto_rotations(d):
    x, y = d[:3], d[3:]
    if np.linalg.norm(np.cross(x, y)) < 1e-3 * np.linalg.norm(x) * np.linalg.norm(y) or not x.any() or not y.any():
        return  # parallel vectors span no frame
    m = six(d)
    assert_rotation(m)
    np.testing.assert_allclose(six(np.concatenate([m[:, 0], m[:, 1]])), m, atol=1e-12)
    np.testing.assert_allclose(m[:, 0], x / np.linalg.norm(x), atol=1e-12)
    assert np.dot(m[:, 1], y) > 0


def test_sixd_of_a_rotation_is_its_first_columns():
    d = rot.to_sixd(matrices())
    np.testing.assert_array_equal(d, np.concatenate([ALL.as_matrix()[..., 0], ALL.as_matrix()[..., 1]], -1))
    np.testing.assert_allclose(rot.from_sixd(d), ALL.as_matrix(), atol=1e-14)


@laws
@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(np.asarray(rot.skew(jnp.asarray(a))) @ b, np.cross(a, b), atol=1e-13)


def test_about_axis_broadcasts_axis_and_angle():
    axis = np.array([[2, -1, 2], [0, 3, 0]]) / 3
    angle = np.random.default_rng(3).uniform(-4, 4, (5, 2))
    expected = Rotation.from_rotvec((axis * angle[..., None]).reshape(-1, 3)).as_matrix().reshape(5, 2, 3, 3)
    np.testing.assert_allclose(rot.about_axis(jnp.asarray(axis), jnp.asarray(angle)), expected, atol=1e-14)


def test_normalise_keeps_zero():
    v = jnp.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(rot.normalise(v), [[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]], atol=1e-15)
    assert np.isfinite(jax.jacobian(rot.normalise)(v)).all()


UNARY = {
    "from_rotation_vector": (rot.from_rotation_vector, TURNS.as_rotvec()),
    "to_rotation_vector": (rot.to_rotation_vector, TURNS.as_matrix()),
    "to_quaternion": (rot.to_quaternion, TURNS.as_matrix()),
    "from_sixd": (rot.from_sixd, TURNS.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)),
    "to_euler": (lambda m: rot.to_euler(m, "YXZ"), TURNS.as_matrix()),
    "swing": (lambda v: rot.swing(v, v[..., ::-1] + 1), TURNS.as_rotvec()),
}


@pytest.mark.parametrize("name", UNARY)
def test_compiled_batched_and_single_calls_agree(name):
    function, x = UNARY[name][0], jnp.asarray(UNARY[name][1][:6])
    whole, single = function(x), jax.jit(function)
    np.testing.assert_allclose(jax.jit(jax.vmap(function))(x), whole, atol=1e-14)
    np.testing.assert_allclose([single(v) for v in x], whole, atol=1e-14)
    np.testing.assert_allclose(single(x.reshape(2, 3, *x.shape[1:])).reshape(whole.shape), whole, atol=1e-14)


HALF_TURNS = [np.diag(d) for d in ((1.0, -1, -1), (-1.0, 1, -1), (-1.0, -1, 1))]
HARD = np.stack([np.eye(3), *HALF_TURNS, Rotation.from_euler("ZYX", [0.3, np.pi / 2, 0]).as_matrix()])


def slopes(function, x) -> np.ndarray:
    """Jacobians at every row of x."""
    return np.asarray(jax.jit(jax.vmap(jax.jacrev(function)))(jnp.asarray(x)))


@pytest.mark.parametrize("order", ["ZYX", "YZX", "XYX", "XZX"])
def test_euler_gradients_are_finite(order):
    assert np.isfinite(slopes(lambda r: rot.to_euler(r, order), HARD)).all()


def test_gradients_are_finite_at_the_identity_and_at_half_turns():
    x = jnp.array([1.0, 0.0, 0.0])

    def everything(r):
        y = rot.apply(r, x)
        swings = rot.swing(jnp.stack([x, x * 0, y]), jnp.stack([y, y, x * 0]))
        outputs = (rot.to_quaternion(r), rot.to_rotation_vector(r), rot.from_sixd(rot.to_sixd(r)), swings)
        return sum(output.sum() for output in outputs)

    assert np.isfinite(jax.jit(jax.vmap(jax.grad(everything)))(jnp.asarray(HARD))).all()


slope_of_exp = jax.jit(jax.jacrev(rot.from_rotation_vector))


@pytest.mark.parametrize("v", [(0, 0, 0), (1e-9, 0, 0), (1e-4, 2e-4, 0), (0.3, -1.0, 2.0), (3.1, 0.1, 0)])
def test_gradient_of_the_exponential_map(v):
    """d/dt exp(v + t e) at t = 0 is exp(v) [J_r(v) e]x with J_r the right Jacobian of SO(3), here as a series."""
    k = np.cross(np.array(v, float), np.eye(3)).T
    right, term = np.zeros((3, 3)), np.eye(3)
    for n in range(1, 40):
        right, term = right + term, term @ -k / (n + 1)
    m = Rotation.from_rotvec(v).as_matrix()
    expected = np.stack([m @ np.cross(c, np.eye(3)).T for c in right.T], -1)
    for dtype, atol in ((np.float64, 1e-7), (np.float32, 3e-6)):
        seen = slope_of_exp(jnp.array(v, dtype))
        np.testing.assert_allclose(seen, expected, atol=atol)


def test_round_trip_through_the_logarithm_has_the_identity_as_gradient():
    trip = jax.jit(jax.jacrev(lambda v: rot.to_rotation_vector(rot.from_rotation_vector(v))))
    for v in ((0, 0, 0), (1e-6, 0, 0), (0.2, 0.4, -0.1), (2, -1, 1.5)):
        np.testing.assert_allclose(trip(jnp.array(v, float)), np.eye(3), atol=1e-7)
