"""Joint positions as NumPy's npz: positions (frames, joints, 3) in file units, names, parents, frame_time, unit_cm."""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..motion import Motion
from ..skeleton import POSITION_CHANNELS
from . import text

MAX_BYTES = 1 << 27  # of all arrays: 50 minutes of 31 joints at 120 Hz in single precision
_KEYS = ("positions", "names", "parents", "frame_time", "unit_cm")


@dataclass(frozen=True, eq=False)
class NpzSource:
    """The bytes a motion was read from; equal only to itself."""

    format: str
    data: bytes
    motion: Motion

    def unchanged(self, motion: Motion) -> bool:
        return (
            motion.skeleton is self.motion.skeleton
            and motion.values is self.motion.values
            and (motion.frame_time, motion.unit_cm) == (self.motion.frame_time, self.motion.unit_cm)
        )


def read_npz(path: str | Path, unit_cm: float | None = None) -> Motion:
    """Read a positions-only motion; see `parse_npz`."""
    return parse_npz(Path(path).read_bytes(), str(path), unit_cm)


def parse_npz(data: bytes, name: str, unit_cm: float | None = None) -> Motion:
    """The motion in the bytes of an npz; `unit_cm`, where given, overrides the file's (NaN there: unknown).

    Raises FormatError for what is not an npz with these keys, for objects, wrong shapes, values that are not finite,
    and arrays whose headers announce more than 128 MiB.
    """
    arrays = _load(data, name)
    positions, names, parents = arrays["positions"], arrays["names"], arrays["parents"]
    if positions.ndim != 3 or positions.shape[2] != 3 or positions.dtype.kind != "f" or positions.size == 0:
        raise FormatError(f"{name}: positions are {positions.dtype}{positions.shape}, wanted floats (frame, joint, 3)")
    joints = positions.shape[1]
    if names.shape != (joints,) or names.dtype.kind != "U":
        raise FormatError(f"{name}: names are {names.dtype}{names.shape}, wanted {joints} strings")
    if parents.shape != (joints,) or parents.dtype.kind not in "iu":
        raise FormatError(f"{name}: parents are {parents.dtype}{parents.shape}, wanted {joints} integers")
    if not np.isfinite(positions).all():
        frame, joint, _ = np.argwhere(~np.isfinite(positions))[0]
        raise FormatError(f"{name}: the position of joint {joint} in frame {frame} is not finite")
    seconds, unit = _scalar(arrays["frame_time"], "frame_time", name), _scalar(arrays["unit_cm"], "unit_cm", name)
    if unit_cm is None and not math.isnan(unit):
        unit_cm = unit
    try:
        with np.errstate(over="ignore"):
            motion = Motion.from_positions(positions, names.tolist(), seconds, parents.tolist(), unit_cm)
    except (ValueError, IndexError) as problem:  # an index where a parent is no joint
        raise FormatError(f"{name}: {problem}") from None
    if not np.isfinite(motion.values).all() or not math.isfinite(seconds):
        raise FormatError(f"{name}: the frame time or the distance between two joints is not finite")
    text.freeze(motion.values)
    source = NpzSource("npz", data, motion)
    return Motion(motion.skeleton, motion.values, motion.frame_time, motion.unit_cm, source)


def write_npz(motion: Motion, path: str | Path) -> None:
    """Write the joint positions beside and rename; see `format_npz`."""
    text.write_bytes(path, format_npz(motion))


def format_npz(motion: Motion) -> bytes:
    """The bytes of an npz: those it was read from where the motion is unchanged, otherwise the same bytes on every run.

    Positions are float64 where the motion holds nothing else, float32 where they come from forward kinematics.
    """
    source = motion.source
    if isinstance(source, NpzSource) and source.unchanged(motion):
        return source.data
    positions = global_positions(motion)
    out = io.BytesIO()
    np.savez(
        out,
        positions=positions.astype(np.float32) if motion.skeleton.has_rotations else positions,
        names=np.array(motion.skeleton.names, np.str_),
        parents=np.array(motion.skeleton.parents, np.int32),
        frame_time=np.float64(motion.frame_time),
        unit_cm=np.float64(math.nan if motion.unit_cm is None else motion.unit_cm),
    )
    return out.getvalue()


def global_positions(motion: Motion) -> Float[np.ndarray, "frames joints 3"]:
    """Joint positions in file units: exact sums where nothing turns, otherwise forward kinematics."""
    values = text.host_values(motion.values, "the motion")
    skeleton = motion.skeleton
    if skeleton.has_rotations:
        from ..kinematics import pose

        return np.asarray(pose(motion).positions, np.float64)
    positions = np.tile(skeleton.offsets, (len(values), 1, 1))
    for j, parent in enumerate(skeleton.parents):
        for n, channel in enumerate(skeleton.channels[j]):
            positions[:, j, POSITION_CHANNELS.index(channel)] = values[:, skeleton.first_column[j] + n]
        if parent >= 0:
            positions[:, j] += positions[:, parent]
    return positions


def _load(data: bytes, name: str) -> dict[str, np.ndarray]:
    """The arrays, once their headers are known to announce no objects and no more than they may."""
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            room = MAX_BYTES
            for key in _KEYS:
                if f"{key}.npy" not in archive.namelist():
                    raise FormatError(f"{name}: no array {key!r}; wanted {', '.join(_KEYS)}")
                with archive.open(f"{key}.npy") as member:
                    room -= _announced(member, key, name)
                if room < 0:
                    raise FormatError(f"{name}: the arrays announce more than {MAX_BYTES} bytes; split the motion")
                with archive.open(f"{key}.npy") as member:
                    arrays[key] = np.lib.format.read_array(member, allow_pickle=False)
    except FormatError:
        raise
    except Exception as problem:  # zipfile, zlib and NumPy raise a dozen kinds for bytes that are no npz
        raise FormatError(f"{name}: not a readable npz ({type(problem).__name__}: {problem}); write it again") from None
    return arrays


def _announced(member: IO[bytes], key: str, name: str) -> int:
    """The bytes that an array's header says will follow."""
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(member)
    if version not in read:
        raise FormatError(f"{name}: {key} has npy version {version}, wanted 1.0 or 2.0")
    shape, _, dtype = read[version](member)
    if dtype.hasobject:
        raise FormatError(f"{name}: {key} holds Python objects, wanted plain numbers or strings")
    if any(n < 0 for n in shape):
        raise FormatError(f"{name}: {key} has shape {shape}")
    return math.prod(shape) * dtype.itemsize


def _scalar(array: np.ndarray, key: str, name: str) -> float:
    if array.shape != () or array.dtype.kind not in "fiu":
        raise FormatError(f"{name}: {key} is {array.dtype}{array.shape}, wanted one number")
    return float(array)
