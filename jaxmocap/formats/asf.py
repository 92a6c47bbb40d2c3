"""Acclaim ASF: the bones that AMC files move, in the CMU dialect.

A bone hangs on the end of its parent and turns in its own frame C (`axis`): its local rotation is C R C^T. `dof rx ry
rz` turns about x first, so R = Rz Ry Rx; a Skeleton multiplies left to right, so a bone's rotation channels are
its dofs reversed.
"""

from __future__ import annotations

import heapq
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ..errors import FormatError
from ..skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from . import text

_CHANNEL = {"t" + c[0].lower(): c for c in POSITION_CHANNELS} | {"r" + c[0].lower(): c for c in ROTATION_CHANNELS}
_DOF = {channel: dof for dof, channel in _CHANNEL.items()}


@dataclass(frozen=True)
class Asf:
    """A skeleton, and how AMC lines fill it: value k of bone `b` goes to column `columns[b][k]`."""

    data: bytes
    skeleton: Skeleton
    columns: dict[bytes, list[int]]
    rotates: Bool[np.ndarray, " channels"]  # columns that hold an angle
    shift: Float[np.ndarray, " channels"]  # a dof moves from the offset, a position channel replaces it
    radians: bool


def read_asf(path: str | Path) -> Skeleton:
    """The skeleton of an ASF file: joint 0 is "root", then the bones, parents first, in the order of the file."""
    return parse_asf(Path(path).read_bytes(), str(path)).skeleton


def parse_asf(data: bytes, name: str) -> Asf:
    """The skeleton that the bytes of an ASF file say. Raises FormatError, with file, line and mend."""
    text.check_text(data, name)
    return _AsfReader(data, name).read()


@dataclass
class _Bone:
    """A block of the :bonedata section; `at` is where it begins."""

    at: int
    name: bytes = b""
    direction: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    length: float = 0.0
    angles: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    order: bytes = b"xyz"
    dofs: list[str] = field(default_factory=list)


class _AsfReader:
    def __init__(self, data: bytes, name: str):
        self.data, self.name = data, name
        self.radians = False
        self.root = _Bone(0, b"root")
        self.bones: dict[bytes, _Bone] = {}
        self.open: _Bone | None = None
        self.parents: dict[bytes, bytes] = {}

    def read(self) -> Asf:
        section = b""
        for at, words in text.lines(self.data):
            try:
                if words[0].startswith(b":"):
                    if self.open is not None:
                        raise ValueError("the last bone before this section has no 'end'")
                    section = words[0].lower()
                elif section == b":units" and words[0].lower() == b"angle":
                    self.radians = words[1:2] == [b"rad"]
                elif section == b":root":
                    self.root_line(at, words)
                elif section == b":bonedata":
                    self.bone_line(at, words)
                elif section == b":hierarchy" and words[0] not in (b"begin", b"end"):
                    self.link(words)
            except ValueError as problem:
                raise text.error_at(self.data, at, self.name, str(problem)) from None
        if self.open is not None:
            raise text.error_at(self.data, self.open.at, self.name, "the bone that begins here has no 'end'")
        if not self.root.dofs:
            raise FormatError(f"{self.name}: no 'order' line in a :root section; add one, such as TX TY TZ RX RY RZ")
        return self.finish([b"root", *self.order()])

    def root_line(self, at: int, words: list[bytes]) -> None:
        key = words[0].lower()
        if key == b"order":
            self.root.at, self.root.dofs = at, _dofs(words[1:])
        elif key == b"axis":
            self.root.order = _order(words[1:])
        elif key == b"position":
            self.root.direction, self.root.length = _vector(words[1:]), 1.0
        elif key == b"orientation":
            self.root.angles = _vector(words[1:])

    def bone_line(self, at: int, words: list[bytes]) -> None:
        key = words[0].lower()
        if key == b"begin":
            if self.open is not None:
                raise ValueError("'begin' inside a bone; the bone before has no 'end'")
            self.open = _Bone(at)
            return
        if self.open is None:
            raise ValueError(f"{text.show(words[0])} outside a bone; wanted 'begin'")
        if key == b"end":
            if not self.open.name or self.open.name in self.bones or self.open.name == b"root":
                raise ValueError("the bone that ends here needs a name of its own")
            self.bones[self.open.name] = self.open
            self.open = None
        elif key == b"name" and len(words) == 2:
            self.open.name = words[1]
        elif key == b"direction":
            self.open.direction = _vector(words[1:])
        elif key == b"length" and len(words) == 2:
            self.open.length = text.number(words[1])
        elif key == b"axis":
            self.open.angles, self.open.order = _vector(words[1:4]), _order(words[4:])
        elif key == b"dof":
            self.open.dofs = _dofs(words[1:])

    def link(self, words: list[bytes]) -> None:
        for bone in words:
            if bone not in self.bones and bone != b"root":
                raise ValueError(f"bone {text.show(bone)} is not in :bonedata; add it or mend the name")
        for child in words[1:]:
            if child in self.parents or child == b"root":
                raise ValueError(f"bone {text.show(child)} has two parents; remove one")
            self.parents[child] = words[0]

    def order(self) -> list[bytes]:
        """The bones, parents first and otherwise as in :bonedata."""
        rank = {bone: n for n, bone in enumerate(self.bones)}
        children: dict[bytes, list[bytes]] = {}
        for child, parent in self.parents.items():
            children.setdefault(parent, []).append(child)
        waiting = [(rank[b], b) for b in children.get(b"root", [])]
        heapq.heapify(waiting)
        order = []
        while waiting:
            bone = heapq.heappop(waiting)[1]
            order.append(bone)
            for child in children.get(bone, []):
                heapq.heappush(waiting, (rank[child], child))
        if lost := [b for b in self.bones if b not in set(order)]:
            top = next((b for b in lost if b not in self.parents), lost[0])
            said = f"bone {text.show(top)} does not hang on the root; give it a parent in :hierarchy"
            raise text.error_at(self.data, self.bones[top].at, self.name, said)
        return order

    def finish(self, order: list[bytes]) -> Asf:
        bones = [self.root, *(self.bones[b] for b in order[1:])]
        index = {b: j for j, b in enumerate(order)}
        parents = [-1] + [index[self.parents[b]] for b in order[1:]]
        with np.errstate(over="ignore"):
            reach = np.array([b.direction for b in bones]) * np.array([[b.length] for b in bones])
        if not np.isfinite(reach).all():
            long = bones[int(np.argwhere(~np.isfinite(reach))[0, 0])]
            raise text.error_at(self.data, long.at, self.name, "the bone is too long for a 64-bit number")
        # The root is a point, so its children begin where it stands; its own position is where the figure starts.
        offsets = np.stack([reach[0]] + [reach[p] if p > 0 else np.zeros(3) for p in parents[1:]])
        leaves = sorted(set(range(1, len(bones))) - set(parents))
        unit = 1.0 if self.radians else np.pi / 180
        axes = np.stack([_frame(np.array(b.angles) * unit, b.order) for b in bones])
        channels, columns, shift = [], {}, []
        for j, bone in enumerate(bones):
            moves = [d for d in bone.dofs if d[0] == "t"]
            turns = [d for d in bone.dofs if d[0] == "r"]
            if j and moves and not np.array_equal(axes[j], np.eye(3)):
                said = f"bone {text.show(bone.name)} slides along its own turned axes, which a Skeleton cannot say"
                raise text.error_at(self.data, bone.at, self.name, f"{said}; remove {', '.join(moves)} or the axis")
            own = moves + turns[::-1]
            columns[bone.name] = [len(shift) + own.index(d) for d in bone.dofs]
            shift += [offsets[j]["xyz".index(d[1])] if j and d[0] == "t" else 0.0 for d in own]
            channels.append([_CHANNEL[d] for d in own])
        skeleton = Skeleton(
            names=[b.decode("utf-8", "replace") for b in order],
            parents=parents,
            offsets=text.freeze(offsets),
            channels=channels,
            end_joints=leaves,
            end_offsets=text.freeze(reach[leaves]),
            axes=text.freeze(axes),
        )
        rotates = np.array([c in ROTATION_CHANNELS for cs in channels for c in cs])
        return Asf(self.data, skeleton, columns, rotates, np.array(shift), self.radians)


def _vector(words: list[bytes]) -> list[float]:
    if len(words) != 3:
        raise ValueError(f"{len(words)} numbers, wanted 3")
    return [text.number(w) for w in words]


def _order(words: list[bytes]) -> bytes:
    order = words[0].lower() if words else b""
    if sorted(order) != sorted(b"xyz"):
        raise ValueError("wanted the order of an axis in three letters, such as XYZ")
    return order


def _dofs(words: list[bytes]) -> list[str]:
    dofs = [w.decode("utf-8", "replace").lower() for w in words]
    for dof in dofs:
        if dof == "l":
            raise ValueError("dof 'l' stretches the bone, which a Skeleton cannot say; remove it")
        if dof not in _CHANNEL or dofs.count(dof) > 1:
            raise ValueError(f"dof {dof[:20]!r}: wanted each of {', '.join(_CHANNEL)} at most once")
    return dofs


def _frame(angles: Float[np.ndarray, " 3"], order: bytes) -> Float[np.ndarray, "3 3"]:
    """The rotation by angles[0] radians about the first axis of the order, then about the second, then the third."""
    frame = np.eye(3)
    for angle, letter in zip(angles, order.decode(), strict=True):
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[letter]
        turn = np.eye(3)
        turn[[i, j], [i, j]] = np.cos(angle)
        turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
        frame = turn @ frame
    return frame


def format_asf(skeleton: Skeleton) -> bytes:
    """An ASF file that reads back as the skeleton, to rounding. Units are degrees.

    Raises FormatError for a skeleton that bones cannot say: they need one root named "root", names that differ and hold
    no spaces, children all at the end of their parent's bone, and channels that are positions, then rotations.
    """
    children = skeleton.children
    ends = dict(zip(skeleton.end_joints, skeleton.end_offsets, strict=True))
    _check_asf(skeleton, ends)
    reach = [skeleton.offsets[c[0]] if c else ends.get(j, np.zeros(3)) for j, c in enumerate(children)]
    rows = [
        "# written by jaxmocap", ":version 1.10", ":name jaxmocap", ":units", "  mass 1.0", "  length 1.0",
        "  angle deg", ":root", f"  order {' '.join(_text_dofs(skeleton.channels[0])).upper()}", "  axis XYZ",
        f"  position {_spell(skeleton.offsets[0])}", f"  orientation {_spell(_angles(skeleton.axes[0]))}", ":bonedata",
    ]
    for j in range(1, skeleton.joint_count):
        length = float(np.linalg.norm(reach[j]))
        direction = reach[j] / length if length else reach[j]
        rows += [
            "  begin", f"    id {j}", f"    name {skeleton.names[j]}", f"    direction {_spell(direction)}",
            f"    length {length!r}", f"    axis {_spell(_angles(skeleton.axes[j]))} XYZ",
        ]
        if skeleton.channels[j]:
            rows.append(f"    dof {' '.join(_text_dofs(skeleton.channels[j]))}")
        rows.append("  end")
    rows += [":hierarchy", "  begin"]
    rows += ["    " + " ".join(skeleton.names[b] for b in (j, *cs)) for j, cs in enumerate(children) if cs]
    return "\n".join([*rows, "  end", ""]).encode()


def _check_asf(skeleton: Skeleton, ends: dict[int, np.ndarray]) -> None:
    problem = ""
    names = skeleton.names
    if len(skeleton.roots) != 1 or names[0] != "root" or len(set(names)) < len(names):
        problem = "wanted one root, named 'root', and names that differ"
    elif any(len(n.split()) != 1 or n.startswith("#") or "\0" in n for n in names):
        problem = "wanted names without spaces"
    elif len(ends) < len(skeleton.end_joints):
        problem = "wanted at most one end site a joint"
    for j, children in enumerate(skeleton.children):
        own = list(skeleton.channels[j])
        offsets = [skeleton.offsets[c] for c in children] + ([ends[j]] if j in ends else [])
        if any(not np.array_equal(o, offsets[0] if j else np.zeros(3)) for o in offsets):
            problem = f"joint {names[j]!r} has children at several places (those of the root must be at 0 0 0)"
        elif own != sorted(own, key=lambda c: c in ROTATION_CHANNELS) or len(set(own)) < len(own):
            problem = f"joint {names[j]!r} wants position channels, then rotations, each once"
        elif j and own[:1] and own[0] in POSITION_CHANNELS and not np.array_equal(skeleton.axes[j], np.eye(3)):
            problem = f"joint {names[j]!r} has position channels and a turned axis"
    if problem or not skeleton.channels[0]:
        raise FormatError(f"ASF cannot say this skeleton: {problem or 'the root has no channels'}; write .bvh instead")


def _text_dofs(channels: tuple[str, ...]) -> list[str]:
    dofs = [_DOF[c] for c in channels]
    return [d for d in dofs if d[0] == "t"] + [d for d in dofs if d[0] == "r"][::-1]


def _angles(frame: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")  # any of the equal triples will do
        return Rotation.from_matrix(frame).as_euler("xyz", degrees=True)


def _spell(vector: Float[np.ndarray, " 3"]) -> str:
    return " ".join(repr(float(v)) for v in vector)
