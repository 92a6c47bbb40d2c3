"""`jaxmocap bench lossless`: peers give back what they got, sizes are those of files, and the whole report on small data."""

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from jaxmocap.__main__ import run
from jaxmocap.bench import lossless, lossless_report
from jaxmocap.bench.lossless_folder import Folder, one_core, read_folder
from jaxmocap.bench.lossless_peers import NUMBERS, TEXT
from jaxmocap.codecs.archive.packing import pack
from jaxmocap.codecs.lossless import AbstractNumberCodec, NumberTable
from jaxmocap.codecs.mrpa.codec import Mrpa
from jaxmocap.formats import write_motion
from jaxmocap.synthesis import walk

T = TypeVar("T")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders named as those of the benchmark's data, with short walks in them."""
    at = tmp_path_factory.mktemp("data")
    names = [f"cmu_bvh/{subject}/{subject}_01.bvh" for subject in lossless_report.SUBJECTS]
    names += [f"cmu_bvh/{lossless_report.BASKETBALL}", f"cmu_bvh/{lossless_report.DANCE}", "cmu_bvh/09/09_02.bvh"]
    for seed, name in enumerate([*names, "cmu_daz/martial/one.bvh"]):
        (at / name).parent.mkdir(parents=True, exist_ok=True)
        write_motion(walk(seed, 1.0), at / name)
    (at / "cmu_amc").mkdir()
    (at / "cmu_amc/one.amc").write_bytes(b":DEGREES\n1\nroot 1.5 2\nlfoot 3\n2\nroot 1.25 2\nlfoot 1e-05\n")
    return at


@pytest.fixture(scope="module")
def folder(data: Path) -> Folder:
    return read_folder(data / "cmu_bvh/09")


@pytest.mark.parametrize("name", TEXT)
def test_peers_give_text_back(name: str, folder: Folder):
    peer = available(TEXT[name])
    for text in (b"", b"HIERARCHY", folder.text()):
        assert peer.decompress(peer.compress(text)) == text
    assert len(peer.compress(folder.text())) < len(folder.text()) / 2


@pytest.mark.parametrize("name", NUMBERS)
def test_peers_give_numbers_back(name: str, folder: Folder):
    peer = available(NUMBERS[name])
    turns = np.cumsum(np.full((400, 3), [1, -700, 1_000_003]), axis=0, dtype=np.int64) % 3_600_000 - 1_800_000
    for matrix in (folder.matrices()[0], turns.astype(np.int32), np.zeros((1, 2), np.int32)):
        assert np.array_equal(peer.decompress(peer.compress(matrix)), matrix)


def available(make: Callable[[], T]) -> T:
    try:
        return make()
    except ImportError as error:
        pytest.skip(f"{error.name} is not installed")


def test_peers_that_are_not_installed_are_said(folder: Folder, monkeypatch: pytest.MonkeyPatch):
    for package in ("brotli", "fpzip", "pcodec", "pyppmd"):
        monkeypatch.setitem(sys.modules, package, None)
    rows = {row["name"]: row for row in lossless.peer_rows(folder)}
    missing = {name: row["missing"] for name, row in rows.items() if "missing" in row}
    assert set(missing.values()) == {"brotli", "fpzip", "pcodec", "pyppmd"} and set(rows) == {*TEXT, *NUMBERS}
    assert rows["gzip -9"]["bytes"] == len(TEXT["gzip -9"]().compress(folder.text()))
    assert "brotli is not installed" in "\n".join(lossless_report.table(list(rows.values())))


def test_sizes_are_those_of_files(folder: Folder):
    row = lossless.archive_row(folder, "mrpa", runs=1)
    size = sum(path.stat().st_size for path in folder.files.values())
    assert row["bytes"] == len(pack(folder.files, "mrpa").data)
    assert row["ratio"] == pytest.approx(size / row["bytes"])
    assert row["ratio_float32"] == pytest.approx(4 * sum(t.integers.size for t in folder.tables) / row["bytes"])
    numbers = lossless.codec_row(folder, "mrpa", Mrpa(), runs=1)
    whole = lossless.with_rest(folder, numbers, row["rest_bytes"])
    assert numbers["bytes"] < whole["bytes"] == row["bytes"]


class Forgetful(AbstractNumberCodec):
    """Mrpa, but for the signs of zeros."""

    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        return Mrpa().encode([replace(t, negative_zeros=np.zeros_like(t.negative_zeros)) for t in tables])

    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        return Mrpa().decode(shared, payload, which)


def test_what_is_lossy_has_no_row(folder: Folder):
    signed = [replace(t, negative_zeros=t.integers == 0) for t in folder.tables]
    assert any(t.negative_zeros.any() for t in signed)
    with pytest.raises(RuntimeError, match="not what went in"):
        lossless.codec_row(replace(folder, tables=signed), "forgetful", Forgetful(), runs=1)


def test_segments_fill_the_sequence(folder: Folder, monkeypatch: pytest.MonkeyPatch):
    few(monkeypatch)
    for name in lossless.THRESHOLDS:
        for row in lossless.threshold_rows(folder, name):
            starts, ends = np.array(row["segments"]).T
            assert starts[0] == 0 and ends[-1] == folder.frames - 1 and (starts[1:] == ends[:-1] + 1).all()
            assert 0 <= row["index_entries"] < len(starts) and row["predicted_frames"] < folder.frames
            assert (row["predicted_frames"] > 0) == (row["index_entries"] > 0) and row["ratio"] > 1


def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two values a threshold."""
    some = {name: ((values[1], values[-2]), patterns) for name, (values, patterns) in lossless.THRESHOLDS.items()}
    monkeypatch.setattr(lossless, "THRESHOLDS", some)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system cannot keep a process on a core")
def test_one_core_and_then_all_again():
    before = os.sched_getaffinity(0)
    with one_core():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_report(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    few(monkeypatch)
    monkeypatch.setattr(lossless_report, "DATABASES", {"run": "09"})
    monkeypatch.setattr(lossless_report, "CORPORA", ("cmu_amc", "cmu_daz/martial"))
    assert run(["bench", "lossless", "--data", str(data), "--output", str(tmp_path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["lossless"]
    assert json.loads((tmp_path / "lossless.json").read_text()) == result
    assert len(list(tmp_path.glob("lossless_*.png"))) == 5
    said = lossless_report.text(result)
    for database in result["databases"].values():
        assert all(row["name"] in said for row in [*database["rows"], database["held_out"]])
        kinds = [(row["name"], row["kind"]) for row in database["rows"]]
        assert len(set(kinds)) == len(kinds) and {("exact", "files"), ("mrpa", "files"), ("app", "files")} <= set(kinds)
    assert result["databases"]["run"]["published"]["MRPA"][0] == 4.01 and "L3C 5.17" in said
    assert [row["codec"] for row in result["one_file"]] == ["exact", "mrpa"]
    assert set(result["corpora"]) == {"cmu_amc", "cmu_daz/martial"}
