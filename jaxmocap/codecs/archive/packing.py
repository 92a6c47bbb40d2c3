"""A folder into a motion database; nothing is given out before it was decoded again and compared with the files."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ...errors import FormatError
from ..artifact import Artifact
from ..number_text.text import NumberText, parse_numbers
from .container import Record, Shared, read_archive, write_archive
from .database import DEFAULT, NUMBER_CODECS, Database, dictionary_of, resolved_model, stored_model
from .index import BLOB, EXECUTABLE, FOLDER, NUMBERS, READ_ONLY, check_name, checksum, encoded


@dataclass(frozen=True)
class Packed:
    """A database: its bytes, and how many files, frames and bytes of files are in it."""

    data: bytes
    files: int
    frames: int
    text_bytes: int


@dataclass(frozen=True, eq=False)
class _Source:
    """A file as it was read: numbers where it is motion text, else its bytes. An empty folder has `data` None."""

    name: str
    mode: int
    size: int
    checksum: int
    data: bytes | None
    text: NumberText | None


def find_files(folder: Path, leave_out: Path | None = None) -> dict[str, Path]:
    """All files below a folder, and the folders that are empty, by their relative paths; or a single file.

    `leave_out` is a file that is left out. Raises FormatError for links and for what is no file, and OSError.
    """
    if not folder.is_dir():
        _check_kind(folder)
        return {folder.name: folder}
    found = {}
    for at, folders, files in os.walk(folder, onerror=_fail):
        paths = [Path(at, name) for name in files]
        for path in (*paths, *(Path(at, name) for name in folders)):
            _check_kind(path)
        paths = [path for path in paths if leave_out is None or path.resolve() != leave_out.resolve()]
        if not folders and not files and Path(at) != folder:
            paths.append(Path(at))
        found |= {path.relative_to(folder).as_posix(): path for path in paths}
    return found


def pack(
    files: dict[str, Path], codec: str = DEFAULT, model: Artifact | None = None, done: Callable[[], object] = lambda: None
) -> Packed:
    """The database of files; `done` is called twice a file: as it has been read, and as it has been verified.

    Equal files give equal bytes. Raises FormatError for a codec or name that is none and for files that change
    meanwhile, and OSError.
    """
    artifact = resolved_model(codec, model)
    sources = []
    for name in sorted(files, key=encoded):  # as the archive has them, and so the codec
        sources.append(_read(name, files[name]))
        done()
    texts = [source.text for source in sources if source.text is not None]
    coder = NUMBER_CODECS[codec](artifact) if texts else None
    tables, payloads = coder.encode([text.table for text in texts]) if coder else (b"", [])
    shared = Shared(codec, stored_model(artifact), tables) if coder else Shared()
    templates = sorted({text.template for text in texts})
    coded = iter(payloads)
    records = [
        _plain_record(source) if source.text is None else _text_record(source, source.text, templates, next(coded))
        for source in sources
    ]
    data = write_archive(shared, templates, records, dictionary_of(coder))
    _verify(Database(read_archive(data), artifact), files, done)
    return Packed(
        data,
        sum(source.data is not None for source in sources),
        sum(len(text.table.integers) for text in texts),
        sum(source.size for source in sources),
    )


def _read(name: str, path: Path) -> _Source:
    try:
        check_name(name)
    except ValueError as error:
        raise FormatError(f"{error}; rename it") from error
    if path.is_dir():
        return _Source(name, 0, 0, checksum(name, b""), None, None)
    data, permissions = path.read_bytes(), path.stat().st_mode
    mode = EXECUTABLE * bool(permissions & stat.S_IXUSR) | READ_ONLY * (not permissions & stat.S_IWUSR)
    return _Source(name, mode, len(data), checksum(name, data), data, parse_numbers(data))


def _plain_record(source: _Source) -> Record:
    kind = FOLDER if source.data is None else BLOB
    return Record(source.name, kind, source.mode, source.size, source.checksum, b"", source.data or b"")


def _text_record(source: _Source, text: NumberText, templates: list[bytes], payload: bytes) -> Record:
    kind = NUMBERS + templates.index(text.template)
    return Record(source.name, kind, source.mode, source.size, source.checksum, text.layout, payload)


def _verify(database: Database, files: dict[str, Path], done: Callable[[], object]) -> None:
    """Raises FormatError where a file is no longer what it was, and RuntimeError where it would not come back."""
    for file in database.read_all():
        name, path = file.entry.name, files[file.entry.name]
        now = b"" if path.is_dir() else path.read_bytes()
        if len(now) != file.entry.size or checksum(name, now) != file.entry.checksum:
            raise FormatError(f"{path}: the file changed while it was packed: pack again")
        if file.data != now:
            raise RuntimeError(f"{path} does not come back: {file.data if isinstance(file.data, Exception) else 'other bytes'}")
        done()


def _fail(error: OSError) -> None:
    raise error


def _check_kind(path: Path) -> None:
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        raise FormatError(f"{path}: a symbolic link, which a database does not hold: put the file in its place, or remove it")
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise FormatError(f"{path}: neither a file nor a folder: remove it")
