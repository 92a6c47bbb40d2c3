"""Motion databases: many files in one, each restored byte for byte, without the others where only it is asked for.

Motion text went through tokens (`number_text`) and a number codec, anything else through zstandard.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ...errors import CorruptStream, FormatError, JaxmocapError, UnsupportedVersion
from ..artifact import Artifact, find_artifact, load_artifact, parse_artifact, shipped_models
from ..container import DIGEST_BYTES
from ..exact import Exact
from ..lossless import AbstractNumberCodec
from ..mrpa.codec import Mrpa
from ..number_text.text import NumberText, format_numbers
from .container import Archive, blob, read_archive
from .index import FOLDER, NUMBERS, Entry, checksum, shown

# Registering a number codec is what has it tested: tests/test_pack.py runs over this table. A codec is made with its model,
# which is None where no model is given and none is shipped under its id.
NUMBER_CODECS: dict[str, Callable[[Artifact | None], AbstractNumberCodec]] = {
    "exact": Exact,
    "mrpa": lambda _: Mrpa(),
}
DEFAULT = "exact"
_BATCH = 64 << 20  # bytes of text that are decoded at a time


@dataclass(frozen=True)
class File:
    """A file of a database: its entry, and its bytes, or what is wrong with them. `frames` is 0 where it is no motion text."""

    entry: Entry
    data: bytes | JaxmocapError
    frames: int = 0


class Database:
    """A database at hand; files are decoded as they are read."""

    def __init__(self, archive: Archive, model: Artifact | None = None):
        """`model` is what the archive may need; shipped and embedded ones are found."""
        self.archive = archive
        self._model = model
        self._index = {entry.name: index for index, entry in enumerate(archive.entries)}
        self._numbers = [index for index, entry in enumerate(archive.entries) if entry.kind >= NUMBERS]
        self._ordinal = {index: number for number, index in enumerate(self._numbers)}

    @staticmethod
    def open(path: str | Path, model: Artifact | None = None) -> Database:
        """Raises CorruptStream, TruncatedStream or UnsupportedVersion, and OSError."""
        return Database(read_archive(Path(path).read_bytes()), model)

    def names(self) -> list[str]:
        """Paths of all files, in order."""
        return [entry.name for entry in self.archive.entries if entry.kind != FOLDER]

    def read(self, name: str) -> bytes:
        """The bytes of one file; nothing is decoded but what it needs.

        Raises KeyError for a name that is not there, CorruptStream, TruncatedStream, UnsupportedVersion or ModelMismatch.
        """
        if self.archive.entries[self._index[name]].kind == FOLDER:
            raise KeyError(name)
        (file,) = self.read_all([name])
        if isinstance(file.data, JaxmocapError):
            raise file.data
        return file.data

    def read_all(self, names: Sequence[str] | None = None) -> Iterator[File]:
        """All files, or some; numbers are decoded many at a time. Empty folders come as files of no bytes.

        Raises KeyError for a name that is not there, UnsupportedVersion or ModelMismatch.
        """
        wanted = range(len(self.archive.entries)) if names is None else [self._index[name] for name in names]
        batch: list[int] = []
        size = 0
        for index in wanted:
            entry = self.archive.entries[index]
            if entry.kind < NUMBERS:
                yield self._other(index)
                continue
            batch.append(index)
            size += entry.size
            if size > _BATCH:
                yield from self._texts(batch)
                batch, size = [], 0
        yield from self._texts(batch)

    @cached_property
    def codec(self) -> AbstractNumberCodec | None:
        """What decodes the numbers; None where the archive holds none. Raises UnsupportedVersion or ModelMismatch."""
        shared = self.archive.shared
        if not shared.codec:
            return None
        if shared.codec not in NUMBER_CODECS:
            raise UnsupportedVersion(f"the numbers were written by {shared.codec!r}, which this jaxmocap lacks: upgrade")
        if len(shared.model) > DIGEST_BYTES:
            return NUMBER_CODECS[shared.codec](parse_artifact(shared.model, "the model inside the archive"))
        return NUMBER_CODECS[shared.codec](find_artifact(shared.model, self._model) if shared.model else None)

    @cached_property
    def _dictionary(self) -> bytes:
        return dictionary_of(self.codec)

    @cached_property
    def _templates(self) -> list[bytes]:
        return self.archive.templates(self._dictionary)

    def _other(self, index: int) -> File:
        entry = self.archive.entries[index]
        if entry.kind == FOLDER:
            return File(entry, b"")
        try:
            return _checked(entry, blob(entry, self.archive.record(index)[1], self._dictionary))
        except CorruptStream as error:
            return File(entry, error)

    def _texts(self, batch: list[int]) -> Iterator[File]:
        """The files of some texts; where one leans on what is damaged, each is decoded by itself."""
        sound = []
        for index in batch:
            try:
                self.archive.record(index)
                sound.append(index)
            except CorruptStream as error:
                yield File(self.archive.entries[index], error)
        if not sound:
            return
        assert self.codec is not None
        try:
            which = [self._ordinal[index] for index in sound]
            tables = self.codec.decode(self.archive.shared.tables, self._payload, which)
        except CorruptStream as error:
            if len(sound) > 1:
                for index in sound:
                    yield from self._texts([index])
            else:
                name = shown(self.archive.entries[sound[0]].name)
                yield File(self.archive.entries[sound[0]], CorruptStream(f"{name}: it leans on what is damaged: {error}"))
            return
        for index, table in zip(sound, tables, strict=True):
            entry = self.archive.entries[index]
            try:
                text = NumberText(self._templates[entry.template], self.archive.record(index)[0], table)
                yield _checked(entry, format_numbers(text), len(table.integers))
            except CorruptStream as error:
                yield File(entry, error)

    def _payload(self, number: int) -> bytes:
        return self.archive.record(self._numbers[number])[1]


def resolved_model(codec: str, given: Artifact | None) -> Artifact | None:
    """The model that numbers are packed with: the one given, else the one shipped for the codec, if any.

    Raises FormatError for a codec that is none.
    """
    if codec not in NUMBER_CODECS:
        raise FormatError(f"--codec is {codec!r}, wanted one of {', '.join(NUMBER_CODECS)}")
    return given if given is not None or codec not in shipped_models() else load_artifact(codec)


def stored_model(model: Artifact | None) -> bytes:
    """What the archive keeps of a model: the start of the digest of a shipped one, any other whole."""
    if model is None:
        return b""
    shipped = any(load_artifact(name) == model for name in shipped_models())
    return model.short_digest if shipped else model.data


def dictionary_of(codec: AbstractNumberCodec | None) -> bytes:
    """Text that the codec's model knows, for zstandard to refer to."""
    return getattr(codec, "dictionary", b"")


def _checked(entry: Entry, data: bytes, frames: int = 0) -> File:
    if len(data) != entry.size or checksum(entry.name, data) != entry.checksum:
        return File(entry, CorruptStream(f"{shown(entry.name)}: what it decodes to does not match its checksum"))
    return File(entry, data, frames)
