"""Files of a motion database into a folder: nowhere else, and over nothing that is there."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from ...errors import CorruptStream, FormatError, JaxmocapError
from ...formats.text import write_bytes
from .database import Database, File
from .index import EXECUTABLE, FOLDER, READ_ONLY, Entry, check_name, checksum


def unpack(database: Database, folder: Path, entries: Sequence[Entry]) -> Iterator[File]:
    """Writes files, and gives each out as it has been written, or has turned out to be damaged and was not.

    Before anything is written: raises FormatError for a file of the folder that has other content and for links in the
    folder, CorruptStream for a database whose paths lead out of the folder or collide.
    """
    _check_names(entries)
    for entry in entries:
        _check_place(folder, entry)
    return _written(database, folder, entries)


def _written(database: Database, folder: Path, entries: Sequence[Entry]) -> Iterator[File]:
    folder.mkdir(parents=True, exist_ok=True)
    for file in database.read_all([entry.name for entry in entries]):
        path = folder / file.entry.name
        if file.entry.kind == FOLDER:
            path.mkdir(parents=True, exist_ok=True)
        elif not isinstance(file.data, JaxmocapError):
            _write(path, file.data, file.entry.mode)
        yield file


def _write(path: Path, data: bytes, mode: int) -> None:
    if path.exists():  # with this content, unless the file system takes two names for one
        if path.read_bytes() != data:
            raise FormatError(f"{path}: the file system takes this name and another one of the database for the same")
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data)
    _set_mode(path, mode)


def chosen(database: Database, wanted: Sequence[str]) -> list[Entry]:
    """The files of some paths, and all below those that are folders; all files where no path is given.

    Raises FormatError for a path that is not there.
    """
    entries = database.archive.entries
    if not wanted:
        return list(entries)
    found: dict[str, Entry] = {}
    for path in wanted:
        path = path.rstrip("/")
        below = {entry.name: entry for entry in entries if entry.name == path or entry.name.startswith(path + "/")}
        if not below:
            raise FormatError(f"{path} is not in the database; `jaxmocap ls` lists what is")
        found |= below
    return list(found.values())


def _check_names(entries: Sequence[Entry]) -> None:
    files = {entry.name for entry in entries}
    for entry in entries:
        try:
            check_name(entry.name)
        except ValueError as error:
            raise CorruptStream(f"the database is not to be trusted: {error}") from error
        parents = entry.name.split("/")[:-1]
        if any("/".join(parents[:depth]) in files for depth in range(1, len(parents) + 1)):
            raise CorruptStream(f"the database is not to be trusted: {entry.name} lies in what is no folder there")


def _check_place(folder: Path, entry: Entry) -> None:
    """Raises FormatError where an entry cannot be written."""
    path = folder / entry.name
    *parents, last = entry.name.split("/")
    at = folder
    for part in parents:
        at = at / part
        if at.is_symlink() or (at.exists() and not at.is_dir()):
            raise FormatError(f"{at} is no folder: move it, or unpack into an empty folder")
    if path.is_symlink() or (path.exists() and path.is_dir() != (entry.kind == FOLDER)):
        raise FormatError(f"{path} is in the way: move it, or unpack into an empty folder")
    if path.is_file() and checksum(entry.name, path.read_bytes()) != entry.checksum:
        raise FormatError(f"{path} exists and has other content: move it, or unpack into an empty folder")


def _set_mode(path: Path, mode: int) -> None:
    permissions = path.stat().st_mode & 0o777
    if mode & EXECUTABLE:
        permissions |= (permissions & 0o444) >> 2
    if mode & READ_ONLY:
        permissions &= ~0o222
    if mode:
        os.chmod(path, permissions)
