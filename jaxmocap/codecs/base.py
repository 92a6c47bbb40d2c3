"""What every codec is, and what it may be asked to meet."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import numpy as np

from ..kinematics import positions_cm
from ..motion import Motion


@dataclass(frozen=True)
class Target:
    """What a lossy encoder shall meet: `mean` or `max` joint error, or the quantiser `step`; all in cm."""

    kind: Literal["mean", "max", "step"]
    cm: float

    def __post_init__(self) -> None:
        if self.kind not in ("mean", "max", "step") or not 0 < self.cm < float("inf"):
            raise ValueError(f"the target is {self.kind} {self.cm} cm, wanted mean, max or step and cm above 0")

    @staticmethod
    def default(motion: Motion) -> Target:
        """A mean error of 0.5 % of the figure's height."""
        return Target("mean", 0.005 * figure_height(motion))


def target_config(target: Target | None) -> dict | None:
    """A target as `config()` states it."""
    return None if target is None else {"kind": target.kind, "cm": target.cm}


def figure_height(motion: Motion) -> float:
    """How tall the figure is, in cm: by its bones, or by its first frame where it has none."""
    height = motion.skeleton.height() * motion.scale
    if height > 0:
        return height
    first = np.asarray(positions_cm(motion.frames(0, 1)))[0]
    return float(max((first.max(0) - first.min(0)).max(), 1e-3))


class AbstractCodec(eqx.Module):
    """A codec with all of its settings: `decode(encode(motion))` gives the motion back, within the codec's promise."""

    @abc.abstractmethod
    def encode(self, motion: Motion) -> bytes:
        """The stream of a motion."""

    @abc.abstractmethod
    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        """The motion of a stream, or some of its frames, for which only the chunks that hold them are read.

        Raises CorruptStream, TruncatedStream, UnsupportedVersion or ModelMismatch.
        """

    @abc.abstractmethod
    def config(self) -> dict:
        """All settings as JSON, enough for `codecs.make` to build the same codec again."""


def frame_range(frames: slice | None, count: int) -> tuple[int, int]:
    """Start and stop of the frames asked for, of `count`. Raises ValueError where they are none."""
    start, stop, stride = (frames or slice(None)).indices(count)
    if stride != 1 or start >= stop:
        raise ValueError(f"frames {start}:{stop} of {count} are none; wanted start < stop and no stride")
    return start, stop
