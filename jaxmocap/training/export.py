"""Models for programs that are not Python: a self-contained C header, or npz; docs/format.md says what is in them."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np

from ..codecs.artifact import Artifact
from ..codecs.quantise import PER_OCTAVE, STEPS, step_cm
from ..errors import FormatError

KINDS = ("safetensors", "npz", "c")

_C_TYPES = {"float64": "double", "float32": "float"}  # integers are called as in Python, with _t
_LINE = 116

# What arrays mean, by the pattern of their names; the first that fits counts.
_MEANING = {
    "basis": "learned basis: coordinate, component, joint",
    "rig.bones": "mean bones in cm: joint offsets, then end sites",
    "rig.axes": "constant frame of each joint's rotation channels",
    "rig.expected": "mean local rotation of each joint",
    "rig.lengths": "of each bone of nonzero length, its mean length in 2^-16 cm",
    "rig.spread": "of each bone of nonzero length, in 2^-16 cm",
    "rig.partner": "an earlier bone of nonzero length that strays alike, or -1",
    "runs.*.scale": "expected magnitude, 16 log2 cm: coordinate, band, component",
    "runs.*.count": "frequencies less one of counts: context, symbol",
    "runs.*.run": "frequencies less one of runs: context, symbol",
    "runs.*.value": "frequencies less one of magnitudes: context, symbol",
    "paper.*.position": "Huffman code lengths of positions: coordinate, component",
    "paper.*.value": "Huffman code lengths of values: octave of the step, symbol",
    "frame.position": "Huffman code lengths of positions: first or later frame, octave of the step, coordinate, component",
    "frame.value": "Huffman code lengths of values: first or later frame, octave of the step, coordinate, symbol",
    "bones.mean": "mean bones in 2^-16 cm: joint offsets, then end sites",
    "bones.spread": "how far each component of a bone strays: 16 log2 cm",
    "bones.partner": "an earlier bone that strays alike, or -1",
    "bones.mirror": "signs with which it does",
    "bones.people": "bones of people of the corpus in 2^-16 cm",
    "constants": "of each channel: its value where all files hold it constant, else NaN",
    "logistic": "65,536 times the logistic function of every 32nd of a logit from -12 to 12",
    "tail": "frequencies less one of unsigned integers: reach, symbol",
    "network.*": "network that looks a frame ahead",
    "packets.*": "density of levels in packets",
    "classes": "how often frames are how busy: octave of the step, class",
    "*.speed": "of each component, how fast it goes: 16 log2 cm a frame",
    "*.spread": "of each component, how far it goes: 16 log2 cm",
    "*.embedding": "what the networks know of each component, in sixteenths",
    "slow.*": "network of the lowest band",
    "fast.*": "network of the octaves",
    "*.mean": "of pose vectors: height in cm, rotation vectors in radians, shifts in cm",
    "*.synthesis": "pose vectors of a coefficient of 1 cm: component, vector",
    "*.turn_cm": "how far a radian of heading moves the figure, in cm",
    "*.spectrum.slow": "expected magnitudes, 16 log2 cm: bin, component",
    "*.spectrum.fast": "expected magnitudes, 16 log2 cm: octave, component",
}


def export_model(artifact: Artifact, kind: str) -> bytes:
    """The model as bytes of one of KINDS; equal models give equal bytes.

    "safetensors" is the model's own file. "npz" holds every tensor under its name, and `spec` (JSON) and `digest` as
    UTF-8. "c" is a header for C99 and C++ with every tensor, the rig and the quantiser's steps.
    Raises ValueError for another kind, and FormatError for a C header of a model without bases.
    """
    if kind == "safetensors":
        return artifact.data
    if kind == "npz":
        return _npz(artifact)
    if kind == "c":
        if "rig" not in artifact.spec:
            raise FormatError(f"a model of {artifact.spec.get('codec')} has no bases for a C header: take safetensors or npz")
        return _c_header(artifact).encode("ascii")
    raise ValueError(f"kind is {kind!r}, wanted one of {', '.join(KINDS)}")


def _npz(artifact: Artifact) -> bytes:
    """As numpy.savez writes it, without the clock and the operating system."""
    spec = json.dumps(artifact.spec, sort_keys=True, ensure_ascii=False).encode()
    arrays = {**artifact.tensors, "spec": np.array(spec), "digest": np.array(artifact.digest.encode())}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.create_system = 3
            content = io.BytesIO()
            np.lib.format.write_array(content, arrays[name], allow_pickle=False)
            archive.writestr(entry, content.getvalue())
    return out.getvalue()


def _c_header(artifact: Artifact) -> str:
    spec, rig = artifact.spec, artifact.spec["rig"]
    prefix = _identifier(spec["codec"])
    guard = f"JAXMOCAP_{prefix.upper()}_{artifact.digest[:8].upper()}_H"
    digest = np.frombuffer(bytes.fromhex(artifact.digest), np.uint8)
    steps = np.array([step_cm(i) for i in range(STEPS)], np.float32)
    channels = [" ".join(of_joint) for of_joint in rig["channels"]]
    parts = [
        f"/* A model of jaxmocap: codec {_words(spec['codec'])}, SHA-256 of its file\n"
        f"   {artifact.digest}.\n   See docs/format.md for what the arrays mean. */",
        f"#ifndef {guard}\n#define {guard}",
        "#include <math.h>\n#include <stdint.h>",
        f"#define {prefix.upper()}_JOINTS {len(rig['names'])}\n#define {prefix.upper()}_ENDS {len(rig['end_joints'])}",
        _array(f"{prefix}_digest", digest, "SHA-256 of the model; a stream names its first four bytes"),
        _array(f"{prefix}_step_cm", steps, f"quantiser steps in cm: step[i] = 2^(i / {PER_OCTAVE} - 7)"),
        _scalar(f"{prefix}_unit_cm", rig["unit_cm"], "centimetres per file unit"),
        _scalar(f"{prefix}_frame_time", rig["frame_time"], "seconds"),
        _strings(f"{prefix}_names", rig["names"], "joints"),
        _strings(f"{prefix}_channels", channels, "of each joint, in the order of its columns"),
        _array(f"{prefix}_parents", np.array(rig["parents"], np.int32), "of each joint, -1 for a root"),
        _array(f"{prefix}_end_joints", np.array(rig["end_joints"], np.int32), "the joint of each end site"),
        *(_array(f"{prefix}_{_identifier(n)}", t, _meaning(n)) for n, t in sorted(artifact.tensors.items())),
        "#endif",
    ]
    return "\n\n".join(parts) + "\n"


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def _words(text: str) -> str:
    """Safe inside a comment."""
    return re.sub(r"[^\w .-]", "_", text, flags=re.ASCII)


def _meaning(tensor: str) -> str:
    return next((meaning for pattern, meaning in _MEANING.items() if fnmatchcase(tensor, pattern)), _words(tensor))


def _scalar(name: str, value: float, meaning: str) -> str:
    return f"/* {meaning} */\nstatic const double {name} = {float(value)!r};"


def _array(name: str, values: np.ndarray, meaning: str) -> str:
    shape = ", ".join(map(str, values.shape))
    if values.dtype == np.float16:  # which C lacks; single precision holds them exactly
        values = values.astype(np.float32)
    if not values.size:
        return f"/* {name} ({shape}) is empty: {meaning} */"
    sizes = "".join(f"[{n}]" for n in values.shape) or "[1]"
    c_type = _C_TYPES.get(values.dtype.name, f"{values.dtype.name}_t")
    return f"/* ({shape}) {meaning} */\nstatic const {c_type} {name}{sizes} =\n{_braced(np.atleast_1d(values))};"


def _braced(values: np.ndarray) -> str:
    if values.ndim > 1:
        return "{" + ",\n".join(_braced(row) for row in values) + "}"
    return "{" + _wrapped([_number(v) for v in values]) + "}"


def _number(value: np.generic) -> str:
    """The shortest decimals that read back to the same number."""
    if value != value:
        return "NAN"
    return str(value) + ("f" if value.dtype == np.float32 else "")


def _strings(name: str, texts: Sequence[str], meaning: str) -> str:
    literals = _wrapped([_literal(text) for text in texts])
    return f"/* {meaning} */\nstatic const char *const {name}[{len(texts)}] =\n{{{literals}}};"


def _literal(text: str) -> str:
    """A string literal of the UTF-8 bytes; `?` is escaped since ?? begins a trigraph."""
    plain = (chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in text.encode())
    return '"' + "".join(plain) + '"'


def _wrapped(items: list[str]) -> str:
    lines, line = [], ""
    for item in items:
        if line and len(line) + len(item) + 2 > _LINE:
            lines.append(line)
            line = ""
        line += f"{', ' if line else ''}{item}"
    return ",\n".join([*lines, line])
