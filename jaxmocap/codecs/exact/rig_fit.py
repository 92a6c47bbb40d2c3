"""Learns a rig model from tables of one rig: what is constant, which laws hold, and how the rest moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int32
from threadpoolctl import threadpool_limits

from ..lossless import NumberTable
from . import signs
from .fit import fit_lanes, untrained
from .law_fit import DECIMALS, causal, fit_chains, fit_geometry
from .laws import AbstractLaw
from .model import RigModel, is_angle
from .tables import Exceptions, law_residuals, to_lanes

_ONE_THREAD = threadpool_limits.wrap(limits=1)  # the last bits of a BLAS depend on its threads, and archives must not
_ALIKE = 0.8  # of the files begin with the same pose, or keep a column constant


def plain_rig(tables: Sequence[NumberTable]) -> RigModel:
    """What costs least to store: constants, and nothing learned about the rest."""
    return _rig(tables, (), learn=False)


def fit_rig(tables: Sequence[NumberTable]) -> RigModel:
    """All that can be learned."""
    return learned_rig(tables, fit_laws(tables))


@_ONE_THREAD
def fit_laws(tables: Sequence[NumberTable]) -> tuple[AbstractLaw, ...]:
    """The laws of the rig, in an order in which all their inputs are known."""
    columns, decimals = tables[0].columns, tables[0].decimals
    bodies = [(t.integers[1:].astype(np.int64) * 10**DECIMALS // 10**decimals).astype(np.int32) for t in tables]
    geometry = fit_geometry(np.concatenate(bodies), columns)
    return tuple(causal([*geometry, *fit_chains(bodies, columns, geometry)]))


@_ONE_THREAD
def learned_rig(tables: Sequence[NumberTable], laws: tuple[AbstractLaw, ...], header: bytes = b"") -> RigModel:
    """The model of a rig whose laws are known; `header` is text that its files share."""
    return _rig(tables, laws, learn=True, header=header)


def _rig(tables: Sequence[NumberTable], laws: tuple[AbstractLaw, ...], learn: bool, header: bytes = b"") -> RigModel:
    columns, decimals = tables[0].columns, tables[0].decimals
    rest = _rest(tables)
    bodies = [t.integers[1:] if rest is not None else t.integers for t in tables]
    bodies = [b for b in bodies if len(b)] or [np.zeros((1, len(columns)), np.int32)]
    steady = np.stack([(b == b[0]).all(0) & (b[0] == bodies[0][0]) for b in bodies]).mean(0) > _ALIKE
    mean = np.median(np.concatenate([b[:: max(len(b) // 200, 1)] for b in bodies]), axis=0)
    mean = np.where(steady, bodies[0][0], np.rint(mean)).astype(np.int32)
    smooth, targets = ({t for law in laws if law.smooth == way for t in law.targets} for way in (True, False))
    moving = tuple(c for c in range(len(columns)) if c in smooth or not (steady[c] or c in targets))
    usual = _usual_signs(tables)
    lanes = untrained(len(moving) + len(targets), len(moving))
    resting = np.zeros(len(columns), np.int32) if rest is None else rest
    model = RigModel(columns, decimals, resting, mean, moving, laws, lanes, usual, header)
    if not learn:
        return model
    values = [to_lanes(model, b, law_residuals(model, b), Exceptions()) for b in bodies]
    return RigModel(columns, decimals, resting, mean, moving, laws, fit_lanes(values, len(moving)), usual, header)


def _rest(tables: Sequence[NumberTable]) -> Int32[np.ndarray, " columns"] | None:
    """The first row, where most files share its angles and none of them leads on to what follows."""
    tables = [t for t in tables if len(t.integers) > 1]
    angles = np.array([is_angle(c) for c in tables[0].columns]) if tables else np.zeros(0, bool)
    if not angles.any():
        return None
    firsts = np.stack([t.integers[0] for t in tables])
    alike = (firsts[:, angles] == firsts[0, angles]).all(1).mean()
    jumps = np.mean([(t.integers[0] != t.integers[1])[angles].mean() > 0.3 for t in tables])
    return firsts[0] if min(alike, jumps) > _ALIKE else None


def _usual_signs(tables: Sequence[NumberTable]) -> tuple[int, ...]:
    """The most common mode of each column."""
    own = np.array([signs.modes(t.integers == 0, t.negative_zeros) for t in tables])
    return tuple(int(np.bincount(column).argmax()) for column in own.T)
