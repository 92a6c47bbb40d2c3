"""Training of `lsdt-clip`: bases from sampled frames, then magnitudes, then entropy tables from the levels themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..codecs import coefficients_paper, coefficients_runs
from ..codecs.artifact import Artifact, make_artifact
from ..codecs.clips import Bases, analyse, cut, to_clips
from ..codecs.coefficients_paper import PaperCodes
from ..codecs.coefficients_runs import BANDS, CONTEXTS, COUNT_CONTEXTS, RunTables
from ..codecs.entropy import integers
from ..codecs.entropy.huffman import code_lengths
from ..codecs.entropy.tables import FrequencyTable
from ..codecs.lsdt_clip import CHUNK_CLIPS
from ..codecs.lsdt_model import CLIP_FRAMES, LsdtModel, nearest
from ..codecs.quantise import PER_OCTAVE, STEPS, quantise, step_cm
from ..errors import FormatError
from .corpus import Corpus
from .loop import Stage, State, run
from .positions import BASIS_ITEMS, ITERATIONS, SPARSITY, PositionCorpus

# One step an octave, from 1/8 cm to 256 cm: the contexts are relative to the step, so what lies between is alike.
STEP_INDICES = range(4 * PER_OCTAVE + PER_OCTAVE // 2, STEPS, PER_OCTAVE)


def train_lsdt(corpus: Corpus, checkpoint: Path, sparsity: int = SPARSITY) -> tuple[Artifact, dict]:
    """The model of a corpus of one rig, and a report: the objective's curve, and nonzero coefficients by step.

    `sparsity` is P, the nonzero coefficients a frame and coordinate that the bases are learned for; 8 is the paper's best.

    Raises FormatError where the corpus has several rigs, or one whose joints cannot be told from positions.
    """
    trainer = _Trainer(corpus, sparsity)
    state = run(trainer.stages(), checkpoint, f"lsdt-clip {corpus.digest()} {sparsity}")
    model = trainer.model(state)
    spec = {
        "codec": "lsdt-clip",
        "corpus": corpus.digest(),
        "rig": model.rig.spec(),
        "sparsity": sparsity,
        "iterations": ITERATIONS,
    }
    artifact = make_artifact(spec, model.tensors())
    report = {
        "codec": "lsdt-clip",
        "digest": artifact.digest,
        "files": len(corpus.files),
        "frames": int(state["frames"].sum()),
        "objective": state["objective"].tolist(),
        "steps_cm": [step_cm(i) for i in STEP_INDICES],
        "nonzeros_a_frame": (state["seen.nonzeros"] / state["frames"].sum()).tolist(),
    }
    return artifact, report


class _Trainer:
    """The stages, each a fold over the files of the corpus; every number that they pass on lies in the state."""

    def __init__(self, corpus: Corpus, sparsity: int):
        self.source = PositionCorpus(corpus, "lsdt-clip")
        self.sparsity = sparsity
        self.joints = self.source.joints

    def stages(self) -> list[Stage]:
        files = len(self.source.corpus.files)
        return [
            Stage("reading", files, self.source.read),
            Stage("learning the bases", BASIS_ITEMS, self._fit),
            Stage("measuring magnitudes", files, self._measure),
            Stage("counting symbols", files, self._count),
        ]

    def _fit(self, state: State, item: int) -> State:
        longest = int(state["frames"].max())
        if nearest(longest) != CLIP_FRAMES[-1]:
            raise FormatError(
                f"the longest file of the corpus has {longest} frames: lsdt-clip learns from clips of {CLIP_FRAMES[-1]}, and "
                "needs a file of about that many"
            )
        return self.source.learn_bases(state, item, self.sparsity)

    def _measure(self, state: State, item: int) -> State:
        """Sums of magnitudes by coordinate, band and component."""
        state = dict(state)
        for frames in CLIP_FRAMES:
            total = state.get(f"sum.{frames}", np.zeros((3, BANDS, self.joints))).copy()
            number = state.get(f"number.{frames}", np.zeros((3, BANDS, self.joints))).copy()
            for chunk in self._chunks(state, item, frames):
                for clip in chunk:
                    if nearest(clip.shape[1]) == frames:
                        band = coefficients_runs.bands(clip.shape[1], self._frame_rate(state))
                        for d in range(3):
                            np.add.at(total[d], band, np.abs(clip[d], dtype=np.float64))
                            np.add.at(number[d], band, 1.0)
            state[f"sum.{frames}"], state[f"number.{frames}"] = total, number
        return state

    def _count(self, state: State, item: int) -> State:
        """Symbols of both forms at every step."""
        state = {name: value.copy() if name.startswith("seen.") else value for name, value in state.items()}
        for frames in CLIP_FRAMES:
            seen = _Seen.of(state, frames, self.joints)
            scale = _scale(state, frames)
            for n, index in enumerate(STEP_INDICES):
                for chunk in self._chunks(state, item, frames, index):
                    seen.add([c for c in chunk if nearest(c.shape[1]) == frames], scale, index, self._frame_rate(state))
                    if frames == CLIP_FRAMES[-1]:
                        nonzeros = sum(int((c != 0).sum()) for c in chunk)
                        state.setdefault("seen.nonzeros", np.zeros(len(STEP_INDICES)))[n] += nonzeros
        return state

    def _chunks(self, state: State, item: int, frames: int, index: int | None = None) -> list[list[np.ndarray]]:
        """The coefficients of a file's clips (3, frequencies, components), chunk by chunk; or their levels at a step."""
        positions = self.source.positions(item)
        c = cut(len(positions), frames)
        coefficients = analyse(to_clips(positions, c), c.full, c.last, c.clip_count - 1, state["basis"])
        values = np.asarray(coefficients if index is None else quantise(coefficients, step_cm(index)))
        clips = [values[n, :, :length] for n, length in enumerate(c.lengths)]
        return [clips[n : n + CHUNK_CLIPS] for n in range(0, len(clips), CHUNK_CLIPS)]

    def _frame_rate(self, state: State) -> int:
        return coefficients_runs.frame_rate(float(state["unit"][1]))

    def model(self, state: State) -> LsdtModel:
        """The model of the final state."""
        tables = {f: _Seen.of(state, f, self.joints).tables(_scale(state, f)) for f in CLIP_FRAMES}
        codes = {f: _Seen.of(state, f, self.joints).codes() for f in CLIP_FRAMES}
        return LsdtModel(self.source.rig(state), Bases(state["basis"], state["basis"]), tables, codes)


def _scale(state: State, frames: int) -> np.ndarray:
    """The mean magnitudes as 16 log2 of cm; what never occurred is taken to be minute."""
    mean = state[f"sum.{frames}"] / np.maximum(state[f"number.{frames}"], 1.0)
    return np.rint(PER_OCTAVE * np.log2(np.maximum(mean, 2.0**-20))).astype(np.int16)


class _Seen:
    """Counts of all symbols of one clip length, as views into the state."""

    def __init__(self, arrays: dict[str, np.ndarray]):
        self.arrays = arrays

    @staticmethod
    def of(state: State, frames: int, joints: int) -> _Seen:
        shapes = {
            "count": (COUNT_CONTEXTS, integers.SYMBOLS),
            "run": (CONTEXTS, integers.SYMBOLS),
            "value": (CONTEXTS, integers.SYMBOLS),
            "position": (3, joints),
            "level": (coefficients_paper.STEP_CLASSES, coefficients_paper.VALUE_SYMBOLS),
        }
        return _Seen({n: state.setdefault(f"seen.{frames}.{n}", np.zeros(s, np.int64)) for n, s in shapes.items()})

    def add(self, chunk: list[np.ndarray], scale: np.ndarray, index: int, frame_rate: int) -> None:
        previous: list[int | None] = [None, None, None]
        for levels in chunk:
            for d, scan in enumerate(coefficients_runs.scans(scale, levels.shape[1], frame_rate)):
                s = coefficients_runs.symbols(levels[d], scan, index)
                context = coefficients_runs.count_context(previous[d])
                self.arrays["count"][context, integers.split(np.array([s.nonzeros]))[0][0]] += 1
                previous[d] = s.nonzeros
                np.add.at(self.arrays["run"], (s.run_context, integers.split(s.run)[0]), 1)
                np.add.at(self.arrays["value"], (s.value_context, integers.split(s.value)[0]), 1)
                self.arrays["position"][d] += (levels[d] != 0).sum(0)
                values = coefficients_paper.value_symbol(levels[d][levels[d] != 0])
                np.add.at(self.arrays["level"][index // PER_OCTAVE], values, 1)

    def tables(self, scale: np.ndarray) -> RunTables:
        count, run_, value = ([FrequencyTable.from_counts(row) for row in self.arrays[n]] for n in ("count", "run", "value"))
        return RunTables(scale, count, run_, value)

    def codes(self) -> PaperCodes:
        level = self.arrays["level"].copy()
        trained = np.flatnonzero(level.sum(1))
        for row in np.flatnonzero(level.sum(1) == 0):  # steps beyond those trained code as the nearest that was
            level[row] = level[trained[np.abs(trained - row).argmin()]]
        return PaperCodes(
            np.stack([code_lengths(row) for row in self.arrays["position"]]), np.stack([code_lengths(row) for row in level])
        )
