"""Learning transforms from corpora, and keeping them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..codecs.artifact import Artifact
from .corpus import Corpus as Corpus
from .exact import train_exact as train_exact
from .learned.train import train_learned as train_learned
from .lsdt import train_lsdt as train_lsdt

# By codec id: from a corpus and a checkpoint to a model and its report.
TRAINERS: dict[str, Callable[[Corpus, Path], tuple[Artifact, dict]]] = {
    "learned": train_learned,
    "lsdt-clip": train_lsdt,
    "exact": train_exact,
}
