"""What trainers of joint position codecs share: reading a corpus of one rig, its mean figure, and learning LSDT from it."""

from __future__ import annotations

import functools
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..codecs.rig import Rig
from ..errors import FormatError
from ..features.recovery import recoverable
from ..kinematics import local_rotations, pose
from ..skeleton import Skeleton
from ..transforms import dct_matrix, fit_lsdt, growing
from .corpus import Corpus
from .loop import State
from .rigs import fit_rig

SPARSITY = 8  # P, the nonzero coefficients a frame and coordinate that the bases are learned for: the paper's best
ITERATIONS = 300
SAMPLES = 11360
_ITERATIONS_AN_ITEM = 50
BASIS_ITEMS = ITERATIONS // _ITERATIONS_AN_ITEM


class PositionCorpus:
    """A corpus of one rig. Stages are folds over its files; every number that they pass on lies in the state."""

    def __init__(self, corpus: Corpus, codec: str):
        """Raises FormatError where the corpus has several rigs, or one whose joints cannot be told from positions."""
        rigs = corpus.rigs()
        skeleton = rigs[0][0]
        if len(rigs) > 1:
            others = ", ".join(f"{r.files[0].name} and {len(r.files) - 1} more" for _, r in rigs[1:])
            raise FormatError(f"the corpus has {len(rigs)} rigs; a model is for one: train apart from the first {others}")
        if not recoverable(skeleton):
            raise FormatError(f"{corpus.files[0]}: joints move along their bones in this rig; {codec} needs rigid bones")
        self.corpus = corpus
        self.skeleton = skeleton
        self.joints = skeleton.joint_count

    def positions(self, item: int) -> Float[np.ndarray, "frames joints 3"]:
        """Of one file, in cm. The stages go over the files one after another, so the last ones are kept at hand."""
        return _positions(self.corpus, self.corpus.files[item])

    def read(self, state: State, item: int) -> State:
        """Frame counts, bones and mean rotations; frames for the bases are taken at an even pace over the corpus."""
        motion = self.corpus.motion(self.corpus.files[item])
        positions = self.positions(item)
        chosen = np.linspace(0, motion.frame_count - 1, 256).astype(int)
        turned = _local_rotations(motion.skeleton, jnp.asarray(motion.values[chosen]))
        bones = np.concatenate([motion.skeleton.offsets, motion.skeleton.end_offsets])
        return {
            "frames": np.append(state.get("frames", np.zeros(0, np.int64)), motion.frame_count),
            "bones": np.concatenate([state.get("bones", np.zeros((0, *bones.shape))), bones[None]]),
            "rotations": state.get("rotations", 0.0) + np.asarray(turned.sum(0), np.float64),
            "unit": np.array([motion.scale, motion.frame_time]),
            "kept": np.concatenate([state.get("kept", np.zeros((0, self.joints, 3), np.float32)), positions[::8]]),
        }

    def learn_bases(self, state: State, item: int, sparsity: int) -> State:
        """One of BASIS_ITEMS parts of Algorithm 1, from the DCT on, and the curve of its objective."""
        kept = state["kept"]
        chosen = kept[np.linspace(0, len(kept) - 1, min(SAMPLES, len(kept))).astype(int)]
        samples = jnp.asarray(np.ascontiguousarray(chosen.transpose(2, 0, 1)))
        part = growing(min(sparsity, self.joints), ITERATIONS).reshape(-1, _ITERATIONS_AN_ITEM)[item]
        start = state.get("basis")
        if start is None:
            start = np.tile(dct_matrix(self.joints).astype(np.float32), (3, 1, 1))
        fits = [fit_lsdt(samples[d : d + 1], jnp.asarray(start[d]), part) for d in range(3)]
        basis = np.concatenate([np.asarray(f.transform.basis) for f in fits])
        curve = np.concatenate([np.asarray(f.objective[:-1]) for f in fits], 1)
        return {**state, "basis": basis, "objective": np.concatenate([state.get("objective", curve[:0]), curve])}

    def rig(self, state: State) -> Rig:
        """The rig of all people of the corpus."""
        s = self.skeleton
        people = [
            Skeleton(s.names, s.parents, b[: self.joints], s.channels, s.end_joints, b[self.joints :], s.axes)
            for b in np.unique(state["bones"], axis=0)
        ]
        unit_cm, frame_time = (float(x) for x in state["unit"])
        return fit_rig(people, state["rotations"], unit_cm, frame_time)


_local_rotations = eqx.filter_jit(local_rotations)


@functools.lru_cache(maxsize=2)
def _positions(corpus: Corpus, file: Path) -> Float[np.ndarray, "frames joints 3"]:
    """In cm; a stage may need a file several times."""
    motion = corpus.motion(file)
    return np.asarray(pose(motion).positions) * np.float32(motion.scale)
