"""Learning transforms from corpora, and keeping them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..codecs.artifact import Artifact
from .corpus import Corpus as Corpus
from .exact import train_exact as train_exact
from .learned.train import train_learned as train_learned
from .live.train import train_live as train_live
from .lsdt import train_lsdt as train_lsdt
from .lsdt_frame import train_dct_frame as train_dct_frame
from .lsdt_frame import train_lsdt_frame as train_lsdt_frame

# By codec id: from a corpus and a checkpoint to a model and its report.
TRAINERS: dict[str, Callable[[Corpus, Path], tuple[Artifact, dict]]] = {
    "learned": train_learned,
    "lsdt-clip": train_lsdt,
    "lsdt-frame": train_lsdt_frame,
    "dct-frame": train_dct_frame,
    "live": train_live,
    "exact": train_exact,
}
