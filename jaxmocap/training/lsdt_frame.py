"""Training of `lsdt-frame` and `dct-frame`: bases, then Huffman codes of what the closed loop makes of the corpus.

What a loop has to code depends on what it coded before, so its symbols are counted in the loop itself, at every octave of
the step. Any frame may be the first of a chunk: the codes of first frames learn from frames all over the corpus.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from ..codecs.artifact import Artifact, make_artifact
from ..codecs.clips import Bases
from ..codecs.entropy.huffman import code_lengths
from ..codecs.frame_coefficients import KINDS, STEP_CLASSES, VALUE_SYMBOLS, FrameCodes, value_symbol
from ..codecs.frame_model import FrameModel
from ..codecs.quantise import PER_OCTAVE, STEPS, step_cm
from ..codecs.residual_frames import analyse, closed_loop
from ..transforms import dct_matrix
from .corpus import Corpus
from .loop import Stage, State, run
from .positions import BASIS_ITEMS, SPARSITY, PositionCorpus

STEP_INDICES = range(PER_OCTAVE // 2, STEPS, PER_OCTAVE)  # the middle of every octave
_FIRST_FRAMES = 32  # one in so many is coded as a first one


def train_lsdt_frame(corpus: Corpus, checkpoint: Path, sparsity: int = SPARSITY) -> tuple[Artifact, dict]:
    """The model of a corpus of one rig, and a report: the objective's curve, and nonzero coefficients by step.

    `sparsity` is P, the nonzero coefficients a frame and coordinate that the bases are learned for; 8 is the paper's best.

    Raises FormatError where the corpus has several rigs, or one whose joints cannot be told from positions.
    """
    trainer = _Trainer(corpus, "lsdt-frame", sparsity)
    stage = Stage("learning the bases", BASIS_ITEMS, trainer.learn_bases)
    artifact, report, state = trainer.train([stage], checkpoint)
    return artifact, {**report, "objective": state["objective"].tolist()}


def train_dct_frame(corpus: Corpus, checkpoint: Path) -> tuple[Artifact, dict]:
    """The same for the DCT over joints, of which nothing but the codes is learned."""
    trainer = _Trainer(corpus, "dct-frame")
    artifact, report, _ = trainer.train([Stage("making the bases", 1, trainer.take_dct)], checkpoint)
    return artifact, report


class _Trainer:
    """The stages, each a fold over the files of the corpus; every number that they pass on lies in the state."""

    def __init__(self, corpus: Corpus, codec: str, sparsity: int = SPARSITY):
        self.source = PositionCorpus(corpus, codec)
        self.codec = codec
        self.sparsity = sparsity

    @threadpool_limits.wrap(limits=1)  # the last bits of a BLAS depend on its threads, and models must not
    def train(self, bases: list[Stage], checkpoint: Path) -> tuple[Artifact, dict, State]:
        """The model, its report and the last state; `bases` are the stages that put a basis into it."""
        corpus = self.source.corpus
        files = len(corpus.files)
        stages = [Stage("reading", files, self.source.read), *bases, Stage("counting symbols", files, self._count)]
        state = run(stages, checkpoint, f"{self.codec} {corpus.digest()} {self.sparsity}")
        model = FrameModel(self.source.rig(state), Bases(state["basis"], state["basis"]), _codes(state))
        artifact = make_artifact({"codec": self.codec, "corpus": corpus.digest(), "rig": model.rig.spec()}, model.tensors())
        frames = int(state["frames"].sum())
        report = {
            "codec": self.codec,
            "digest": artifact.digest,
            "files": files,
            "frames": frames,
            "steps_cm": [step_cm(i) for i in STEP_INDICES],
            "nonzeros_a_frame": (state["seen.position"][1].sum((1, 2)) / frames).tolist(),
        }
        return artifact, report, state

    def learn_bases(self, state: State, item: int) -> State:
        return self.source.learn_bases(state, item, self.sparsity)

    def take_dct(self, state: State, item: int) -> State:
        return {**state, "basis": np.tile(dct_matrix(self.source.joints).astype(np.float32), (3, 1, 1))}

    def _count(self, state: State, item: int) -> State:
        """Positions and values of nonzeros by kind of frame, octave and coordinate."""
        joints = self.source.joints
        shapes = {"seen.position": (KINDS, STEP_CLASSES, 3, joints), "seen.value": (KINDS, STEP_CLASSES, 3, VALUE_SYMBOLS)}
        state = {**state, **{name: state.get(name, np.zeros(shape, np.int64)).copy() for name, shape in shapes.items()}}
        coefficients = analyse(self.source.positions(item), state["basis"])
        for n, index in enumerate(STEP_INDICES):
            later = closed_loop(coefficients, index, joints)[1:]
            first = np.concatenate([closed_loop(frame[None], index, joints) for frame in coefficients[::_FIRST_FRAMES]])
            for kind, levels in enumerate((first, later)):
                for d in range(3):
                    nonzero = levels[:, d] != 0
                    state["seen.position"][kind, n, d] += nonzero.sum(0)
                    np.add.at(state["seen.value"][kind, n, d], value_symbol(levels[:, d][nonzero])[0], 1)
        return state


def _codes(state: State) -> FrameCodes:
    return FrameCodes(*(np.apply_along_axis(code_lengths, -1, state[f"seen.{name}"]) for name in ("position", "value")))
