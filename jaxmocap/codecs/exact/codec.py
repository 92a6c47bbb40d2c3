"""`exact`: byte-exact coding of the numbers of motion texts, as small as we can.

A rig model says which columns are constant, which follow from others by laws, and how the rest moves. Every table decodes
by itself with the model alone: its payload holds the few things in which it differs from its rig, and then the lanes.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Sequence

import numpy as np

from ...errors import CorruptStream
from ..artifact import Artifact, parse_artifact
from ..bitstream import ByteReader, varint
from ..lossless import AbstractNumberCodec, NumberTable, by_rig
from ..squeeze import expand, squeeze
from .fit import SHORTEST
from .lanes import worth_compiling
from .model import RigModel, from_artifact, to_artifact
from .rig_fit import fit_rig, plain_rig
from .tables import decode_tables, encode_table

_GIVEN, _LEARNED = 0, 1  # the model is the artifact, or stored
_FRAME_BYTES = 80  # that a frame of a figure takes, more or less
_LEARNING_FRAMES = 1500  # tables that teach fewer frames do not pay for a model of their own


class Exact(AbstractNumberCodec):
    """`artifact` is the model of the rig that is expected; tables of other rigs have theirs learned, and stored."""

    artifact: Artifact | None = None

    @property
    def dictionary(self) -> bytes:
        """Text that files of the rig share."""
        return b"" if self.artifact is None else from_artifact(self.artifact).header

    def encode(self, tables: Sequence[NumberTable]) -> tuple[bytes, list[bytes]]:
        rigs = by_rig(tables)
        shared, payloads = varint(len(rigs)), [b""] * len(tables)
        for number, members in enumerate(rigs.values()):
            model_bytes, coded = self._encode_rig([tables[n] for n in members])
            shared += model_bytes
            for n, data in zip(members, coded, strict=True):
                payloads[n] = varint(number) + data
        return shared, payloads

    def _encode_rig(self, tables: list[NumberTable]) -> tuple[bytes, list[bytes]]:
        """The artifact's model where it fits, or else the cheapest of those that can be learned."""
        if self.artifact is not None and (model := from_artifact(self.artifact)).fits(tables[0].columns, tables[0].decimals):
            return bytes([_GIVEN]), _encoded(model, tables)
        learned = [plain_rig(tables)]
        teaching = sum(len(t.integers) for t in tables if len(t.integers) >= SHORTEST)
        if teaching >= _LEARNING_FRAMES:
            learned.append(fit_rig(tables))
        choices = []
        for model in learned:
            raw = to_artifact(model, _digest(tables)).data
            data = varint(len(raw)) + squeeze(raw)
            stored = bytes([_LEARNED]) + varint(len(data)) + data + _checksum(data)
            choices.append((stored, _encoded(model, tables)))
        return min(choices, key=lambda c: len(c[0]) + sum(map(len, c[1])))

    def decode(self, shared: bytes, payload: Callable[[int], bytes], which: Sequence[int]) -> list[NumberTable]:
        models = self._models(shared)
        readers = [ByteReader(payload(n)) for n in which]
        numbers = [reader.varint() for reader in readers]
        if max(numbers, default=-1) >= len(models):
            raise CorruptStream(f"a table names rig {max(numbers)}, the archive holds {len(models)}")
        frames = sum(reader.left for reader in readers) // _FRAME_BYTES
        tables: dict[int, NumberTable] = {}
        for rig in sorted(set(numbers)):
            members = [n for n, number in enumerate(numbers) if number == rig]
            compiled = worth_compiling(models[rig].lanes, frames)
            found = decode_tables(models[rig], [readers[n] for n in members], compiled)
            tables.update(zip(members, found, strict=True))
        return [tables[n] for n in range(len(readers))]

    def _models(self, shared: bytes) -> list[RigModel]:
        reader = ByteReader(shared)
        models = []
        for _ in range(reader.varint()):
            kind = reader.byte()
            if kind == _LEARNED:
                data = ByteReader(reader.take(reader.varint()))
                if reader.take(4) != _checksum(data.data):
                    raise CorruptStream("a rig model of the archive does not match its checksum")
                size = data.varint()
                artifact = parse_artifact(expand(data.take(data.left), size), "the archive's rig model")
            elif kind == _GIVEN and self.artifact is not None:
                artifact = self.artifact
            else:
                raise CorruptStream("the tables need the archive's model, and it has none")
            models.append(from_artifact(artifact))
        if reader.left:
            raise CorruptStream(f"{reader.left} bytes follow the last rig model")
        return models


def _checksum(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(4, "little")


def _encoded(model: RigModel, tables: Sequence[NumberTable]) -> list[bytes]:
    compiled = worth_compiling(model.lanes, sum(len(t.integers) for t in tables))
    return [encode_table(model, t, compiled) for t in tables]


def _digest(tables: Sequence[NumberTable]) -> str:
    total = hashlib.sha256()
    for table in tables:
        total.update(np.ascontiguousarray(table.integers).tobytes())
    return total.hexdigest()
