"""Training: corpora, the resumable loop, and models that come out the same however often they were interrupted."""

import functools
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxmocap.codecs import CODECS, Artifact, decode, load_artifact, make
from jaxmocap.codecs.artifact import make_artifact, parse_artifact
from jaxmocap.codecs.lsdt_clip import _model
from jaxmocap.codecs.lsdt_model import CLIP_FRAMES, LsdtModel
from jaxmocap.errors import FormatError
from jaxmocap.formats import write_motion
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.skeleton import Skeleton
from jaxmocap.synthesis import UNIT_CM, walk
from jaxmocap.training import TRAINERS, Corpus, loop, train_learned, train_lsdt
from jaxmocap.training.learned import train as learned_training
from jaxmocap.training.learned.train import Trainer
from jaxmocap.training.loop import Stage, State

SECONDS = 2.1


def measured(source: Motion, decoded: Motion, measure: str = "mean_cm") -> float:
    value = compare(source, decoded)[measure]
    assert isinstance(value, float)
    return value


@pytest.fixture(scope="session")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    for seed in (1, 2):
        write_motion(walk(seed=seed, seconds=SECONDS), folder / f"walk{seed}.bvh")
    return folder


@pytest.fixture(scope="session")
def trained(folder, tmp_path_factory) -> tuple[Artifact, dict]:
    return train_lsdt(Corpus.of([folder], UNIT_CM), tmp_path_factory.mktemp("state") / "checkpoint")


_TRAIN = """
import sys
from pathlib import Path
from jaxmocap.training import TRAINERS, Corpus, loop, train_learned, train_lsdt
from jaxmocap.training.learned.train import Trainer
loop._SAVE_SECONDS = 0.0
artifact, _ = train_lsdt(Corpus.of([sys.argv[1]], float(sys.argv[2])), Path(sys.argv[3]))
Path(sys.argv[4]).write_bytes(artifact.data)
"""


def test_killed_run_resumes_to_the_same_model(folder, trained, tmp_path):
    """Killed twice, each time just after a checkpoint; a run in another process is also the second run of determinism."""
    checkpoint, out = tmp_path / "checkpoint", tmp_path / "model"
    command = [sys.executable, "-c", _TRAIN, str(folder), str(UNIT_CM), str(checkpoint), str(out)]
    for stage in (1, 3):
        running = subprocess.Popen(command, stderr=subprocess.PIPE)
        while running.poll() is None and _stage_of(checkpoint) < stage:
            time.sleep(0.02)
        running.send_signal(signal.SIGKILL)
        assert running.wait() == -signal.SIGKILL
        assert running.communicate()[1].count(b"resuming") == (stage > 1)
        assert not out.exists()
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "resuming" in done.stderr
    assert load_artifact(out).digest == trained[0].digest


def _stage_of(checkpoint: Path) -> int:
    try:
        return _place_of(checkpoint)["stage"]
    except FileNotFoundError:
        return -1


def _place_of(checkpoint: Path) -> dict:
    data = checkpoint.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return json.loads(header["__metadata__"]["jaxmocap"])


def test_model_and_report(folder, trained):
    artifact, report = trained
    assert artifact.spec["codec"] == "lsdt-clip"
    assert artifact.spec["format"] == 1
    assert artifact.spec["corpus"] == Corpus.of([folder], UNIT_CM).digest()
    rig = artifact.spec["rig"]
    skeleton = walk(seed=1, seconds=0.1).skeleton
    assert tuple(rig["names"]) == skeleton.names and tuple(rig["parents"]) == skeleton.parents
    assert rig["unit_cm"] == UNIT_CM
    basis = artifact.tensors["basis"]
    assert basis.shape == (3, skeleton.joint_count, skeleton.joint_count)
    np.testing.assert_allclose(basis @ basis.transpose(0, 2, 1), np.tile(np.eye(31), (3, 1, 1)), atol=1e-4)
    assert report["digest"] == artifact.digest
    assert (report["files"], report["frames"]) == (2, 2 * round(SECONDS * 120))
    objective = np.array(report["objective"])
    assert objective.shape[1] == 3 and np.isfinite(objective).all()
    assert report["nonzeros_a_frame"] == sorted(report["nonzeros_a_frame"], reverse=True)
    json.dumps(report)


def test_model_codes_another_walk(trained):
    """Smaller than with the basis that travels along, which is what an untrained rig costs."""
    motion = walk(seed=9, seconds=SECONDS)
    settings = {"codec": "lsdt-clip", "target": {"kind": "mean", "cm": 1.0}}
    data = make(settings, trained[0]).encode(motion)
    assert measured(motion, make(settings, trained[0]).decode(data)) <= 1.0
    s = motion.skeleton
    renamed = Skeleton([n + "_" for n in s.names], s.parents, s.offsets, s.channels, s.end_joints, s.end_offsets)
    stranger = Motion(renamed, motion.values, motion.frame_time, motion.unit_cm)
    assert len(data) < len(make(settings, trained[0]).encode(stranger)) / 2


def test_artifact_round_trip(trained, tmp_path):
    artifact = trained[0]
    path = tmp_path / "model.safetensors"
    path.write_bytes(artifact.data)
    read = load_artifact(path)
    assert read == artifact and hash(read) == hash(artifact)
    assert read.spec == json.loads(json.dumps(artifact.spec))
    assert make_artifact(read.spec, read.tensors).data == artifact.data
    tensors = _model(read).tensors()
    assert tensors.keys() == artifact.tensors.keys()
    for name, values in tensors.items():
        assert np.array_equal(values, artifact.tensors[name]), name
        assert values.dtype == artifact.tensors[name].dtype, name


def test_broken_models_are_refused(trained, tmp_path):
    from safetensors.numpy import save

    data, tensors = trained[0].data, trained[0].tensors
    header = 8 + int.from_bytes(data[:8], "little")
    broken = [b"", b"\0" * 8, data[:100], data[:-1], data + b"\0", b"HIERARCHY\nROOT Hips\n", b"\xff" * 64]
    broken += [data[:20] + b"\xff" + data[21:], data[: header - 40] + data[header:]]
    foreign = [save(tensors), save(tensors, metadata={"other": "1"}), save(tensors, metadata={"jaxmocap": "no json"})]
    foreign += [save(tensors, metadata={"jaxmocap": json.dumps(spec)}) for spec in (None, [], 1, {"format": 2}, {})]
    for number, bytes_ in enumerate(broken + foreign):
        with pytest.raises(FormatError, match="model"):
            parse_artifact(bytes_, f"model {number}")
    with pytest.raises(FormatError, match="wanted a model file or one of .*exact, learned, live, lsdt-clip"):
        load_artifact(tmp_path / "missing")


@pytest.mark.parametrize("missing", ["basis", "rig.bones", "rig.partner", "runs.60.scale", "runs.240.run", "paper.120.value"])
def test_models_that_are_not_whole_are_refused(trained, missing):
    artifact = trained[0]
    tensors = {name: values for name, values in artifact.tensors.items() if name != missing}
    with pytest.raises(FormatError, match="not whole"):
        LsdtModel.load(make_artifact(artifact.spec, tensors))
    with pytest.raises(FormatError, match="not whole"):
        LsdtModel.load(make_artifact({k: v for k, v in artifact.spec.items() if k != "rig"}, artifact.tensors))


def test_model_has_tables_of_all_clips(trained):
    model = _model(trained[0])
    assert set(model.tables) == set(model.codes) == set(CLIP_FRAMES)


def test_corpus_finds_files(tmp_path):
    motion = walk(seed=1, seconds=0.1)
    (tmp_path / "b" / "deep").mkdir(parents=True)
    for name in ("b/deep/z.bvh", "b/a.bvh", "c.bvh", "b/D.BVH"):
        write_motion(motion, tmp_path / Path(name).with_suffix(".bvh"))
    (tmp_path / "b" / "notes.txt").write_text("no motion")
    (tmp_path / "b" / "D.bvh").rename(tmp_path / "b" / "D.BVH")
    corpus = Corpus.of([tmp_path / "c.bvh", tmp_path / "b", tmp_path / "b" / "a.bvh"])
    names = [str(f.relative_to(tmp_path)) for f in corpus.files]
    assert names == ["b/D.BVH", "b/a.bvh", "b/deep/z.bvh", "c.bvh"]
    assert Corpus.of([str(tmp_path)]).files == corpus.files
    assert [m.frame_count for m in corpus] == [12] * 4
    (tmp_path / "c.bvh").write_text("HIERARCHY\nbroken")  # read only when its turn comes
    motions = iter(Corpus.of([tmp_path]))
    assert [next(motions).frame_count for _ in range(3)] == [12] * 3
    with pytest.raises(FormatError):
        next(motions)


def test_corpus_start_and_unit(tmp_path):
    motion = walk(seed=1, seconds=0.1)
    write_motion(motion, tmp_path / "a.bvh")
    (read,) = Corpus.of([tmp_path], 2.5, start=10)
    assert (read.frame_count, read.unit_cm) == (2, 2.5)
    np.testing.assert_allclose(read.values, motion.values[10:], atol=1e-4)
    with pytest.raises(FormatError, match="a.bvh: 12 frames, and the first 12 are to be dropped"):
        list(Corpus.of([tmp_path], start=12))


def test_corpus_digest_knows_contents_not_names(tmp_path):
    first, second = walk(seed=1, seconds=0.1), walk(seed=2, seconds=0.1)
    for place, a, b in (("x", first, second), ("y", second, first), ("z", first, first)):
        (tmp_path / place).mkdir()
        write_motion(a, tmp_path / place / "a.bvh")
        write_motion(b, tmp_path / place / "b.bvh")
    x, y, z = (Corpus.of([tmp_path / place], 1.0) for place in "xyz")
    assert x.digest() == y.digest()
    assert len({x.digest(), z.digest(), Corpus(x.files, 2.0).digest(), Corpus(x.files, 1.0, 1).digest()}) == 4


def test_corpus_refuses_nothing(tmp_path):
    with pytest.raises(FormatError, match="no motion files"):
        Corpus.of([tmp_path])
    with pytest.raises(FormatError, match="no such file or folder"):
        Corpus.of([tmp_path / "missing"])


def test_rigs_are_grouped(tmp_path):
    motion = walk(seed=1, seconds=0.1)
    other = Motion(Skeleton(["root"], [-1], np.zeros((1, 3)), [["Xposition", "Yposition", "Zposition"]]), np.ones((4, 3)), 0.1)
    write_motion(other, tmp_path / "a.bvh")
    write_motion(motion, tmp_path / "b.bvh")
    write_motion(walk(seed=2, seconds=0.1), tmp_path / "c.bvh")
    corpus = Corpus.of([tmp_path])
    groups = corpus.rigs()
    assert [[f.name for f in c.files] for _, c in groups] == [["b.bvh", "c.bvh"], ["a.bvh"]]
    assert [s.joint_count for s, _ in groups] == [31, 1]
    with pytest.raises(FormatError, match="2 rigs.*a.bvh"):
        train_lsdt(corpus, tmp_path / "checkpoint")


def test_bones_that_change_length_are_refused(tmp_path):
    """All joints have position channels, so no bones are there to keep."""
    points = Motion.from_positions(np.random.default_rng(0).normal(size=(4, 2, 3)), ["a", "b"], 0.1, [-1, 0])
    write_motion(points, tmp_path / "a.bvh")
    with pytest.raises(FormatError, match="needs rigid bones"):
        train_lsdt(Corpus.of([tmp_path]), tmp_path / "checkpoint")


def _append(stage: int, state: State, item: int) -> State:
    return {**state, "seen": np.append(state.get("seen", np.zeros(0, np.int64)), 10 * stage + item)}


STAGES = [Stage(f"stage {n}", items, functools.partial(_append, n)) for n, items in enumerate((3, 0, 2, 4))]
FOLD = [0, 1, 2, 20, 21, 30, 31, 32, 33]


def test_loop_is_a_plain_fold(tmp_path):
    assert loop.run(STAGES, tmp_path / "checkpoint", "key")["seen"].tolist() == FOLD
    # A finished run does nothing again; another key begins anew.
    assert loop.run(STAGES, tmp_path / "checkpoint", "key")["seen"].tolist() == FOLD
    assert loop.run(STAGES[:1], tmp_path / "checkpoint", "other")["seen"].tolist() == FOLD[:3]


@pytest.mark.parametrize("stop", range(len(FOLD)))
@pytest.mark.parametrize("seconds", [0.0, 1e9])
def test_loop_resumes_wherever_it_was_interrupted(stop, seconds, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "_SAVE_SECONDS", seconds)
    done = []

    def interrupted(stage: Stage) -> Stage:
        def step(state: State, item: int) -> State:
            if len(done) == stop:
                raise KeyboardInterrupt
            done.append(item)
            return stage.step(state, item)

        return Stage(stage.name, stage.items, step)

    with pytest.raises(KeyboardInterrupt):
        loop.run([interrupted(s) for s in STAGES], tmp_path / "checkpoint", "key")
    assert loop.run(STAGES, tmp_path / "checkpoint", "key")["seen"].tolist() == FOLD


@pytest.mark.parametrize("damage", [b"", b"junk", None])
def test_damaged_checkpoint_is_as_good_as_none(damage, tmp_path):
    checkpoint = tmp_path / "checkpoint"
    loop.run(STAGES[:1], checkpoint, "key")
    checkpoint.write_bytes(checkpoint.read_bytes()[:-5] if damage is None else damage)
    assert loop.run(STAGES, checkpoint, "key")["seen"].tolist() == FOLD


# The codec `learned`.


@pytest.fixture(scope="session")
def one_file(tmp_path_factory) -> Corpus:
    """The smallest corpus there is: nothing to hold out, and bones of one person."""
    folder = tmp_path_factory.mktemp("one")
    write_motion(walk(seed=1, seconds=1.0), folder / "walk.bvh")
    return Corpus.of([folder], UNIT_CM)


@pytest.fixture(scope="session")
def learned(one_file, tmp_path_factory) -> tuple[Artifact, dict, Path]:
    checkpoint = tmp_path_factory.mktemp("state") / "checkpoint"
    return *train_learned(one_file, checkpoint), checkpoint


def test_every_codec_has_a_trainer():
    assert {load_artifact(name).spec["codec"] for name in CODECS} < set(TRAINERS)


def test_learned_of_one_file(one_file, learned):
    artifact, report, _ = learned
    assert artifact.spec["codec"] == report["codec"] == "learned"
    assert artifact.spec["corpus"] == one_file.digest()
    assert (report["files"], report["frames"], report["digest"]) == (1, 120, artifact.digest)
    curves = np.concatenate(list(report["curves"].values()))
    assert curves.shape[1] == 2 and np.isfinite(curves).all()
    for curve in report["curves"].values():
        assert curve[-1][1] <= curve[0][1]
    assert json.loads(json.dumps(report)) == report


@pytest.mark.parametrize("metric", ["joints", "shell"])
def test_learned_codes_what_it_saw_and_what_it_did_not(one_file, learned, metric):
    artifact = learned[0]
    codec = make({"codec": "learned", "metric": metric, "target": {"kind": "mean", "cm": 1.0}}, artifact)
    (seen,) = one_file
    for motion in (seen, walk(seed=5, seconds=1.0)):
        decoded = decode(codec.encode(motion), artifact)
        assert measured(motion, decoded, "mean_cm" if metric == "joints" else "shell_mean_cm") <= 1.0


def test_interrupted_learned_resumes_to_the_same_model(one_file, learned, tmp_path, monkeypatch):
    """Among moments, levels, and epochs of either network; each time a new trainer goes on."""
    artifact, _, finished = learned
    monkeypatch.setattr(loop, "_SAVE_SECONDS", 0.0)
    checkpoint, left = tmp_path / "checkpoint", [0]

    def interrupted(stage: Stage) -> Stage:
        def step(state: State, item: int) -> State:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return stage.step(state, item)

        return Stage(stage.name, stage.items, step)

    for steps in (3, 4, 3, 4, 8, 5):
        left[0] = steps
        with pytest.raises(KeyboardInterrupt):
            loop.run([interrupted(s) for s in Trainer(one_file).stages()], checkpoint, _place_of(finished)["key"])
    assert 0 < _place_of(checkpoint)["stage"] < _place_of(finished)["stage"]
    again, _ = train_learned(one_file, checkpoint)
    assert again.data == artifact.data


def test_a_corpus_that_is_large_enough_refines_its_basis(one_file, learned, monkeypatch):
    """Components are turned into each other, the same whether a new trainer goes on or the one that began."""
    for name, value in {"_FRAMES_FOR_STEPS": 60, "_REFINING": 2, "_STEPS_AT_ONCE": 1, "_CLIPS": 2, "_CROP": 32}.items():
        monkeypatch.setattr(learned_training, name, value)
    before, *_ = loop._resume(learned[2], _place_of(learned[2])["key"])
    trainer = Trainer(one_file)
    half = trainer._refine("joints", before, 0)
    after, again = (t._refine("joints", half, 1) for t in (trainer, Trainer(one_file)))
    synthesis, was = after["joints.synthesis"], before["joints.synthesis"]
    np.testing.assert_array_equal(synthesis, again["joints.synthesis"])
    assert not np.array_equal(synthesis, was) and np.isfinite(after["curve.basis.joints"]).all()
    turned = synthesis @ np.linalg.pinv(was, rcond=1e-6)
    np.testing.assert_allclose(turned @ turned.T, np.eye(len(turned)), atol=0.01)
    assert set(after) == set(before) | {"curve.basis.joints"}


def test_learned_wants_one_rig(one_file, tmp_path):
    other = Motion(Skeleton(["root"], [-1], np.zeros((1, 3)), [["Xposition", "Yposition", "Zposition"]]), np.ones((4, 3)), 0.1)
    write_motion(other, tmp_path / "a.bvh")
    with pytest.raises(FormatError, match="2 rigs"):
        train_learned(Corpus.of([*one_file.files, tmp_path]), tmp_path / "checkpoint")


def test_a_corpus_of_short_clips_alone_is_refused(tmp_path: Path):
    write_motion(walk(1, 1.0), tmp_path / "short.bvh")
    with pytest.raises(FormatError, match="longest file of the corpus has 120 frames"):
        TRAINERS["lsdt-clip"](Corpus.of([tmp_path], UNIT_CM), tmp_path / "partial")
