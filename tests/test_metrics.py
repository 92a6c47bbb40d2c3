"""Distortion measures against values worked out by hand, and what each of them sees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import ArrayLike

from jaxmocap import Motion, Skeleton, metrics
from jaxmocap.kinematics import pose
from jaxmocap.synthesis import walk

# Two frames, two joints; the distances between `A` and `B` are 0, 5 in the first frame and 1, 3 in the second.
A = jnp.zeros((2, 2, 3))
B = jnp.array([[[0, 0, 0], [3, 4, 0]], [[0, 1, 0], [1, 2, 2]]], float)


def arm(angles: ArrayLike, unit_cm: float | None = 2.0) -> Motion:
    """Two bones of 10 units along x, an end site 5 further; `angles` are the x, y, z turns of shoulder and elbow."""
    channels = [("Xrotation", "Yrotation", "Zrotation")] * 2
    along = np.array([[0, 0, 0], [10, 0, 0], [5, 0, 0]], float)
    skeleton = Skeleton(["shoulder", "elbow"], [-1, 0], along[:2], channels, [1], along[2:])
    return Motion(skeleton, np.asarray(angles, float).reshape(-1, 6), 0.01, unit_cm)


def test_hand_computed_values():
    np.testing.assert_allclose(metrics.joint_error(A, B), [[0, 5], [1, 3]])
    assert metrics.mean_error(A, B) == 9 / 4
    assert metrics.max_error(A, B) == 5
    np.testing.assert_allclose(metrics.rms_error(A, B), np.sqrt(35 / 4), rtol=1e-6)


def test_arms_is_the_mean_over_frames_of_the_root_mean_square_over_joints():
    """Gu et al. 2009, eq. 3: the root is taken a frame, so it is neither the mean nor the overall rms."""
    np.testing.assert_allclose(metrics.arms_error(A, B), (np.sqrt(25 / 2) + np.sqrt(10 / 2)) / 2, rtol=1e-6)


@pytest.mark.parametrize("name", ["mean_error", "max_error", "rms_error", "arms_error"])
def test_each_measure_is_a_distance_and_keeps_batch_axes(name):
    measure = getattr(metrics, name)
    x, y, z = jax.random.normal(jax.random.key(0), (3, 4, 6, 5, 3))
    assert measure(x, y).shape == (4,)
    np.testing.assert_allclose(measure(x, y), [measure(a, b) for a, b in zip(x, y, strict=True)], rtol=1e-6)
    np.testing.assert_array_equal(measure(x, y), measure(y, x))
    np.testing.assert_array_equal(measure(x, x), 0)
    np.testing.assert_allclose(measure(3 * x, 3 * y), 3 * measure(x, y), rtol=1e-6)
    assert (measure(x, z) <= measure(x, y) + measure(y, z) + 1e-6).all()


def test_measures_are_ordered():
    x, y = jax.random.normal(jax.random.key(1), (2, 20, 5, 3))
    mean, arms, rms, most = (getattr(metrics, f"{n}_error")(x, y) for n in ("mean", "arms", "rms", "max"))
    assert mean < arms < rms < most


@pytest.mark.parametrize("name", ["mean_error", "max_error", "rms_error", "arms_error"])
def test_gradients_are_finite_even_at_zero_error(name):
    slope = jax.jit(jax.grad(lambda b: getattr(metrics, name)(A, b)))
    assert np.isfinite(slope(A)).all()
    assert np.isfinite(slope(B)).all()
    assert np.abs(slope(B)).max() > 0


def test_gradient_of_the_mean_is_the_direction_of_each_error():
    slope = jax.grad(lambda b: metrics.mean_error(A, b))(B)
    np.testing.assert_allclose(slope[0, 1], np.array([3, 4, 0]) / 5 / 4, rtol=1e-6)
    np.testing.assert_array_equal(slope[0, 0], 0)


def test_shell_points_stand_three_cm_off_along_each_axis():
    motion = arm([0, 0, 0, 0, 0, 90])
    points = metrics.shell_points(pose(motion), (1,), 2.0)
    assert points.shape == (1, 9, 3)
    at = np.repeat([[0, 0, 0], [20, 0, 0], [20, 10, 0]], 3, 0)
    turned = np.array([[0, 3, 0], [-3, 0, 0], [0, 0, 3]])
    expected = at + np.concatenate([3 * np.eye(3), turned, turned])
    np.testing.assert_allclose(points[0], expected, atol=1e-5)


@pytest.mark.parametrize("angles", [[0, 0, 0, 30, 0, 0], [0, 0, 0, 0, 0, 30]], ids=["twist", "leaf rotation"])
def test_shell_sees_what_joints_do_not(angles):
    report = metrics.compare(arm([0] * 6), arm(angles))
    assert report["mean_cm"] == report["max_cm"] == report["rms_cm"] == report["arms"] == 0
    chord = 2 * 3 * np.sin(np.radians(15))
    if angles[3]:  # about the bone: two of three points move at elbow and end
        assert report["shell_max_cm"] == pytest.approx(chord, rel=1e-5)
        assert report["shell_mean_cm"] == pytest.approx(4 * chord / 9, rel=1e-5)
    else:
        assert report["shell_max_cm"] > 2 * 5 * 2 * np.sin(np.radians(15))


def test_a_small_turn_of_the_shell_is_its_arc():
    report = metrics.compare(arm([0] * 6), arm([0, 0, 0, 0.01, 0, 0]))
    assert report["shell_max_cm"] == pytest.approx(3 * np.radians(0.01), rel=1e-2)


def test_compare_reports_centimetres():
    report = metrics.compare(arm([[0] * 6, [0] * 6]), arm([[0] * 6, [0, 0, 90, 0, 0, 0]]))
    elbow = 20 * np.sqrt(2)
    assert report["per_joint_cm"] == pytest.approx([0, elbow / 2], rel=1e-5)
    assert report["mean_cm"] == pytest.approx(elbow / 4, rel=1e-5)
    assert report["max_cm"] == pytest.approx(elbow, rel=1e-5)
    assert report["rms_cm"] == pytest.approx(elbow / 2, rel=1e-5)
    assert report["arms"] == pytest.approx(elbow / np.sqrt(2) / 2, rel=1e-5)


def test_compare_without_a_unit_is_in_file_units():
    report = metrics.compare(arm([0] * 6, None), arm([0, 0, 90, 0, 0, 0], None))
    assert report["max_cm"] == pytest.approx(10 * np.sqrt(2), rel=1e-5)


def test_positions_only_motion_has_no_shell():
    moving = Motion.from_positions(np.ones((3, 2, 3)), ["shoulder", "elbow"], 0.01)
    report = metrics.compare(moving, moving)
    assert report["shell_mean_cm"] is None and report["shell_max_cm"] is None
    assert report["mean_cm"] == 0


def test_compare_refuses_what_does_not_match():
    motion = walk(0, 0.1)
    with pytest.raises(ValueError, match="12 and 10 frames"):
        metrics.compare(motion, motion.frames(2))
    with pytest.raises(ValueError, match="31 and 2 joints"):
        metrics.compare(motion, arm([0] * 6))
