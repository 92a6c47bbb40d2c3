"""Training of `learned`, in resumable stages: mean pose, moments, basis, then densities on levels that they helped to choose.

Densities are first fitted to plainly quantised levels; with them the basis is refined by gradients through rate and
kinematics. Then they are fitted twice to levels that the encoder chose with the densities so far, since what is optimal
to code has other statistics than what is merely rounded. Steps are drawn log-uniformly, and are an input, so that one
model serves all rates.
"""

from __future__ import annotations

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from ...codecs.artifact import Artifact, make_artifact
from ...codecs.learned import bands
from ...codecs.learned.attempt import Attempt, Source
from ...codecs.learned.basis import Basis, direction_of
from ...codecs.learned.coefficients import Densities, Levels, active_components
from ...codecs.learned.constants import constants_of
from ...codecs.learned.contexts import FAST_INPUTS, SLOW_INPUTS
from ...codecs.learned.density import Density, logistic_table, tail_table
from ...codecs.learned.distortion import METRICS, Metric
from ...codecs.learned.figure import in_cm
from ...codecs.learned.klt import jacobian_moment, weighted_klt
from ...codecs.learned.model import LearnedModel
from ...codecs.learned.optimise import WEIGHT
from ...codecs.learned.pose_vectors import PoseVectors
from ...codecs.learned.spectrum import Spectrum, fit_spectrum
from ...codecs.learned.steps import index_of, step_cm
from ...codecs.rig import Rig, bones_of, with_bones
from ...errors import FormatError
from ...motion import Motion
from ...skeleton import Skeleton
from ..corpus import Corpus
from ..loop import Stage, State, run
from ..rigs import fit_rig
from ..trees import flatten, unflatten
from . import densities as fit
from .augmentation import mirror_axis, mirrored
from .bones import fit_bones
from .refinement import Refinement, draw_batch
from .rows import Rows, empty, joined, rows_of

HIDDEN = 48
_EPOCHS = {"plain": 4, "optimal": 4, "final": 12}
_ROUNDS = 12
_STEPS_CM = {"plain": (1 / 64, 32.0), "optimal": (1 / 16, 32.0), "final": (1 / 64, 32.0)}
_FINE_STEPS_CM, _FINE_SHARE = (1 / 512, 1 / 64), 0.1  # fine steps are asked for seldom
_REFINING, _STEPS_AT_ONCE = 25, 20  # the basis is refined by at most so many times so many steps
_CLIPS, _CROP = 8, 256  # clips a step, and their frames
_FRAMES_FOR_STEPS = 6000  # the corpus must have, for _STEPS_AT_ONCE steps not to learn it by heart
_DRAWS = {"plain": 2, "optimal": 1, "final": 1}
_HELD_OUT = 7  # every seventh file says when to stop


@threadpool_limits.wrap(limits=1)  # the last bits of a BLAS depend on its threads, and models must not
def train_learned(corpus: Corpus, checkpoint: Path) -> tuple[Artifact, dict]:
    """The model of a corpus of one rig, and a report: bits a level by epoch, on training and held-out files.

    Raises FormatError where the corpus has several rigs.
    """
    trainer = Trainer(corpus)
    state = run(trainer.stages(), checkpoint, f"learned 2 {corpus.digest()}")
    model = trainer.model(state)
    spec = {"codec": "learned", "corpus": corpus.digest(), "rig": model.rig.spec()}
    artifact = make_artifact(spec, model.tensors())
    report = {
        "codec": "learned",
        "digest": artifact.digest,
        "files": len(corpus.files),
        "frames": int(state["frames"][: len(corpus.files)].sum()),
        "curves": {key.removeprefix("curve."): value.tolist() for key, value in state.items() if key.startswith("curve.")},
        "components": {metric: model.bases[metric].components for metric in METRICS},
    }
    return artifact, report


class Trainer:
    """The stages and what they share; everything that outlasts an item is in the state."""

    def __init__(self, corpus: Corpus):
        rigs = corpus.rigs()
        if len(rigs) > 1:
            raise FormatError(f"the corpus has {len(rigs)} rigs, wanted one: train a model for each")
        self.corpus = corpus
        self.files = corpus.files
        self._analysed: dict[int, tuple[PoseVectors, np.ndarray, np.ndarray]] = {}
        self._rows_made: tuple[str, dict[str, tuple[Rows, Rows]]] = ("", {})
        self._refinement_made: Refinement | None = None
        # Where the rig has two sides, every file is there twice: as it is, and mirrored.
        self.items = len(corpus.files) * (2 if _has_sides(rigs[0][0]) else 1)

    def stages(self) -> list[Stage]:
        files, stages = self.items, self.basis_stages()
        for name, epochs in _EPOCHS.items():
            stages += [Stage(f"{name} levels", files, functools.partial(self._add_levels, name))]
            stages += [Stage(f"{name} densities", 2 * epochs, functools.partial(self._fit_density, name))]
            if name == "plain":
                stages += [Stage(f"basis of {m}", _REFINING, functools.partial(self._refine, m)) for m in METRICS]
        return stages

    def basis_stages(self) -> list[Stage]:
        """Up to a Karhunen-Loeve basis for every metric."""
        return [
            Stage("mean pose", self.items, self._add_rotations),
            Stage("moments", self.items, self._add_moments),
            Stage("spectra", len(METRICS), self._fit_spectrum),
        ]

    def model(self, state: State) -> LearnedModel:
        return LearnedModel(
            self.rig(state), {m: self.basis(state, m) for m in METRICS}, self._densities(state), state["constants"],
            fit_bones(np.unique(state["bones"], axis=0) * state["unit"][0]),
        )  # fmt: skip

    def _add_rotations(self, state: State, item: int) -> State:
        motion = self._motion(item)
        plain = PoseVectors(in_cm(motion.skeleton, motion.scale), np.tile(np.eye(3), (motion.skeleton.joint_count, 1, 1)))
        path, body = plain.analyse(motion, motion.scale)
        local, _ = plain.local(np.zeros_like(path), body)
        total = local.sum(-1).transpose(2, 0, 1)
        state = {**state, "rotations": state.get("rotations", 0.0) + total}
        state["frames"] = np.append(state.get("frames", np.zeros(0, np.int64)), motion.frame_count)
        if item < len(self.files):
            still, bones = constants_of(motion.values), bones_of(motion.skeleton)[None]
            state["constants"] = np.where(state.get("constants", still) == still, still, np.nan)
            state["bones"] = np.concatenate([*([state["bones"]] if item else []), bones])
            state["unit"] = np.array([motion.scale, motion.frame_time])
        return state

    def _add_moments(self, state: State, item: int) -> State:
        figure, _, body = self._vectors(state, item)
        count = float(len(body))
        state = {**state, "sum.x": state.get("sum.x", 0.0) + body.sum(0), "sum.xx": state.get("sum.xx", 0.0) + body.T @ body}
        for metric in METRICS:
            moment, radius = jacobian_moment(figure, metric, body)
            state[f"{metric}.jacobian"] = state.get(f"{metric}.jacobian", 0.0) + count * moment
            state[f"{metric}.radius"] = state.get(f"{metric}.radius", np.zeros(1)) + count * radius
        return state

    def _fit_spectrum(self, state: State, item: int) -> State:
        metric = METRICS[item]
        count = state["frames"].sum()
        mean = state["sum.x"] / count
        covariance = state["sum.xx"] / count - np.outer(mean, mean)
        synthesis = weighted_klt(state[f"{metric}.jacobian"] / count, covariance)
        unknown = Spectrum(np.zeros((1, 3 + len(synthesis))), np.zeros((1, 3 + len(synthesis))))
        turn_cm = float(np.float32(np.sqrt(state[f"{metric}.radius"][0] / count)))
        basis = Basis(_rounded(mean, np.float32), _rounded(synthesis, np.float16), turn_cm, unknown)
        coefficients = (self.coefficients(state, basis, n)[1] for n in range(self.items))
        spectrum = fit_spectrum([bands.forward(y, self._octaves(state)) for y in coefficients])
        return {
            **state,
            f"{metric}.mean": basis.mean, f"{metric}.synthesis": basis.synthesis, f"{metric}.turn_cm": np.array([turn_cm]),
            **_spectrum_state(metric, spectrum),
        }  # fmt: skip

    def _add_levels(self, name: str, state: State, item: int) -> State:
        """Levels of one file at steps of its own, for every metric."""
        if item == 0:
            state = {key: value for key, value in state.items() if not key.startswith("levels.")}
        random = np.random.default_rng([item, *name.encode()])
        for metric in METRICS:
            basis = self.basis(state, metric)
            for draw in range(_DRAWS[name]):
                finest, coarsest = _FINE_STEPS_CM if random.random() < _FINE_SHARE else _STEPS_CM[name]
                index = int(random.integers(index_of(finest), index_of(coarsest)))
                levels = self._levels(state, metric, basis, item, index, name != "plain")
                counts = active_components(levels)
                for b, (band, active) in enumerate(zip(levels, counts, strict=True)):
                    state[f"levels.{item}.{metric}.{draw}.{index}.{b}"] = band[:, :active].astype(np.int32)
        return state

    def _levels(self, state: State, metric: Metric, basis: Basis, item: int, index: int, optimal: bool) -> Levels:
        octaves, step = self._octaves(state), step_cm(index)
        if not optimal:
            _, y = self.coefficients(state, basis, item)
            wanted = bands.forward(y, octaves)
            return [(np.sign(w) * np.floor(np.abs(w) / step + 0.33)).astype(np.int64) for w in wanted]
        figure, path, body = self._vectors(state, item)
        source = Source(figure, figure, path, body, octaves, basis, metric, self._densities(state))
        optimiser = Attempt(source, index).optimiser
        for _ in range(_ROUNDS):
            optimiser.look()
            optimiser.move(WEIGHT)
        return optimiser.levels

    def _fit_density(self, name: str, state: State, item: int) -> State:
        """One epoch of one network; the first half of the items is the lowest band's, the second the octaves'."""
        epochs = _EPOCHS[name]
        which, n = ("slow", "fast")[item // epochs], item % epochs
        rows, held_out = self._rows(state, name)[which]
        batches = max(len(rows.sizes) // fit.BATCH, 1)
        steps = batches * epochs
        density = self._density(state, which)
        if not len(rows.sizes):  # a small corpus may have no levels at all at the steps that were drawn
            return {**flatten(density, f"{which}.density"), **flatten(density, f"{which}.best"), **state}
        optimiser_state = fit.optimiser(steps).init(eqx.filter(density, eqx.is_array))
        if n:
            optimiser_state = unflatten(optimiser_state, state, f"{which}.optimiser")
        order = np.random.default_rng([n, *name.encode()]).permutation(len(rows.sizes))
        order = np.resize(order, batches * min(fit.BATCH, len(order))).reshape(batches, -1)
        density, optimiser_state, trained = fit.epoch(density, optimiser_state, rows, jnp.asarray(order), steps)
        held = fit.evaluate(density, held_out)
        curve = np.concatenate([state.get(f"curve.{name}.{which}", np.zeros((0, 2))), [[float(trained), float(held)]]])
        state = {**state, f"curve.{name}.{which}": curve, **flatten(optimiser_state, f"{which}.optimiser")}
        state = {**state, **flatten(density, f"{which}.density")}
        if held <= curve[:, 1].min():
            state = {**state, **flatten(density, f"{which}.best")}
        return state

    def _refine(self, metric: Metric, state: State, item: int) -> State:
        """Some steps of the basis down the gradient of rate and distortion."""
        name, items = f"refined.{metric}", min(int(state["frames"].sum()) // _FRAMES_FOR_STEPS, _REFINING)
        if item >= items:
            return state
        clips = [self._vectors(state, n)[1:] for n in range(self.items)]
        refinement = self._refinement(state, metric, items * _STEPS_AT_ONCE)
        at = refinement.start()
        at = unflatten(at, state, name) if item else at
        losses = []
        for n in range(_STEPS_AT_ONCE):
            key = jax.random.key(item * _STEPS_AT_ONCE + n)
            at, metrics = refinement.step(at, draw_batch(clips, _CLIPS, _CROP, key), key)
            losses.append(float(metrics.loss))
        curve = np.append(state.get(f"curve.basis.{metric}", np.zeros(0)), np.mean(losses))
        state = {**state, f"curve.basis.{metric}": curve, **flatten(at, name)}
        if item < items - 1:
            return state
        basis = refinement.finish(at, clips)
        kept = {key: value for key, value in state.items() if not key.startswith(name)}
        return {**kept, f"{metric}.synthesis": basis.synthesis, **_spectrum_state(metric, basis.spectrum)}

    def _refinement(self, state: State, metric: Metric, steps: int) -> Refinement:
        """Made once a stage, so that its step is compiled once."""
        if self._refinement_made is None or self._refinement_made.metric != metric:
            figure, octaves = self._vectors(state, 0)[0], self._octaves(state)
            parts = (figure, metric, octaves, self.basis(state, metric), self._densities(state))
            self._refinement_made = Refinement(*parts, steps)
        return self._refinement_made

    def _rows(self, state: State, name: str) -> dict[str, tuple[Rows, Rows]]:
        """Rows for training and rows held out, of either network; made once a stage."""
        if self._rows_made[0] != name:
            self._rows_made = (name, self._make_rows(state))
        return self._rows_made[1]

    def _make_rows(self, state: State) -> dict[str, tuple[Rows, Rows]]:
        parts: dict[str, tuple[list[Rows], list[Rows]]] = {
            "slow": ([empty(SLOW_INPUTS)], [empty(SLOW_INPUTS)]),
            "fast": ([empty(FAST_INPUTS)], [empty(FAST_INPUTS)]),
        }
        for stem in sorted({key.rpartition(".")[0] for key in state if key.startswith("levels.")}):
            _, item, of, _, index = stem.split(".")
            basis = self.basis(state, next(metric for metric in METRICS if metric == of))
            levels = []
            while f"{stem}.{len(levels)}" in state:
                band = state[f"{stem}.{len(levels)}"]
                levels.append(np.pad(band.astype(np.int64), ((0, 0), (0, basis.components - band.shape[1]))))
            held_out = int(item) % len(self.files) % _HELD_OUT == _HELD_OUT - 1
            random = np.random.default_rng(int(item))
            for which, rows in zip(("slow", "fast"), rows_of(levels, basis.spectrum, int(index), random), strict=True):
                parts[which][held_out].append(rows)
        found = {}
        for which, (train, held) in parts.items():
            rows, held_out = joined(train), joined(held)
            found[which] = (rows, held_out if len(held_out.sizes) else rows)  # a small corpus has nothing to hold out
        return found

    def _motion(self, item: int) -> Motion:
        motion = self.corpus.motion(self.files[item % len(self.files)])
        return motion if item < len(self.files) else mirrored(motion)

    def rig(self, state: State) -> Rig:
        first = self._motion(0).skeleton
        people = [with_bones(first, bones) for bones in np.unique(state["bones"], axis=0)]
        return fit_rig(people, state["rotations"], float(state["unit"][0]), float(state["unit"][1]))

    def _vectors(self, state: State, item: int) -> tuple[PoseVectors, np.ndarray, np.ndarray]:
        """Figure, path and body of an item about the mean pose, which is settled before any stage asks."""
        if item not in self._analysed:
            motion = self._motion(item)
            mean = _rounded(self.rig(state).expected, np.float32)
            figure = PoseVectors(in_cm(motion.skeleton, motion.scale), mean)
            self._analysed[item] = (figure, *figure.analyse(motion, motion.scale))
        return self._analysed[item]

    def coefficients(self, state: State, basis: Basis, item: int) -> tuple[int, np.ndarray]:
        _, path, body = self._vectors(state, item)
        direction = direction_of(path)
        return direction, basis.coefficients(path, body, direction)

    def _octaves(self, state: State) -> int:
        return bands.octave_count(float(state["unit"][1]))

    def basis(self, state: State, metric: Metric) -> Basis:
        parts = (state[f"{metric}.{name}"] for name in ("mean", "synthesis", "turn_cm", "slow", "fast"))
        mean, synthesis, turn_cm, slow, fast = parts
        return Basis(mean, synthesis, float(turn_cm[0]), Spectrum(slow, fast))

    def _density(self, state: State, which: str) -> Density:
        inputs = {"slow": SLOW_INPUTS, "fast": FAST_INPUTS}[which]
        density = Density.init(inputs, HIDDEN, jax.random.key(len(which) + inputs))
        return unflatten(density, state, f"{which}.density") if f"{which}.density.0" in state else density

    def _densities(self, state: State) -> Densities:
        def best(which: str):
            return unflatten(self._density(state, which), state, f"{which}.best").freeze()

        return Densities(best("slow"), best("fast"), logistic_table(), tail_table())


def _spectrum_state(metric: Metric, spectrum: Spectrum) -> State:
    return {f"{metric}.slow": spectrum.slow, f"{metric}.fast": spectrum.fast}


def _rounded(x: np.ndarray, to: type[np.floating]) -> np.ndarray:
    """As the model's file will hold it."""
    return x.astype(to).astype(np.float64)


def _has_sides(skeleton: Skeleton) -> bool:
    try:
        mirror_axis(skeleton)
    except ValueError:
        return False
    return True
