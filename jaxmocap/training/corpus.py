"""A corpus: motion files, found in folders, read when they are needed, grouped by rig."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import FormatError
from ..formats import SUFFIXES, read_motion
from ..motion import Motion
from ..skeleton import Skeleton


@dataclass(frozen=True)
class Corpus:
    """Files in a fixed order. `start` frames are dropped from the front of each: the T-pose of the CMU conversions."""

    files: tuple[Path, ...]
    unit_cm: float | None = None
    start: int = 0

    @staticmethod
    def of(paths: Sequence[str | Path], unit_cm: float | None = None, start: int = 0) -> Corpus:
        """Files as they are, folders with all motion files below them, each once, by path. Raises FormatError."""
        found: set[Path] = set()
        for path in map(Path, paths):
            if path.is_dir():
                found |= {f for f in path.rglob("*") if f.suffix.lower() in SUFFIXES and f.is_file()}
            elif path.is_file():
                found.add(path)
            else:
                raise FormatError(f"{path}: no such file or folder")
        if not found:
            raise FormatError(f"no motion files ({', '.join(SUFFIXES)}) in {', '.join(map(str, paths))}")
        return Corpus(tuple(sorted(found)), unit_cm, start)

    def motion(self, file: Path) -> Motion:
        """One file, read now. Raises FormatError where it is broken or has nothing after `start`."""
        motion = read_motion(file, self.unit_cm)
        if motion.frame_count <= self.start:
            raise FormatError(f"{file}: {motion.frame_count} frames, and the first {self.start} are to be dropped")
        return motion.frames(self.start) if self.start else motion

    def __iter__(self) -> Iterator[Motion]:
        return map(self.motion, self.files)

    def rigs(self) -> list[tuple[Skeleton, Corpus]]:
        """The corpus of every rig, with one of its skeletons; most files first."""
        groups: list[tuple[Skeleton, list[Path]]] = []
        for file in self.files:
            skeleton = read_motion(file, self.unit_cm).skeleton
            for known, files in groups:
                if known.same_rig(skeleton):
                    files.append(file)
                    break
            else:
                groups.append((skeleton, [file]))
        groups.sort(key=lambda group: -len(group[1]))
        return [(skeleton, Corpus(tuple(files), self.unit_cm, self.start)) for skeleton, files in groups]

    def digest(self) -> str:
        """SHA-256 of the files' contents and of what is done to them; names do not matter."""
        parts = sorted(hashlib.sha256(f.read_bytes()).hexdigest() for f in self.files)
        return hashlib.sha256(f"{self.unit_cm} {self.start} {' '.join(parts)}".encode()).hexdigest()
