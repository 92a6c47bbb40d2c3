"""`jaxmocap encode`: a motion file to a stream."""

from __future__ import annotations

import inspect
import json as json_module
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..errors import JaxmocapError
from .base import Command, Input, Output, Report, load_model, read_file, table, unit_name, without_first

if TYPE_CHECKING:
    from ..codecs.artifact import Artifact
    from ..codecs.base import Target

_ERRORS = ("mean_cm", "max_cm", "shell_mean_cm", "shell_max_cm")


@dataclass(kw_only=True)
class Encode(Command):
    """Compress a motion file."""

    input: Input
    """BVH, AMC (with its ASF beside it), TRC or npz."""
    output: Output
    """The stream to write."""
    codec: str | None = None
    """The codec: learned, live, lsdt-clip, lsdt-frame, dct-frame, mdtt or pca-rdo.

    Default: the one that the model is for, or learned."""
    model: Path | None = None
    """A trained model: a file, or the id of a shipped one. Default: the one shipped for the codec."""
    mean_error: float | None = None
    """The mean error to keep, in cm (in file units where the unit is unknown). Default: 0.5 % of the figure's height."""
    max_error: float | None = None
    """The error that nothing in any frame may exceed, in cm."""
    metric: Literal["joints", "shell"] | None = None
    """What errors are of: joints, or three points 3 cm from each, which see twist, too. Default: shell, where the codec can."""
    step: float | None = None
    """The quantiser step, in cm, instead of an error."""
    unit_cm: float | None = None
    """Centimetres per file unit: BVH does not say. 5.6444 for the CMU conversions."""
    start: int = 0
    """Leave out so many frames at the front: 1 for the T-pose of the CMU conversions."""
    config: str = "{}"
    """Settings of the codec, as JSON: {"clip_frames": 60, "form": "paper"} of lsdt-clip."""
    qualities: int | None = None
    """How many qualities the beginnings of the stream hold, each with about 2.2 times less error than the last. Default: 1."""
    embed_model: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put the model into the stream."""

    def run(self) -> Report:
        from ..codecs import make
        from ..formats.text import write_bytes
        from ..metrics import compare

        model = load_model(self.model)
        settings = self._settings(model)
        motion = without_first(read_file(self.input, self.unit_cm), self.start, self.input.name)
        began = time.perf_counter()
        try:
            codec = make(settings, model)
        except ValueError as error:
            raise JaxmocapError(str(error)) from error
        data = codec.encode(motion)
        seconds = time.perf_counter() - began
        error = compare(motion, codec.decode(data))
        write_bytes(self.output, data)
        raw_bytes = motion.frame_count * motion.skeleton.joint_count * 12
        return {
            "codec": settings["codec"],
            "metric": codec.config().get("metric", "joints"),
            "frames": motion.frame_count,
            "joints": motion.skeleton.joint_count,
            "raw_bytes": raw_bytes,
            "text_bytes": self.input.stat().st_size,
            "stream_bytes": len(data),
            "ratio": raw_bytes / len(data),
            "unit": unit_name(motion),
            **{key: error[key] for key in _ERRORS},
            "seconds": seconds,
        }

    def text(self, report: Report) -> str:
        unit = report["unit"]
        errors = [(f"{key.removesuffix('_cm').replace('_', ' ')} error, {unit}", report[key]) for key in _ERRORS]
        return table([
            (str(self.output), f"{report['stream_bytes']:,} bytes, {report['ratio']:.1f}:1 of float32 positions"),
            ("codec", report["codec"]),
            ("frames", report["frames"]),
            *((name, value) for name, value in errors if value is not None),
            ("seconds", report["seconds"]),
        ])

    def _settings(self, model: Artifact | None) -> dict:
        from ..codecs import DEFAULT

        try:
            settings = json_module.loads(self.config)
        except ValueError as error:
            raise JaxmocapError(f"--config is no JSON: {error}") from error
        if not isinstance(settings, dict):
            raise JaxmocapError('--config is not a JSON object such as {"clip_frames": 60}')
        settings["codec"] = self.codec or (DEFAULT if model is None else model.spec["codec"])
        if self.metric is not None:
            settings["metric"] = self._where_taken("metric", self.metric, settings["codec"])
        if self.qualities is not None:
            settings["qualities"] = self._where_taken("qualities", self.qualities, settings["codec"])
        target = self._target()
        if target is not None:
            settings["target"] = target
        if self.embed_model:
            settings["embed"] = True
        return settings

    def _where_taken(self, name: str, value: object, codec: str) -> object:
        from ..codecs import CODECS

        if codec in CODECS and name not in inspect.signature(CODECS[codec]).parameters:
            raise JaxmocapError(f"--{name} is for codecs that take it, such as learned; {codec} does not")
        return value

    def _target(self) -> Target | None:
        from ..codecs.base import Target

        asked = {"mean": self.mean_error, "max": self.max_error, "step": self.step}
        given = [(kind, cm) for kind, cm in asked.items() if cm is not None]
        if len(given) > 1:
            raise JaxmocapError("give one of --mean-error, --max-error and --step")
        try:
            return Target(*given[0]) if given else None  # type: ignore[arg-type]
        except ValueError as error:
            raise JaxmocapError(str(error)) from error
