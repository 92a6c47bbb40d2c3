"""The procedural walk is physically plausible: what a viewer would notice, and what the demo relies on."""

from typing import NamedTuple

import jax
import numpy as np
import pytest

from jaxmocap import Motion
from jaxmocap.kinematics import pose
from jaxmocap.synthesis import cmu_like_skeleton, walk

SEEDS = (0, 1, 3)
METRE = 100 / 5.6444


class Seen(NamedTuple):
    motion: Motion
    positions: np.ndarray
    rotations: np.ndarray
    ends: np.ndarray


@pytest.fixture(scope="module")
def walks() -> list[Seen]:
    with jax.enable_x64(True):
        return [Seen(m, *(np.asarray(x) for x in pose(m))) for m in map(walk, SEEDS)]


def joint(seen: Seen, name: str) -> np.ndarray:
    return seen.positions[:, seen.motion.skeleton.names.index(name)]


def sole(seen: Seen, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Ball and toe tip of a foot."""
    skeleton = seen.motion.skeleton
    tip = skeleton.end_joints.index(skeleton.names.index(f"{side}ToeBase"))
    return joint(seen, f"{side}ToeBase"), seen.ends[:, tip]


def on_the_floor(point: np.ndarray) -> np.ndarray:
    """Frames in which the point is as low as it ever is, and in the next frame too."""
    low = np.abs(point[:, 1] - point[:, 1].min()) < 1e-6
    return low[:-1] & low[1:]


def test_skeleton_has_the_layout_of_the_cmu_conversion(data_dir):
    text = (data_dir / "cmu_bvh" / "09" / "09_06.bvh").read_text()
    hierarchy = text[: text.index("MOTION")].split()
    names = [hierarchy[n + 1] for n, word in enumerate(hierarchy) if word in ("ROOT", "JOINT")]
    skeleton = cmu_like_skeleton()
    assert list(skeleton.names) == names
    parents, stack, joints = [], [-1], -1
    for n, word in enumerate(hierarchy):
        if word in ("ROOT", "JOINT"):
            parents.append(stack[-1])
            joints += 1
        elif word == "{":
            stack.append(joints)
        elif word == "}":
            stack.pop()
        elif word == "CHANNELS":
            count = int(hierarchy[n + 1])
            assert skeleton.channels[joints] == tuple(hierarchy[n + 2 : n + 2 + count])
    assert list(skeleton.parents) == parents
    end_joints = [names.index(name) for name in ("LeftToeBase", "RightToeBase", "Head", "LeftHandIndex1", "LThumb")]
    assert list(skeleton.end_joints[:5]) == end_joints


def test_people_differ_a_little_and_sides_less():
    people = [cmu_like_skeleton(seed) for seed in range(8)]
    lengths = np.array([np.linalg.norm(p.offsets, axis=1) for p in people])
    assert people[0].same_rig(people[1])
    bones = lengths[0] > 0
    spread = lengths[:, bones].std(0) / lengths[:, bones].mean(0)
    assert (0.005 < spread).all() and (spread < 0.1).all()
    left = [n for n, name in enumerate(people[0].names) if name.startswith(("Left", "LHip", "LThumb"))]
    right = [n for n, name in enumerate(people[0].names) if name.startswith(("Right", "RHip", "RThumb"))]
    np.testing.assert_allclose(lengths[:, left], lengths[:, right], rtol=0.02)


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_planted_feet_do_not_slide(walks, side):
    for seen in walks:
        ball, tip = sole(seen, side)
        ankle = joint(seen, f"{side}Foot")
        planted = on_the_floor(ball) & on_the_floor(tip)
        flat = planted & on_the_floor(ankle)
        for point, held in ((ball, planted), (tip, planted), (ankle, flat)):
            slide = np.linalg.norm(np.diff(point, axis=0), axis=1)[held]
            assert slide.max() * 5.6444 < 1e-5
        assert 0.2 < flat.mean() < planted.mean() < 0.9


def test_somebody_always_stands_and_the_floor_holds(walks):
    for seen in walks:
        stands = on_the_floor(sole(seen, "Left")[0]) | on_the_floor(sole(seen, "Right")[0])
        assert stands.all()
        assert min(seen.positions[..., 1].min(), seen.ends[..., 1].min()) > 0


def test_joints_move_smoothly(walks):
    for seen in walks:
        points = np.concatenate([seen.positions, seen.ends], 1) / METRE
        velocity = np.diff(points, axis=0) / seen.motion.frame_time
        acceleration = np.diff(velocity, axis=0) / seen.motion.frame_time
        assert np.isfinite(seen.motion.values).all()
        assert np.linalg.norm(velocity, axis=-1).max() < 7
        assert np.linalg.norm(acceleration, axis=-1).max() < 100
        assert np.abs(np.diff(seen.motion.values[:, 3:], axis=0)).max() < 6  # no jump of an Euler angle


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_knees_bend_forward_and_stay_in_range(walks, side):
    for seen in walks:
        hip, knee, ankle = (joint(seen, f"{side}{name}") for name in ("UpLeg", "Leg", "Foot"))
        toes = sole(seen, side)[0] - ankle
        straight = hip + (ankle - hip) * 0.5
        toes[:, 1] = 0
        assert (((knee - straight) * toes).sum(1) > 0).all()
        thigh, shank = knee - hip, ankle - knee
        cosine = (thigh * shank).sum(1) / np.linalg.norm(thigh, axis=1) / np.linalg.norm(shank, axis=1)
        bend = np.degrees(np.arccos(cosine))
        assert 5 < bend.min() and 45 < bend.max() < 110


def test_walks_turns_and_stops(walks):
    for seen in walks:
        forward = seen.rotations[:, 0, :, 2]
        heading = np.degrees(np.arctan2(forward[:, 0], forward[:, 2]))
        speed = np.linalg.norm(np.diff(joint(seen, "Hips")[:, [0, 2]], axis=0), axis=1) / METRE / seen.motion.frame_time
        assert np.ptp(heading) > 45
        assert speed.max() > 0.7 and speed.min() < 0.2


def test_arms_swing_against_the_legs(walks):
    for seen in walks:
        forward = seen.rotations[:, 0, :, 2]
        ankles = ((joint(seen, "LeftFoot") - joint(seen, "RightFoot")) * forward).sum(1)
        wrists = ((joint(seen, "LeftHand") - joint(seen, "RightHand")) * forward).sum(1)
        assert np.corrcoef(ankles, wrists)[0, 1] < -0.5


def test_seed_decides():
    np.testing.assert_array_equal(walk(7, 1.0).values, walk(7, 1.0).values)
    assert not np.array_equal(walk(7, 1.0).values, walk(8, 1.0).values)
    assert not np.array_equal(cmu_like_skeleton(7).offsets, cmu_like_skeleton(8).offsets)
    np.testing.assert_array_equal(walk(7, 1.0).skeleton.offsets, cmu_like_skeleton(7).offsets)


@pytest.mark.parametrize("seconds, rate, frames", [(8.0, 120.0, 960), (2.5, 30.0, 75), (0.01, 120.0, 1)])
def test_length_and_rate(seconds, rate, frames):
    motion = walk(0, seconds, rate)
    assert motion.values.shape == (frames, 96)
    assert motion.frame_time == 1 / rate and motion.unit_cm == 5.6444
    assert np.isfinite(motion.values).all()


def test_no_frame_is_refused():
    with pytest.raises(ValueError, match="at least one frame"):
        walk(0, seconds=0.0)
