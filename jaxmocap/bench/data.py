"""The CMU clips of the benchmarks: what is tested, and what may be learned from."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import FormatError
from ..formats import read_motion
from ..motion import Motion
from ..training.corpus import Corpus

UNIT_CM = 5.6444  # 2.54 / 0.45
TEST = ("09_06", "09_01", "02_05", "02_10", "05_02", "05_12", "06_03", "06_14", "01_05")


def data_folder(folder: Path | None) -> Path:
    """The folder with `cmu_bvh`: the one given, JAXMOCAP_DATA, or ../shared/data. Raises FormatError."""
    found = folder or Path(os.environ.get("JAXMOCAP_DATA", "../shared/data"))
    if not (found / "cmu_bvh").is_dir():
        raise FormatError(f"{found}: no folder cmu_bvh in it; name the data with --data or JAXMOCAP_DATA")
    return found


def test_motions(data: Path) -> dict[str, Motion]:
    """The nine test clips without their T-pose."""
    files = {name: data / "cmu_bvh" / name[:2] / f"{name}.bvh" for name in TEST}
    return {name: read_motion(file, UNIT_CM).frames(1) for name, file in files.items()}


def train_corpus(data: Path, start: int = 1) -> Corpus:
    """Every other clip of the five subjects; `start` 1 leaves out its T-pose, as lossy codecs do."""
    files = sorted(f for f in (data / "cmu_bvh").glob("*/*.bvh") if f.stem not in TEST)
    return Corpus(tuple(files), UNIT_CM, start)
