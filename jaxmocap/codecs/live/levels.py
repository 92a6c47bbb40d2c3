"""Levels of a frame as they stand in a file, where the past is known: each under what the outlook says of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..entropy.range_coder import Decoder, Encoder
from ..entropy.tables import TOTAL
from ..learned.coefficients import decode_signs, decode_sizes, encode_signs, encode_sizes, tail_frequencies
from ..learned.density import STOPS, stop_frequencies, tail_rows, tail_rows_of
from ..learned.steps import level_of_step
from .model import LiveModel
from .tracker import Outlook, Prior

_MOST_LOGIT = 12 * 32


class Tables(NamedTuple):
    """What turns outputs of networks into frequencies."""

    logistic: np.ndarray
    tail: np.ndarray

    @staticmethod
    def of(model: LiveModel) -> Tables:
        return Tables(model.logistic, model.tail)


def encode_first(encoder: Encoder, levels: Int[np.ndarray, " components"], prior: Prior, step_index: int, t: Tables) -> None:
    """Places in steps, of which nothing is known but how far components spread."""
    encode_sizes(encoder, np.abs(levels), first_frequencies(prior, step_index, t.tail))
    encode_signs(encoder, levels[levels != 0])


def decode_first(decoder: Decoder, prior: Prior, step_index: int, t: Tables) -> Int[np.ndarray, " components"]:
    return decode_signs(decoder, decode_sizes(decoder, first_frequencies(prior, step_index, t.tail)))


def first_frequencies(prior: Prior, step_index: int, tail: np.ndarray) -> Int[np.ndarray, "components symbols"]:
    """Of the symbols of places in steps."""
    return tail_frequencies(tail, tail_rows_of(prior.spread - level_of_step(step_index)))


def encode_frame(encoder: Encoder, levels: Int[np.ndarray, " components"], outlook: Outlook, t: Tables) -> None:
    size = np.abs(levels)
    encoder.encode_each(np.minimum(size, STOPS), stop_frequencies(outlook.outputs, t.logistic))
    beyond = size >= STOPS
    if beyond.any():
        encode_sizes(encoder, size[beyond] - STOPS, tail_frequencies(t.tail, tail_rows(outlook.outputs[beyond])))
    moved = np.flatnonzero(size)
    if len(moved):
        encoder.encode_each((levels[moved] < 0).astype(np.int64), _sign_frequencies(outlook, moved, t))


def decode_frame(decoder: Decoder, outlook: Outlook, t: Tables) -> Int[np.ndarray, " components"]:
    size = decoder.decode_each(stop_frequencies(outlook.outputs, t.logistic))
    beyond = np.flatnonzero(size == STOPS)
    if len(beyond):
        size[beyond] += decode_sizes(decoder, tail_frequencies(t.tail, tail_rows(outlook.outputs[beyond])))
    moved = np.flatnonzero(size)
    if len(moved):
        size[moved] *= 1 - 2 * decoder.decode_each(_sign_frequencies(outlook, moved, t))
    return size


def _sign_frequencies(outlook: Outlook, moved: np.ndarray, t: Tables) -> Int[np.ndarray, "moved 2"]:
    """Of positive and negative levels."""
    logits = np.clip(outlook.sign_outputs()[moved], -_MOST_LOGIT, _MOST_LOGIT)
    positive = np.clip(t.logistic[logits + _MOST_LOGIT].astype(np.int64), 1, TOTAL - 1)
    return np.stack([positive, TOTAL - positive], 1)
