"""The levels of a frame as a packet holds them, which knows no past: how many are not zero, about, which, and what.

A class says about how many are not zero. It, the step and the corpus's knowledge of every component give each a
probability; what is coded is the next component that is not zero, given the last, until there is none.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from ..entropy import integers
from ..entropy.range_coder import Decoder, Encoder
from ..entropy.tables import FrequencyTable
from ..learned.contexts import OCTAVE
from ..learned.density import STOPS, stop_frequencies, tail_rows, tail_rows_of
from ..learned.steps import level_of_step
from .model import LiveModel
from .tracker import EMBEDDING, Prior

_BOUNDS = (1, 2, 4, 7, 11, 17, 27)  # a class begins with so many nonzeros
CLASSES = len(_BOUNDS) + 1
INPUTS = 3 + EMBEDDING + 1


def class_of(levels: Int[np.ndarray, " components"]) -> int:
    """By how many levels are not zero."""
    return int(np.searchsorted(_BOUNDS, np.count_nonzero(levels), "right"))


def contexts(prior: Prior, step_index: int, kind: int) -> Int[np.ndarray, "components inputs"]:
    """The inputs of the density of packets, in sixteenths."""
    still = prior.contexts(step_index)
    return np.column_stack([still, np.full(len(still), kind * OCTAVE // 2)])


def step_octave(step_index: int) -> int:
    """Which row of the classes' frequencies is for this step."""
    return step_index // OCTAVE


class Density:
    """Tables for the packets of one stream, made as they are needed."""

    def __init__(self, prior: Prior, model: LiveModel):
        self.prior, self.model = prior, model
        self._made: dict[tuple, FrequencyTable] = {}
        self._frequencies: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def classes(self, step_index: int) -> FrequencyTable:
        """How busy frames are."""
        return self._table(("class", step_octave(step_index)), lambda: self.model.classes[step_octave(step_index)])

    def next_moved(self, step_index: int, kind: int, after: int) -> FrequencyTable:
        """Which component is the next that is not zero: one behind `after`, or, as the last symbol, none."""

        def frequencies() -> np.ndarray:
            zero = self._of(step_index, kind)[0][after:, 0]
            still = np.concatenate([[1 << 32], np.zeros(len(zero), np.int64)])
            for n, share in enumerate(zero.tolist()):  # integers alone, so that every machine has the same
                still[n + 1] = int(still[n]) * share >> 16
            return np.append(still[:-1] - still[1:], still[-1])

        return self._table(("next", step_index, kind, after), frequencies)

    def size(self, step_index: int, kind: int, component: int) -> FrequencyTable:
        """Whether what is not zero is 1, 2 or more."""
        return self._table(("size", step_index, kind, component), lambda: self._of(step_index, kind)[0][component, 1:])

    def beyond(self, step_index: int, kind: int, component: int) -> FrequencyTable:
        """How much more than 3 it is, as the symbol of an integer."""
        row = int(self._of(step_index, kind)[1][component])
        return self._table(("tail", row), lambda: self.model.tail[row])

    def place(self, step_index: int, component: int) -> FrequencyTable:
        """How many steps from zero the component is, as the symbol of an integer."""
        row = int(tail_rows_of(self.prior.spread[component : component + 1] - level_of_step(step_index))[0])
        return self._table(("tail", row), lambda: self.model.tail[row])

    def _of(self, step_index: int, kind: int) -> tuple[np.ndarray, np.ndarray]:
        if (step_index, kind) not in self._frequencies:
            outputs = self.model.packets(contexts(self.prior, step_index, kind))
            self._frequencies[step_index, kind] = stop_frequencies(outputs, self.model.logistic), tail_rows(outputs)
        return self._frequencies[step_index, kind]

    def _table(self, key: tuple, weights: Callable[[], np.ndarray]) -> FrequencyTable:
        if key not in self._made:
            self._made[key] = FrequencyTable.from_counts(weights())
        return self._made[key]


def write_moved(encoder: Encoder, levels: Int[np.ndarray, " components"], step_index: int, density: Density) -> None:
    """All levels of a frame."""
    kind, count, after = class_of(levels), len(levels), 0
    encoder.encode(kind, density.classes(step_index))
    for component in np.flatnonzero(levels).tolist():
        encoder.encode(component - after, density.next_moved(step_index, kind, after))
        size = abs(int(levels[component]))
        encoder.encode(min(size, STOPS) - 1, density.size(step_index, kind, component))
        if size >= STOPS:
            write_integer(encoder, size - STOPS, density.beyond(step_index, kind, component))
        encoder.encode_bits(int(levels[component] < 0), 1)
        after = component + 1
    if after < count:
        encoder.encode(count - after, density.next_moved(step_index, kind, after))


def read_moved(decoder: Decoder, count: int, step_index: int, density: Density) -> Int[np.ndarray, " components"]:
    """Levels of a frame. Raises CorruptStream where no encoder wrote such bytes."""
    kind, levels, after = decoder.decode(density.classes(step_index)), np.zeros(count, np.int64), 0
    while after < count:
        component = after + decoder.decode(density.next_moved(step_index, kind, after))
        if component == count:
            break
        size = decoder.decode(density.size(step_index, kind, component)) + 1
        if size == STOPS:
            size += read_integer(decoder, density.beyond(step_index, kind, component))
        levels[component] = -size if decoder.decode_bits(1) else size
        after = component + 1
    return levels


def write_integer(encoder: Encoder, value: int, table: FrequencyTable) -> None:
    if value < integers.EXACT:
        return encoder.encode(value, table)
    symbol, raw, bits = (int(x) for x in integers.split(np.array(value)))
    encoder.encode(symbol, table)
    encoder.encode_bits(raw, bits)


def read_integer(decoder: Decoder, table: FrequencyTable) -> int:
    symbol = decoder.decode(table)
    return integers.join(symbol, decoder.decode_bits(integers.raw_bits(symbol)))
