"""The tree structure of a database (Wang et al. 2020, section III-D): written breadth first, tree by tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ..errors import CorruptStream
from .bitstream import ByteReader, varint


@dataclass(frozen=True, eq=False)
class Links:
    """Segments by their first frames, ascending from 0; the parent of each, -1 for a root, which comes before it.

    `back` is how many frames before its own a segment's frame finds the one of the parent's motion; 0 for a root.
    """

    starts: Int[np.ndarray, " segments"]
    parent: Int[np.ndarray, " segments"]
    back: Int[np.ndarray, " segments"]

    def source(self, frames: int) -> Int[np.ndarray, " frames"]:
        """For every frame of the sequence the earlier one that predicts it, or -1."""
        back = np.repeat(self.back, np.diff(self.starts, append=frames))
        return np.where(back > 0, np.arange(frames) - back, -1)


def without_loners(links: Links) -> Links:
    """The same links, with neighbouring segments joined that have neither parent nor children."""
    alone = links.parent < 0
    alone[links.parent[links.parent >= 0]] = False
    kept = np.ones(len(alone), bool)
    kept[1:] = ~(alone[1:] & alone[:-1])
    parent = np.where(links.parent >= 0, np.cumsum(kept)[links.parent] - 1, -1)
    return Links(links.starts[kept], parent[kept], links.back[kept])


def pack_links(links: Links) -> bytes:
    """Lengths, then breadth first each tree's segments: number of children, number of the segment, and `back`.

    A segment's number counts from its parent's, a root's from the root before.
    """
    parts = [varint(len(links.starts)), *map(varint, np.diff(links.starts).tolist())]
    parent, back = links.parent.tolist(), links.back.tolist()
    children: list[list[int]] = [[] for _ in parent]
    for s, p in enumerate(parent):
        if p >= 0:
            children[p].append(s)
    before = 0
    for root in (s for s, p in enumerate(parent) if p < 0):
        parts.append(varint(root - before))
        before = root
        queue = [root]
        for s in queue:
            if s != root:
                parts += [varint(s - parent[s]), varint(back[s])]
            parts.append(varint(len(children[s])))
            queue += children[s]
    return b"".join(parts)


def read_links(reader: ByteReader, frames: int) -> Links:
    """What `pack_links` wrote, for a sequence of so many frames. Raises CorruptStream or TruncatedStream."""
    count = reader.varint()
    if count > frames:
        raise CorruptStream(f"{count} segments are more than {frames} frames")
    starts = np.cumsum([0, *(reader.varint() for _ in range(count - 1))])[:count]
    parent, back = np.full(count, -2), np.zeros(count, int)
    root = seen = 0
    while seen < count:
        queue = [-1]
        for p in queue:
            s = p + reader.varint() if p >= 0 else root + reader.varint()
            if s >= count or s == p or parent[s] != -2:
                raise CorruptStream(f"segment {s} of {count} cannot stand where the index has it")
            parent[s] = p
            back[s] = reader.varint() if p >= 0 else 0
            root, seen = s if p < 0 else root, seen + 1
            queue += [s] * min(reader.varint(), count)
    if count and ((np.diff(starts, append=frames) < 1).any() or (back[parent >= 0] < 1).any() or (back > starts - 1).any() & (parent[back > starts - 1] >= 0).any()):
        raise CorruptStream("segments of the index do not follow each other, or lean on later ones")
    return Links(starts, parent, back)
