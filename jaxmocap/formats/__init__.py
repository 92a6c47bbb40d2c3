"""Motion files: BVH, ASF/AMC, TRC and npz. `read_motion` and `write_motion` go by the suffix of the path."""

from __future__ import annotations

from pathlib import Path

from ..errors import FormatError
from ..motion import Motion
from .acclaim import read_amc, write_amc
from .bvh import read_bvh, write_bvh
from .npz import read_npz, write_npz
from .trc import read_trc, write_trc

SUFFIXES = (".bvh", ".amc", ".trc", ".npz")


def read_motion(path: str | Path, unit_cm: float | None = None) -> Motion:
    """Read a motion file; `unit_cm` is centimetres per file unit, where the file does not say or is to be overruled.

    Raises FormatError for an unknown suffix and for a broken file; OSError where the file cannot be opened.
    """
    match _suffix(path):
        case ".bvh":
            return read_bvh(path, unit_cm)
        case ".amc":
            return read_amc(path, unit_cm=unit_cm)
        case ".trc":
            return read_trc(path, unit_cm)
        case _:
            return read_npz(path, unit_cm)


def write_motion(motion: Motion, path: str | Path) -> None:
    """Write a motion file beside and rename it. TRC and npz keep joint positions only; AMC gets its ASF beside it.

    Raises FormatError for an unknown suffix and for what the format cannot say.
    """
    match _suffix(path):
        case ".bvh":
            write_bvh(motion, path)
        case ".amc":
            write_amc(motion, path)
        case ".trc":
            write_trc(motion, path)
        case _:
            write_npz(motion, path)


def _suffix(path: str | Path) -> str:
    suffix = Path(path).suffix.lower()
    if suffix == ".asf":
        raise FormatError(f"{path}: an ASF is a skeleton without motion; give the .amc that lies beside it")
    if suffix not in SUFFIXES:
        raise FormatError(f"{path}: unknown suffix {suffix!r}; known are {', '.join(SUFFIXES)}")
    return suffix
