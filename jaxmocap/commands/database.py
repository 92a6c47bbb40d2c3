"""What the commands about databases share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import JaxmocapError

if TYPE_CHECKING:
    from ..codecs.archive.database import Database
    from ..codecs.artifact import Artifact


def open_database(path: Path, model: Artifact | None = None) -> Database:
    """The database of a file; what was mended in it is said on stderr. Errors name the file."""
    from ..codecs.archive.database import Database

    try:
        database = Database.open(path, model)
    except JaxmocapError as error:
        raise type(error)(f"{path}: {error}") from error
    for notice in database.archive.notices:
        print(f"jaxmocap: {path}: {notice}", file=sys.stderr)
    return database


@contextmanager
def file_progress(total: int) -> Iterator[Callable[[], object]]:
    """A bar on stderr, where that is a terminal; to be called once a file."""
    from tqdm import tqdm

    with tqdm(total=total, unit=" files", disable=None, leave=False) as bar:
        yield bar.update
