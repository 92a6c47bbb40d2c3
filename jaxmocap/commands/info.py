"""`jaxmocap info`: what a motion file, a stream, a database or a model holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import ModelMismatch
from .base import Command, Input, Report, load_model, read_file, table
from .database import open_database


@dataclass(kw_only=True)
class Info(Command):
    """Describe a motion file, a stream, a database or a model."""

    input: Input
    """Any motion file, .jmc stream or database, or .safetensors model."""
    unit_cm: float | None = None
    """Centimetres per file unit."""
    model: Path | None = None
    """The model that a stream needs, where it is neither shipped nor embedded."""

    def run(self) -> Report:
        from ..codecs.archive.container import HEAD_BYTES, is_archive
        from ..codecs.container import SUFFIX

        suffix = self.input.suffix.lower()
        if suffix == SUFFIX:
            with self.input.open("rb") as file:
                described = self._database() if is_archive(file.read(HEAD_BYTES)) else self._stream()
            return {"bytes": self.input.stat().st_size, **described}
        if suffix == ".safetensors":
            return {"bytes": self.input.stat().st_size, **self._model()}
        return {"bytes": self.input.stat().st_size, **self._motion()}

    def text(self, report: Report) -> str:
        return table([(key.replace("_", " "), _flat(value)) for key, value in report.items()])

    def _motion(self) -> Report:
        return {"format": self.input.suffix[1:].lower(), **_described(read_file(self.input, self.unit_cm))}

    def _stream(self) -> Report:
        from ..codecs import codec_name, decode
        from ..codecs.container import VERSION, read_stream
        from ..codecs.learned.description import describe

        data = self.input.read_bytes()
        stream = read_stream(data)
        header = stream.header
        report: Report = {
            "format": f"jmc {VERSION}",
            "codec": codec_name(header),
            "model": "embedded" if header.model is not None else header.digest.hex(),
            "chunks": header.chunk_count,
            "chunk_frames": header.chunk_frames,
            "sections": stream.section_bytes(),
        }
        model = load_model(self.model)
        try:
            if report["codec"] == "learned":
                report |= describe(stream, model)
            one = decode(data, model, slice(0, 1))
        except ModelMismatch as error:
            return {**report, "frames": header.frames, "skeleton": f"unknown: {error}"}
        return {**report, **_described(one), "frames": header.frames, "seconds": header.frames * one.frame_time}

    def _database(self) -> Report:
        from ..codecs.archive.container import VERSION
        from ..codecs.archive.index import BLOB, NUMBERS
        from ..codecs.container import DIGEST_BYTES

        archive = open_database(self.input).archive
        shared, kinds = archive.shared, [entry.kind for entry in archive.entries]
        model = shared.model.hex() if len(shared.model) <= DIGEST_BYTES else "embedded"
        return {
            "format": f"jmd {VERSION}",
            "codec": shared.codec or None,
            "model": model or None,
            "files": sum(kind >= BLOB for kind in kinds),
            "motion_files": sum(kind >= NUMBERS for kind in kinds),
            "text_bytes": sum(entry.size for entry in archive.entries),
            "sections": archive.section_bytes(),
        }

    def _model(self) -> Report:
        from ..codecs.artifact import load_artifact

        artifact = load_artifact(self.input)
        rig = artifact.spec["rig"]
        return {
            "format": "model",
            "codec": artifact.spec["codec"],
            "digest": artifact.digest,
            "corpus": artifact.spec["corpus"],
            "joints": len(rig["names"]),
            "names": rig["names"],
            "tensors": {name: "x".join(map(str, t.shape)) for name, t in artifact.tensors.items()},
        }


def _described(motion) -> Report:
    s = motion.skeleton
    return {
        "frames": motion.frame_count,
        "frame_time": motion.frame_time,
        "frame_rate": round(1 / motion.frame_time, 3),
        "seconds": motion.frame_count * motion.frame_time,
        "unit_cm": motion.unit_cm,
        "joints": s.joint_count,
        "channels": s.channel_count,
        "end_sites": len(s.end_joints),
        "height_cm": s.height() * motion.scale if motion.unit_cm else None,
        "names": list(s.names),
    }


def _flat(value: object) -> object:
    if isinstance(value, dict):
        return ", ".join(f"{k} {v}" for k, v in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else "not known" if value is None else value
