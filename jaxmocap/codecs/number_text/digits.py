"""Decimal numbers written in bulk: four digits at a time from tables, into fields whose unused places are zero bytes."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt, UInt8

from .rule import FIXED, Decimal, NumberRule, Numbers, join

_FOUR = np.array([b"%04d" % n for n in range(10_000)])
_LEADING = np.array([(b"%d" % n).rjust(4, b"\0") for n in range(10_000)])  # without zeros in front
_TRAILING = np.array([(b"%04d" % n).rstrip(b"0") for n in range(10_000)])  # without zeros at the end


def fields(rule: NumberRule, decimals: int, numbers: Numbers, literals: np.ndarray) -> np.ndarray:
    """A record of bytes for every number: its sign in the first byte, its text, and the literal of its column.

    Zero bytes in it say nothing: take them out.
    """
    d = join(rule, decimals, numbers)
    parts = {
        "sign": numbers.negative * np.uint8(ord("-")),
        **{f"whole {k}": chunk for k, chunk in enumerate(_whole_chunks(d.whole))},
        "point": np.uint8(ord(".") if rule.digits else 0) if rule.kind == FIXED else _points(d, rule),
        **{f"fraction {k}": chunk for k, chunk in enumerate(_fraction_chunks(d.fraction, rule))},
        **({"exponent": _exponents(d.power, rule)} if d.power is not None and d.power.any() else {}),
        "literal": literals,
    }
    out = np.empty(d.whole.shape, [(name, part.dtype) for name, part in parts.items()])
    for name, part in parts.items():
        out[name] = part
    if rule.whole:
        out["fraction 0"][_whole_numbers(d)] = rule.whole[1:]
    return out


def counters(numbers: UInt[np.ndarray, " rows"]) -> UInt8[np.ndarray, "rows width"]:
    """Whole numbers, one a row, in fields with zero bytes in front."""
    return np.stack(_whole_chunks(numbers), axis=1).view(np.uint8).reshape(len(numbers), -1)


def _whole_chunks(whole: UInt[np.ndarray, "*n"]) -> list[np.ndarray]:
    """Four digits each, high ones first; nothing in front of the first digit."""
    chunks: list[np.ndarray] = []
    ten_thousand = whole.dtype.type(10_000)
    while int(whole.max(initial=0)) >= ten_thousand:
        above = whole // ten_thousand
        part = whole - above * ten_thousand
        chunks.append(np.where(above > 0, _FOUR.take(part), _leading(part, not chunks)))
        whole = above
    return [_leading(whole, not chunks), *reversed(chunks)]


def _leading(chunk: UInt[np.ndarray, "*n"], last: bool) -> np.ndarray:
    text = _LEADING.take(chunk)
    return text if last else np.where(chunk > 0, text, b"")


def _fraction_chunks(fraction: UInt[np.ndarray, "*n"], rule: NumberRule) -> list[np.ndarray]:
    """Four digits each, the last one what is left, high ones first; without zeros at the end unless the rule keeps them."""
    chunks: list[np.ndarray] = []
    for places in range(rule.places, 0, -4):
        if places > 4:
            unit = fraction.dtype.type(10 ** (places - 4))
            part = fraction // unit
            fraction = fraction - part * unit
            trimmed = fraction == 0
        else:
            part, trimmed = fraction * fraction.dtype.type(10 ** (4 - places)), True
        text = _FOUR.take(part) if rule.kind == FIXED else np.where(trimmed, _TRAILING.take(part), _FOUR.take(part))
        chunks.append(text.astype(f"S{min(places, 4)}"))
    return chunks


def _points(d: Decimal, rule: NumberRule) -> UInt8[np.ndarray, "*n"]:
    """A point where a fraction follows, or what stands behind a whole number."""
    there = (d.fraction > 0) | _whole_numbers(d) if rule.whole else d.fraction > 0
    return there * np.uint8(ord("."))


def _whole_numbers(d: Decimal) -> np.ndarray:
    return d.fraction == 0 if d.power is None else (d.fraction == 0) & (d.power == 0)


def _exponents(power: np.ndarray, rule: NumberRule) -> np.ndarray:
    lowest = int(power.min())
    powers = range(lowest, int(power.max()) + 1)
    texts = [b"e%c%0*d" % (b"-+"[p > 0], rule.exponent, abs(p)) if p else b"" for p in powers]
    return np.array(texts).take(power - lowest)
