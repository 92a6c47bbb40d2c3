"""Rate and distortion in real bytes: what codecs and compressors of arrays need for a mean joint error, clip by clip."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..codecs import Target, make
from ..codecs.artifact import Artifact, load_artifact, make_artifact
from ..errors import JaxmocapError
from ..kinematics import positions_cm
from ..metrics import compare
from ..motion import Motion
from . import rd_positions
from .lossless_folder import one_core, timed
from .rd_peers import PEERS
from .rd_positions import ALL_FRAMES, THINNED, ArrayCoder

Config = Mapping[str, str | int]
Errors = Mapping[str, float | list[float] | None]
Method = Callable[[Motion, Target], tuple[int, Errors]]  # bytes of the stream, and errors of what it decodes to
LEARNED: Config = {"codec": "learned", "metric": "joints"}
COLUMNS: dict[str, Config] = {
    "learned": LEARNED,
    "lsdt-clip runs": {"codec": "lsdt-clip", "form": "runs", "clip_frames": 240},
    "lsdt-clip paper": {"codec": "lsdt-clip", "form": "paper", "clip_frames": 240},
}
_MEANS, _LARGEST = ("mean_cm", "shell_mean_cm"), ("max_cm", "shell_max_cm")


def methods() -> tuple[dict[str, Method], dict[str, str]]:
    """All columns of the table, and the package that is missing for those that are not among them."""
    made = {name: by_codec(config) for name, config in COLUMNS.items()}
    made["learned, person not named"] = by_codec(LEARNED, nameless(load_artifact(str(LEARNED["codec"]))))
    of_peers, missing = peers()
    return {**made, **of_peers}, missing


def peers() -> tuple[dict[str, Method], dict[str, str]]:
    """Those of the columns that are compressors of arrays, and the package that is missing for others."""
    made: dict[str, Method] = {}
    missing: dict[str, str] = {}
    for name, peer in PEERS.items():
        try:
            coder = peer()
        except ImportError as error:
            missing[name] = error.name or name
        else:
            made[name] = by_positions(coder, ALL_FRAMES)
            made[f"{name}, thinned"] = by_positions(coder, THINNED)
    return made, missing


def by_codec(config: Config, artifact: Artifact | None = None) -> Method:
    """Whole streams, header and skeleton included; the model is the shipped one unless given, and not counted."""

    def code(motion: Motion, target: Target) -> tuple[int, Errors]:
        codec = make({**config, "target": target}, artifact)
        data = codec.encode(motion)
        return len(data), compare(motion, codec.decode(data))

    return code


def nameless(artifact: Artifact) -> Artifact:
    """The model without the people of its corpus, if it has any: of these, too, bones are then written, and not named.

    Nor has the model a number, which costs each stream 3 bytes.
    """
    people = {name: tensor[:0] for name, tensor in artifact.tensors.items() if name == "bones.people"}
    return make_artifact(artifact.spec, {**artifact.tensors, **people})


def by_positions(coder: ArrayCoder, everies: Sequence[int]) -> Method:
    """Streams of positions, for mean errors; they hold no skeleton, and what they decode to has no exact bones."""

    def code(motion: Motion, target: Target) -> tuple[int, Errors]:
        original = np.asarray(positions_cm(motion), np.float64)
        data = rd_positions.encode(original, motion.skeleton, coder, target.cm, everies)
        error = np.linalg.norm(rd_positions.decode(data, motion.skeleton, coder) - original, axis=-1)
        return len(data), {"mean_cm": float(error.mean()), "max_cm": float(error.max())}

    return code


def clip_row(name: str, motion: Motion, method: Method, target: Target) -> dict:
    """Bytes, ratio to float32 positions of all joints, and errors in cm of one clip."""
    size, errors = method(motion, target)
    known = {measure: errors[measure] for measure in (*_MEANS, *_LARGEST) if errors.get(measure) is not None}
    return {"clip": name, "frames": motion.frame_count, "bytes": size, "ratio": _raw_bytes(motion) / size, **known}


def pooled(motions: Mapping[str, Motion], method: Method, target: Target) -> dict:
    """A row of all clips together, each of which meets the target; `missing` says why where one cannot."""
    row = {"target_cm": target.cm}
    try:
        clips = [clip_row(name, motion, method, target) for name, motion in motions.items()]
    except JaxmocapError as error:
        return {**row, "missing": str(error)}
    frames, size = np.array([c["frames"] for c in clips]), sum(c["bytes"] for c in clips)
    errors = {name: np.array([c[name] for c in clips]) for name in (*_MEANS, *_LARGEST) if name in clips[0]}
    return {
        **row,
        "bytes": size,
        "ratio": sum(map(_raw_bytes, motions.values())) / size,
        **{name: float(e @ frames / frames.sum() if name in _MEANS else e.max()) for name, e in errors.items()},
        "clips": clips,
    }


def curve(motions: Mapping[str, Motion], method: Method, targets_cm: Sequence[float]) -> list[dict]:
    """A row for every mean error."""
    return [pooled(motions, method, Target("mean", cm)) for cm in targets_cm]


def ratio_at(rows: Sequence[dict], mean_cm: float) -> float | None:
    """The ratio at a mean error: log ratio over log error between the two measured points around it, None outside them.

    Targets are met by each clip on its own, so what is measured lies a little below them.
    """
    points = sorted((row["mean_cm"], row["ratio"]) for row in rows if "missing" not in row)
    if not points or not points[0][0] <= mean_cm <= points[-1][0]:
        return None
    error, ratio = np.log(points).T
    return float(np.exp(np.interp(np.log(mean_cm), error, ratio)))


def speed(motions: Mapping[str, Motion], config: Config, mean_cm: float) -> dict[str, float]:
    """Frames/s by processor seconds on one core, each clip coded once before."""
    encode_s = decode_s = 0.0
    with one_core():
        codec = make({**config, "target": Target("mean", mean_cm)})
        for motion in motions.values():
            codec.decode(codec.encode(motion))
            data, seconds = timed(lambda m=motion: codec.encode(m))
            encode_s += seconds
            decode_s += timed(lambda d=data: codec.decode(d))[1]
    frames = sum(m.frame_count for m in motions.values())
    return {"encode_fps": frames / encode_s, "decode_fps": frames / decode_s}


def first_frame_row(name: str, motion: Motion, method: Method, mean_cm: float) -> dict:
    """What the first frame, a T-pose, adds to the stream at the same mean error."""
    whole, rest = (clip_row(name, m, method, Target("mean", mean_cm)) for m in (motion, motion.frames(1)))
    return {**whole, "bytes_without": rest["bytes"], "cost": whole["bytes"] - rest["bytes"]}


def bound_row(name: str, motion: Motion, method: Method, max_cm: float) -> dict:
    """A stream that bounds the error of every joint in every frame, and the bytes of one for its mean error alone."""
    bounded = clip_row(name, motion, method, Target("max", max_cm))
    free = clip_row(name, motion, method, Target("mean", bounded["mean_cm"]))
    factor = bounded["bytes"] / free["bytes"]
    return {**bounded, "bytes_for_mean": free["bytes"], "max_cm_for_mean": free["max_cm"], "factor": factor}


def _raw_bytes(motion: Motion) -> int:
    return motion.frame_count * motion.skeleton.joint_count * 12
