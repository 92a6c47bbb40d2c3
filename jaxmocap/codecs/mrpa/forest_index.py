"""The tree structure of a database (Wang et al. 2020, section III-D): written breadth first, tree by tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8

from ...errors import CorruptStream
from ..bitstream import ByteReader, varint
from ..entropy.range_coder import RangeDecoder, RangeEncoder
from ..entropy.tables import FrequencyTable

SHARES = np.array([0, 1, 2, 4, 8], np.uint8)  # eighths of a parent's step that a channel may take


@dataclass(frozen=True, eq=False)
class Links:
    """Segments by their first frames, ascending from 0; the parent of each, which comes before it, or -1 for a root.

    `back` is how many frames before its own a segment's frame finds its match in the parent's motion, 0 for a root;
    `shares` tells by channel how much of that motion's steps the segment takes: places in `SHARES`.
    """

    starts: Int[np.ndarray, " segments"]
    parent: Int[np.ndarray, " segments"]
    back: Int[np.ndarray, " segments"]
    shares: UInt8[np.ndarray, "segments lanes"]

    def source(self, frames: int) -> Int[np.ndarray, " frames"]:
        """For every frame of the sequence the earlier one that it leans on, or -1."""
        back = np.repeat(self.back, np.diff(self.starts, append=frames))
        return np.where(back > 0, np.arange(frames) - back, -1)

    def weight(self, frames: Int[np.ndarray, " n"]) -> UInt8[np.ndarray, "n lanes"]:
        """For every frame the eighths that its channels take."""
        return SHARES[self.shares][np.searchsorted(self.starts, frames, "right") - 1]


def without_loners(links: Links) -> Links:
    """The same links, with neighbouring segments joined that have neither parent nor children."""
    alone = links.parent < 0
    alone[links.parent[links.parent >= 0]] = False
    kept = np.ones(len(alone), bool)
    kept[1:] = ~(alone[1:] & alone[:-1])
    parent = np.where(links.parent >= 0, np.cumsum(kept)[links.parent] - 1, -1)
    return Links(links.starts[kept], parent[kept], links.back[kept], links.shares[kept])


def pack_links(links: Links) -> bytes:
    """Lengths of all segments but the last; breadth first each tree's segments: how far a segment's number is from its
    parent's (a root's from the root before), `back`, and the number of children; then the shares."""
    parts = [varint(len(links.starts)), *map(varint, np.diff(links.starts).tolist())]
    parent, back = links.parent.tolist(), links.back.tolist()
    children: list[list[int]] = [[] for _ in parent]
    for s, p in enumerate(parent):
        if p >= 0:
            children[p].append(s)
    before = 0
    for root in (s for s, p in enumerate(parent) if p < 0):
        queue = [root]
        for s in queue:
            parts.append(varint(root - before) if s == root else varint(s - parent[s]) + varint(back[s]))
            parts.append(varint(len(children[s])))
            queue += children[s]
        before = root
    return b"".join(parts) + _pack_shares(links.shares[links.parent >= 0])


def read_links(reader: ByteReader, frames: int, lanes: int) -> Links:
    """What `pack_links` wrote, for a sequence of so many frames. Raises CorruptStream or TruncatedStream."""
    count = reader.varint()
    if not 0 < count <= frames:
        raise CorruptStream(f"{count} segments cannot hold {frames} frames")
    starts = np.cumsum([0, *(reader.varint() for _ in range(count - 1))])
    parent, back = np.full(count, -2), np.zeros(count, int)
    root = seen = 0
    while seen < count:
        queue = [-1]
        for p in queue:
            s = max(p, 0) + reader.varint() if p >= 0 else root + reader.varint()
            if s >= count or s == p or parent[s] != -2:
                raise CorruptStream(f"segment {s} of {count} cannot stand where the index has it")
            parent[s] = p
            if p >= 0:
                back[s] = reader.varint()
            else:
                root = s
            seen += 1
            queue += [s] * min(reader.varint(), count)
    linked = parent >= 0
    if (np.diff(starts, append=frames) < 1).any() or (linked & ((back < 1) | (back > starts))).any():
        raise CorruptStream("segments of the index do not follow each other, or lean on frames that are not before them")
    shares = np.zeros((count, lanes), np.uint8)
    shares[linked] = _read_shares(reader, int(linked.sum()), lanes)
    return Links(starts, parent, back, shares)


def _pack_shares(shares: UInt8[np.ndarray, "links lanes"]) -> bytes:
    if not len(shares):
        return b""
    counts = np.bincount(shares.ravel(), minlength=len(SHARES))
    table, encoder = FrequencyTable.from_counts(counts), RangeEncoder()
    for share in shares.ravel().tolist():
        encoder.encode(share, table)
    body = encoder.finish()
    return b"".join(map(varint, counts.tolist())) + varint(len(body)) + body


def _read_shares(reader: ByteReader, count: int, lanes: int) -> UInt8[np.ndarray, "links lanes"]:
    if not count:
        return np.zeros((0, lanes), np.uint8)
    table = FrequencyTable.from_counts(np.array([reader.varint() for _ in SHARES]))
    decoder = RangeDecoder(reader.take(reader.varint()))
    return np.array([decoder.decode(table) for _ in range(count * lanes)], np.uint8).reshape(count, lanes)
