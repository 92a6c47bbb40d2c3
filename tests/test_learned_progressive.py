"""Progressive streams of `learned`: their beginnings decode to coarser motions, and cost little more than one quality."""

import numpy as np
import pytest

from jaxmocap.bench.data import UNIT_CM
from jaxmocap.codecs import decode, make
from jaxmocap.codecs.container import Stream, read_stream
from jaxmocap.errors import CorruptStream, JaxmocapError, TruncatedStream
from jaxmocap.formats import read_motion
from jaxmocap.metrics import compare
from jaxmocap.motion import Motion
from jaxmocap.synthesis import walk


def coded(motion: Motion, qualities: int, kind: str = "mean", cm: float = 0.4) -> bytes:
    target = {"kind": kind, "cm": cm}
    return make({"codec": "learned", "metric": "joints", "qualities": qualities, "target": target}).encode(motion)


def error(motion: Motion, decoded: Motion, kind: str = "mean") -> float:
    return float(compare(motion, decoded)[f"{kind}_cm"])  # type: ignore[arg-type]


def ends(stream: Stream) -> list[int]:
    """Where every quality ends, in bytes."""
    return [stream.spans[(n + 1) * stream.header.chunk_count - 1][1] + 4 for n in range(stream.layers)]


@pytest.fixture(scope="module")
def motion() -> Motion:
    """A walk whose every channel moves a little: of channels at zero the search does not know that they stay there."""
    still = walk(seed=5, seconds=1.0)
    return still.with_values(still.values + np.random.default_rng(0).normal(0, 1e-3, still.values.shape))


@pytest.mark.parametrize(("kind", "cm"), [("mean", 0.4), ("max", 1.5), ("step", 0.5)])
def test_every_quality_has_less_error(motion: Motion, kind: str, cm: float):
    data = coded(motion, 3, kind, cm)
    errors = [error(motion, decode(data, quality=n)) for n in (1, 2, 3)]
    assert errors[0] > 1.2 * errors[1] and errors[1] > 1.2 * errors[2]
    whole = decode(data)
    np.testing.assert_array_equal(whole.values, decode(data, quality=3).values)
    assert kind == "step" or error(motion, whole, kind) <= cm
    if kind == "mean":
        assert errors[0] <= 2.2**2 * cm and errors[1] <= 2.2 * cm


def test_beginnings_decode_as_the_whole_does(motion: Motion):
    data = coded(motion, 3)
    for quality, end in enumerate(ends(read_stream(data)), 1):
        np.testing.assert_array_equal(decode(data[:end], quality=quality).values, decode(data, quality=quality).values)
        with pytest.raises((TruncatedStream, CorruptStream)):
            decode(data[: end - 1], quality=quality)
    with pytest.raises(TruncatedStream):
        decode(data[: ends(read_stream(data))[1]])


def test_qualities_that_are_none_are_refused(motion: Motion):
    with pytest.raises(JaxmocapError, match="qualities 1 to 1"):
        decode(coded(motion, 1), quality=2)
    for qualities in (0, 9):
        with pytest.raises(ValueError, match="qualities"):
            make({"codec": "learned", "qualities": qualities})


def test_a_jump_is_in_the_first_quality(motion: Motion):
    values = motion.values.copy()
    values[50:, 3:6] += 60
    jumping = motion.with_values(values)
    data = coded(jumping, 2)
    assert error(jumping, decode(data, quality=1)) <= 0.88 and error(jumping, decode(data)) <= 0.4


@pytest.mark.parametrize("name", ["09_03", "05_05"])
def test_half_of_a_stream_is_nearly_as_good_as_a_stream_of_its_size(data_dir, name: str):
    motion = read_motion(data_dir / "cmu_bvh" / name[:2] / f"{name}.bvh", UNIT_CM).frames(1)
    data = coded(motion, 2, cm=0.3)
    reached = error(motion, decode(data[: len(data) // 2], quality=1))
    assert len(coded(motion, 1, cm=reached / 1.3)) > len(data) / 2
