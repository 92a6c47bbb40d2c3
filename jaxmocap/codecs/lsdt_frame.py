"""`lsdt-frame`: the frame-by-frame method of Hou et al. 2016 (section 3.1), with real bytes.

The first frame by the learned spatial transform (1), every other as the transformed residual (3) against the frame before
as it was reconstructed (2); hard threshold, uniform quantisation, Huffman positions and values, a fixed-length count for
each coefficient vector. Ours: the width of that count is a setting of the stream and bounds a vector's nonzeros
(frame_codec.py); the dead zone is the one that pays on train clips; code lengths by octave of the step are learned in the
closed loop, those of first frames apart; bones of exact length; chunks; a basis that travels where no model knows the rig.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..motion import Motion
from . import frame_codec, own_basis
from .artifact import Artifact
from .base import AbstractCodec, Target, target_config
from .clips import Bases
from .container import Stream, read_stream
from .frame_transform import AbstractSpatialTransform

NUMBER = 3


class LsdtTransform(AbstractSpatialTransform):
    """LSDT, a basis a coordinate; for a rig that no model knows it is fitted to the motion and travels."""

    name = "lsdt-frame"
    number = NUMBER

    def entries(self, positions: Float[np.ndarray, "frames joints 3"]) -> Int[np.ndarray, "3 joints columns"]:
        return own_basis.fit_entries(positions)

    def columns(self, joints: int) -> int:
        return joints

    def bases(self, entries: Int[np.ndarray, "3 components columns"], joints: int) -> Bases:
        return own_basis.bases_of(entries)


class LsdtFrame(AbstractCodec):
    """`artifact` is the trained model; `target` None means a mean error of 0.5 % of the figure's height.

    `embed` puts the model itself into every stream.
    """

    artifact: Artifact = eqx.field(static=True)
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def config(self) -> dict:
        return {"codec": "lsdt-frame", "target": target_config(self.target), "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; raises JaxmocapError where the target is out of reach."""
        return frame_codec.encode(motion, LsdtTransform(), self.artifact, self.target, self.embed)

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    return frame_codec.decode(stream, LsdtTransform(), at_hand, frames)


def packets(data: bytes, at_hand: Artifact | None = None) -> list[bytes]:
    """Every frame of a stream as bytes of its own, as it would be sent the moment it is there; without any framing."""
    return frame_codec.packets(read_stream(data), LsdtTransform(), at_hand)
