"""`live`: the tracker and its trainable twin, levels, the fountain, control, and streams that lose packets."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmocap.bench.data import UNIT_CM
from jaxmocap.codecs import load_artifact, make
from jaxmocap.codecs.entropy.range_coder import PythonDecoder, PythonEncoder
from jaxmocap.codecs.learned.contexts import OCTAVE
from jaxmocap.codecs.learned.pose_vectors import PoseVectors
from jaxmocap.codecs.learned.steps import index_of, level_of_step, step_cm
from jaxmocap.codecs.live import tracker
from jaxmocap.codecs.live.analysis import Analysis
from jaxmocap.codecs.live.codec import model_of
from jaxmocap.codecs.live.encoder import choose_levels, encode_frames
from jaxmocap.codecs.live.events import Density, class_of, read_moved, write_moved
from jaxmocap.codecs.live.fountain import MOST_BYTES, Basin, Fountain
from jaxmocap.codecs.live.packets import NUMBERS, framed, unframed
from jaxmocap.codecs.live.setting import write_setting
from jaxmocap.codecs.live.stream import Decoder, Encoder
from jaxmocap.errors import CorruptStream, JaxmocapError
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.kinematics import pose
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, Skeleton
from jaxmocap.synthesis import UNIT_CM as SYNTHETIC_UNIT_CM
from jaxmocap.synthesis import walk
from jaxmocap.training import Corpus, train_live
from jaxmocap.training.live import train as live_training
from jaxmocap.training.live.rollout import Batch, rollout

MODEL = model_of(load_artifact("live"))
INDEX = index_of(0.2)
TURNS = ("Zrotation", "Yrotation", "Xrotation")
rng = np.random.default_rng


@pytest.fixture(scope="module")
def motion() -> Motion:
    return walk(seed=8, seconds=4.0)


@pytest.fixture(scope="module")
def wanted(motion) -> np.ndarray:
    """Places of the walk."""
    figure = PoseVectors(motion.skeleton, MODEL.rig.expected)
    path, body = figure.analyse(motion, motion.scale)
    return tracker.to_units(MODEL.bases["joints"].coefficients(path, body, 0))


def shown_of(packets: list, decoder: Decoder | None = None) -> list:
    """What a receiver shows, frame by frame; None for a packet is one that did not come."""
    decoder = decoder or Decoder()
    return [decoder.conceal() if packet is None else decoder.push(packet) for packet in packets]


def packets_of(motion: Motion, cm: float = 0.3, repeats: int = 0) -> list[bytes]:
    encoder = Encoder(motion.skeleton, motion.frame_time, motion.unit_cm, "error", cm, "joints", repeats)
    return [encoder.push(values) for values in motion.values]


def errors_of(motion: Motion, shown: list) -> np.ndarray:
    """Mean joint error of every frame, in cm; not a number where nothing was shown."""
    original = np.asarray(pose(motion).positions) * motion.scale
    found = np.full(motion.frame_count, np.nan)
    seen = [n for n, frame in enumerate(shown) if frame]
    at = np.asarray(pose(motion.with_values(np.stack([shown[n].values for n in seen]))).positions) * motion.scale
    found[seen] = np.linalg.norm(at - original[seen], axis=-1).mean(1)
    return found


def test_the_tracker_and_its_trainable_twin_agree(wanted):
    """Rounding apart: they choose nearly the same levels, and decode to nearly the same."""
    part, prior = wanted[:60], MODEL.priors["joints"]
    levels, places = encode_frames(part, prior, MODEL.network, INDEX)
    batch = Batch(
        jnp.asarray(part[None] / tracker.UNITS, jnp.float32),
        *(jnp.asarray(x[None] / OCTAVE, jnp.float32) for x in (prior.speed, prior.spread, prior.embedding)),
    )
    made = rollout(MODEL.network.thaw(), batch, jnp.asarray(level_of_step(INDEX) / OCTAVE))
    # From the first place on: the twin does not code it.
    same = np.asarray(made.levels[0])[1:20] == levels[1:20]
    assert same.mean() > 0.99
    assert np.abs(np.asarray(made.decoded[0])[:20] - places[:20] / tracker.UNITS).max() < 1.5 * step_cm(INDEX)
    assert np.abs(np.asarray(made.decoded[0]) - part / tracker.UNITS).max() < 1.5 * step_cm(INDEX)


def test_what_is_decoded_is_within_a_step(wanted):
    _, places = encode_frames(wanted, MODEL.priors["joints"], MODEL.network, INDEX)
    assert np.abs(places - wanted).max() <= 1.0 * tracker.step_units(INDEX)


def test_ends_that_lost_sight_of_each_other_come_together(wanted):
    """The same levels move two trackers whose pasts differ: what differs comes to rest instead of growing."""
    prior, network = MODEL.priors["joints"], MODEL.network
    levels, _ = encode_frames(wanted, prior, network, INDEX)
    one = tracker.State.at(wanted[0])
    other = one._replace(average=one.average + rng(0).integers(-(1 << 14), 1 << 14, one.average.shape))
    apart = []
    for of_frame in levels[1:200]:
        places = []
        for state in (one, other):
            outlook = tracker.look(state, prior, network, INDEX)
            places.append(tracker.place_of(outlook, of_frame, INDEX))
        one, other = tracker.advance(one, places[0], of_frame), tracker.advance(other, places[1], of_frame)
        apart.append(np.abs(one.place - one.average[tracker.SWIFT] - other.place + other.average[tracker.SWIFT]).max())
    assert apart[-1] < 0.15 * apart[0]
    assert np.abs(one.place - other.place).max() < 6 * (1 << 14)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-70, 70), min_size=MODEL.bases["joints"].components, max_size=MODEL.bases["joints"].components))
def test_events_come_back(levels):
    sparse = np.where(rng(sum(levels) % 1000).random(len(levels)) < 0.2, levels, 0)
    density = Density(MODEL.priors["joints"], MODEL)
    encoder = PythonEncoder()
    write_moved(encoder, sparse, INDEX, density)
    assert (read_moved(PythonDecoder(encoder.finish()), len(levels), INDEX, density) == sparse).all()


def test_classes_go_by_nonzeros():
    levels = np.zeros(76, np.int64)
    found = []
    for n in range(77):
        levels[:n] = 3
        found.append(class_of(levels))
    assert found[0] == 0 and found[1] == 1 and found[76] == 7 and sorted(found) == found


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 2**32 - 1))
def test_any_symbols_of_the_fountain_are_enough(data, seed):
    fountain, basin, found = Fountain(data), Basin(), None
    for number in rng(seed).permutation(NUMBERS):
        found = basin.add(int(number), fountain.symbol(int(number)))
        if found is not None:
            break
    assert found == data and len(basin) == fountain.needed


def test_a_false_symbol_spoils_nothing_after_it():
    fountain, basin = Fountain(b"whose motion it is"), Basin()
    assert [basin.add(n, fountain.symbol(n)) for n in range(5)] == [None] * 5
    assert basin.add(5, fountain.symbol(5) ^ 1) is None
    found = [basin.add(n, fountain.symbol(n)) for n in range(6, 6 + fountain.needed)]
    assert found[:-1] == [None] * (fountain.needed - 1) and found[-1] == b"whose motion it is"


def test_the_fountain_refuses_what_is_too_large():
    assert Fountain(bytes(MOST_BYTES)).needed > 1
    with pytest.raises(ValueError, match="too many"):
        Fountain(bytes(MOST_BYTES + 1))


def test_everybody_is_refreshed_in_a_turn():
    for components in (1, 6, 76, 133):
        told = np.concatenate([tracker.refreshed(n, components) for n in range(tracker.REFRESH_FRAMES)])
        assert sorted(told.tolist()) == list(range(components))
    assert NUMBERS % tracker.REFRESH_FRAMES == 0


def test_framing():
    assert unframed(framed(NUMBERS + 5, b"abc")) == (5, b"abc")
    packet = framed(7, bytes(range(20)))
    for at in range(8 * len(packet)):
        damaged = bytearray(packet)
        damaged[at // 8] ^= 1 << at % 8
        with pytest.raises(CorruptStream):
            unframed(bytes(damaged))
    for short in (b"", packet[:2]):
        with pytest.raises(CorruptStream, match="bytes"):
            unframed(short)


def test_analysis_of_a_frame_is_that_of_the_motion(data_dir):
    motion = read_motion(data_dir / "cmu_bvh" / "05" / "05_05.bvh", UNIT_CM).frames(1, 400)
    figure = PoseVectors(motion.skeleton, MODEL.rig.expected)
    path, body = figure.analyse(motion, motion.scale)
    analysis = Analysis(figure, motion.scale)
    for n, values in enumerate(motion.values):
        p, b = analysis.of(values)
        np.testing.assert_allclose(p[0], path[n], atol=1e-9)
        np.testing.assert_allclose(b[0], body[n], atol=1e-6)


def test_packets_without_loss_show_what_the_encoder_has(motion):
    packets = packets_of(motion)
    shown = shown_of(list(packets))
    errors = errors_of(motion, shown)
    assert len(errors) == motion.frame_count and np.isfinite(errors).all()
    assert np.nanmean(errors) < 0.36
    assert [frame.number for frame in shown if frame] == [n for n, frame in enumerate(shown) if frame]
    assert not any(frame.concealed for frame in shown if frame)


@pytest.mark.parametrize("repeats", [1, 2])
def test_a_frame_told_again_mends_its_loss_at_once(motion, repeats):
    packets: list[bytes | None] = list(packets_of(motion, repeats=repeats))
    whole = shown_of(packets)
    for n in range(repeats):
        packets[200 + n] = None
    shown = shown_of(packets)
    assert all(shown[200 + n].concealed for n in range(repeats))
    for n in range(200 + repeats, len(packets)):
        assert (shown[n].values == whole[n].values).all()


def test_packets_that_come_late_or_twice_mend(motion):
    packets = packets_of(motion)
    swapped = packets.copy()
    swapped[150], swapped[153] = swapped[153], swapped[150]
    decoder = Decoder()
    shown = [decoder.push(p) for p in [*swapped[:300], swapped[299], *swapped[300:]]]
    whole = shown_of(packets)
    assert shown[-1] and (shown[-1].values == whole[-1].values).all()
    assert decoder.tally.repeated == 1 and decoder.tally.late >= 1


def test_without_telling_again_a_loss_is_mended_by_refreshing(motion):
    packets: list[bytes | None] = list(packets_of(motion))
    plain = errors_of(motion, shown_of(packets))
    packets[200] = None
    errors = errors_of(motion, shown_of(packets))
    again = slice(200 + tracker.REFRESH_FRAMES, None)
    assert errors[again].mean() < 1.1 * plain[again].mean()


def test_half_a_second_behind_a_burst_all_is_well(motion):
    packets: list[bytes | None] = list(packets_of(motion))
    plain = errors_of(motion, shown_of(packets))
    packets[200:220] = [None] * 20
    errors = errors_of(motion, shown_of(packets))
    assert np.abs(errors - plain)[280:].max() < 0.2


def test_a_receiver_that_joins_late_is_right_within_half_a_second(motion):
    packets = packets_of(motion)
    shown = [None] * 140 + shown_of(list(packets[140:]))
    plain, errors = (errors_of(motion, s) for s in (shown_of(list(packets)), shown))
    first = next(n for n, frame in enumerate(shown) if frame)
    assert first - 140 <= 60
    assert errors[first + 1 :].mean() < 1.5 * plain[first + 1 :].mean()


def test_a_long_silence_is_no_long_work(motion):
    packets = packets_of(motion.with_values(np.concatenate([motion.values] * 5)))
    decoder = Decoder()
    shown = [decoder.push(p) for p in [*packets[:100], *packets[2200:2300]]]
    assert shown[99] and shown[-1] and shown[-1].number == 2299
    at = motion.with_values(np.stack([shown[-1].values, motion.values[2299 % motion.frame_count]]))
    error = compare(at.frames(0, 1), at.frames(1, 2))["mean_cm"]
    assert isinstance(error, float) and error < 1.0


def test_control_follows_a_rate(motion):
    encoder = Encoder(motion.skeleton, motion.frame_time, motion.unit_cm, "rate", 9.0, "joints")
    sizes = [len(encoder.push(v)) for v in np.concatenate([motion.values] * 4)]
    assert 8 * np.mean(sizes[-960:]) / motion.frame_time / 1000 == pytest.approx(9.0, rel=0.15)


def test_control_follows_an_error(motion):
    long = motion.with_values(np.concatenate([motion.values] * 3))
    errors = errors_of(long, shown_of(list(packets_of(long, 1.0))))
    assert np.nanmean(errors[-480:]) == pytest.approx(1.0, rel=0.25)


@pytest.mark.parametrize("channels", [TURNS, POSITION_CHANNELS + TURNS, TURNS[:1]], ids=["turning", "sliding", "a hinge"])
def test_unknown_rigs_stream_too(channels):
    offsets = np.array([[0.0, 0, 0], [20, 5, 0], [0, 15, 0]])
    skeleton = Skeleton(["a", "b", "c"], [-1, 0, 1], offsets, [POSITION_CHANNELS + TURNS, channels, TURNS])
    moves = np.sin(np.arange(400)[:, None] / 120 * np.linspace(0.5, 2, skeleton.channel_count))
    motion = Motion(skeleton, 30 * moves, 1 / 100, 2.0)
    shown = shown_of(list(packets_of(motion, 1.0)))
    errors = errors_of(motion, shown)
    assert errors[-150:].mean() < 1.5


def test_what_cannot_be_streamed_is_refused(motion):
    s = motion.skeleton
    with pytest.raises(ValueError, match="wanted"):
        Encoder(s, motion.frame_time, motion.unit_cm, "error", -1.0)
    with pytest.raises(ValueError, match="repeats"):
        Encoder(s, motion.frame_time, motion.unit_cm, repeats=9)
    encoder = Encoder(s, motion.frame_time, motion.unit_cm)
    with pytest.raises(JaxmocapError, match="finite"):
        encoder.push(np.full(s.channel_count, np.nan))
    with pytest.raises(JaxmocapError, match="shape"):
        encoder.push(motion.values[0][:-1])


def test_levels_are_nearest_but_for_the_dead_zone(wanted):
    prior = MODEL.priors["joints"]
    outlook = tracker.look(tracker.State.at(wanted[0]), prior, MODEL.network, INDEX)
    step = tracker.step_units(INDEX)
    for off, level in ((0.55, 0), (0.65, 1), (1.5, 1), (1.7, 2), (-0.65, -1)):
        found = choose_levels(outlook.place + int(off * step), outlook, INDEX)
        assert (found == level).all()


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Corpus:
    folder = tmp_path_factory.mktemp("walks")
    for seed in (1, 2):
        write_motion(walk(seed=seed, seconds=2.0), folder / f"walk{seed}.bvh")
    return Corpus.of([folder], SYNTHETIC_UNIT_CM)


def test_training_resumes_to_the_same_model_which_codes(corpus, tmp_path, monkeypatch):
    artifact, report = train_live(corpus, tmp_path / "whole")
    assert artifact.spec["codec"] == report["codec"] == "live" and report["frames"] == 480
    curve = report["curves"]["network"]
    assert np.isfinite(curve).all() and curve[-1] < 0.9 * curve[0]
    assert report["curves"]["packets"][-1] < report["curves"]["packets"][0]

    class Interrupted(Exception):
        pass

    def interrupted(*arguments):
        raise Interrupted

    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(live_training, "encode_packet", interrupted)  # when packets are made
        train_live(corpus, tmp_path / "part")
    assert train_live(corpus, tmp_path / "part")[0].digest == artifact.digest

    motion = walk(seed=3, seconds=1.0)
    codec = make({"codec": "live", "metric": "joints", "target": {"kind": "mean", "cm": 1.0}}, artifact)
    data = codec.encode(motion)
    mean_cm = compare(motion, codec.decode(data))["mean_cm"]
    assert isinstance(mean_cm, float) and mean_cm <= 1.0 and len(data) < 120 * 40


def test_the_file_has_fewer_bytes_than_packets_and_holds_its_target(data_dir):
    motion = read_motion(data_dir / "cmu_bvh" / "09" / "09_03.bvh", UNIT_CM).frames(1)
    codec = make({"codec": "live", "metric": "joints", "target": {"kind": "mean", "cm": 0.5}})
    data = codec.encode(motion)
    mean_cm = compare(motion, codec.decode(data))["mean_cm"]
    assert isinstance(mean_cm, float) and mean_cm <= 0.5
    assert len(data) < 0.75 * sum(map(len, packets_of(motion, 0.5)))
    setting = write_setting(motion.skeleton, motion.scale, MODEL, "joints", 8)
    assert len(setting.section) == 1  # a person of the corpus
