"""Motion recurring pattern analysis: Wang, Meng, Wei, Wang, Xun, IEEE Access 8, 2020. A lossless codec of databases.

All motions form one sequence (section III). Its recurring paths cut it into segments, and these form a forest; a
segment is coded by differences of neighbouring residuals against its parent. docs/methods.md says what is assumed.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float32, Int, Int8
from threadpoolctl import threadpool_limits

from ...segmentation.forest import Forest, build_forest
from ...segmentation.neighbours import radius_neighbours
from ...segmentation.paths import Paths, grow_paths
from ...segmentation.som import som_segments
from ..bitstream import ByteReader
from ..lossless import AbstractNumberCodec, NumberTable
from . import float_streams, float_tables
from . import groups as number_groups
from .float_coding import Floats, Tables, no_floats
from .float_streams import CHUNK, ORDER, TableDecoder, expected_step, last_steps, own_steps
from .forest_index import Links, pack_links, read_links
from .groups import Group
from .steps import choose_links, first_frames, fit_coefficients, inner_frames, steps

_MINOR = ("toe", "foot", "finger", "hand", "thumb", "wrist", "clavicle")
_IMPORTANT_WEIGHT, _MINOR_WEIGHT = 0.7, 0.3


class AbstractSegmentation(eqx.Module):
    """How h-segments, which overlap, become segments of the sequence."""

    @abc.abstractmethod
    def __call__(self, paths: Paths, frames: int) -> Int[np.ndarray, " segments"]:
        """First frames of the segments, ascending from 0."""


class SomSegmentation(AbstractSegmentation):
    """The paper's: see `som_segments`."""

    length_threshold: int = 30
    rounds: int = 10

    def __call__(self, paths: Paths, frames: int) -> Int[np.ndarray, " segments"]:
        return som_segments(paths.h, frames, self.length_threshold, self.rounds)


class PathSegmentation(AbstractSegmentation):
    """The paper's "Non-SOM": the h-segments themselves, of which longer ones have what they share with shorter ones."""

    def __call__(self, paths: Paths, frames: int) -> Int[np.ndarray, " segments"]:
        owner = np.full(frames, -1)
        for n in np.argsort(paths.h[:, 1] - paths.h[:, 0], kind="stable"):
            owner[paths.h[n, 0] : paths.h[n, 1] + 1] = n
        return np.flatnonzero(np.diff(owner, prepend=-2))


class Patterns(eqx.Module):
    """Search for recurring patterns; thresholds in frames, `radius` in degrees of the mean over weighted joints."""

    radius: float = 20.0
    most: int = 64
    valid_path: int = 55
    iou_threshold: float = 0.6
    segmentation: AbstractSegmentation = SomSegmentation()


@dataclass(frozen=True, eq=False)
class Analysis:
    """The path set and the forest of a database, and the paper's two figures of them (section IV)."""

    paths: Paths
    forest: Forest

    @property
    def predicted_frames(self) -> int:
        """Frames of segments that have a parent."""
        forest = self.forest
        return int((forest.ends - forest.starts + 1)[forest.parent >= 0].sum())

    @property
    def index_entries(self) -> int:
        """Pairs of parent and child."""
        return int((self.forest.parent >= 0).sum())


def analyse(tables: Sequence[NumberTable], patterns: Patterns) -> Analysis:
    """What recurs in tables of one rig, in the order given. Raises ValueError where columns differ."""
    if len({(table.columns, table.decimals) for table in tables}) != 1:
        raise ValueError("tables must have the same columns and decimals")
    values = np.concatenate([table.integers for table in tables])
    return _analyse(tables[0].columns, values / np.float32(10 ** tables[0].decimals), patterns)


def _analyse(columns: Sequence[str], values: Float32[np.ndarray, "frames columns"], patterns: Patterns) -> Analysis:
    joints, weights = joint_angles(columns, values.astype(np.float32))
    radius = patterns.radius * float(weights.sum())
    paths = grow_paths(*radius_neighbours(joints, weights, radius, patterns.most, patterns.valid_path), patterns.valid_path)
    starts = patterns.segmentation(paths, len(values))
    ends = np.append(starts[1:], len(values))[: len(starts)] - 1
    return Analysis(paths, build_forest(starts, ends, paths, patterns.iou_threshold))


def joint_angles(
    columns: Sequence[str], values: Float32[np.ndarray, "frames columns"]
) -> tuple[Float32[np.ndarray, "frames joints 3"], Float32[np.ndarray, " joints"]]:
    """Angles by joint, filled up with zeros, and the weights of (2): 0.3 for toes, feet, hands, fingers, thumbs, wrists
    and clavicles, by name, else 0.7. Positions are left out: the first three of six channels, or named so."""
    joints: dict[str, list[int]] = {}
    for column, name in enumerate(columns):
        joints.setdefault(name.rpartition(" ")[0], []).append(column)
    for name, members in joints.items():
        turning = [c for c in members if not columns[c].endswith("position")]
        joints[name] = turning[3:] if len(turning) == 6 else turning[:3]
    angles = np.zeros((len(values), len(joints), 3), np.float32)
    for j, members in enumerate(joints.values()):
        angles[:, j, : len(members)] = values[:, members]
    minor = [any(word in name.lower() for word in _MINOR) for name in joints]
    return angles, np.where(minor, _MINOR_WEIGHT, _IMPORTANT_WEIGHT).astype(np.float32)


class Mrpa(AbstractNumberCodec):
    """The codec. Tables of one rig form one database; a table leans on earlier ones that hold parents of its segments."""

    patterns: Patterns = Patterns()

    @threadpool_limits.wrap(limits=1)  # the last bits of a BLAS depend on its threads, and archives must not
    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        return number_groups.encode(tables, self._encode_group)

    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        return number_groups.decode(shared, payload, which, _decode_group)

    def _encode_group(self, group: Group, tables: Sequence[Floats]) -> tuple[bytes, list[bytes]]:
        if not sum(group.frames) or not group.columns:
            return b"", [b""] * len(tables)
        values = np.concatenate([table.value for table in tables])
        forest = _analyse(group.columns, values / np.float32(10**group.decimals), self.patterns).forest
        firsts, inner = first_frames(group.frames), inner_frames(group.frames)
        values[[first for first, n in zip(firsts, group.frames, strict=True) if n]] = 0  # while decoding they are unknown
        moved = own_steps(values, inner)
        past = np.concatenate([last_steps(m) for m in np.split(moved, firsts[1:])], 1)
        coefficients = fit_coefficients(moved, past)
        own = expected_step(past, coefficients.astype(np.int32)[:, None])
        links = choose_links(moved, own, forest)
        coded = []
        for table, first in zip(tables, firsts, strict=True):
            leaning = steps(values, links, inner, first, first + len(table.value))
            coded.append(float_streams.split(table, float_streams.predictions(table, leaning, coefficients)))
        packed = float_tables.learn(coded)
        frequencies = float_tables.read(packed)
        payloads = [
            float_streams.encode(table, symbols, frequencies) if len(table.value) else b""
            for table, symbols in zip(tables, coded, strict=True)
        ]
        return pack_links(links) + coefficients.tobytes() + packed, payloads


def _decode_group(
    group: Group, section: bytes, payload: Callable[[int], bytes], members: Sequence[int]
) -> dict[int, Floats]:
    count, lanes = sum(group.frames), len(group.columns)
    if not count or not lanes:
        return {m: no_floats(group.frames[m], lanes) for m in members}
    reader = ByteReader(section)
    links = read_links(reader, count, lanes)
    coefficients = np.frombuffer(reader.take(ORDER * lanes), np.int8).reshape(ORDER, lanes)
    sequence = _Sequence(group, links, coefficients, float_tables.read(reader.take(reader.left)))
    return {m: sequence.table(m, payload) for m in sorted(_ancestors(links, group.frames, members))}


def _ancestors(links: Links, frames: Sequence[int], members: Sequence[int]) -> set[int]:
    """The tables `members` and all that they lean on."""
    table = np.repeat(np.arange(len(frames)), frames)
    source = links.source(len(table))
    needed, waiting = set(), set(members)
    while waiting:
        m = waiting.pop()
        needed.add(m)
        sources = source[table == m]
        waiting |= set(table[sources[sources >= 0]].tolist()) - needed
    return needed


class _Sequence:
    """The sequence of a rig's tables while it is decoded."""

    def __init__(
        self,
        group: Group,
        links: Links,
        coefficients: Int8[np.ndarray, "order lanes"],
        tables: Tables,
    ):
        self._firsts, self._frames, self._inner = first_frames(group.frames), group.frames, inner_frames(group.frames)
        self._links, self._coefficients, self._tables = links, coefficients, tables
        self._source = links.source(len(self._inner))
        self._known = np.zeros((len(self._inner), len(group.columns)), np.int32)

    def table(self, m: int, payload: Callable[[int], bytes]) -> Floats:
        """Decodes table m, all that it leans on being decoded."""
        first, n = self._firsts[m], self._frames[m]
        found = no_floats(n, self._known.shape[1])
        if not n:
            return found
        decoder = TableDecoder(payload(m), self._coefficients, self._tables)
        at = 1
        while at < n:
            source = self._source[first + at : first + min(at + CHUNK, n)]
            piece = slice(at, at + _run(source, first + at))
            leaning = steps(self._known, self._links, self._inner, first + piece.start, first + piece.stop)
            found.value[piece], found.negative[piece] = decoder.frames(leaning)
            self._known[first + at : first + piece.stop] = found.value[piece]
            at = piece.stop
        found.value[0], found.negative[0] = decoder.first()
        return found


def _run(source: Int[np.ndarray, " n"], known: int) -> int:
    """How many of the frames lean on none but frames before `known`."""
    later = np.flatnonzero(source >= known)
    return int(later[0]) if len(later) else len(source)
