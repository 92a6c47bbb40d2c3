"""How a program writes its numbers (`%.4f`, the same without the zeros at its end, `%.6g`), and what they are then.

A number is an integer, cut off toward zero at the decimals of its table, and digits behind that: noise, mostly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, Int64, UInt, UInt64

FIXED, TRIMMED, GENERAL = 0, 1, 2
MAX_DECIMALS, MAX_SIGNIFICANT = 12, 12
LARGEST = (1 << 31) - 1  # of a table: -2^31 has no magnitude there
LOWEST_POWER = -280  # doubles thin out below
POWERS = np.array([10**n for n in range(20)], np.uint64)


@dataclass(frozen=True)
class NumberRule:
    """`digits` are decimals, or significant digits where `kind` is GENERAL.

    TRIMMED and GENERAL leave zeros at the end away; `whole` is what stands behind a whole number then ("" or ".0").
    `exponent` is the least number of digits of an exponent: C says 2, older Windows 3.
    """

    kind: int
    digits: int
    whole: bytes = b""
    exponent: int = 2

    def pack(self) -> bytes:
        """Three bytes."""
        return bytes([self.kind | self.exponent << 4, self.digits, len(self.whole)])

    @staticmethod
    def unpack(data: bytes) -> NumberRule:
        """Raises ValueError for bytes that are no rule."""
        kind, digits, whole = data
        rule = NumberRule(kind & 15, digits, b".0"[:whole], kind >> 4)
        least, most = (1, MAX_SIGNIFICANT) if rule.kind == GENERAL else (0, MAX_DECIMALS)
        ends = (0,) if rule.kind == FIXED or not digits else (0, 2)
        if rule.kind > GENERAL or not least <= digits <= most or whole not in ends or rule.exponent not in (2, 3):
            raise ValueError(f"{data.hex()} is no number rule")
        return rule

    @property
    def places(self) -> int:
        """The most digits behind a point that a number can have."""
        return self.digits + 3 if self.kind == GENERAL else self.digits


class Numbers(NamedTuple):
    """Some numbers under a rule and the decimals of a table; `extra` holds the digits behind those of the integer.

    `tiny` says what GENERAL numbers are whose integer is 0: 0 for zero itself, else 1 + mantissa - lowest mantissa +
    span * (power - LOWEST_POWER), with `span` mantissas a power, which grows with the number.
    """

    integers: Int32[np.ndarray, "*n"]
    negative: Bool[np.ndarray, "*n"]
    extra: UInt64[np.ndarray, "*n"]
    tiny: Int64[np.ndarray, "*n"]


class Decimal(NamedTuple):
    """Numbers ready for writing: `fraction` counts 10^-places; a `power` other than 0 is an exponent to be written."""

    whole: UInt[np.ndarray, "*n"]
    fraction: UInt[np.ndarray, "*n"]
    power: Int64[np.ndarray, "*n"] | None


def split(rule: NumberRule, decimals: int, values: Float[np.ndarray, "*n"]) -> tuple[Numbers, Bool[np.ndarray, "*n"]]:
    """The numbers that values are under a rule, and which of them it cannot say (they become 0)."""
    size = np.abs(values)
    if rule.kind == GENERAL:
        whole, extra, tiny, fits = _split_general(rule, decimals, size)
    else:
        with np.errstate(over="ignore"):
            scaled = np.rint(size * 10.0**rule.digits)
        spare = rule.digits - decimals
        fits = scaled < min(2.0**50, (LARGEST + 1.0) * 10.0**spare)
        digits = np.where(fits, scaled, 0).astype(np.uint64)
        whole, extra = np.divmod(digits, POWERS[spare]) if spare else (digits, np.zeros_like(digits))
        tiny = np.zeros(values.shape, np.int64)
    negative = np.signbit(values)
    integers = whole.astype(np.int64)
    return Numbers(np.where(negative, -integers, integers).astype(np.int32), negative, extra, tiny), ~fits


def join(rule: NumberRule, decimals: int, numbers: Numbers) -> Decimal:
    """The parts that a rule writes numbers by."""
    magnitude = np.abs(numbers.integers).view(np.uint32)
    if rule.kind == GENERAL:
        return _join_general(rule, decimals, magnitude.astype(np.uint64), numbers)
    if rule.digits == decimals:  # 32 bits will do, which is twice as fast
        digits, unit = magnitude, np.uint32(10**decimals) if decimals < 10 else POWERS[decimals]
    else:
        digits, unit = magnitude * POWERS[rule.digits - decimals] + numbers.extra, POWERS[rule.digits]
    whole = digits // unit  # NumPy divides by a constant without dividing, but not in divmod
    return Decimal(whole, digits - whole * unit, None)


def extra_counts(rule: NumberRule, decimals: int, integers: Int32[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """How many digits stand behind those of each integer; none where `tiny` says it all."""
    if rule.kind != GENERAL:
        return np.full(integers.shape, rule.digits - decimals)
    lengths = _lengths(np.abs(integers))
    return np.where(lengths, np.maximum(rule.digits - lengths, 0), 0)


def _lengths(integers: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """The number of decimal digits; 0 has none."""
    return np.searchsorted(POWERS[:11].astype(np.int64), integers, side="right")


def _split_general(rule: NumberRule, decimals: int, size: Float[np.ndarray, "*n"]):
    lowest, span = POWERS[rule.digits - 1], 9 * int(POWERS[rule.digits - 1])
    power = np.floor(np.log10(size, out=np.zeros_like(size), where=size > 0)).astype(np.int64)
    fits = (size < 10.0**rule.digits) & (power > LOWEST_POWER + 2)
    power = np.where(fits, power, 0)
    scale = rule.digits - 1 - power
    size = np.where(fits, size, 0.0)
    scaled = np.where(scale < 0, size / 10.0 ** np.maximum(-scale, 0), size * 10.0 ** np.maximum(scale, 0))
    digits = np.rint(scaled).astype(np.uint64)
    low, high = (digits < lowest) & (digits > 0), digits >= 10 * lowest  # rounded up, or log10 was off by one
    digits = np.where(low, digits * 10, np.where(high, digits // 10, digits))
    power = power + high - low
    spare = rule.digits - 1 - power - decimals
    cut = POWERS[np.clip(spare, 0, 19)]
    whole = np.where(spare > rule.digits, 0, digits // cut * POWERS[np.clip(-spare, 0, 9)])
    fits &= whole <= LARGEST
    whole = np.where(fits, whole, 0)
    tiny = (power - LOWEST_POWER) * span + (digits - lowest).astype(np.int64) + 1
    return whole, np.where(whole > 0, digits % cut, 0), np.where((whole == 0) & (digits > 0) & fits, tiny, 0), fits


def _join_general(rule: NumberRule, decimals: int, magnitude: np.ndarray, numbers: Numbers) -> Decimal:
    lowest, span = POWERS[rule.digits - 1], 9 * int(POWERS[rule.digits - 1])
    lengths = _lengths(magnitude.astype(np.int64))
    spare = rule.digits - lengths
    digits = np.where(spare < 0, magnitude // POWERS[np.maximum(-spare, 0)], magnitude * POWERS[np.maximum(spare, 0)])
    digits = digits + numbers.extra
    power = lengths - 1 - decimals
    above, mantissa = np.divmod(numbers.tiny - 1, span)
    tiny = (lengths == 0) & (numbers.tiny > 0)
    digits = np.where(tiny, mantissa.astype(np.uint64) + lowest, digits)
    power = np.where(tiny, np.minimum(above + LOWEST_POWER, 0), np.where(lengths, power, 0))
    plain = (power >= -4) & (power < rule.digits)
    below = np.where(plain, rule.digits - 1 - power, rule.digits - 1)  # digits of the mantissa behind the point
    cut = POWERS[below]
    whole = digits // cut
    return Decimal(whole, (digits - whole * cut) * POWERS[rule.places - below], np.where(plain, 0, power))
