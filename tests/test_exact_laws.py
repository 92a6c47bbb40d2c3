"""Laws of a rig: what they predict, how they are found, and the trigonometry below them."""

import json
import math

import numpy as np
import pytest

from jaxmocap.codecs.exact.bends import Bent, bend_terms
from jaxmocap.codecs.exact.law import Joint, turned
from jaxmocap.codecs.exact.law_fit import causal, fit_chains, fit_geometry
from jaxmocap.codecs.exact.laws import (
    Aimed,
    Constrained,
    euler,
    law_from_spec,
    law_spec,
    residuals,
    restored,
)
from jaxmocap.codecs.exact.polynomials import Polynomial, monomials
from jaxmocap.codecs.exact.trigonometry import arc_tangent, sine_cosine

ZYX = (2, 1, 0)
SPINE = np.array([0.56, -1.58, 2.02])


def columns(joints):
    return [f"J{j} {axis}rotation" for j in range(joints) for axis in "ZYX"]


def joint(n, axes=ZYX):
    return Joint((3 * n, 3 * n + 1, 3 * n + 2), axes)


def wander(frames, count, seed, size):
    """Smooth random angles, in 1e-4 degrees."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / 40
    phase = rng.uniform(0, 2 * np.pi, (5, count, 1))
    pace = rng.uniform(0.2, 1.5, (5, count, 1))
    return size * np.sin(pace * time + phase).sum(0) / 2


def unit(vector):
    return np.array(vector) / np.linalg.norm(vector)


def about(axis, angle):
    """Rotation matrices about an axis, rows of [row][column] with a value a frame (Rodrigues' formula)."""
    x, y, z = unit(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.eye(3)[..., None] + cross[..., None] * sine + (cross @ cross)[..., None] * (1 - cosine)


def times(a, b):
    return np.einsum("ijt,jkt->ikt", a, b)


def table_of(*matrices):
    """Euler angles ZYX of the joints' rotation matrices, rounded."""
    angles = [a for m in matrices for a in euler(list(map(list, m)), ZYX)]
    return np.rint(np.stack(angles, 1)).astype(np.int32)


def radians(angle):
    return angle / 1.8e6 * np.pi


def rotation(angles):
    """Of angles about Z, Y and X."""
    z, y, x = (about(axis, radians(a)) for axis, a in zip(np.eye(3)[::-1], angles, strict=True))
    return times(times(z, y), x)


def bent_table(frames, sheets, least=0.0, seed=0, size=120_000.0):
    """Chains that keep a direction law, made with NumPy's own trigonometry."""
    angles = wander(frames, 7, seed, size)
    first, second = (rotation(angles[a : a + 3]) for a in (0, 3))
    e = np.tile(np.array([0.0, 1.0, 0.0])[:, None], frames)
    to_second = np.einsum("jit,jt->it", second, e)
    to_first = np.einsum("jit,jt->it", times(first, second), e)
    aims = []
    for sheet in sheets:
        p, q = 1 - (to_first * to_second).sum(0), 1 - to_second[1]
        aim = (sheet[0] + p) * to_first + (sheet[1] + q) * to_second + (sheet[2] - p - q / 2) * e
        aims.append(aim / np.linalg.norm(aim, axis=0))
    aim = aims[0] if len(aims) == 1 else np.where(1 - aims[0][1] < least, aims[1], aims[0])
    y = radians(angles[6] / 8)
    sine = aim[2] / np.cos(y)
    x = np.arcsin(sine)
    z = np.arctan2(aim[1], aim[0]) - np.arctan2(np.cos(x), np.sin(y) * np.sin(x))
    z = (z + np.pi) % (2 * np.pi) - np.pi
    third = np.stack([z, y, x]) / np.pi * 1.8e6
    return np.rint(np.concatenate([angles[:6], third])).astype(np.int32).T


def test_bent_chain_is_found():
    table = bent_table(10_000, [SPINE])
    laws = fit_chains(np.array_split(table[:8000], 20), columns(3), [])
    law = next(law for law in laws if isinstance(law, Bent))
    assert law.targets == (6, 8)
    np.testing.assert_allclose(law.coefficients[0, :, 0], SPINE, atol=2e-3)
    left = np.abs(np.stack(residuals(law, table[8000:], 4)))
    assert np.median(left) <= 1 and np.quantile(left, 0.98) <= 3


def test_bent_chain_of_two_sheets_is_found():
    sheets = [np.array([0.3, -0.9, 1.6]), np.array([0.16, -0.46, 1.3])]
    table = bent_table(6000, sheets, least=0.008, size=80_000.0)
    laws = fit_chains(np.array_split(table, 15), columns(3), [])
    law = next(law for law in laws if isinstance(law, Bent))
    assert len(law.coefficients) == 2
    assert law.least == pytest.approx(0.008, rel=0.02)
    assert np.quantile(np.abs(np.stack(residuals(law, table, 4))), 0.85) <= 3


@pytest.mark.parametrize("axes", [(2, 1, 0), (0, 1, 2), (1, 2, 0), (0, 2, 1)])
def test_bent_points_the_bone_where_it_says(axes):
    """R3 turns the middle axis onto the aim, for any order of the axes."""
    chain = (joint(0), joint(1), joint(2, axes))
    law = Bent(chain, 1, 0.0, np.array([[[0.5, 0.1, 0, 0], [-1.5, 0, 0.2, 0], [2.0, 0, 0, 0.1]]]))
    angles = wander(50, 9, 3, 100_000.0)
    angles[6], angles[8] = law.predict(angles)
    bone = [np.full(50, float(n == axes[1])) for n in range(3)]
    for k in (2, 1, 0):
        bone = turned(bone, axes[k], angles[6 + k])
    np.testing.assert_allclose(np.stack(bone), np.stack(law.aims(angles)[0]), atol=1e-12)


def hinge_table(frames=3000):
    """A joint that turns about a fixed axis that is none of the coordinates'."""
    return table_of(about((1.0, 0.1, -0.05), radians(wander(frames, 1, 1, 300_000.0)[0])))


def two_axes(frames, seed):
    """Joints that turn about two axes: R = about(a) about(b)."""
    turns = radians(wander(frames, 2, seed, 250_000.0))
    return times(about((0.0, 0.1, 1.0), turns[0]), about((1.0, 0.0, 0.1), turns[1]))


def test_hinge_is_found():
    laws = fit_geometry(hinge_table(), columns(1))
    assert len({t for law in laws for t in law.targets}) == 2
    table = hinge_table(4000)[3000:]
    assert max(np.abs(r).max() for law in laws for r in residuals(law, table, 4)) <= 3


def test_joint_of_two_axes_is_found():
    table = table_of(two_axes(4000, 2))
    (law,) = fit_geometry(table[:3000], columns(1))
    assert isinstance(law, Constrained)
    assert np.quantile(np.abs(residuals(law, table[3000:], 4)[0]), 0.9) <= 3


def test_joint_that_aims_is_found():
    """The second joint points its d where the first one, which is free, points k."""
    source = rotation(wander(6000, 3, 4, 150_000.0))
    before, after = (about(axis, np.full(6000, 0.2)) for axis in ((1, 1, 0), (0, 1, 1)))
    x, y, z = np.einsum("jit,jkt,k->it", before, source, unit((0.1, 0.98, 0.17)))
    tilt, turn = np.arcsin(z), np.arctan2(-x, y)  # of Rz(turn) Rx(tilt), which points e_y there
    aimed = times(times(before, times(about((0, 0, 1), turn), about((1, 0, 0), tilt))), after)
    table = table_of(source, aimed)
    laws = fit_geometry(table[:5000], columns(2))
    targets = {t for law in laws for t in law.targets}
    assert any(isinstance(law, Aimed) for law in laws) and targets == {3, 4, 5}
    for law in causal(laws):
        assert np.quantile(np.abs(np.stack(residuals(law, table[5000:], 4))), 0.9) <= 3


def test_free_joints_have_no_law():
    table = np.rint(wander(3000, 9, 7, 200_000.0)).astype(np.int32).T
    assert fit_geometry(table, columns(3)) == []


LAWS = [
    Constrained(joint(0), 2, (0, 1), (1.0, 0.25, 0.0), (0.0, 1.0, 0.5), 0.125, -1),
    Aimed(joint(1), joint(0), 1, (0.0, 1.0, 0.1), (0.0, 1.0, 0.2), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01, 1),
    Polynomial((6, 7), (0, 1, 2), (90_000, 80_000, 70_000), 2, np.arange(20.0).reshape(10, 2) * 1000),
    Bent((joint(0), joint(1), joint(2)), 1, 0.01, np.linspace(-1, 1.3, 24).reshape(2, 3, 4)),
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_law_round_trips(law):
    """By JSON and numbers, and the targets by what it leaves of them."""
    again = law_from_spec(json.loads(json.dumps(law_spec(law))), law.numbers)
    assert type(again) is type(law) and law_spec(again) == law_spec(again.with_numbers(law.numbers))
    assert again.numbers == law.numbers and again.targets == law.targets and again.inputs == law.inputs
    table = np.rint(wander(60, 9, 5, 200_000.0)).astype(np.int32).T
    for decimals in (4, 6):
        left = residuals(law, table, decimals)
        for column, want in zip(restored(again, table, left, decimals), law.targets, strict=True):
            np.testing.assert_array_equal(column, table[:, want])


def test_law_of_no_known_kind_is_refused():
    with pytest.raises(KeyError):
        law_from_spec({}, [])
    with pytest.raises(ValueError, match="the kind 'spiral'"):
        law_from_spec({"law": "spiral"}, [])


def test_monomials_are_products():
    angles = np.array([[3000.0, -2000.0], [500.0, 8000.0]])
    x, y = angles / 4000
    y = np.clip(y, -1.5, 1.5)
    want = np.stack([np.ones(2), y, x, y * y, x * y, x * x])
    np.testing.assert_allclose(monomials(angles, (4000, 4000), 2) / 2**20, want, atol=2e-6)


def test_bend_terms_are_products():
    arms = [list(unit(v)[:, None]) for v in ([0.1, 1, 0.2], [0.3, 1, 0], [0, 1, 0])]
    p, q, r = (1 - np.dot(np.ravel(arms[i]), np.ravel(arms[j])) for i, j in ((0, 1), (1, 2), (0, 2)))
    np.testing.assert_allclose(np.stack(bend_terms(arms, 2))[:, 0], [1, r, q, p, r * r, q * r, q * q, p * r, p * q, p * p])


def test_laws_in_a_circle_are_refused():
    forth = Polynomial((0,), (1,), (1,), 1, np.zeros((2, 1)))
    back = Polynomial((1,), (0,), (1,), 1, np.zeros((2, 1)))
    with pytest.raises(ValueError, match="circle"):
        list(causal([forth, back]))


ANGLES = np.concatenate([np.linspace(-4e6, 4e6, 20_011), [0.0, 9e5, -9e5, 1.8e6, 450_000.0, 2.0**39]])


def test_sine_and_cosine():
    sine, cosine = sine_cosine(ANGLES)
    exact = radians(np.remainder(ANGLES, 3.6e6))
    np.testing.assert_allclose(sine, np.sin(exact), rtol=0, atol=1.5e-15)
    np.testing.assert_allclose(cosine, np.cos(exact), rtol=0, atol=1.5e-15)


def test_arc_tangent():
    """To 1e-9 of 1e-4 degrees, as doubles allow."""
    x, y = np.cos(radians(ANGLES[:-6])), np.sin(radians(ANGLES[:-6]))
    np.testing.assert_allclose(arc_tangent(y, x), np.degrees(np.arctan2(y, x)) * 1e4, rtol=1e-15, atol=1e-9)
    edges = [(0.0, 0.0, 0.0), (0.0, -1.0, 1.8e6), (1.0, 0.0, 9e5), (-1.0, 0.0, -9e5), (0.0, 1.0, 0.0)]
    for b, a, want in edges:
        assert math.isclose(arc_tangent(np.array([b]), np.array([a]))[0], want, abs_tol=1e-9)


def test_trigonometry_does_not_depend_on_the_layout():
    spread = np.zeros((len(ANGLES), 3))
    spread[:, 1] = ANGLES
    sine, cosine = sine_cosine(ANGLES)
    arc = arc_tangent(sine, cosine)
    for layout in (spread[:, 1], np.asfortranarray(spread)[:, 1], ANGLES[::-1][::-1]):
        s, c = sine_cosine(layout)
        assert s.tobytes() == sine.tobytes() and c.tobytes() == cosine.tobytes()
        assert arc_tangent(s, c).tobytes() == arc.tobytes()
    for n in range(0, len(ANGLES), 997):
        s, c = sine_cosine(ANGLES[n : n + 1])
        assert s[0] == sine[n] and c[0] == cosine[n] and arc_tangent(s, c)[0] == arc[n]
