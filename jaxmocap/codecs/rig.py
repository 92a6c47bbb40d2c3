"""A rig that a model knows, and how few bytes a skeleton of it takes.

A model stores names, tree, channels and mean bones once; a stream then says only how long the bones of its person are,
as whole multiples of a step that follows the quantiser's. A skeleton that no model knows is written whole.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..errors import CorruptStream
from ..skeleton import Skeleton
from .bitstream import BitReader, BitWriter, ByteReader, varint
from .quantise import PER_OCTAVE

LENGTHS, OFFSETS, WHOLE = 0, 1, 2
# Bones are 32 to 64 times finer than the coefficients, whose mean error is near a twentieth of their step.
_FINER_OCTAVES = 6
_FIXED_POINT = 16
_MOST_JOINTS = 1 << 12


@dataclass(frozen=True)
class Rig:
    """What all skeletons of a rig share. `skeleton` holds mean bones in cm.

    The integer arrays have an entry for each bone of nonzero length: `lengths[b]` is that length in 2^-16 cm, `spread[b]`
    how far it strays from its prediction, likewise, and `partner[b]` an earlier bone, often the mirror image, that strays
    the same way (-1: none). `expected` is the mean local rotation of each joint.
    """

    skeleton: Skeleton
    expected: Float[np.ndarray, "joints 3 3"]
    lengths: np.ndarray
    spread: np.ndarray
    partner: np.ndarray
    unit_cm: float
    frame_time: float

    def spec(self) -> dict:
        s = self.skeleton
        return {**_outline(s), "unit_cm": self.unit_cm, "frame_time": self.frame_time}

    def tensors(self) -> dict[str, np.ndarray]:
        return {
            "rig.bones": bones_of(self.skeleton),
            **({"rig.axes": self.skeleton.axes} if self.skeleton.has_axes else {}),
            "rig.expected": self.expected.astype(np.float32),
            "rig.lengths": self.lengths.astype(np.int32),
            "rig.spread": self.spread.astype(np.int32),
            "rig.partner": self.partner.astype(np.int16),
        }

    @staticmethod
    def load(spec: dict, tensors: dict[str, np.ndarray]) -> Rig:
        skeleton = _with_bones(spec, tensors["rig.bones"], tensors.get("rig.axes"))
        lengths, spread, partner = (tensors[f"rig.{name}"].astype(np.int64) for name in ("lengths", "spread", "partner"))
        expected = tensors["rig.expected"].astype(np.float64)
        return Rig(skeleton, expected, lengths, spread, partner, spec["unit_cm"], spec["frame_time"])


def bones_of(skeleton: Skeleton) -> Float[np.ndarray, "bones 3"]:
    """All offsets: of the joints, then of the end sites."""
    return np.concatenate([skeleton.offsets, skeleton.end_offsets])


def with_bones(skeleton: Skeleton, bones: Float[np.ndarray, "bones 3"]) -> Skeleton:
    """The skeleton with other bones, in their unit."""
    return _with_bones(_outline(skeleton), bones, skeleton.axes if skeleton.has_axes else None)


def bone_octave(step_index: int) -> int:
    """Bones are multiples of 2^octave cm at this quantiser step."""
    return step_index // PER_OCTAVE - 7 - _FINER_OCTAVES


def write_skeleton(skeleton: Skeleton, rig: Rig | None, scale: float, step_index: int) -> bytes:
    """The skeleton section. `scale` is cm per file unit; bones are rounded to what the quantiser step needs."""
    octave = bone_octave(step_index)
    bones = bones_of(skeleton) * scale
    if rig is None or not rig.skeleton.same_rig(skeleton):
        outline = json.dumps({**_outline(skeleton), **_axes_of(skeleton)}, separators=(",", ":"), ensure_ascii=False)
        packed = zlib.compress(outline.encode(), 9, wbits=-15)
        return bytes([WHOLE]) + varint(len(packed)) + packed + _write_offsets(bones, np.zeros_like(bones), octave)
    if _along_rig(bones, bones_of(rig.skeleton)):
        return bytes([LENGTHS]) + _write_lengths(bones, rig, octave)
    return bytes([OFFSETS]) + _write_offsets(bones, bones_of(rig.skeleton), octave)


def read_skeleton(
    section: bytes, rig: Rig, unit_cm: float | None, step_index: int
) -> tuple[Skeleton, float, bytes, bool]:
    """The skeleton in file units, the cm of one, what follows it in the section, and whether the model knew its rig.

    Where nobody knows the unit, a figure of the rig is taken to be of the rig's unit, any other of centimetres.
    Raises CorruptStream where the section contradicts itself.
    """
    octave = bone_octave(step_index)
    reader = ByteReader(section)
    kind = reader.byte()
    if kind == WHOLE:
        outline = _read_outline(reader.take(reader.varint()))
        count = len(outline["names"]) + len(outline["end_joints"])
        bones, rest = _read_offsets(section[reader.at :], np.zeros((count, 3)), octave)
        try:
            skeleton = _with_bones(outline, bones / (unit_cm or 1.0), outline.get("axes"))
        except (ValueError, TypeError, OverflowError) as error:
            raise CorruptStream(f"the stream's skeleton does not hold together: {error}") from error
        if not (np.abs(skeleton.axes) < 1.001).all():
            raise CorruptStream("the stream's skeleton has axes that are no rotations")
        return skeleton, unit_cm or 1.0, rest, False
    if kind not in (LENGTHS, OFFSETS):
        raise CorruptStream(f"the skeleton section is of kind {kind}, known are 0 to 2")
    mean = bones_of(rig.skeleton)
    read = _read_lengths if kind == LENGTHS else lambda data, rig, octave: _read_offsets(data, mean, octave)
    bones, rest = read(section[reader.at :], rig, octave)
    scale = unit_cm or rig.unit_cm
    return _with_bones(_outline(rig.skeleton), bones / scale, rig.skeleton.axes), scale, rest, True


def _along_rig(bones: np.ndarray, mean: np.ndarray) -> bool:
    """True when every bone points nearly where the rig's does: a joint's own rotation takes up the difference."""
    length, mean_length = np.linalg.norm(bones, axis=1), np.linalg.norm(mean, axis=1)
    if ((length == 0) != (mean_length == 0)).any():
        return False
    return bool(((bones * mean).sum(1) >= 0.9 * length * mean_length).all())


def _write_lengths(bones: np.ndarray, rig: Rig, octave: int) -> bytes:
    lengths = np.linalg.norm(bones, axis=1)
    mean = np.linalg.norm(bones_of(rig.skeleton), axis=1)
    used = np.flatnonzero(mean > 0)
    size = int(np.clip(np.rint(128 * np.median(lengths[used] / mean[used])), 1, 255)) if len(used) else 128
    counts = np.rint(np.ldexp(lengths[used], -octave)).astype(np.int64)
    residual = counts - _predicted(rig.lengths, size, octave)
    writer = BitWriter()
    for b, r in enumerate(residual.tolist()):
        p = rig.partner[b]
        _write_golomb(writer, r - (int(residual[p]) if p >= 0 else 0), _order(rig.spread[b], octave))
    return bytes([size]) + writer.to_bytes()


def _read_lengths(data: bytes, rig: Rig, octave: int) -> tuple[np.ndarray, bytes]:
    mean = bones_of(rig.skeleton)
    mean_length = np.linalg.norm(mean, axis=1)
    used = np.flatnonzero(mean_length > 0)
    size = ByteReader(data).byte()
    reader = BitReader(data[1:])
    residual: list[int] = []
    for b in range(len(used)):
        p = rig.partner[b]
        residual.append(_read_golomb(reader, _order(rig.spread[b], octave)) + (residual[p] if p >= 0 else 0))
    # In doubles: exact for any bone, where a damaged stream's sums would leave 64-bit integers.
    counts = _predicted(rig.lengths, size, octave) + np.array(residual, np.float64)
    bones = np.zeros_like(mean)
    bones[used] = mean[used] / mean_length[used, None] * np.ldexp(counts, octave)[:, None]
    return bones, data[1 + (reader.at + 7) // 8 :]


def _predicted(lengths: np.ndarray, size: int, octave: int) -> np.ndarray:
    """The rig's lengths at this size (128: as the mean), in steps, by integers alone."""
    shift = 7 + _FIXED_POINT + octave
    return lengths * size + (1 << shift - 1) >> shift


def _order(spread: int, octave: int) -> int:
    """The Exp-Golomb order that suits a residual of this spread, counted in bone steps."""
    return max(0, int(spread).bit_length() - 1 - (_FIXED_POINT + octave))


def _write_offsets(bones: np.ndarray, mean: np.ndarray, octave: int) -> bytes:
    residual = (_steps(bones, octave) - _steps(mean, octave)).ravel()
    order = max(0, int(np.abs(residual).mean() + 1).bit_length() - 1) if len(residual) else 0
    writer = BitWriter()
    for r in residual.tolist():
        writer.write(int(r != 0), 1)
        if r:
            _write_golomb(writer, r, order)
    return bytes([order]) + writer.to_bytes()


def _read_offsets(data: bytes, mean: np.ndarray, octave: int) -> tuple[np.ndarray, bytes]:
    order = ByteReader(data).byte()
    if order > 60:
        raise CorruptStream(f"the skeleton's bones are coded with order {order}, 60 is the most")
    reader = BitReader(data[1:])
    residual = [_read_golomb(reader, order) if reader.read(1) else 0 for _ in range(mean.size)]
    counts = _steps(mean, octave) + np.array(residual, np.int64).reshape(mean.shape)
    return np.ldexp(counts.astype(np.float64), octave), data[1 + (reader.at + 7) // 8 :]


def _steps(bones: np.ndarray, octave: int) -> np.ndarray:
    return np.rint(np.ldexp(bones, -octave)).astype(np.int64)


def _write_golomb(writer: BitWriter, value: int, order: int) -> None:
    """Exp-Golomb of a signed integer: small magnitudes in order + 2 bits or so."""
    shifted = (2 * value - 1 if value > 0 else -2 * value) + (1 << order)
    extra = shifted.bit_length() - 1 - order
    writer.write(1, extra + 1)
    writer.write(shifted, extra + order)


def _read_golomb(reader: BitReader, order: int) -> int:
    extra = 0
    while not reader.read(1):
        extra += 1
        if extra + order > 60:
            raise CorruptStream("the skeleton holds a bone of impossible length")
    unsigned = (1 << extra + order | reader.read(extra + order)) - (1 << order)
    return (unsigned + 1) // 2 if unsigned & 1 else -(unsigned // 2)


def _outline(s: Skeleton) -> dict:
    return {"names": s.names, "parents": s.parents, "channels": s.channels, "end_joints": s.end_joints}


def _axes_of(s: Skeleton) -> dict:
    return {"axes": np.round(s.axes, 9).tolist()} if s.has_axes else {}


def _with_bones(outline: dict, bones: np.ndarray, axes: np.ndarray | list | None) -> Skeleton:
    joints = len(outline["names"])
    return Skeleton(
        outline["names"], outline["parents"], bones[:joints], outline["channels"],
        outline["end_joints"], bones[joints:], None if axes is None else np.array(axes, np.float64),
    )


def _read_outline(packed: bytes) -> dict:
    """The JSON of a skeleton written whole, unpacked within bounds."""
    unpacker = zlib.decompressobj(wbits=-15)
    try:
        text = unpacker.decompress(packed, 1 << 24)
        outline = json.loads(text)
    except (zlib.error, ValueError, RecursionError) as error:
        raise CorruptStream(f"the stream's skeleton cannot be unpacked: {error}") from error
    wanted = ("names", "parents", "channels", "end_joints")
    if not isinstance(outline, dict) or not all(isinstance(outline.get(key), list) for key in wanted):
        raise CorruptStream(f"the stream's skeleton lacks one of {', '.join(wanted)}")
    kinds = (("names", str), ("parents", int), ("end_joints", int))
    if not all(type(item) is kind for key, kind in kinds for item in outline[key]):
        raise CorruptStream("the stream's skeleton has names that are no text, or joints that are no whole numbers")
    if not 0 < len(outline["names"]) <= _MOST_JOINTS or len(outline["end_joints"]) > _MOST_JOINTS:
        raise CorruptStream(f"the stream's skeleton has {len(outline['names'])} joints")
    return outline
