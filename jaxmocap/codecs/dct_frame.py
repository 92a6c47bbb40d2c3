"""`dct-frame`: frame-by-frame compression by a spatial DCT (Kwak and Bajic 2011), with real bytes.

C.-H. Kwak, I. V. Bajic: Hybrid low-delay compression of motion capture data. ICME 2011, as Hou et al. 2016 (section 2.2) tell
it: "1D DCT to the predictive residuals between consecutive frames for exploiting the spatial coherence". Prediction from
the reconstructed frame before, quantisation, coding of coefficients and all that is ours are those of `lsdt-frame`, so that
the two differ in the transform alone: a DCT over the joints of each coordinate, in the order of the file.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..motion import Motion
from ..transforms.dct import dct_matrix
from . import frame_codec
from .artifact import Artifact
from .base import AbstractCodec, Target, target_config
from .clips import Bases
from .container import Stream, read_stream
from .frame_transform import AbstractSpatialTransform

NUMBER = 4


class DctTransform(AbstractSpatialTransform):
    """The DCT over joints, the same for all coordinates; it never travels."""

    name = "dct-frame"
    number = NUMBER

    def entries(self, positions: Float[np.ndarray, "frames joints 3"]) -> Int[np.ndarray, "3 joints columns"]:
        return np.zeros((3, positions.shape[1], 0), np.int8)

    def columns(self, joints: int) -> int:
        return 0

    def bases(self, entries: Int[np.ndarray, "3 components columns"], joints: int) -> Bases:
        basis = np.tile(dct_matrix(joints)[: entries.shape[1]].astype(np.float32), (3, 1, 1))
        return Bases(basis, basis)


class DctFrame(AbstractCodec):
    """`artifact` is the trained model; `target` None means a mean error of 0.5 % of the figure's height.

    `embed` puts the model itself into every stream.
    """

    artifact: Artifact = eqx.field(static=True)
    target: Target | None = eqx.field(static=True, default=None)
    embed: bool = eqx.field(static=True, default=False)

    def config(self) -> dict:
        return {"codec": "dct-frame", "target": target_config(self.target), "embed": self.embed}

    def encode(self, motion: Motion) -> bytes:
        """The stream; raises JaxmocapError where the target is out of reach."""
        return frame_codec.encode(motion, DctTransform(), self.artifact, self.target, self.embed)

    def decode(self, data: bytes, frames: slice | None = None) -> Motion:
        return decode(read_stream(data), self.artifact, frames)


def decode(stream: Stream, at_hand: Artifact | None, frames: slice | None = None) -> Motion:
    """The motion of a stream, or some of its frames; `at_hand` is a model that may be the one it needs."""
    return frame_codec.decode(stream, DctTransform(), at_hand, frames)


def packets(data: bytes, at_hand: Artifact | None = None) -> list[bytes]:
    """Every frame of a stream as bytes of its own, as it would be sent the moment it is there; without any framing."""
    return frame_codec.packets(read_stream(data), DctTransform(), at_hand)
