"""Training of `live`, in resumable stages: a Karhunen-Loeve basis, what components do, the network, densities of packets."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from ...codecs.artifact import Artifact, make_artifact
from ...codecs.learned.basis import Basis
from ...codecs.learned.contexts import OCTAVE
from ...codecs.learned.density import Density, FrozenDensity, logistic_table, tail_table
from ...codecs.learned.distortion import METRICS, Metric
from ...codecs.learned.steps import STEPS, index_of
from ...codecs.live import tracker
from ...codecs.live.encoder import encode_packet
from ...codecs.live.events import CLASSES, INPUTS, class_of, contexts, step_octave
from ...codecs.live.model import LiveModel
from ...codecs.live.tracker import Prior, to_units
from ..corpus import Corpus
from ..learned import densities as fit
from ..learned.bones import fit_bones
from ..learned.rows import Rows, joined
from ..learned.train import Trainer
from ..loop import Stage, State, run
from ..trees import flatten, unflatten
from . import network as net

_UPDATES, _AT_ONCE = 80, 25  # of the network: so many times so many steps
_FRAMES_FOR_STEPS = 2000  # for _AT_ONCE steps more
_CLIPS, _CROP = 12, 160  # a step
_EPOCHS, _HIDDEN = 10, 24  # of the density of packets
_FRAMES, _DRAWS = 240, 3  # an item, in so many pieces, each at a step of its own
_MOST_CM = 10.0  # a frame: what is faster is a jump, and says nothing of speed
_ABSENT = -20.0  # log2 of cm, for components that a basis lacks


@threadpool_limits.wrap(limits=1)  # the last bits of a BLAS depend on its threads, and models must not
def train_live(corpus: Corpus, checkpoint: Path) -> tuple[Artifact, dict]:
    """The model of a corpus of one rig, and a report: the loss of the network, and bits a level of packets.

    Raises FormatError where the corpus has several rigs.
    """
    trainer = _LiveTrainer(corpus)
    state = run(trainer.stages(), checkpoint, f"live 1 {corpus.digest()}")
    model = trainer.model(state)
    artifact = make_artifact({"codec": "live", "corpus": corpus.digest(), "rig": model.rig.spec()}, model.tensors())
    report = {
        "codec": "live",
        "digest": artifact.digest,
        "files": len(corpus.files),
        "frames": int(state["frames"][: len(corpus.files)].sum()),
        "curves": {key.removeprefix("curve."): value.tolist() for key, value in state.items() if key.startswith("curve.")},
    }
    return artifact, report


class _LiveTrainer:
    """The stages; everything that outlasts an item is in the state."""

    def __init__(self, corpus: Corpus):
        self.poses = Trainer(corpus)
        self._made: dict[Metric, list[np.ndarray]] = {}

    def stages(self) -> list[Stage]:
        return [
            *self.poses.basis_stages(),
            Stage("components", len(METRICS), self._measure),
            Stage("network", _UPDATES, self._train),
            Stage("packets", self.poses.items, self._add_packets),
            Stage("densities", _EPOCHS, self._fit_density),
        ]

    def model(self, state: State) -> LiveModel:
        learner = self._learner(state)
        priors: dict[Metric, Prior] = {m: self._prior(state, learner, n) for n, m in enumerate(METRICS)}
        bases: dict[Metric, Basis] = {m: self.poses.basis(state, m) for m in METRICS}
        bones = fit_bones(np.unique(state["bones"], axis=0) * state["unit"][0])
        packets = unflatten(_empty_density(), state, "density").freeze()
        trained = np.flatnonzero(state["classes"].sum(1))  # octaves of steps beyond those trained are as the nearest
        seen = state["classes"][trained[np.abs(trained[None] - np.arange(STEPS // OCTAVE)[:, None]).argmin(1)]]
        return LiveModel(
            self.poses.rig(state), bases, priors, learner.network.freeze(), packets, seen, logistic_table(), tail_table(), bones
        )

    def _coefficients(self, state: State, metric: Metric) -> list[np.ndarray]:
        """Of every item, (frames, components) in cm."""
        if metric not in self._made:
            basis = self.poses.basis(state, metric)
            items = range(self.poses.items)
            self._made[metric] = [self.poses.coefficients(state, basis, n)[1].astype(np.float32) for n in items]
        return self._made[metric]

    def _measure(self, state: State, item: int) -> State:
        """Speed and spread of the components of a basis."""
        clips = self._coefficients(state, METRICS[item])
        gone = np.concatenate([np.minimum(np.abs(np.diff(y, axis=0)), _MOST_CM) for y in clips]).mean(0, dtype=np.float64)
        spread = np.concatenate(clips).std(0, dtype=np.float64)
        return {**state, f"speed.{item}": np.log2(gone + 1e-4), f"spread.{item}": np.log2(spread + 1e-3)}

    def _train(self, state: State, item: int) -> State:
        """Some steps of the network, as many as the corpus is worth."""
        updates = min(_UPDATES, 2 + int(state["frames"].sum()) // _FRAMES_FOR_STEPS)
        if item >= updates:
            return state
        count = max(len(state[f"speed.{n}"]) for n in range(len(METRICS)))
        speed, spread = (jnp.asarray(_stacked(state, name, count), jnp.float32) for name in ("speed", "spread"))
        learner = self._learner(state)
        optimiser_state = net.optimiser(updates * _AT_ONCE).init(eqx.filter(learner, eqx.is_array))
        optimiser_state = unflatten(optimiser_state, state, "optimiser") if item else optimiser_state
        losses = []
        for n in range(_AT_ONCE):
            drawn = self._draw(state, count, np.random.default_rng(item * _AT_ONCE + n))
            learner, optimiser_state, loss = net.step(learner, optimiser_state, drawn, speed, spread, updates * _AT_ONCE)
            losses.append(float(loss))
        curve = np.append(state.get("curve.network", np.zeros(0)), np.mean(losses))
        return {**state, "curve.network": curve, **flatten(learner, "learner"), **flatten(optimiser_state, "optimiser")}

    def _draw(self, state: State, count: int, random: np.random.Generator) -> net.Drawn:
        """Crops of files, which come as often as they have frames; short ones hold their last."""
        crops, bases = [], random.integers(0, len(METRICS), _CLIPS)
        for basis in bases:
            clips = self._coefficients(state, METRICS[basis])
            room = np.array([max(len(y) - _CROP, 1) for y in clips], float)
            clip = clips[random.choice(len(clips), p=room / room.sum())]
            at = random.integers(0, max(len(clip) - _CROP, 0) + 1)
            part = clip[at : at + _CROP]
            crops.append(np.pad(part, ((0, _CROP - len(part)), (0, 0)), mode="edge"))
            crops[-1] = np.pad(crops[-1], ((0, 0), (0, count - part.shape[1])))
        log_step = jnp.asarray(net.log_step_of(random.random()), jnp.float32)
        return net.Drawn(jnp.asarray(np.stack(crops)), jnp.asarray(bases), log_step)

    def _learner(self, state: State) -> net.Learner:
        count = max(len(state[f"speed.{n}"]) for n in range(len(METRICS)))
        learner = net.Learner.init(len(METRICS), count, jax.random.key(0))
        return unflatten(learner, state, "learner") if "learner.0" in state else learner

    def _prior(self, state: State, learner: net.Learner, basis: int) -> Prior:
        speed, spread = (np.rint(OCTAVE * state[f"{name}.{basis}"]).astype(np.int64) for name in ("speed", "spread"))
        embedding = np.asarray(learner.embedding[basis, : len(speed)], np.float64)
        return Prior(speed, spread, np.rint(OCTAVE * embedding).astype(np.int64))

    def _add_packets(self, state: State, item: int) -> State:
        """Contexts and levels as they stand in packets, from pieces of one file for every metric."""
        learner = self._learner(state)
        network, random = learner.network.freeze(), np.random.default_rng(item)
        parts, seen = [], state.get("classes", np.zeros((STEPS // OCTAVE, CLASSES))).copy()
        for basis, metric in enumerate(METRICS):
            prior, y = self._prior(state, learner, basis), self._coefficients(state, metric)[item]
            for _ in range(_DRAWS):
                index = index_of(2.0 ** net.log_step_of(random.random()))
                at = random.integers(0, max(len(y) - _FRAMES, 0) + 1)
                for frame in _packet_levels(to_units(y[at : at + _FRAMES]), prior, network, index)[::4]:
                    kind = class_of(frame)
                    seen[step_octave(index), kind] += 1
                    parts.append(Rows(contexts(prior, index, kind).astype(np.int16), np.abs(frame).astype(np.float32)))
        rows = joined(parts)
        chosen = random.permutation(len(rows.sizes))[:12000]
        return {
            **state, "classes": seen,
            f"packets.{item}.contexts": rows.contexts[chosen], f"packets.{item}.sizes": rows.sizes[chosen],
        }  # fmt: skip

    def _fit_density(self, state: State, item: int) -> State:
        """One epoch."""
        rows = joined([
            Rows(state[f"packets.{n}.contexts"], state[f"packets.{n}.sizes"]) for n in range(self.poses.items)
        ])  # fmt: skip
        batches = max(len(rows.sizes) // fit.BATCH, 1)
        density = unflatten(_empty_density(), state, "density") if item else _empty_density()
        optimiser_state = fit.optimiser(batches * _EPOCHS).init(eqx.filter(density, eqx.is_array))
        optimiser_state = unflatten(optimiser_state, state, "density.optimiser") if item else optimiser_state
        order = np.random.default_rng(item).permutation(len(rows.sizes))
        order = np.resize(order, batches * min(fit.BATCH, len(order))).reshape(batches, -1)
        density, optimiser_state, bits = fit.epoch(density, optimiser_state, rows, jnp.asarray(order), batches * _EPOCHS)
        curve = np.append(state.get("curve.packets", np.zeros(0)), float(bits))
        state = {**state, "curve.packets": curve, **flatten(density, "density")}
        return {**state, **flatten(optimiser_state, "density.optimiser")}


def _packet_levels(wanted: np.ndarray, prior: Prior, network: FrozenDensity, index: int) -> list[np.ndarray]:
    """Of all frames but the first."""
    state, found = tracker.State.at(wanted[0]), []
    for number, places in enumerate(wanted[1:], 1):
        levels, _, state = encode_packet(places, number, state, prior, network, index)
        found.append(levels)
    return found


def _stacked(state: State, name: str, count: int) -> np.ndarray:
    """Of all bases, as wide as the widest."""
    rows = [state[f"{name}.{n}"] for n in range(len(METRICS))]
    return np.stack([np.pad(row, (0, count - len(row)), constant_values=_ABSENT) for row in rows])


def _empty_density() -> Density:
    return Density.init(INPUTS, _HIDDEN, jax.random.key(1))
