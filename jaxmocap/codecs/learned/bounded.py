"""The search for the fewest bytes with no error above a bound: levels for the typical frame, corrections for the others.

Around the best step bytes hardly change, but finer levels have the smaller mean error: corrections take a quarter at most.
"""

from __future__ import annotations

import numpy as np

from ...errors import JaxmocapError
from .attempt import Attempt, Source, plain_index, step_of_mean
from .corrections import correction_bytes
from .mending import mended
from .payload import Coded
from .steps import index_of

_TYPICAL = 0.75  # of all frames are under the bound when quantised plainly
_BY_MEAN = 3.0  # how far the largest error of a frame is above the mean, about
_MOST_SHARE = 0.25
_FINER = 4
_PATIENCE = 8  # tries in which the largest error falls no more


def encode_to_max(source: Source, cm: float) -> Coded:
    """All integers: no point of any frame is off by more than `cm`. Raises JaxmocapError out of reach."""

    def typical(index: int) -> float:
        return float(np.quantile(Attempt(source, index).optimiser.errors().max(0), _TYPICAL))

    index = plain_index(index_of(step_of_mean(cm / _BY_MEAN)), cm, typical)
    best, least, since = None, np.inf, 0
    for finer in (*range(index, 0, -_FINER), 0):
        attempt = Attempt(source, finer)
        attempt.refine()
        coded, largest = mended(source, attempt.coded(), cm)
        since = 0 if largest < least else since + 1
        least = min(largest, least)
        if best is None and since == _PATIENCE:
            break
        if largest <= cm:
            best = coded
            extra = correction_bytes(coded.corrections, len(source.path), source.octaves, source.basis.components)
            if extra <= _MOST_SHARE * (extra + attempt.bits() / 8):
                break
    if best is None:
        raise JaxmocapError(f"a maximum error of {cm:g} cm is out of this codec's reach on this motion")
    return best
