"""Model artifacts: safetensors with a JSON spec in the metadata, known by the SHA-256 of the file."""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import numpy as np

from ..errors import FormatError, ModelMismatch
from .container import DIGEST_BYTES

MODEL_FORMAT = 1
_SHIPPED = "models"
_SHARED = {"mdtt": "lsdt-clip", "pca-rdo": "lsdt-clip"}  # codecs that use the rig in another's model


@dataclass(frozen=True, eq=False)
class Artifact:
    """A trained model as it lies in a file: named arrays, and a spec that says which codec they are for.

    The spec holds `codec`, `format`, `rig` (see rig.py), the codec's own settings and the corpus digest.
    """

    spec: dict
    tensors: dict[str, np.ndarray]
    data: bytes = field(repr=False)

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the file, in hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    @property
    def short_digest(self) -> bytes:
        """As much of it as headers hold."""
        return bytes.fromhex(self.digest)[:DIGEST_BYTES]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Artifact) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def make_artifact(spec: dict, tensors: dict[str, np.ndarray]) -> Artifact:
    """The artifact of a spec and arrays; equal content gives equal bytes."""
    from safetensors.numpy import save

    spec = {"format": MODEL_FORMAT, **spec}
    ordered = {name: np.ascontiguousarray(tensors[name]) for name in sorted(tensors)}
    data = save(ordered, metadata={"jaxmocap": json.dumps(spec, sort_keys=True)})
    return Artifact(spec, ordered, data)


def parse_artifact(data: bytes, name: str) -> Artifact:
    """Raises FormatError where the bytes are no model of jaxmocap; `name` is for the message."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        tensors = load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        spec = json.loads(header["__metadata__"]["jaxmocap"])
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{name}: this is no jaxmocap model (safetensors with a spec): {error}") from error
    if not isinstance(spec, dict) or spec.get("format") != MODEL_FORMAT:
        raise FormatError(f"{name}: the model has another format than {MODEL_FORMAT}; train it again, or change jaxmocap")
    return Artifact(spec, tensors, data)


def load_artifact(model: str | Path) -> Artifact:
    """A model from a file, or a shipped one by its id, such as "lsdt-clip". Raises FormatError where there is none."""
    path, name = Path(model), _SHARED.get(str(model), str(model))
    if name in shipped_models():
        return _shipped(name)
    try:
        return parse_artifact(path.read_bytes(), path.name)
    except OSError as error:
        raise FormatError(
            f"{model}: {error.strerror}; wanted a model file or one of {', '.join(shipped_models())}"
        ) from error


def find_artifact(digest: bytes, at_hand: Artifact | None = None) -> Artifact:
    """The model whose digest begins so: the one at hand, or a shipped one. Raises ModelMismatch."""
    wanted = digest.hex()
    if at_hand is not None:
        if at_hand.digest.startswith(wanted):
            return at_hand
        raise ModelMismatch(f"the stream needs the model {wanted}..., the one given is {at_hand.digest[: len(wanted)]}...")
    for name in shipped_models():
        if _shipped(name).digest.startswith(wanted):
            return _shipped(name)
    raise ModelMismatch(f"the stream needs the model {wanted}..., which is not shipped: pass its file with --model")


def stream_artifact(embedded: bytes | None, digest: bytes, at_hand: Artifact | None) -> Artifact:
    """The model that a stream needs: the one inside it, or what `find_artifact` finds."""
    return find_artifact(digest, at_hand) if embedded is None else parse_artifact(embedded, "the stream's model")


@functools.cache
def shipped_models() -> tuple[str, ...]:
    """The ids of the models inside the package."""
    folder = resources.files("jaxmocap") / _SHIPPED
    return tuple(sorted(p.name.removesuffix(".safetensors") for p in folder.iterdir() if p.name.endswith(".safetensors")))


@functools.cache
def _shipped(name: str) -> Artifact:
    file = resources.files("jaxmocap") / _SHIPPED / f"{name}.safetensors"
    return parse_artifact(file.read_bytes(), file.name)
