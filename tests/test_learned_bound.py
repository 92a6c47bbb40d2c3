"""No point of any frame is off by more than the bound: jumps, glitches and bursts mended, for few bytes."""

import numpy as np
import pytest

from jaxmocap.codecs import make
from jaxmocap.codecs.artifact import load_artifact
from jaxmocap.codecs.entropy.range_coder import RangeDecoder, RangeEncoder
from jaxmocap.codecs.learned.bands import inverse
from jaxmocap.codecs.learned.corrections import (
    HEIGHT,
    NO_CORRECTIONS,
    Corrections,
    decode_corrections,
    encode_corrections,
    sample_counts,
)
from jaxmocap.codecs.learned.golomb import write_unsigned
from jaxmocap.errors import CorruptStream, JaxmocapError
from jaxmocap.formats import read_motion
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.synthesis import walk

ARTIFACT = load_artifact("learned")
UNIT_CM = 5.6444


def coder(kind: str, cm: float, metric: str = "joints"):
    return make({"codec": "learned", "metric": metric, "target": {"kind": kind, "cm": cm}}, ARTIFACT)


def errors_of(motion: Motion, decoded: Motion, metric: str = "joints") -> tuple[float, float]:
    """Mean and largest, in cm."""
    prefix = "" if metric == "joints" else "shell_"
    found = compare(motion, decoded)
    mean, largest = found[f"{prefix}mean_cm"], found[f"{prefix}max_cm"]
    assert isinstance(mean, float) and isinstance(largest, float)
    return mean, largest


def glitched(motion: Motion, frame: int, channel: int, by: float) -> Motion:
    values = motion.values.copy()
    values[frame, channel] += by
    return Motion(motion.skeleton, values, motion.frame_time, motion.unit_cm)


@pytest.fixture(scope="module")
def jog(data_dir) -> Motion:
    """With its T-pose before the first frame."""
    return read_motion(data_dir / "cmu_bvh" / "09" / "09_03.bvh", UNIT_CM)


@pytest.mark.parametrize(("metric", "cm"), [("joints", 0.5), ("joints", 3.0), ("shell", 1.0)])
def test_no_point_of_a_motion_with_its_t_pose_is_above_the_bound(jog, metric, cm):
    bounded = coder("max", cm, metric)
    data = bounded.encode(jog)
    mean, largest = errors_of(jog, bounded.decode(data), metric)
    assert largest <= cm
    assert mean > cm / 6  # no finer than the bound needs
    assert len(data) < 1.5 * len(coder("mean", mean, metric).encode(jog))


def test_a_glitch_of_one_frame_costs_little(jog):
    calm = jog.frames(1, 100)
    glitch = glitched(calm, 40, jog.skeleton.first_column[20], 35.0)
    bounded = coder("max", 1.0)
    data = bounded.encode(glitch)
    assert errors_of(glitch, bounded.decode(data))[1] <= 1.0
    assert len(data) < len(bounded.encode(calm)) + 130


def test_a_bound_holds_on_another_rig():
    motion = walk(0, 2.0, 60.0)
    bounded = coder("max", 0.8)
    assert errors_of(motion, bounded.decode(bounded.encode(motion)))[1] <= 0.8


def test_a_bound_out_of_reach_is_refused(jog):
    with pytest.raises(JaxmocapError, match="out of this codec's reach"):
        coder("max", 1e-4).encode(jog.frames(1, 30))


def some(frames: int, octaves: int, components: int, seed: int = 0) -> Corrections:
    random = np.random.default_rng(seed)
    found = []
    for octave, samples in enumerate(sample_counts(frames, octaves)):
        places = np.sort(random.choice(samples * components, min(5, samples * components), replace=False))
        levels = random.choice([-9, -3, -2, -1, 1, 2, 40], len(places))
        found += [(octave, *divmod(p, components), level) for p, level in zip(places.tolist(), levels.tolist(), strict=True)]
    return Corrections(*np.array(found).T)


@pytest.mark.parametrize(("frames", "octaves", "components"), [(1, 4, 1), (2, 4, 3), (47, 4, 7), (50, 0, 3), (130, 2, 60)])
@pytest.mark.parametrize("empty", [False, True])
def test_corrections_come_back(frames, octaves, components, empty):
    corrections = NO_CORRECTIONS if empty else some(frames, octaves, components)
    encoder = RangeEncoder()
    encode_corrections(encoder, corrections, frames, octaves, components)
    read = decode_corrections(RangeDecoder(encoder.finish()), frames, octaves, components)
    for a, b in zip(corrections, read, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_motion_without_corrections_pays_nothing_for_them():
    encoder = RangeEncoder()
    for _ in range(40):
        encode_corrections(encoder, NO_CORRECTIONS, 100, 4, 60)
    assert len(encoder.finish()) <= 1


@pytest.mark.parametrize(("gap", "size"), [(6, 1), (0, 1 << 23), (1 << 22, 1)])
def test_corrections_outside_the_motion_are_refused(gap, size):
    encoder = RangeEncoder()
    encoder.encode_each(np.array([1]), np.array([[(1 << 16) - (1 << 10), 1 << 10]]))
    write_unsigned(encoder, 1, 2)
    write_unsigned(encoder, gap, 1)  # one of 3 frames x 2 components
    write_unsigned(encoder, size - 1, 0)
    with pytest.raises(CorruptStream):
        decode_corrections(RangeDecoder(encoder.finish()), 3, 0, 2)


def test_more_corrections_than_places_are_refused():
    encoder = RangeEncoder()
    encoder.encode_each(np.array([1]), np.array([[(1 << 16) - (1 << 10), 1 << 10]]))
    write_unsigned(encoder, 7, 2)
    with pytest.raises(CorruptStream, match="7 corrections"):
        decode_corrections(RangeDecoder(encoder.finish()), 3, 0, 2)


@pytest.mark.parametrize(("frames", "octaves"), [(1, 0), (33, 4), (64, 3), (7, 4)])
def test_bumps_are_samples_of_the_slow_part(frames, octaves):
    """Of the finest kind one frame alone; of the longest what a sample of the lowest band does."""
    step = 0.25
    one = Corrections(*(np.array([n]) for n in (octaves, frames - 1, 1, -3)))
    shift = one.shift(frames, octaves, 2, step)
    assert shift[frames - 1, 1] == -3 * HEIGHT * step and np.count_nonzero(shift) == 1
    counts = sample_counts(frames, octaves)
    bands = [np.zeros((n, 1)) for n in np.diff(counts, prepend=0)]
    slow = np.zeros((counts[0], 1))
    slow[-1] = HEIGHT * step * 2.0 ** (octaves / 2)
    cosines = inverse([np.eye(counts[0])])
    expected = inverse([cosines.T @ slow, *bands[1:]])
    longest = Corrections(*(np.array([n]) for n in (0, counts[0] - 1, 0, 1)))
    np.testing.assert_allclose(longest.shift(frames, octaves, 1, step), expected, atol=1e-12)


def test_frames_with_corrections_decode_alone(jog):
    bounded = coder("max", 1.0)
    data = bounded.encode(jog.frames(0, 60))
    np.testing.assert_array_equal(bounded.decode(data, slice(20, 31)).values, bounded.decode(data).values[20:31])
