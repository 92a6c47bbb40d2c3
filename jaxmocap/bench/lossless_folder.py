"""What the lossless benchmarks read, and how they time: processor seconds on one core."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Int32

from ..codecs.archive.packing import find_files
from ..codecs.lossless import NumberTable
from ..codecs.number_text.text import parse_numbers

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Folder:
    """The files of a folder, and the numbers of those that are motion text."""

    files: dict[str, Path]
    tables: list[NumberTable]

    @property
    def frames(self) -> int:
        return sum(len(table.integers) for table in self.tables)

    @property
    def text_bytes(self) -> int:
        """Of all files."""
        return sum(path.stat().st_size for path in self.files.values())

    @property
    def float32_bytes(self) -> int:
        """Frames x columns x 4."""
        return sum(4 * table.integers.size for table in self.tables)

    def text(self) -> bytes:
        """All files, one after another: what the paper has gzip compress."""
        return b"".join(path.read_bytes() for path in self.files.values())

    def matrices(self) -> list[Int32[np.ndarray, "frames columns"]]:
        """All frames of each rig."""
        rigs: dict[tuple[object, ...], list[np.ndarray]] = {}
        for table in self.tables:
            rigs.setdefault((table.columns, table.decimals), []).append(table.integers)
        return [np.concatenate(parts) for parts in rigs.values()]


def read_folder(path: Path) -> Folder:
    """All files below a folder, or a single file."""
    files = dict(sorted(find_files(path).items()))
    texts = [parse_numbers(file.read_bytes()) for file in files.values() if file.is_file()]
    return Folder(files, [text.table for text in texts if text is not None])


@contextmanager
def one_core() -> Iterator[None]:
    """All threads of this process on one core, on systems that can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    _pin({min(allowed)})
    try:
        yield
    finally:
        _pin(allowed)


def _pin(cores: set[int]) -> None:
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), cores)


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """What a call gives, and the processor seconds of all threads: on one core those that an idle machine would take."""
    began = time.process_time()
    result = call()
    return result, time.process_time() - began
