"""Codecs: a registry, and what opens any stream."""

from __future__ import annotations

from collections.abc import Callable

from ..errors import UnsupportedVersion
from ..motion import Motion
from . import dct_frame, lsdt_clip, lsdt_frame, mdtt, pca_rdo
from .artifact import Artifact
from .artifact import load_artifact as load_artifact
from .base import AbstractCodec as AbstractCodec
from .base import Target as Target
from .container import Header, read_stream
from .dct_frame import DctFrame as DctFrame
from .learned import codec as learned_codec
from .learned.codec import Learned as Learned
from .live import codec as live_codec
from .live.codec import Live as Live
from .lsdt_clip import LsdtClip as LsdtClip
from .lsdt_frame import LsdtFrame as LsdtFrame
from .mdtt import Mdtt as Mdtt
from .pca_rdo import PcaRdo as PcaRdo

# Registering a codec is what has it tested: the laws in tests/test_codec_laws.py run over this table.
CODECS: dict[str, Callable[..., AbstractCodec]] = {
    "lsdt-clip": LsdtClip,
    "learned": Learned,
    "lsdt-frame": LsdtFrame,
    "dct-frame": DctFrame,
    "mdtt": Mdtt,
    "pca-rdo": PcaRdo,
    "live": Live,
}
_BY_NUMBER = {
    lsdt_clip.NUMBER: ("lsdt-clip", lsdt_clip.decode),
    learned_codec.NUMBER: ("learned", learned_codec.decode),
    lsdt_frame.NUMBER: ("lsdt-frame", lsdt_frame.decode),
    dct_frame.NUMBER: ("dct-frame", dct_frame.decode),
    mdtt.NUMBER: ("mdtt", mdtt.decode),
    pca_rdo.NUMBER: ("pca-rdo", pca_rdo.decode),
    live_codec.NUMBER: ("live", live_codec.decode),
}
DEFAULT = "learned"


def make(config: dict, artifact: Artifact | None = None) -> AbstractCodec:
    """The codec of a `config()`; a setting left out takes its default. The model is the shipped one unless given.

    Raises ValueError for an unknown codec, an unknown setting, or one out of range.
    """
    settings = dict(config)
    name = settings.pop("codec", DEFAULT)
    if name not in CODECS:
        raise ValueError(f"codec is {name!r}, wanted one of {', '.join(CODECS)}; lossless ones: jaxmocap pack")
    if isinstance(settings.get("target"), dict):
        settings["target"] = Target(**settings["target"])
    try:
        return CODECS[name](artifact=artifact or load_artifact(name), **settings)
    except TypeError as error:
        raise ValueError(f"{name} does not take these settings: {error}") from error


def decode(data: bytes, artifact: Artifact | None = None, frames: slice | None = None, quality: int | None = None) -> Motion:
    """The motion of any stream, or some of its frames, for which only the chunks that hold them are read.

    `artifact` is a model that the stream may need; shipped and embedded ones are found. With `quality`, from 1 on, a
    progressive stream, or as much as there is of it, decodes as it is after so many layers. Raises CorruptStream,
    TruncatedStream, UnsupportedVersion or ModelMismatch, and ValueError for frames that are none.
    """
    stream = read_stream(data, quality)
    _, decode_stream = _entry(stream.header)
    return decode_stream(stream, artifact, frames)


def codec_name(header: Header) -> str:
    """The id of the codec that a stream was written by. Raises UnsupportedVersion where it is not known here."""
    return _entry(header)[0]


def _entry(header: Header):
    if header.codec not in _BY_NUMBER:
        raise UnsupportedVersion(f"the stream was written by codec {header.codec}, which this jaxmocap lacks: upgrade")
    return _BY_NUMBER[header.codec]
