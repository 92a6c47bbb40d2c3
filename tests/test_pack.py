"""Databases: any folder goes in, every file comes out, from the library and from the shell."""

import hashlib
import json
import os
import random
import shutil
import stat
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.__main__ import run
from jaxmocap.codecs.archive.container import Record, Shared, read_archive, write_archive
from jaxmocap.codecs.archive.database import NUMBER_CODECS, Database
from jaxmocap.codecs.archive.index import BLOB, checksum
from jaxmocap.codecs.archive.packing import find_files, pack
from jaxmocap.codecs.artifact import load_artifact
from jaxmocap.codecs.bitstream import ByteReader, varint
from jaxmocap.codecs.lossless import AbstractNumberCodec, NumberTable
from jaxmocap.codecs.squeeze import expand, squeeze
from jaxmocap.errors import CorruptStream, FormatError, JaxmocapError
from jaxmocap.formats import write_motion
from jaxmocap.synthesis import walk


class Plain(AbstractNumberCodec):
    """The least that a number codec can be: every table leans on the first one's columns."""

    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        shared = json.dumps([table.columns for table in tables]).encode()
        payloads = []
        for table in tables:
            values = np.diff(table.integers.astype("<i8"), axis=0, prepend=0).T.tobytes()
            payloads.append(bytes([table.decimals]) + varint(len(values)) + squeeze(values + table.negative_zeros.tobytes()))
        return shared, payloads

    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        columns, tables = json.loads(shared), []
        for number in which:
            payload(0)
            reader = ByteReader(payload(number))
            decimals, size = reader.byte(), reader.varint()
            data = expand(reader.take(reader.left), size + size // 8)
            differences = np.frombuffer(data[:size], "<i8").reshape(len(columns[number]), -1)
            zeros = np.frombuffer(data[size:], bool).reshape(-1, len(columns[number]))
            integers = np.cumsum(differences, axis=1).T.astype(np.int32)
            tables.append(NumberTable(tuple(columns[number]), integers, zeros, decimals))
        return tables


CODECS = {"plain": lambda _: Plain(), **NUMBER_CODECS}


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(NUMBER_CODECS, "plain", CODECS["plain"])


@pytest.fixture(params=sorted(CODECS))
def codec(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Walks of two rigs' worth of headers, and whatever else people keep beside them."""
    at = tmp_path_factory.mktemp("folder")
    (at / "sub/deep").mkdir(parents=True)
    (at / "nothing here").mkdir()
    for name, seed in (("walk.bvh", 1), ("sub/deep/walk.bvh", 2), ("sub/laufen_ü.bvh", 3)):
        write_motion(walk(seed, 0.5), at / name)
    text = (at / "walk.bvh").read_bytes()
    (at / "cut.bvh").write_bytes(text[: len(text) * 2 // 3])
    (at / "headless.bvh").write_bytes(text[:300])
    (at / "crlf.bvh").write_bytes(text.replace(b"\n", b"\r\n"))
    (at / "mixed.bvh").write_bytes(text.replace(b"\n", b"\r\n", 250).replace(b"0.0000", b"1e300", 3))
    (at / "one.amc").write_bytes(b":DEGREES\n1\nroot 1.5 2\nlfoot 3\n2\nroot 1.25 2\nlfoot 1e-05\n")
    (at / "empty.bvh").write_bytes(b"")
    (at / "noise.bin").write_bytes(random.Random(7).randbytes(3000))
    (at / "notes.txt").write_text("take 3 is the good one\n" * 40)
    (at / "run.sh").write_text("#!/bin/sh\n")
    (at / "run.sh").chmod(0o755)
    (at / "locked.txt").write_text("read only")
    (at / "locked.txt").chmod(0o444)
    Path(os.fsdecode(bytes(at) + b"/\xff.bvh")).write_bytes(text)
    return at


@pytest.fixture(scope="module")
def database(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    NUMBER_CODECS["plain"] = CODECS["plain"]
    path = tmp_path_factory.mktemp("database") / "db.jmc"
    path.write_bytes(pack(find_files(folder), "plain").data)
    del NUMBER_CODECS["plain"]
    return path


def tree(folder: Path) -> dict[str, bytes | None]:
    """Every path below a folder with its bytes; None for a folder."""
    paths = {str(path.relative_to(folder)): path for path in folder.rglob("*")}
    return {name: path.read_bytes() if path.is_file() else None for name, path in paths.items()}


def report(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    assert run([*map(str, arguments), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert run(list(map(str, arguments))) == 2
    out, err = capsys.readouterr()
    assert out == "" and all(line.startswith("jaxmocap: ") for line in err.splitlines())
    return err


def test_every_file_comes_back(folder: Path, tmp_path: Path, codec: str, capsys: pytest.CaptureFixture[str]):
    packed = report(capsys, "pack", folder, "-o", tmp_path / "db.jmc", "--codec", codec)
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    assert packed["files"] == len(sizes) and packed["text_bytes"] == sum(sizes)
    assert packed["stream_bytes"] == (tmp_path / "db.jmc").stat().st_size
    assert packed["ratio"] == pytest.approx(packed["text_bytes"] / packed["stream_bytes"]) and packed["frames"] > 6 * 60
    back = report(capsys, "unpack", tmp_path / "db.jmc", "-o", tmp_path / "out")
    assert tree(tmp_path / "out") == tree(folder)
    assert all(back[key] == packed[key] for key in ("files", "frames", "text_bytes"))
    assert (tmp_path / "out/run.sh").stat().st_mode & stat.S_IXUSR
    assert not (tmp_path / "out/locked.txt").stat().st_mode & stat.S_IWUSR
    assert (tmp_path / "out/notes.txt").stat().st_mode & (stat.S_IWUSR | stat.S_IXUSR) == stat.S_IWUSR


def test_files_alone_and_together_are_the_same(folder: Path, tmp_path: Path, codec: str):
    packed = pack(find_files(folder), codec)
    assert packed.data == pack(find_files(folder), codec).data
    (tmp_path / "db.jmc").write_bytes(packed.data)
    opened = Database.open(tmp_path / "db.jmc")
    assert set(opened.names()) == {name for name, data in tree(folder).items() if data is not None}
    for name in opened.names():
        assert opened.read(name) == (folder / name).read_bytes()
    with pytest.raises(KeyError):
        opened.read("nothing here")


def test_a_damaged_byte_spoils_one_file_and_what_leans_on_it(folder: Path, database: Path, tmp_path: Path):
    whole, original = database.read_bytes(), tree(folder)
    archive = read_archive(whole)
    first = next(entry.name for entry in archive.entries if entry.kind >= 2)
    places = random.Random(3).sample(range(len(whole)), 150)
    for at in places:
        data = bytearray(whole)
        data[at] ^= 0x10
        opened = Database(read_archive(bytes(data)))
        files = {file.entry.name: file.data for file in opened.read_all()}
        lost = [name for name, found in files.items() if isinstance(found, JaxmocapError)]
        assert all(found == (original[name] or b"") for name, found in files.items() if name not in lost)
        if at < archive.starts[0]:
            assert not lost and opened.archive.notices
        elif first in lost:
            assert len(lost) == sum(entry.kind >= 2 for entry in archive.entries)
        else:
            assert len(lost) == 1


def test_unpack_names_what_is_damaged_and_writes_the_rest(
    folder: Path, database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data, archive = bytearray(database.read_bytes()), read_archive(database.read_bytes())
    names = [entry.name for entry in archive.entries]
    data[archive.starts[names.index("notes.txt")] + 3] ^= 1
    data[archive.starts[names.index("walk.bvh")] + 90] ^= 1
    (tmp_path / "bad.jmc").write_bytes(data)
    said = refusal(capsys, "unpack", tmp_path / "bad.jmc", "-o", tmp_path / "out")
    assert "damaged: notes.txt, walk.bvh" in said and said.count("\n") == 3
    rest = {name: content for name, content in tree(folder).items() if name not in ("notes.txt", "walk.bvh")}
    assert tree(tmp_path / "out") == rest
    whole = bytearray(database.read_bytes())
    whole[30] ^= 1
    (tmp_path / "mended.jmc").write_bytes(whole)
    assert run(["unpack", str(tmp_path / "mended.jmc"), "-o", str(tmp_path / "mended")]) == 0
    assert "byte 30, in the index, was damaged and has been mended" in capsys.readouterr().err
    assert tree(tmp_path / "mended") == tree(folder)


def test_a_truncated_database_gives_what_is_whole(
    folder: Path, database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    whole, original = database.read_bytes(), tree(folder)
    for size in range(0, len(whole), len(whole) // 40):
        try:
            opened = Database(read_archive(whole[:size]))
        except CorruptStream:
            assert size < read_archive(whole).starts[0]
            continue
        files = {file.entry.name: file.data for file in opened.read_all()}
        assert all(isinstance(data, JaxmocapError) or data == (original[name] or b"") for name, data in files.items())
    (tmp_path / "cut.jmc").write_bytes(whole[:-1])
    assert "damaged: \\xff.bvh" in refusal(capsys, "unpack", tmp_path / "cut.jmc", "-o", tmp_path / "out")
    assert len(tree(tmp_path / "out")) == len(original) - 1


def test_ls_and_info(folder: Path, database: Path, capsys: pytest.CaptureFixture[str]):
    listed = report(capsys, "ls", database)
    assert listed["text_bytes"] == sum(len(data) for data in tree(folder).values() if data)
    assert listed["stream_bytes"] == database.stat().st_size
    kinds = {entry["name"]: entry["kind"] for entry in listed["entries"]}
    assert kinds["walk.bvh"] == "numbers" and kinds["noise.bin"] == "blob" and kinds["nothing here"] == "folder"
    assert kinds["one.amc"] == "numbers" and kinds["cut.bvh"] == "numbers" and kinds["headless.bvh"] == "blob"
    assert run(["ls", str(database)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(kinds) + 2
    described = report(capsys, "info", database)
    assert described["format"] == "jmd 1" and described["codec"] == "plain" and described["files"] == listed["files"]
    assert sum(described["sections"].values()) == described["bytes"]


def test_some_files(folder: Path, database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made = report(capsys, "unpack", database, "-o", tmp_path, "notes.txt", "sub/")
    wanted = {name: data for name, data in tree(folder).items() if name == "notes.txt" or name.startswith("sub")}
    assert tree(tmp_path) == wanted and made["files"] == 3
    assert "nowhere is not in the database" in refusal(capsys, "unpack", database, "-o", tmp_path, "nowhere")


def test_what_is_there_is_not_overwritten(folder: Path, database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    shutil.copytree(folder, tmp_path / "same")
    report(capsys, "unpack", database, "-o", tmp_path / "same")
    (tmp_path / "same/walk.bvh").write_text("my own")
    (tmp_path / "same/notes.txt").unlink()
    assert "walk.bvh exists" in refusal(capsys, "unpack", database, "-o", tmp_path / "same")
    assert (tmp_path / "same/walk.bvh").read_text() == "my own" and not (tmp_path / "same/notes.txt").exists()
    report(capsys, "unpack", database, "-o", tmp_path / "same", "notes.txt")


def test_links_in_the_target_are_not_followed(database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for link in ("sub", "notes.txt"):
        out, elsewhere = tmp_path / f"out {link}", tmp_path / f"elsewhere {link}"
        out.mkdir()
        elsewhere.mkdir()
        (out / link).symlink_to(elsewhere)
        refusal(capsys, "unpack", database, "-o", out)
        assert not tree(elsewhere) and tree(out) == {link: None}


@pytest.mark.parametrize("names", [["../out"], ["/tmp/out"], ["a/../../b"], ["c:\\x"], ["..\\x"], ["a", "a/b"], ["a/./b"]])
def test_paths_that_lead_out_are_refused(names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    records = [Record(name, BLOB, 0, 3, checksum(name, b"bad"), b"", b"bad") for name in names]
    (tmp_path / "evil.jmc").write_bytes(write_archive(Shared(), [], records))
    before = tree(tmp_path)
    assert "not to be trusted" in refusal(capsys, "unpack", tmp_path / "evil.jmc", "-o", tmp_path / "deep/out")
    assert tree(tmp_path) == before


def test_what_cannot_be_packed_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "in").mkdir()
    out = tmp_path / "x.jmc"
    arguments = ["pack", tmp_path / "in", "-o", out, "--codec", "plain"]
    assert "wanted one of" in refusal(capsys, *arguments[:-1], "zip")
    assert "none: No such file" in refusal(capsys, "pack", tmp_path / "none", "-o", out, "--codec", "plain")
    (tmp_path / "in/back\\slash").write_text("x")
    assert "rename it" in refusal(capsys, *arguments)
    (tmp_path / "in/back\\slash").unlink()
    (tmp_path / "in/link").symlink_to(tmp_path)
    assert "link: a symbolic link" in refusal(capsys, *arguments)
    (tmp_path / "in/link").unlink()
    os.mkfifo(tmp_path / "in/pipe")
    assert "pipe: neither a file nor a folder" in refusal(capsys, *arguments)
    assert not out.exists()


def test_a_file_that_changes_meanwhile_is_noticed(tmp_path: Path):
    (tmp_path / "a.txt").write_text("before")

    def change() -> None:
        (tmp_path / "a.txt").write_text("after")

    with pytest.raises(FormatError, match="changed while it was packed"):
        pack(find_files(tmp_path), "plain", done=change)


def test_the_database_is_not_packed_into_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "a.txt").write_text("a")
    for _ in range(2):
        assert report(capsys, "pack", tmp_path, "-o", tmp_path / "db.jmc", "--codec", "plain")["files"] == 1


def test_a_single_file_and_an_empty_folder(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    report(capsys, "pack", folder / "walk.bvh", "-o", tmp_path / "db.jmc", "--codec", "plain")
    report(capsys, "unpack", tmp_path / "db.jmc", "-o", tmp_path / "out")
    assert tree(tmp_path / "out") == {"walk.bvh": (folder / "walk.bvh").read_bytes()}
    (tmp_path / "empty").mkdir()
    made = report(capsys, "pack", tmp_path / "empty", "-o", tmp_path / "db.jmc", "--codec", "plain")
    assert made["files"] == 0 and made["stream_bytes"] < 50
    assert report(capsys, "unpack", tmp_path / "db.jmc", "-o", tmp_path / "none")["files"] == 0


def test_streams_are_no_databases(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for data in (b"JMC\1" + bytes(40), b"HIERARCHY\nROOT Hips\n", b""):
        (tmp_path / "x.jmc").write_bytes(data)
        assert "x.jmc: " in refusal(capsys, "ls", tmp_path / "x.jmc")
        refusal(capsys, "unpack", tmp_path / "x.jmc", "-o", tmp_path / "out")
        refusal(capsys, "info", tmp_path / "x.jmc")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["cmu_bvh/09", "cmu_amc/16"])
def test_real_subjects(data_dir: Path, tmp_path: Path, codec: str, name: str):
    packed = pack(find_files(data_dir / name), codec)
    archive = read_archive(packed.data)
    assert packed.text_bytes > 4 * len(packed.data)
    assert archive.section_bytes()["index"] < 60 + 30 * packed.files


@pytest.mark.parametrize("codec", ["exact", "mrpa"])
def test_golden_databases_decode_for_ever(codec: str):
    golden = Path(__file__).parent / "golden" / "databases"
    model = load_artifact(golden / "exact-2f5999c8.safetensors") if codec == "exact" else None
    database = Database.open(golden / f"database-{codec}.jmc", model)
    found = {name: hashlib.sha256(database.read(name)).hexdigest() for name in database.names()}
    assert found == json.loads((golden / f"database-{codec}.json").read_text())
    assert codec != "exact" or database.archive.shared.model == bytes.fromhex("2f5999c8")
