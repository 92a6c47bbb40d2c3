"""The bytes of a database: what is damaged is noticed and named, and what all files need mends itself."""

import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmocap.codecs.archive.container import HEAD_BYTES, Record, Shared, blob, is_archive, read_archive, write_archive
from jaxmocap.codecs.archive.crc import mended
from jaxmocap.codecs.archive.index import BLOB, FOLDER, NUMBERS, check_name, checksum
from jaxmocap.codecs.squeeze import expand, squeeze
from jaxmocap.errors import CorruptStream, JaxmocapError, TruncatedStream, UnsupportedVersion

FILES = {"a/one.txt": b"one " * 50, "a/two": bytes(range(256)), "b": b"", "c/n.bvh": b"numbers"}
SHARED = Shared("exact", b"\1\2\3\4", b"tables of the codec")
TEMPLATES = [b"HIERARCHY first " * 9, b"HIERARCHY second " * 9]


def archive() -> bytes:
    records = [
        Record(name, BLOB, n % 4, len(data), checksum(name, data), b"", data) for n, (name, data) in enumerate(FILES.items())
    ]
    records[3] = Record("c/n.bvh", NUMBERS + 1, 0, 999, 12345, b"layout " * 40, b"payload")
    records.append(Record("empty", FOLDER, 0, 0, checksum("empty", b"")))
    return write_archive(SHARED, TEMPLATES, records)


WHOLE = archive()
START = read_archive(WHOLE).starts[0]


def contents(data: bytes) -> dict[str, tuple[bytes, bytes] | None]:
    """Layout and payload of every file, None for a damaged one."""
    found = read_archive(data)
    assert found.shared == SHARED and found.templates() == TEMPLATES
    result: dict[str, tuple[bytes, bytes] | None] = {}
    for index, entry in enumerate(found.entries):
        try:
            layout, payload = found.record(index)
            result[entry.name] = layout, blob(entry, payload) if entry.kind == BLOB else payload
        except CorruptStream as error:
            assert str(error).startswith(entry.name)
            result[entry.name] = None
    return result


def test_everything_comes_back_in_order():
    wanted = {name: (b"", data) for name, data in FILES.items()}
    wanted |= {"c/n.bvh": (b"layout " * 40, b"payload"), "empty": (b"", b"")}
    assert contents(WHOLE) == wanted and list(contents(WHOLE)) == sorted(wanted)
    found = read_archive(WHOLE)
    assert found.notices == () and [e.mode for e in found.entries] == [0, 1, 2, 0, 0]
    assert [e.kind for e in found.entries] == [BLOB, BLOB, BLOB, NUMBERS + 1, FOLDER]
    assert sum(found.section_bytes().values()) == len(WHOLE)


def test_the_same_files_give_the_same_bytes():
    records = [Record(name, BLOB, 0, len(d), checksum(name, d), b"", d) for name, d in FILES.items()]
    assert write_archive(SHARED, TEMPLATES, records) == write_archive(SHARED, TEMPLATES, records[::-1])


def test_few_bytes_a_file():
    def size(count: int) -> int:
        names = [f"09/09_{n:02}.bvh" for n in range(count)]
        records = [Record(n, NUMBERS, 0, 123456, zlib.crc32(n.encode()), b"1234", b"") for n in names]
        return len(write_archive(Shared(), [b""], records))

    assert size(0) < 40
    assert size(60) - size(10) < 50 * 20


@pytest.mark.parametrize("error", [1, 0x80, 0xFF, 0x55])
def test_a_damaged_byte_is_mended_or_spoils_one_file(error: int):
    wanted = contents(WHOLE)
    for at in range(len(WHOLE)):
        data = bytearray(WHOLE)
        data[at] ^= error
        assert is_archive(bytes(data[:HEAD_BYTES]))
        found = contents(bytes(data))
        if at < START:
            assert found == wanted and len(read_archive(bytes(data)).notices) == 1, at
        else:
            (lost,) = [name for name, content in found.items() if content is None]
            assert all(found[name] == wanted[name] for name in wanted if name != lost)


@given(st.integers(0, START - 1), st.integers(0, START - 1), st.integers(1, 255), st.integers(1, 255))
def test_two_damaged_bytes_are_mended_or_refused(one: int, two: int, first: int, second: int):
    data = bytearray(WHOLE)
    data[one] ^= first
    data[two] ^= second
    try:
        assert contents(bytes(data)) == contents(WHOLE)
    except (CorruptStream, UnsupportedVersion):
        pass


def test_a_prefix_gives_what_is_whole_in_it():
    wanted = contents(WHOLE)
    for size in range(len(WHOLE)):
        if size < START:
            with pytest.raises(TruncatedStream):
                read_archive(WHOLE[:size])
        else:
            found = read_archive(WHOLE[:size])
            for index, entry in enumerate(found.entries):
                if entry.stored and found.starts[index] + entry.stored > size:
                    with pytest.raises(TruncatedStream, match=entry.name):
                        found.record(index)
            assert all(content in (None, wanted[name]) for name, content in contents(WHOLE[:size]).items())


def test_bytes_behind_the_archive_are_said():
    assert read_archive(WHOLE + b"xyz").notices == ("3 bytes follow the archive",)


@given(st.binary(max_size=200))
def test_other_bytes_are_refused(data: bytes):
    with pytest.raises((CorruptStream, UnsupportedVersion)):
        read_archive(data)
    with pytest.raises(JaxmocapError):
        read_archive(WHOLE[:3] + data)


def test_a_later_version_is_named():
    head = bytearray(WHOLE[:HEAD_BYTES])
    head[3] = 2
    head[-4:] = zlib.crc32(head[:-4]).to_bytes(4, "little")
    with pytest.raises(UnsupportedVersion, match="format 2"):
        read_archive(bytes(head) + WHOLE[HEAD_BYTES:])


def test_no_two_damages_of_a_head_look_alike():
    body = bytearray(HEAD_BYTES - 4)
    marks = set()
    for at in range(len(body)):
        for error in range(1, 256):
            body[at] = error
            marks.add(zlib.crc32(body) ^ zlib.crc32(bytes(len(body))))
            body[at] = 0
    checksum_marks = {error << shift for error in range(1, 256) for shift in (0, 8, 16, 24)}
    assert len(marks) == 255 * len(body) and not marks & checksum_marks


@given(st.binary(min_size=1, max_size=2000), st.data())
def test_a_crc_finds_the_byte(data: bytes, draw: st.DataObject):
    at, error = draw.draw(st.integers(0, len(data) - 1)), draw.draw(st.integers(1, 255))
    damaged = data[:at] + bytes([data[at] ^ error]) + data[at + 1 :]
    ways = list(mended(damaged, zlib.crc32(data)))
    assert data in ways and all(zlib.crc32(way) == zlib.crc32(data) for way in ways)
    assert list(mended(data, zlib.crc32(data))) == []


@given(st.binary(max_size=5000), st.binary(max_size=300))
def test_squeezing(data: bytes, dictionary: bytes):
    packed = squeeze(data, dictionary)
    assert expand(packed, len(data), dictionary) == data
    for size in {len(data) + 1, max(len(data) - 1, 1)} - {len(data)}:
        with pytest.raises(CorruptStream):
            expand(packed, size, dictionary)


def test_a_dictionary_helps_and_sizes_are_bounded():
    text = bytes(range(256))
    assert len(squeeze(text, text)) < 30 < len(squeeze(text))
    with pytest.raises(CorruptStream, match="cannot hold"):
        expand(b"1234", 1 << 34)


@pytest.mark.parametrize("name", ["", "/etc/passwd", "..", "../a", "a/../b", "a//b", "a/", "./a", "a\\b", "C:a", "c:/", "a\0"])
def test_names_that_lead_elsewhere(name: str):
    with pytest.raises(ValueError, match="no path inside a folder"):
        check_name(name)


@pytest.mark.parametrize("name", ["a", "..a/b..", "Take 12:30.bvh", "ünï/コード", "a b", "\udcff"])
def test_names_that_stay(name: str):
    check_name(name)
