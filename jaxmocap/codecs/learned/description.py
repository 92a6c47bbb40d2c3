"""What a stream of `learned` says of itself: metric, steps, jumps, and where its bytes went."""

from __future__ import annotations

from ..artifact import Artifact, stream_artifact
from ..container import Stream
from . import bands
from .codec import model_of, params_of
from .payload import read_layers
from .setting import HAS_CONSTANTS, OWN_BASIS, join_sections, read_setting


def describe(stream: Stream, at_hand: Artifact | None) -> dict[str, object]:
    """As JSON. `steps_cm` has a step for every layer of every chunk; `sections` are all bytes of the stream, by what they hold.

    Raises ModelMismatch, CorruptStream or TruncatedStream.
    """
    header = stream.header
    flags, metric = params_of(header)
    model = model_of(stream_artifact(header.model, header.digest, at_hand))
    setting = read_setting(header.skeleton, flags, model, metric)
    octaves = bands.octave_count(model.rig.frame_time if header.frame_time is None else header.frame_time)
    steps, jumps, nonzeros, corrections = [], 0, 0, 0
    for n in range(header.chunk_count):
        held = min(header.chunk_frames, header.frames - n * header.chunk_frames)
        payloads = [stream.chunk(n, k) for k in range(stream.layers)]
        for coded in read_layers(payloads, held, octaves, setting.basis, model.densities):
            steps.append(round(coded.step, 6))
            jumps += len(coded.jumps.frames)
            corrections += len(coded.corrections.level)
            nonzeros += sum(int((band != 0).sum()) for band in coded.levels)
    return {
        "metric": metric,
        "basis": "its own" if flags & OWN_BASIS else "the model's",
        "qualities": header.layers,
        "components": setting.basis.components,
        "steps_cm": steps,
        "jumps": jumps,
        "nonzero_levels": nonzeros,
        "corrections": corrections,
        "sections": _sections(stream, flags, setting.sections),
    }


def _sections(stream: Stream, flags: int, parts: tuple[bytes, ...]) -> dict[str, int]:
    """Those of the container, with the skeleton's taken apart; each part counts the length in front of it."""
    names = ["bones", *(["basis"] if flags & OWN_BASIS else []), *(["constants"] if flags & HAS_CONSTANTS else [])]
    sizes = [len(join_sections([part, b""])) for part in parts[:-1]] + [len(parts[-1])]
    found: dict[str, int] = {}
    for name, size in stream.section_bytes().items():
        found |= dict(zip(names, sizes, strict=True)) if name == "skeleton" else {name: size}
    return found
