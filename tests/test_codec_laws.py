"""What holds for every codec of the registry: round trips within the target, frame ranges, and damaged streams refused."""

import functools
import json
import resource
import signal
import struct
import zlib
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxmocap.codecs import CODECS, decode, load_artifact, make
from jaxmocap.codecs.artifact import make_artifact
from jaxmocap.codecs.base import figure_height
from jaxmocap.codecs.container import read_stream
from jaxmocap.codecs.rig import Rig
from jaxmocap.errors import CorruptStream, JaxmocapError, ModelMismatch, TruncatedStream, UnsupportedVersion
from jaxmocap.kinematics import pose, positions_cm
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.skeleton import POSITION_CHANNELS, ROTATION_CHANNELS, Skeleton
from jaxmocap.synthesis import walk

REFUSED = (CorruptStream, TruncatedStream, UnsupportedVersion)
# Settings with which so many frames make several chunks, and variants that write other bytes.
MANY_CHUNKS: dict[str, dict] = {
    "lsdt-clip": {"clip_frames": 60},
    "learned": {},
    "lsdt-frame": {},
    "dct-frame": {},
    "mdtt": {},
    "pca-rdo": {},
    "live": {},
}
LONG = {"lsdt-clip": 540, "learned": 16500, "lsdt-frame": 8300, "dct-frame": 8300, "mdtt": 4100, "pca-rdo": 4100, "live": 8300}
VARIANTS: dict[str, list[dict]] = {
    "lsdt-clip": [{"form": "runs"}, {"form": "paper"}],
    "learned": [{"metric": "joints"}, {"metric": "shell"}, {"metric": "joints", "qualities": 3}],
    "lsdt-frame": [{}],
    "dct-frame": [{}],
    "mdtt": [{}],
    "pca-rdo": [{}],
    "live": [{"metric": "joints"}, {"metric": "shell"}],
}
COUNTS = {
    "lsdt-clip": (1, 2, 239, 240, 241, 961),
    "learned": (1, 2, 3, 15, 16, 17, 240),
    "lsdt-frame": (1, 2, 240),
    "dct-frame": (1, 2, 240),
    "mdtt": (1, 2, 239, 240, 241),
    "pca-rdo": (1, 2, 14, 15, 16, 121),
    "live": (1, 2, 240),
}
FRAMES = 540
# In cm: leaves less than half a centimetre.
FINE_STEP = {"lsdt-clip": 1.0, "learned": 0.5, "lsdt-frame": 0.5, "dct-frame": 0.5, "mdtt": 1.0, "pca-rdo": 1.0, "live": 0.2}

codecs = pytest.mark.parametrize("name", CODECS)
variants = pytest.mark.parametrize(
    "settings_", [{"codec": name, **v} for name in CODECS for v in VARIANTS[name]], ids=lambda s: "-".join(map(str, s.values()))
)
_encoded: dict[str, bytes] = {}


@pytest.fixture(scope="session")
def motion() -> Motion:
    return walk(seed=3, seconds=FRAMES / 120)


@pytest.fixture(scope="session")
def jumpy(motion) -> Motion:
    """A T-pose far away in frame 0, and one frame in which the figure is turned round."""
    values = motion.values[:120].copy()
    values[0] = 0
    values[60, 3:] += 90
    return motion.with_values(values)


def measured(settings_: dict, source: Motion, decoded: Motion, kind: str = "mean") -> float:
    """What a target of these settings speaks of: of joints, or of the shell around them where there are rotations."""
    report = compare(source, decoded)
    shell = make(settings_).config().get("metric") == "shell" and report["shell_mean_cm"] is not None
    value = report[f"shell_{kind}_cm" if shell else f"{kind}_cm"]
    assert isinstance(value, float)
    return value


def mean_target(cm: float) -> dict:
    return {"kind": "mean", "cm": cm}


def stream_of(settings_: dict, motion: Motion) -> bytes:
    """Each encoded once, whichever test asks."""
    key = json.dumps([settings_, motion.frame_count])
    if key not in _encoded:
        _encoded[key] = make(settings_).encode(motion)
    return _encoded[key]


def many_chunks(name: str) -> bytes:
    data = stream_of({"codec": name, "target": mean_target(1.0), **MANY_CHUNKS[name]}, long_motion(LONG[name]))
    assert read_stream(data).header.chunk_count > 2
    return data


@functools.cache
def long_motion(frames: int) -> Motion:
    """A walk; of more frames than that is quick for, two joints that swing."""
    if frames <= 600:
        return walk(seed=3, seconds=frames / 120)
    skeleton = Skeleton(["a", "b"], [-1, 0], np.array([[0.0, 0, 0], [20, 5, 0]]), [POSITION_CHANNELS + TURNS, TURNS])
    values = 30 * np.sin(np.arange(frames)[:, None] / 120 * np.linspace(0.1, 0.5, skeleton.channel_count))
    return Motion(skeleton, values, 1 / 120, 1.0)


def assert_alike(decoded: Motion, source: Motion) -> None:
    """The same frames, joints, names, tree, rate and unit."""
    assert decoded.values.shape[0] == source.frame_count
    assert decoded.skeleton.names == source.skeleton.names
    assert decoded.skeleton.parents == source.skeleton.parents
    assert decoded.frame_time == source.frame_time
    assert decoded.unit_cm == source.unit_cm
    assert np.isfinite(decoded.values).all()


def assert_bones_keep_lengths(decoded: Motion) -> None:
    at = np.asarray(pose(decoded).positions)
    s = decoded.skeleton
    for j, parent in enumerate(s.parents):
        if parent >= 0:
            length = np.linalg.norm(at[:, j] - at[:, parent], axis=1)
            assert np.abs(length - np.linalg.norm(s.offsets[j])).max() < 1e-4 * (1 + np.abs(at).max())


@variants
def test_round_trip(settings_, motion):
    codec = make({**settings_, "target": mean_target(1.0)})
    decoded = codec.decode(stream_of(codec.config(), motion))
    assert_alike(decoded, motion)
    assert decoded.skeleton.same_rig(motion.skeleton)
    assert measured(settings_, motion, decoded) <= 1.0
    assert_bones_keep_lengths(decoded)
    scale = motion.scale
    lengths = [np.linalg.norm(m.skeleton.offsets, axis=1) * scale for m in (motion, decoded)]
    assert np.abs(lengths[0] - lengths[1]).max() < 1.0


@variants
def test_config_through_json_and_determinism(settings_, motion):
    codec = make({**settings_, "target": mean_target(1.0)})
    again = make(json.loads(json.dumps(codec.config())))
    assert again.config() == codec.config()
    assert again.encode(motion) == stream_of(codec.config(), motion)


@codecs
def test_settings_are_validated(name):
    for wrong in ({"codec": "none"}, {"codec": name, "colour": 1}, {"codec": name, "target": {"kind": "mean", "cm": -1.0}}):
        with pytest.raises(ValueError, match="codec|settings|target"):
            make(wrong)


@variants
@pytest.mark.parametrize("cm", [0.2, 2.0])
@pytest.mark.parametrize("kind", ["mean", "max"])
def test_target_is_met(settings_, kind, cm, jumpy):
    codec = make({**settings_, "target": {"kind": kind, "cm": cm}})
    assert measured(settings_, jumpy, codec.decode(codec.encode(jumpy)), kind) <= cm


@codecs
def test_step_target_orders_sizes_and_errors(name, jumpy):
    sizes, errors = [], []
    for cm in (FINE_STEP[name], 8.0, 64.0):
        codec = make({"codec": name, "target": {"kind": "step", "cm": cm}})
        data = codec.encode(jumpy)
        sizes.append(len(data))
        errors.append(measured(codec.config(), jumpy, codec.decode(data)))
    assert sizes == sorted(sizes, reverse=True) and errors == sorted(errors)
    assert errors[0] < 0.5 < errors[2]


@codecs
def test_default_target_is_half_a_percent_of_the_height(name, jumpy):
    codec = make({"codec": name})
    assert measured(codec.config(), jumpy, codec.decode(codec.encode(jumpy))) <= 0.005 * figure_height(jumpy)


@codecs
def test_frame_ranges_are_slices(name):
    data, frames = many_chunks(name), LONG[name]
    whole = np.asarray(positions_cm(decode(data)))
    skeleton = decode(data).skeleton

    @settings(max_examples=25, deadline=None)
    @given(st.integers(0, frames - 1).flatmap(lambda a: st.tuples(st.just(a), st.integers(a + 1, frames + 9))))
    @example((-70, -1))
    @example((None, None))
    def check(ends):
        chosen = slice(*ends)
        part = decode(data, frames=chosen)
        padded = np.zeros((frames, part.values.shape[1]))  # one shape, one compilation
        padded[: part.frame_count] = part.values
        at = np.asarray(positions_cm(Motion(skeleton, padded, part.frame_time, part.unit_cm)))[: part.frame_count]
        assert at.shape == whole[chosen].shape
        np.testing.assert_allclose(at, whole[chosen], rtol=1e-4, atol=1e-3)

    check()


@codecs
def test_ranges_of_no_frames_are_refused(name):
    data = many_chunks(name)
    for frames in (slice(5, 5), slice(9, 3), slice(LONG[name], None), slice(0, 10, 2), slice(None, None, -1)):
        with pytest.raises(ValueError, match="are none"):
            decode(data, frames=frames)


@codecs
def test_only_the_chunks_needed_are_read(name):
    data = many_chunks(name)
    stream = read_stream(data)
    start, stop = stream.spans[-1]
    damaged = data[:start] + bytes(b ^ 255 for b in data[start:stop]) + data[stop:]
    before = (stream.header.chunk_count - 1) * stream.header.chunk_frames
    expected = decode(data, frames=slice(0, before)).values
    assert np.array_equal(decode(damaged, frames=slice(0, before)).values, expected)
    for frames in (None, slice(before - 1, before + 1), slice(-1, None)):
        with pytest.raises(CorruptStream, match="checksum"):
            decode(damaged, frames=frames)


@variants
def test_every_truncation_is_refused(settings_, motion):
    for data in (stream_of({**settings_, "target": mean_target(1.0)}, motion), many_chunks(settings_["codec"])):
        for end in range(len(data)):
            with pytest.raises(CorruptStream):
                decode(data[:end])


@variants
def test_random_flips_are_refused(settings_, motion):
    rng = np.random.default_rng(0)
    streams = (stream_of({**settings_, "target": mean_target(1.0)}, motion), many_chunks(settings_["codec"]))
    for n in range(2000):
        damaged = bytearray(streams[n % 2])
        for at in rng.choice(len(damaged), rng.integers(1, 4), replace=False):
            damaged[at] ^= rng.integers(1, 256)
        with pytest.raises(REFUSED):
            decode(bytes(damaged))


def resealed(data: bytes, header_end: int, spans) -> bytes:
    """The stream with its checksums made right again."""
    crc = zlib.crc32(data[:header_end])
    out = bytearray(data)
    for start, stop in spans:
        out[stop : stop + 4] = struct.pack("<I", zlib.crc32(data[start:stop], crc))
    return bytes(out)


@contextmanager
def bounded(seconds: float, more_bytes: int):
    """Raises TimeoutError in what takes too long, and MemoryError in what takes too much."""

    def expire(*_):
        raise TimeoutError

    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (now + more_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)


@codecs
def test_crafted_streams_decode_or_are_refused(name, motion, unknown):
    """Mutated with checksums that hold: what comes out is a motion or one of our errors, soon and in little memory."""
    rng = np.random.default_rng(1)
    sources = [stream_of({"codec": name, **v, "target": mean_target(1.0)}, motion) for v in VARIANTS[name]]
    sources += [make({"codec": name, **v, "target": mean_target(1.0)}).encode(unknown) for v in VARIANTS[name]]
    sources.append(many_chunks(name))
    outcomes = {"decoded": 0, "refused": 0}
    with bounded(100, 1 << 30):
        for n in range(300):
            data = sources[n % len(sources)]
            stream = read_stream(data)
            sealed = {at for _, stop in stream.spans for at in range(stop, stop + 4)}
            header_end = stream.spans[0][0]
            # Half of the mutations hit the header and the skeleton, the rest the motion.
            places = [at for at in range(header_end if n % 2 else len(data)) if at not in sealed]
            mutated = bytearray(data)
            for at in rng.choice(places, rng.integers(1, 4), replace=False):
                mutated[at] ^= rng.integers(1, 256)
            try:
                made = decode(resealed(bytes(mutated), header_end, stream.spans))
            except JaxmocapError:
                outcomes["refused"] += 1
            else:
                assert made.values.ndim == 2
                outcomes["decoded"] += 1
    assert min(outcomes.values()) > 10, outcomes


def another_model(name: str):
    shipped = load_artifact(name)
    return make_artifact({**shipped.spec, "corpus": "another"}, shipped.tensors)


@codecs
def test_wrong_and_missing_models(name, motion):
    data = stream_of({"codec": name, "target": mean_target(1.0), **MANY_CHUNKS[name]}, motion)
    other = another_model(name)
    with pytest.raises(ModelMismatch, match="needs the model"):
        decode(data, artifact=other)
    with pytest.raises(ModelMismatch, match="needs the model"):
        make({"codec": name}, other).decode(data)
    foreign = make({"codec": name, "target": mean_target(1.0)}, other).encode(motion)
    with pytest.raises(ModelMismatch, match="not shipped"):
        decode(foreign)
    assert_alike(decode(foreign, artifact=other), motion)


@codecs
def test_embedded_model_travels_along(name, motion):
    other = another_model(name)
    codec = make({"codec": name, "target": mean_target(1.0), "embed": True}, other)
    data = codec.encode(motion)
    decoded = decode(data)
    assert_alike(decoded, motion)
    assert measured(codec.config(), motion, decoded) <= 1.0
    assert read_stream(data).section_bytes()["model"] == len(other.data)
    assert np.array_equal(decode(data, artifact=load_artifact(name)).values, decoded.values)


@pytest.mark.parametrize(("name", "frames"), [(name, count) for name in CODECS for count in COUNTS[name]])
def test_any_number_of_frames(name, frames):
    source = walk(seed=5, seconds=frames / 120)
    codec = make({"codec": name, "target": mean_target(1.0)})
    decoded = codec.decode(codec.encode(source))
    assert_alike(decoded, source)
    assert measured(codec.config(), source, decoded) <= 1.0


@codecs
def test_one_chunk_costs_at_most_20_bytes(name):
    """All that is neither skeleton nor coded motion, at the rate and in the unit of the model."""
    model = load_artifact(name)
    rig = Rig.load(model.spec["rig"], model.tensors)
    source = walk(seed=3, seconds=2.0)
    s, bones = rig.skeleton, rig.skeleton.offsets / rig.unit_cm
    skeleton = Skeleton(s.names, s.parents, bones, s.channels, s.end_joints, s.end_offsets / rig.unit_cm, s.axes)
    motion = Motion(skeleton, source.values, rig.frame_time, rig.unit_cm)
    codec = make({"codec": name, "target": mean_target(1.0)})
    data = codec.encode(motion)
    sections = read_stream(data).section_bytes()
    assert len(data) - sections["skeleton"] - sections["motion"] <= 20
    assert sections["model"] == 0
    assert measured(codec.config(), motion, decode(data)) <= 1.0


# Rigs and motions that no model knows.

RNG = np.random.default_rng(7)
UNKNOWN_FRAMES = 60
_smooth = np.cumsum(np.cumsum(RNG.normal(size=(UNKNOWN_FRAMES, 64)), 0), 0)
SMOOTH = 40 * _smooth / np.abs(_smooth).max(0)
TURNS = ROTATION_CHANNELS


def rigid(parents, channels, axes=None) -> Motion:
    joints = len(parents)
    offsets = np.random.default_rng(joints).normal(scale=15, size=(joints, 3))
    leaves = sorted(set(range(joints)) - set(parents))
    skeleton = Skeleton([f"j{n}" for n in range(joints)], parents, offsets, channels, leaves, offsets[leaves] / 2, axes)
    return Motion(skeleton, SMOOTH[:, : skeleton.channel_count], 1 / 97.3, None)


@pytest.fixture(scope="session")
def unknown() -> Motion:
    """Two figures in one file: two roots, an end site on each leaf, an order of rotations for each joint."""
    six, orders = POSITION_CHANNELS, [TURNS, TURNS[::-1], (TURNS[1], TURNS[2], TURNS[0])]
    channels = [six + TURNS, orders[1], orders[2], six + orders[1], orders[0], orders[2]]
    return rigid([-1, 0, 1, -1, 3, 3], channels)


def rig_with_moving_joints() -> Motion:
    return rigid([-1, 0, 1, 2], [POSITION_CHANNELS + TURNS, POSITION_CHANNELS + TURNS, TURNS, ("Xposition", "Zrotation")])


def rig_with_limits() -> Motion:
    """Hinges and saddle joints in frames of their own, as in ASF."""
    axes = np.tile(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), (5, 1, 1))
    root = POSITION_CHANNELS + TURNS
    return rigid([-1, 0, 1, 2, 0], [root, ("Xrotation",), ("Xrotation", "Zrotation"), (), TURNS], axes)


def rooted_without_positions() -> Motion:
    return rigid([-1, 0, 1], [TURNS, TURNS, TURNS])


def points(parents) -> Motion:
    at = SMOOTH[:, :15].reshape(UNKNOWN_FRAMES, 5, 3)
    return Motion.from_positions(at, list("abcab"), 1 / 30, parents, 0.1)


def one_point() -> Motion:
    return Motion.from_positions(SMOOTH[:, None, :3], ["only"], 1 / 120, None, 100.0)


def constant() -> Motion:
    source = walk(seed=2, seconds=0.5)
    return Motion(source.skeleton, np.tile(source.values[:1], (UNKNOWN_FRAMES, 1)), 0.04, None)


def unknown_and_constant() -> Motion:
    still = rooted_without_positions()
    return still.with_values(np.zeros_like(still.values))


UNKNOWN = {
    "moving joints": rig_with_moving_joints,
    "limits": rig_with_limits,
    "roots that do not move": rooted_without_positions,
    "points": lambda: points(None),
    "points with parents": lambda: points([-1, 0, 1, 0, -1]),
    "one point": one_point,
    "constant": constant,
    "unknown and constant": unknown_and_constant,
}


@variants
@pytest.mark.parametrize("source", UNKNOWN.values(), ids=UNKNOWN.keys())
def test_unknown_rigs(settings_, source):
    check_unknown(settings_, source())


@variants
def test_several_roots(settings_, unknown):
    check_unknown(settings_, unknown)


def check_unknown(settings_: dict, source: Motion) -> None:
    codec = make({**settings_, "target": {"kind": "max", "cm": 0.5}})
    decoded = codec.decode(codec.encode(source))
    assert_alike(decoded, source)
    assert measured(settings_, source, decoded, "max") <= 0.5
    if decoded.skeleton.is_rigid:
        assert source.skeleton.is_rigid
        assert_bones_keep_lengths(decoded)


@codecs
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_must_be_finite(name, value, motion):
    values = motion.values[:60].copy()
    values[7, 9] = value
    with pytest.raises(JaxmocapError, match="not finite"):
        make({"codec": name}).encode(motion.with_values(values))


@codecs
def test_no_frames_are_refused(name, motion):
    with pytest.raises(JaxmocapError, match="no frames"):
        make({"codec": name}).encode(motion.frames(0, 0))


@codecs
def test_targets_out_of_reach_are_refused(name, jumpy):
    with pytest.raises(JaxmocapError, match="out of this codec's reach"):
        make({"codec": name, "target": {"kind": "max", "cm": 1e-6}}).encode(jumpy)
