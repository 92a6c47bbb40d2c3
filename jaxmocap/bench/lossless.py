"""The lossless archive as in Wang et al. 2020: ratios (Table 4), seconds (Table 5), thresholds (Tables 1-3, Figs. 5-8)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..codecs.archive.container import read_archive
from ..codecs.archive.database import Database
from ..codecs.archive.index import NUMBERS as NUMBER_KIND
from ..codecs.archive.packing import pack
from ..codecs.container import DIGEST_BYTES
from ..codecs.lossless import AbstractNumberCodec, NumberTable
from ..codecs.mrpa.codec import Mrpa, Patterns, SomSegmentation, analyse
from ..training.corpus import Corpus
from ..training.exact import train_exact
from .lossless_folder import Folder, timed
from .lossless_peers import NUMBERS, TEXT, Matrix, NumberPeer, TextPeer

THRESHOLDS: dict[str, tuple[tuple[float, ...], Callable[[float], Patterns]]] = {
    "ValidPathThr": ((5, 10, 20, 30, 40, 50, 55, 60, 70, 80, 90), lambda n: Patterns(valid_path=int(n))),
    "LengthThr": ((5, 10, 15, 20, 25, 30, 40, 45, 50), lambda n: Patterns(segmentation=SomSegmentation(int(n)))),
    "IoUThr": ((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9), lambda share: Patterns(iou_threshold=share)),
}


def row(
    folder: Folder, name: str, kind: str, size: int, compress_s: float | None = None, decompress_s: float | None = None
) -> dict:
    """`kind` says what went in and came out: text, numbers, or the files of a database."""
    return {
        "name": name,
        "kind": kind,
        "bytes": size,
        "ratio": folder.text_bytes / size,
        "ratio_float32": folder.float32_bytes / size,
        "compress_s": compress_s,
        "decompress_s": decompress_s,
        "compress_fps": folder.frames / compress_s if compress_s else None,
        "decompress_fps": folder.frames / decompress_s if decompress_s else None,
    }


def peer_rows(folder: Folder, names: Sequence[str] = (*TEXT, *NUMBERS)) -> list[dict]:
    """A row a peer, timed at its only run; `missing` is the package that is not installed."""
    text, matrices = folder.text(), folder.matrices()
    rows = []
    for name in names:
        try:
            peer = TEXT[name]() if name in TEXT else NUMBERS[name]()
        except ImportError as error:
            rows.append({"name": name, "kind": "text" if name in TEXT else "numbers", "missing": error.name})
            continue
        made = _text_row(folder, name, peer, text) if isinstance(peer, TextPeer) else _number_row(folder, name, peer, matrices)
        rows.append(made)
    return rows


def _text_row(folder: Folder, name: str, peer: TextPeer, text: bytes) -> dict:
    data, compress_s = timed(lambda: peer.compress(text))
    back, decompress_s = timed(lambda: peer.decompress(data))
    _check(name, back == text)
    return row(folder, name, "text", len(data), compress_s, decompress_s)


def _number_row(folder: Folder, name: str, peer: NumberPeer, matrices: Sequence[Matrix]) -> dict:
    parts, compress_s = timed(lambda: [peer.compress(matrix) for matrix in matrices])
    back, decompress_s = timed(lambda: [peer.decompress(part) for part in parts])
    _check(name, all(np.array_equal(a, b) for a, b in zip(back, matrices, strict=True)))
    return row(folder, name, "numbers", sum(len(p) for part in parts for p in part), compress_s, decompress_s)


def codec_row(folder: Folder, name: str, codec: AbstractNumberCodec, runs: int = 2) -> dict:
    """A number codec by itself; the last run is timed, so that all is compiled."""
    taken = {}
    for _ in range(runs):
        (shared, payloads), compress_s = timed(lambda: codec.encode(folder.tables))
        back, decompress_s = timed(lambda s=shared, p=payloads: codec.decode(s, p.__getitem__, range(len(p))))
        _check(name, all(map(_equal, back, folder.tables)))
        taken = row(folder, name, "numbers", len(shared) + sum(map(len, payloads)), compress_s, decompress_s)
    return taken


def archive_row(folder: Folder, codec: str, runs: int = 2) -> dict:
    """A database as `jaxmocap pack` makes and `unpack` reads it; packing includes the unpacking that verifies it.

    `rest_bytes` are those that are not the number codec's: headers, layouts of the text, names, checksums, other files.
    """
    taken = {}
    for _ in range(runs):
        packed, compress_s = timed(lambda: pack(folder.files, codec))
        count, decompress_s = timed(lambda d=packed.data: sum(1 for _ in Database(read_archive(d)).read_all()))
        _check(codec, count == len(folder.files))
        archive = read_archive(packed.data)
        numbers = sum(entry.payload for entry in archive.entries if entry.kind >= NUMBER_KIND)
        rest = len(packed.data) - len(archive.shared.tables) - numbers
        taken = {**row(folder, codec, "files", len(packed.data), compress_s, decompress_s), "rest_bytes": rest}
    return taken


def with_rest(folder: Folder, numbers: dict, rest_bytes: int) -> dict:
    """The row of the database that the numbers of a row would be in."""
    return row(folder, numbers["name"], "files", numbers["bytes"] + rest_bytes)


def held_out_row(folder: Folder, name: str, learned_from: Sequence[Path]) -> dict:
    """The database by `exact` with a model of other files: as if that were shipped, and with it inside."""
    with tempfile.TemporaryDirectory() as scratch:
        model, _ = train_exact(Corpus(tuple(learned_from)), Path(scratch, "partial"))
    archive = read_archive(pack(folder.files, "exact", model).data)
    inside = len(archive.shared.model)
    return {
        **row(folder, name, "files", len(archive.data) - inside + DIGEST_BYTES),
        "model_bytes": inside,
        "ratio_with_model": folder.text_bytes / len(archive.data),
    }


def one_of_many(folder: Folder, name: str, codec: str) -> dict:
    """Seconds to restore one file of a database, and all of them."""
    archive = pack(folder.files, codec).data
    taken = {}
    for key, wanted in (("one_s", [name]), ("all_s", list(folder.files))) * 2:
        _, taken[key] = timed(lambda w=wanted: [file.data for file in Database(read_archive(archive)).read_all(w)])
    return {"codec": codec, "file": name, "files": len(folder.files), **taken}


def threshold_rows(folder: Folder, name: str) -> list[dict]:
    """What `mrpa` finds, and its ratio, against one of its thresholds, the others as usual."""
    values, patterns = THRESHOLDS[name]
    rest = archive_row(folder, "mrpa", runs=1)["rest_bytes"]
    return [_threshold_row(folder, value, patterns(value), rest) for value in values]


def _threshold_row(folder: Folder, value: float, patterns: Patterns, rest: int) -> dict:
    analysis = analyse(folder.tables, patterns)
    shared, payloads = Mrpa(patterns).encode(folder.tables)
    forest = analysis.forest
    return {
        "value": value,
        "input_segments": len(analysis.paths),
        "segments": [[int(a), int(b)] for a, b in zip(forest.starts, forest.ends, strict=True)],
        "predicted_frames": analysis.predicted_frames,
        "index_entries": analysis.index_entries,
        "ratio": folder.text_bytes / (rest + len(shared) + sum(map(len, payloads))),
    }


def _equal(a: NumberTable, b: NumberTable) -> bool:
    return np.array_equal(a.integers, b.integers) and np.array_equal(a.negative_zeros, b.negative_zeros)


def _check(name: str, same: bool) -> None:
    if not same:
        raise RuntimeError(f"{name}: what comes back is not what went in")
