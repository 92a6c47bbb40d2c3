"""Finds the laws of a rig in its tables: which joints have one or two axes, and which aim where a neighbour points."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int32

from .bends import Bent, bend_terms, bone, bones
from .law import AbstractLaw, Angles, Joint
from .laws import Aimed, Constrained, residuals, wrapped
from .polynomials import COEFFICIENT_BITS, REACH, TERM_BITS, Polynomial, monomials
from .trigonometry import sine_cosine

Table = Int32[np.ndarray, "frames columns"]
_SAMPLES = 6000
_NULL = 4e-6  # of a law's violation, so much the rounding of angles explains
_ROUNDING = 5e-7
_REWEIGHTINGS = 10
_PARTS = 12
_DEGREE = 4
_ANCHOR = 1e-4  # how much a polynomial's values count beside its changes
_BENT_DEGREE, _BENT_SAMPLES = 5, 12000
_RADIAN = 1.7453292519943296e-6  # of 1e-4 degrees
_BENT_SPREADS = tuple(np.repeat([3000.0, 300.0, 30.0, 3.0, 1.0], 4) * _RADIAN)
_OFF = 20 * _RADIAN
_WORTHWHILE = 6.0  # bits a frame
_MOST, _SOME = 0.9, 0.2  # of the frames keep a law
_POLISHINGS = 4
_DIFFERENCE = 1e-6
_STEEP = 1e8  # 1e-4 degrees by unit: beyond, a law tells its target badly
DECIMALS = 4  # the tables here are in 1e-4 degrees
_TURN = 3_600_000


def joints(columns: Sequence[str]) -> list[Joint]:
    """The joints with three rotation columns about different axes, in degrees."""
    found: dict[str, list[tuple[int, int]]] = {}
    for n, name in enumerate(columns):
        joint, _, channel = name.rpartition(" ")
        if channel in ("Xrotation", "Yrotation", "Zrotation"):
            found.setdefault(joint, []).append((n, "XYZ".index(channel[0])))
    return [
        Joint(tuple(n for n, _ in c), tuple(a for _, a in c))  # pyright: ignore[reportArgumentType]
        for c in found.values()
        if len(c) == 3 and {a for _, a in c} == {0, 1, 2}
    ]


def fit_geometry(table: Table, columns: Sequence[str]) -> list[AbstractLaw]:
    """Laws of single joints, then of pairs, each measured on the table; in an order in which all inputs come first."""
    triples = np.linspace(0, len(table) - 3, max(min(len(table), _SAMPLES) // 3, 1)).astype(int)
    chosen = table[np.add.outer(triples, np.arange(3)).ravel()]  # frames by threes, for their second differences
    moving = (chosen != chosen[0]).any(0)
    candidates = [j for j in joints(columns) if moving[list(j.columns)].all()]
    matrices = {j: _matrices(chosen, j) for j in candidates}
    best = {j: _joint_laws(chosen, j, m) for j, m in matrices.items()}
    return [law for laws in best.values() for law in laws] + _aimed_laws(chosen, matrices, best)


def _matrices(table: Table, joint: Joint) -> Float[np.ndarray, "frames 3 3"]:
    total = np.broadcast_to(np.eye(3), (len(table), 3, 3))
    for column, axis in zip(joint.columns, joint.axes, strict=True):
        s, c = sine_cosine(table[:, column].astype(np.float64))
        turn = np.zeros((len(table), 3, 3))
        j, k = (axis + 1) % 3, (axis + 2) % 3
        turn[:, axis, axis], turn[:, j, j], turn[:, k, k] = 1.0, c, c
        turn[:, k, j], turn[:, j, k] = s, -s
        total = total @ turn
    return total


def _joint_laws(table: Table, joint: Joint, matrices: Float[np.ndarray, "frames 3 3"]) -> list[AbstractLaw]:
    axis, kept = _null(matrices - np.eye(3))
    sets = _hinge_laws(joint, axis) if kept > _MOST else []
    if not sets and (zero := _zero_entry(matrices)) is not None:
        sets = [[law] for law in _universal_laws(joint, *zero)]
    settled = [[_polished(table, _branched(table, law)) for law in laws] for laws in sets]
    return min(settled, key=lambda laws: _cost(table, joint, laws), default=[])


def _cost(table: Table, joint: Joint, laws: Sequence[AbstractLaw]) -> float:
    """Bits of what the laws leave, and of the second differences of the angles that stay free."""
    targets = [t for law in laws for t in law.targets]
    free = [c for c in joint.columns if c not in targets]
    return sum(_bits(residuals(law, table, DECIMALS)) for law in laws) + _free_bits(table, free)


def _free_bits(table: Table, columns: Sequence[int]) -> float:
    """What columns cost that no law tells; the frames of the table come by threes."""
    angles = table[:, list(columns)].astype(np.int64).reshape(-1, 3, len(columns))
    return _bits(wrapped(angles[:, 2] - 2 * angles[:, 1] + angles[:, 0], DECIMALS).T)


def _hinge_laws(joint: Joint, axis: np.ndarray) -> list[list[Constrained]]:
    """R n = n, with each of the three angles free in turn."""
    n: tuple[float, float, float] = tuple(axis.tolist())
    unit = np.eye(3).tolist()
    e0, e1, e2 = (tuple(unit[a]) for a in joint.axes)
    last = Constrained(joint, 2, (1,), e0, n, n[joint.axes[0]], 1)
    middle_by_last = Constrained(joint, 1, (2,), e0, n, n[joint.axes[0]], 1)
    middle_by_first = Constrained(joint, 1, (0,), n, e2, n[joint.axes[2]], 1)
    first = Constrained(joint, 0, (1, 2), n, n, 1.0, 0)
    aligned_last = Constrained(joint, 2, (0, 1), n, n, 1.0, 0)
    first_by_middle = Constrained(joint, 0, (1,), n, e2, n[joint.axes[2]], 1)
    return [[middle_by_last, first], [last, first], [middle_by_first, aligned_last], [first_by_middle, aligned_last]]


def _universal_laws(joint: Joint, u: np.ndarray, v: np.ndarray, g: float) -> list[Constrained]:
    uu, vv = tuple(u.tolist()), tuple(v.tolist())
    return [Constrained(joint, m, tuple(k for k in range(3) if k != m), uu, vv, g, 1) for m in range(3)]


def _branched(table: Table, law: Constrained) -> Constrained:
    if law.branch == 0:
        return law
    both = [replace(law, branch=b) for b in (1, -1)]
    return min(both, key=lambda x: _bits(residuals(x, table, DECIMALS)))


def _aimed_laws(table: Table, matrices: dict[Joint, np.ndarray], best: dict[Joint, list[AbstractLaw]]) -> list[AbstractLaw]:
    """Joints of two axes that point where another joint does; a joint that is aimed is no source."""
    aimed: dict[Joint, AbstractLaw] = {}
    for source, joint in itertools.permutations(matrices, 2):
        own = [law for law in best[joint] if isinstance(law, Constrained)]
        if joint in aimed or source in aimed or len(own) != 1:
            continue
        pair, kept = _null(np.concatenate([matrices[joint], -matrices[source]], 2))
        if kept < _SOME or np.linalg.norm(pair[:3]) < 0.5 or np.linalg.norm(pair[3:]) < 0.5:
            continue
        d, k = (tuple((p / np.linalg.norm(p)).tolist()) for p in (pair[:3], pair[3:]))
        third = own[0]
        laws = [Aimed(joint, source, third.unknown, d, k, third.u, third.v, third.g, b) for b in (1, -1)]
        law = _polished(table, min(laws, key=lambda x: _bits(residuals(x, table, DECIMALS))))
        if _bits(residuals(law, table, DECIMALS)) < _free_bits(table, law.targets):
            aimed[joint] = law
    return list(aimed.values())


def fit_chains(bodies: Sequence[Table], columns: Sequence[str], taken: Sequence[AbstractLaw]) -> list[AbstractLaw]:
    """Chains of three joints of which one nearly follows from the two others, as spines solved from few markers do."""
    targets = {t for law in taken for t in law.targets}
    every = joints(columns)
    pairs = [_neighbours(body) for body in bodies if len(body) > 2]
    now, after = (np.concatenate([p[n] for p in pairs]) for n in (0, 1))
    laws: list[AbstractLaw] = []
    for chain in zip(every, every[1:], every[2:], strict=False):
        free = [j for j in chain if not targets & set(j.columns) and (now[:, j.columns] != now[0, j.columns]).any(0).all()]
        if len(free) < 3:
            continue
        found = _chain_laws(now, after, chain)
        gains = [sum(_saving(now, after, law) for law in laws) for laws in found]
        best = int(np.argmax(gains))
        if gains[best] > _WORTHWHILE:
            laws += found[best]
            targets |= {c for j in chain for c in j.columns}
    return laws


def _neighbours(body: Table) -> tuple[Table, Table]:
    at = np.linspace(0, len(body) - 2, min(_SAMPLES // 15, len(body) - 1)).astype(int)
    return body[at], body[at + 1]


def _chain_laws(now: Table, after: Table, chain: tuple[Joint, Joint, Joint]) -> list[list[AbstractLaw]]:
    """What may be known of a chain: any of its joints nearly, or the last one, where that bends as the others do."""
    near: list[list[AbstractLaw]] = [
        [_polynomial(now, after, j.columns, _columns(o for o in chain if o is not j))] for j in chain
    ]
    middle = _polynomial(now, after, chain[2].columns[1:2], _columns(chain[:2]))
    return [*near, *([middle, law] for law in _bent(now, chain))]


def _columns(of: Iterable[Joint]) -> tuple[int, ...]:
    return tuple(c for joint in of for c in joint.columns)


def _saving(now: Table, after: Table, law: AbstractLaw) -> float:
    """Bits a frame: how much less than its targets changes from one frame to the next what the law leaves of them."""
    change = wrapped((after.astype(np.int64) - now)[:, law.targets], DECIMALS).T
    left = [np.stack(residuals(law, x, DECIMALS)) for x in (now, after)]
    return _bits(change) - _bits(wrapped(left[1] - left[0], DECIMALS))


def _polynomial(now: Table, after: Table, targets: tuple[int, ...], inputs: tuple[int, ...]) -> Polynomial:
    """The law that leaves least from one frame to the next."""
    scales = tuple(int(s) for s in np.maximum(np.percentile(np.abs(now[:, inputs]), 99, axis=0), 1))
    one = float(1 << TERM_BITS)
    terms = monomials(now[:, inputs].T, scales, _DEGREE).T / one
    steps = monomials(after[:, inputs].T, scales, _DEGREE).T / one - terms
    solved = []
    for c in targets:
        step = wrapped(after[:, c].astype(np.int64) - now[:, c], DECIMALS)
        weights, found = np.ones(len(now)), np.zeros(terms.shape[1])
        for _ in range(4):
            gram = (steps * weights[:, None]).T @ steps + _ANCHOR * terms.T @ terms
            gram += 1e-10 * np.trace(gram) * np.eye(len(gram))
            found = np.linalg.solve(gram, (steps * weights[:, None]).T @ step + _ANCHOR * terms.T @ now[:, c])
            weights = 1 / np.maximum(np.abs(step - steps @ found), 1.0)
        whole = np.rint(found * (1 << COEFFICIENT_BITS))
        exact = np.abs(whole).sum() * one * REACH**_DEGREE < 2.0**53  # the sums that doubles hold
        solved.append(whole if exact else np.zeros_like(whole))
    return Polynomial(targets, inputs, scales, _DEGREE, np.stack(solved, 1))


def _bent(table: Table, chain: tuple[Joint, Joint, Joint]) -> list[Bent]:
    """Laws of one sheet and, where enough frames are off that, of two."""
    angles = table[:: -(-len(table) // _BENT_SAMPLES)].T.astype(np.float64)
    one = Bent(chain, _BENT_DEGREE, 0.0, _sheet(angles, chain)[None])
    off = _miss(one, angles)[0] > _OFF
    if off.sum() < one.coefficients.size:
        return [one]
    two = replace(one, coefficients=np.stack([one.coefficients[0], _sheet(angles[:, off], chain)]))
    first, second = _miss(two, angles)
    own = [_sheet(angles[:, nearer], chain) for nearer in (first < second, first >= second)]
    return [one, *(_parted(replace(one, coefficients=np.stack(pair)), angles) for pair in (own, own[::-1]))]


def _parted(law: Bent, angles: Float[np.ndarray, "columns frames"]) -> Bent:
    """The law with the `least` bend that tells its two sheets apart best."""
    first, second = _miss(law, angles)
    bend = 1.0 - law.aims(angles)[0][law.joints[2].axes[1]]
    order = np.argsort(bend)
    gain = np.cumsum((np.log(first + _RADIAN) - np.log(second + _RADIAN))[order])
    return replace(law, least=float(bend[order][np.argmax(gain)]))


def _miss(law: Bent, angles: Float[np.ndarray, "columns frames"]) -> list[Angles]:
    """How far each sheet points past the bone."""
    true = bone(law.joints[2], angles)
    return [np.sqrt(sum((a - b) ** 2 for a, b in zip(aim, true, strict=True))) for aim in law.aims(angles)]


def _sheet(angles: Float[np.ndarray, "columns frames"], chain: tuple[Joint, Joint, Joint]) -> Float[np.ndarray, "3 terms"]:
    """Least squares on where the third bone points; the longer, the less say have frames that bend otherwise."""
    arms = bones(chain, angles)
    terms = np.stack(bend_terms(arms, _BENT_DEGREE))
    rows = np.concatenate([np.stack(arm) * terms[:, None] for arm in arms])  # coefficients, components, frames
    scale = np.sqrt((rows**2).mean((1, 2))) + 1e-30
    rows = (rows / scale[:, None, None]).transpose(2, 1, 0)
    aims = np.stack(bone(chain[2], angles), 1)
    weights, found = np.ones(len(rows)), np.zeros(len(scale))
    for spread in _BENT_SPREADS:
        weighted = (rows * weights[:, None, None]).reshape(-1, len(scale))
        gram = weighted.T @ rows.reshape(-1, len(scale))
        gram += 1e-13 * gram.trace() / len(gram) * np.eye(len(gram))
        found = np.linalg.solve(gram, weighted.T @ aims.ravel())
        weights = 1 / (((rows @ found - aims) ** 2).sum(1) + spread**2)
    return np.rint((found / scale).reshape(3, -1) * 2.0**32) / 2.0**32


def _null(rows: Float[np.ndarray, "frames equations n"]) -> tuple[np.ndarray, float]:
    """The unit vector that most frames come nearest to annihilating, and the share of frames that it does.

    Begun from the part of the frames that keeps a law best, then reweighted until frames that break it (a hand held by a
    limit, a glitch, another person) have no say.
    """
    starts = [_annihilated(part, np.ones(len(part))) for part in (rows, *np.array_split(rows, _PARTS))]
    vector = min(starts, key=lambda v: float(np.log(_violation(rows, v) + _ROUNDING).sum()))
    for _ in range(_REWEIGHTINGS):
        vector = _annihilated(rows, 1 / np.maximum(_violation(rows, vector), _ROUNDING))
    return vector, float((_violation(rows, vector) < _NULL).mean())


def _annihilated(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    flat = (rows * weights[:, None, None]).reshape(-1, rows.shape[-1])
    return np.linalg.eigh(flat.T @ flat)[1][:, 0]


def _violation(rows: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.sqrt(((rows @ vector) ** 2).sum(1))


def _zero_entry(matrices: Float[np.ndarray, "frames 3 3"]) -> tuple[np.ndarray, np.ndarray, float] | None:
    """u, v and g of the one bilinear law u^T R v = g that a joint of two axes keeps, or None."""
    entries = np.concatenate([matrices.reshape(-1, 1, 9), -np.ones((len(matrices), 1, 1))], 2)
    vector, kept = _null(entries)
    if kept < _MOST:
        return None
    left, strength, right = np.linalg.svd(vector[:9].reshape(3, 3))
    if strength[1] > 1e-3 * strength[0]:
        return None
    return left[:, 0], right[0], float(vector[9] / strength[0])


def _polished(table: Table, law: AbstractLaw) -> AbstractLaw:
    """The law with its numbers where it fits best, by Gauss and Newton on what it leaves; in units of 2^-32."""
    numbers = np.array(law.numbers)
    angles = table.T.astype(np.float64)
    targets = angles[list(law.targets)]

    def leaves(x: np.ndarray) -> np.ndarray:
        left = targets - np.stack(law.with_numbers(x.tolist()).predict(angles))
        return (left - _TURN * np.rint(left / _TURN)).ravel()

    for _ in range(_POLISHINGS):
        left = leaves(numbers)
        weights = 1 / np.maximum(np.abs(left), 1.0) ** 2
        slopes = np.stack([(leaves(numbers + step) - left) / _DIFFERENCE for step in _DIFFERENCE * np.eye(len(numbers))])
        usable = (np.abs(slopes) < _STEEP).all(0) & (np.abs(left) < 100)
        slopes = slopes * (weights * usable)
        gram = slopes @ (slopes / np.where(weights > 0, weights, 1.0)).T
        ridged = gram + 1e-9 * np.trace(gram) * np.eye(len(gram)) + 1e-12 * np.eye(len(gram))
        numbers = numbers - np.linalg.solve(ridged, slopes @ left)
    best = law.with_numbers((np.rint(numbers * 2.0**32) / 2.0**32).tolist())
    return best if _bits(residuals(best, table, DECIMALS)) < _bits(residuals(law, table, DECIMALS)) else law


def _bits(rows: Iterable[np.ndarray]) -> float:
    """What integers cost, all rows together, in bits a frame: the entropy of their octave, and the bits below it."""
    total = 0.0
    for row in rows:
        octave = np.frexp(np.abs(row).astype(np.float64))[1]
        share = np.unique(octave, return_counts=True)[1] / len(row)
        total += float(octave.mean() - (share * np.log2(share)).sum())
    return total


def causal(laws: Sequence[AbstractLaw]) -> Iterator[AbstractLaw]:
    """The laws in an order in which the targets of each come before they are inputs."""
    waiting = list(laws)
    while waiting:
        open_targets = {t for law in waiting for t in law.targets}
        ready = [law for law in waiting if not open_targets & set(law.inputs)]
        yield from ready
        waiting = [law for law in waiting if law not in ready]
        if not ready:
            raise ValueError("laws lean on each other in a circle")
