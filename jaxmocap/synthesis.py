"""Procedural motion for the demo and for tests without data: a figure that walks, turns, stops and looks around.

Footsteps are planned along a smooth path, and two-bone inverse kinematics hangs the legs between the hips and the feet.
Everything is a sum of eased steps in time, so every joint moves with bounded acceleration.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .motion import Motion
from .skeleton import POSITION_CHANNELS, Skeleton

_Scalars = Float[np.ndarray, " frames"]
_Times = Float[np.ndarray, " n"]
_Vectors = Float[np.ndarray, "frames 3"]
_Rotations = Float[np.ndarray, "frames 3 3"]

UNIT_CM = 5.6444
_METRE = 100 / UNIT_CM
_EULER = ("Zrotation", "Yrotation", "Xrotation")
_SIDES = {"Left": 1.0, "Right": -1.0}
_SOLE, _HEEL = 0.35, 0.7  # the ball of the foot above the floor, the heel behind the ankle, in file units

_LEG = (
    ("{s}HipJoint", "Hips", (0, 0, 0)),
    ("{side}UpLeg", "{s}HipJoint", (1.6, -1.8, 0.4)),
    ("{side}Leg", "{side}UpLeg", (2.5, -6.9, 0)),
    ("{side}Foot", "{side}Leg", (2.5, -6.9, 0)),
    ("{side}ToeBase", "{side}Foot", (0.2, -0.8, 2.2)),
    ("", "{side}ToeBase", (0, 0, 1.1)),
)
_TRUNK = (
    ("LowerBack", "Hips", (0, 0, 0)),
    ("Spine", "LowerBack", (0, 2, -0.2)),
    ("Spine1", "Spine", (0, 2, 0)),
    ("Neck", "Spine1", (0, 0, 0)),
    ("Neck1", "Neck", (0, 1.8, 0.1)),
    ("Head", "Neck1", (0, 1.7, 0.2)),
    ("", "Head", (0, 1.8, 0)),
)
_ARM = (
    ("{side}Shoulder", "Spine1", (0, 0, 0)),
    ("{side}Arm", "{side}Shoulder", (3.1, 1.4, -0.4)),
    ("{side}ForeArm", "{side}Arm", (5.4, 0, 0)),
    ("{side}Hand", "{side}ForeArm", (4.1, 0, 0)),
    ("{side}FingerBase", "{side}Hand", (0, 0, 0)),
    ("{side}HandIndex1", "{side}FingerBase", (0.6, 0, 0)),
    ("", "{side}HandIndex1", (0.5, 0, 0)),
    ("{s}Thumb", "{side}Hand", (0, 0, 0)),
    ("", "{s}Thumb", (0.5, 0, 0.5)),
)


def cmu_like_skeleton(seed: int = 0) -> Skeleton:
    """A human with the 31 joints, names, tree and 96 channels of the BVH conversions of the CMU database.

    One file unit is 5.6444 cm. Size and bone lengths vary with the seed by a few per cent, left against right by less.
    """
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.95, 1.05)
    limb = {bone: size * rng.uniform(0.97, 1.03) for bone, *_ in (*_LEG, *_ARM, *_TRUNK)}
    names, parents, offsets = ["Hips"], [-1], [np.zeros(3)]
    ends, end_offsets = [], []
    for part, side in ((_LEG, "Left"), (_LEG, "Right"), (_TRUNK, ""), (_ARM, "Left"), (_ARM, "Right")):
        for bone, parent, offset in part:
            parent_index = names.index(parent.format(side=side, s=side[:1]))
            mirrored = np.array(offset) * (_SIDES.get(side, 1.0), 1, 1)
            vector = np.round(mirrored * limb[bone] * rng.uniform(0.995, 1.005), 5) + 0.0
            if bone:
                names.append(bone.format(side=side, s=side[:1]))
                parents.append(parent_index)
                offsets.append(vector)
            else:
                ends.append(parent_index)
                end_offsets.append(vector)
    channels = [(*POSITION_CHANNELS, *_EULER)] + [_EULER] * (len(names) - 1)
    return Skeleton(names, parents, np.array(offsets), channels, ends, np.array(end_offsets))


def walk(seed: int = 0, seconds: float = 8.0, frame_rate: float = 120.0) -> Motion:
    """A person of `cmu_like_skeleton(seed)` who walks a winding path, pauses, turns, looks around and gestures.

    The floor is y = 0, and the stance foot does not slide on it. Headings stay within 65 degrees of +z, where the
    root's Euler angles are smooth. Channel values are in degrees and file units; `unit_cm` is 5.6444.
    Raises ValueError when not one frame fits into `seconds`.
    """
    frames = round(seconds * frame_rate)
    if frames < 1:
        raise ValueError(f"seconds * frame_rate is {seconds * frame_rate}, wanted at least one frame")
    skeleton = cmu_like_skeleton(seed)
    rng = np.random.default_rng([seed, 1])
    path = _plan_path(rng, frames, frame_rate)
    steps = _plan_steps(rng, path)
    time = path.time[:frames]
    feet = {side: _foot(skeleton, side, steps[side], time) for side in _SIDES}
    body = _body(rng, path, feet, time)
    position, local = _hips(skeleton, path, feet, body, frame_rate)
    local |= _upper_body(rng, body, time)
    return Motion(skeleton, _channel_values(skeleton, position, local), 1 / frame_rate, UNIT_CM)


class _Path(NamedTuple):
    """Where the figure would glide without legs: a little longer than the motion, as footsteps look ahead."""

    time: Float[np.ndarray, " n"]
    ground: Float[np.ndarray, "n 3"]
    heading: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]


class _Steps(NamedTuple):
    """Where the ball of one foot and its heading start, and what each step of it changes, and when."""

    start: Float[np.ndarray, " 4"]
    change: Float[np.ndarray, "steps 4"]
    lift: Float[np.ndarray, " steps"]
    land: Float[np.ndarray, " steps"]


class _Foot(NamedTuple):
    """Ankle, global rotation, heading and bend of the toes (radians) of one foot, and 0..1 for how much it swings."""

    ankle: _Vectors
    rotation: _Rotations
    heading: _Scalars
    toes: _Scalars
    swing: _Scalars


class _Body(NamedTuple):
    """What drives the trunk: stride (left foot before right, metres), weight on the left foot (-1..1), and drift."""

    heading: _Scalars
    stride: _Scalars
    weight: _Scalars
    speed: _Scalars
    drift: Float[np.ndarray, "frames 8"]


def _plan_path(rng: np.random.Generator, frames: int, rate: float) -> _Path:
    time = np.arange(frames + round(2 * rate)) / rate
    starts, speeds, headings = [], [], [0.0]
    start, side = rng.uniform(0.1, 0.4), rng.choice([-1.0, 1.0])
    while start < time[-1]:
        pause = len(starts) % 3 == 2
        starts.append(start)
        speeds.append(0.0 if pause else rng.uniform(0.8, 1.3))
        headings.append(side * np.radians(rng.uniform(20, 65)))
        start += rng.uniform(1.6, 2.2) if pause else rng.uniform(2.0, 3.0)
        side = -side
    begin, turn = np.array(starts), np.diff(headings)
    speed = _METRE * (_ease(time, begin, begin + 1.0) @ np.diff(speeds, prepend=0.0))
    heading = _ease(time, begin, begin + 0.8 + np.abs(turn) / np.radians(60)) @ turn
    velocity = speed[:, None] * _forward(heading)
    ground = np.cumsum((velocity + np.roll(velocity, 1, 0)) / 2, 0) / rate
    return _Path(time, ground - ground[0], heading, speed)


def _plan_steps(rng: np.random.Generator, path: _Path) -> dict[str, _Steps]:
    """Left and right take turns; each steps to where the body will be in the middle of the stance that follows."""
    period = rng.uniform(0.50, 0.56)
    width, toe_out = 0.085 * _METRE, np.radians(7)

    def placement(time: float, side: str) -> Float[np.ndarray, " 4"]:
        n = min(int(np.searchsorted(path.time, time)), len(path.time) - 1)
        heading = path.heading[n]
        place = path.ground[n] + _SIDES[side] * width * _leftward(heading) + 0.09 * _METRE * _forward(heading)
        return np.append(place + (0, _SOLE, 0), heading + _SIDES[side] * toe_out)

    at = {side: placement(0.0, side) for side in _SIDES}
    start = dict(at)
    taken: dict[str, list[tuple[Float[np.ndarray, " 4"], float, float]]] = {side: [] for side in _SIDES}
    time, side = 0.1, str(rng.choice(list(_SIDES)))
    while time < path.time[-1] - 1.5 * period:
        duration = period * rng.uniform(0.96, 1.04)
        change = placement(time + 1.5 * period, side) - at[side]
        if np.hypot(change[0], change[2]) > 0.03 * _METRE or abs(change[3]) > np.radians(4):
            taken[side].append((change, time + 0.15 * period, time + duration))
            at[side] = at[side] + change
        time, side = time + duration, "Right" if side == "Left" else "Left"
    return {
        side: _Steps(
            start[side],
            np.array([change for change, _, _ in taken[side]]).reshape(-1, 4),
            np.array([lift for _, lift, _ in taken[side]]),
            np.array([land for _, _, land in taken[side]]),
        )
        for side in _SIDES
    }


def _foot(skeleton: Skeleton, side: str, steps: _Steps, time: _Scalars) -> _Foot:
    """The heel rises about the planted ball, the foot swings, the heel strikes, and the foot rolls flat about it."""
    ball_from_ankle = skeleton.offsets[skeleton.names.index(f"{side}ToeBase")]
    ball_from_heel = np.array([ball_from_ankle[0], _SOLE, ball_from_ankle[2] + _HEEL])
    lift, land = steps.lift, steps.land
    plan = steps.start + _ease(time, lift, land) @ steps.change
    reach = np.clip(np.hypot(steps.change[:, 0], steps.change[:, 2]) / (1.1 * _METRE), 0.15, 1.0)
    middle = (lift + land) / 2
    swing = _bump(time, lift, middle, land)
    rise = _bump(time, lift - 0.25, lift + 0.08, land - 0.06) @ (reach * np.radians(52))
    strike = _bump(time, middle, land - 0.02, land + 0.07) @ (reach * np.radians(24))
    ball = plan[:, :3] + np.outer(swing @ (0.02 + 0.04 * reach), (0, _METRE, 0))
    turn = _about("Y", plan[:, 3])
    ball += _rotate(turn, (_about("X", -strike) - np.eye(3)) @ ball_from_heel)
    rotation = turn @ _about("X", rise - strike)
    return _Foot(ball - rotation @ ball_from_ankle, rotation, plan[:, 3], -rise, swing.sum(1))


def _body(rng: np.random.Generator, path: _Path, feet: dict[str, _Foot], time: _Scalars) -> _Body:
    heading = path.heading[: len(time)]
    apart = feet["Left"].ankle - feet["Right"].ankle
    stride = (apart * _forward(heading)).sum(1) / _METRE
    frequency, phase = rng.uniform(0.1, 0.45, (3, 8)), rng.uniform(0, 2 * np.pi, (3, 8))
    drift = np.sin(2 * np.pi * frequency * time[:, None, None] + phase).mean(1)
    weight = feet["Right"].swing - feet["Left"].swing
    return _Body(heading, stride, weight, path.speed[: len(time)] / _METRE, drift)


def _hips(
    skeleton: Skeleton, path: _Path, feet: dict[str, _Foot], body: _Body, rate: float
) -> tuple[_Vectors, dict[str, _Rotations]]:
    """Root position and the local rotations of hips and legs."""
    offset = dict(zip(skeleton.names, skeleton.offsets, strict=True))
    yaw = body.heading - np.radians(9) * body.stride
    pelvis = _about("Y", yaw) @ _about("Z", np.radians(3 * body.weight + body.drift[:, 0]))
    pelvis = pelvis @ _about("X", np.radians(2 * body.speed + body.drift[:, 1]))
    position = path.ground[: len(yaw)] + (0.025 * body.weight + 0.008 * body.drift[:, 2])[:, None] * (
        _METRE * _leftward(body.heading)
    )
    bones = {side: (offset[f"{side}Leg"], offset[f"{side}Foot"]) for side in _SIDES}
    highest = []
    for side, foot in feet.items():
        socket = position + pelvis @ offset[f"{side}UpLeg"]
        length = 0.99 * sum(float(np.linalg.norm(bone)) for bone in bones[side])
        across2 = (foot.ankle[:, 0] - socket[:, 0]) ** 2 + (foot.ankle[:, 2] - socket[:, 2]) ** 2
        highest.append(foot.ankle[:, 1] - socket[:, 1] + np.sqrt(length**2 - across2))
    position[:, 1] = _smooth_below(np.min(highest, 0), max(1, round(0.1 * rate)))
    local = {"Hips": pelvis}
    for side, foot in feet.items():
        socket = position + pelvis @ offset[f"{side}UpLeg"]
        thigh, shank = _leg(socket, foot.ankle, _forward((yaw + foot.heading) / 2), *bones[side])
        local[f"{side}UpLeg"] = _transpose(pelvis) @ thigh
        local[f"{side}Leg"] = _transpose(thigh) @ shank
        local[f"{side}Foot"] = _transpose(shank) @ foot.rotation
        local[f"{side}ToeBase"] = _about("X", foot.toes)
    return position, local


def _leg(
    hip: _Vectors, ankle: _Vectors, forward: _Vectors, thigh: Float[np.ndarray, " 3"], shank: Float[np.ndarray, " 3"]
) -> tuple[_Rotations, _Rotations]:
    """Global rotations of thigh and shank, from the law of cosines; the knee points forward."""
    upper, lower = np.linalg.norm(thigh), np.linalg.norm(shank)
    reach = ankle - hip
    distance = np.linalg.norm(reach, axis=1, keepdims=True)
    down = reach / distance
    hinge = np.cross(down, forward)
    hinge /= np.linalg.norm(hinge, axis=1, keepdims=True)
    along = (upper**2 + distance**2 - lower**2) / (2 * distance)
    knee = along * down + np.sqrt(upper**2 - along**2) * np.cross(hinge, down)
    return _align(thigh, knee / upper, hinge), _align(shank, (reach - knee) / lower, hinge)


def _align(bone: Float[np.ndarray, " 3"], direction: _Vectors, hinge: _Vectors) -> _Rotations:
    """Turns a bone of the rest pose, which faces +z, into `direction` and the axis of its knee into `hinge`."""
    rest = bone / np.linalg.norm(bone)
    rest_hinge = np.cross(rest, (0.0, 0.0, 1.0))
    rest_hinge /= np.linalg.norm(rest_hinge)
    frame = np.stack([direction, np.cross(hinge, direction), hinge], -1)
    return frame @ np.stack([rest, np.cross(rest_hinge, rest), rest_hinge], -1).T


def _upper_body(rng: np.random.Generator, body: _Body, time: _Scalars) -> dict[str, _Rotations]:
    """The chest turns and rolls against the hips, the arms swing against the legs, the head looks where it will."""
    drift, stride = body.drift, body.stride
    twist = np.radians(18 * stride + 3 * drift[:, 3])
    bend = np.radians(2 * drift[:, 4] - 2 * body.speed + 3)
    roll = np.radians(-4 * body.weight + 2 * drift[:, 5])
    vertebra = _about("Y", twist / 3) @ _about("Z", roll / 3) @ _about("X", bend / 3)
    look = np.radians(50) * np.tanh(_events(rng, time) @ rng.uniform(-1.5, 1.5, 4))
    nod = np.radians(3 * drift[:, 6] + 2)
    neck = _about("Y", (look - np.radians(9) * stride) / 2) @ _about("X", nod / 2)
    local = {"LowerBack": vertebra, "Spine": vertebra, "Spine1": vertebra, "Neck1": neck, "Head": neck}
    for column, (side, sign) in enumerate(_SIDES.items()):
        gesture = np.tanh(_events(rng, time) @ rng.uniform(0.2, 1.0, 4))
        beat = np.sin(2 * np.pi * rng.uniform(0.9, 1.4) * time + rng.uniform(0, 6))
        swing = np.radians(-sign * 45 * stride + 4 * drift[:, 6 + column] + 4) + np.radians(35) * gesture
        spread = np.radians(78 - 6 * drift[:, 7] - 8 * gesture)
        elbow = np.radians(18 + 3 * drift[:, column] - sign * 14 * stride) + gesture * np.radians(40 + 8 * beat)
        local[f"{side}Arm"] = _about("X", -swing) @ _about("Z", -sign * spread)
        local[f"{side}ForeArm"] = _about("Y", -sign * elbow)
        local[f"{side}Hand"] = _about("Z", -sign * np.radians(6 + 4 * drift[:, 5 + column] + 10 * gesture * beat))
        local[f"{side}HandIndex1"] = _about("Z", -sign * np.radians(20 + 6 * drift[:, 3 + column]))
        local[f"{side[0]}Thumb"] = _about("Y", -sign * np.radians(15 + 8 * gesture))
    return local


def _events(rng: np.random.Generator, time: _Scalars) -> Float[np.ndarray, "frames 4"]:
    """Four things that happen at some time: eased from 0 to 1 and back."""
    start = rng.uniform(0, max(time[-1] - 1, 1), 4)
    hold = start + rng.uniform(0.5, 0.9, 4)
    stop = hold + rng.uniform(0.3, 1.5, 4)
    return _ease(time, start, hold) - _ease(time, stop, stop + rng.uniform(0.6, 1.0, 4))


def _channel_values(
    skeleton: Skeleton, position: _Vectors, local: dict[str, _Rotations]
) -> Float[np.ndarray, "frames channels"]:
    still = np.zeros((len(position), 3))
    angles = [_euler_zyx(local[name]) if name in local else still for name in skeleton.names]
    return np.concatenate([position, *angles], 1)


def _euler_zyx(rotation: _Rotations) -> _Vectors:
    z = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    y = np.arcsin(np.clip(-rotation[:, 2, 0], -1, 1))
    x = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    return np.degrees(np.stack([np.unwrap(z), y, np.unwrap(x)], 1))


def _smooth_below(x: _Scalars, width: int) -> _Scalars:
    """A smooth curve that nowhere exceeds `x`: the running minimum, averaged over no more than its window."""
    padded = np.pad(x, 2 * width, mode="edge")
    lowest = np.lib.stride_tricks.sliding_window_view(padded, 2 * width + 1).min(1)
    kernel = np.hanning(2 * width + 3)[1:-1]
    return np.convolve(lowest, kernel / kernel.sum(), "valid")


def _ease(time: _Scalars, start: _Times, stop: _Times) -> Float[np.ndarray, "frames n"]:
    """From 0 at `start` to 1 at `stop`, at rest and without acceleration at both."""
    u = np.clip((time[:, None] - start) / (stop - start), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _bump(time: _Scalars, start: _Times, top: _Times, stop: _Times) -> Float[np.ndarray, "frames n"]:
    """From 0 at `start` to 1 at `top` and back to 0 at `stop`."""
    return _ease(time, start, top) - _ease(time, top, stop)


def _about(axis: str, angle: _Scalars) -> _Rotations:
    n = "XYZ".index(axis)
    j, k = (n + 1) % 3, (n + 2) % 3
    result = np.zeros((len(angle), 3, 3))
    result[:, n, n] = 1
    result[:, j, j] = result[:, k, k] = np.cos(angle)
    result[:, k, j] = np.sin(angle)
    result[:, j, k] = -np.sin(angle)
    return result


def _rotate(rotation: _Rotations, v: _Vectors) -> _Vectors:
    return (rotation @ v[:, :, None])[:, :, 0]


def _transpose(rotation: _Rotations) -> _Rotations:
    return np.swapaxes(rotation, 1, 2)


def _forward(heading: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    return np.stack([np.sin(heading), np.zeros_like(heading), np.cos(heading)], -1)


def _leftward(heading: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    return np.stack([np.cos(heading), np.zeros_like(heading), -np.sin(heading)], -1)
