"""A resumable loop over stages of work whose state is a dict of arrays."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..formats.text import write_bytes

State = dict[str, np.ndarray]
_SAVE_SECONDS = 20.0


@dataclass(frozen=True)
class Stage:
    """`step(state, n)` gives the state after item n of `items`; it must depend on nothing else that changes."""

    name: str
    items: int
    step: Callable[[State, int], State]


def run(stages: Sequence[Stage], checkpoint: Path, key: str) -> State:
    """The state after all stages, from the checkpoint on where one with this `key` exists.

    Items are atomic: an interrupted run that is started again ends in the same state as one that was not. The
    checkpoint is left for the caller to remove when the result is safe.
    """
    state, first_stage, first_item = _resume(checkpoint, key)
    saved = time.monotonic()
    for s, stage in enumerate(stages[first_stage:], first_stage):
        for item in range(first_item, stage.items):
            state = stage.step(state, item)
            _progress(f"{stage.name} {item + 1}/{stage.items}")
            if time.monotonic() - saved > _SAVE_SECONDS:
                _save(checkpoint, key, state, s, item + 1)
                saved = time.monotonic()
        first_item = 0
        _save(checkpoint, key, state, s + 1, 0)
        _progress(None)
    return state


def _resume(checkpoint: Path, key: str) -> tuple[State, int, int]:
    from safetensors import safe_open

    try:
        with safe_open(checkpoint, framework="numpy") as file:
            at = json.loads(file.metadata()["jaxmocap"])
            if at["key"] == key:
                print(f"resuming {checkpoint.name} at stage {at['stage'] + 1}, item {at['item'] + 1}", file=sys.stderr)
                return {name: file.get_tensor(name) for name in file.keys()}, at["stage"], at["item"]  # noqa: SIM118
    except Exception:  # a checkpoint that cannot be read is as good as none, whatever is wrong with it
        pass
    return {}, 0, 0


def _save(checkpoint: Path, key: str, state: State, stage: int, item: int) -> None:
    from safetensors.numpy import save

    at = json.dumps({"key": key, "stage": stage, "item": item})
    arrays = {name: np.asarray(value, order="C") for name, value in state.items()}
    write_bytes(checkpoint, save(arrays, metadata={"jaxmocap": at}))


def _progress(line: str | None) -> None:
    """One line that overwrites itself on a terminal; nothing elsewhere but the end of each stage."""
    if sys.stderr.isatty():
        sys.stderr.write("\n" if line is None else f"\r\x1b[K{line}")
        sys.stderr.flush()
