"""Arithmetic that processors do fast with many numbers at once, in place of what they do slowly."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi


class Divisor:
    """A ``number`` from 1 to 2^32 - 1 that divides any UInt32. Another number is the same
    kernel.

    There is no division of integer vectors: it is done one by one, and took most of the time of
    kernels that lay volumes out anew. A product and two shifts do the same (Granlund and
    Montgomery, *Division by invariant integers using multiplication*, 1994).
    """

    def __init__(self, number: int) -> None:
        bits = (number - 1).bit_length()
        self._number = dr.opaque(mi.UInt32, number)
        self._factor = dr.opaque(mi.UInt32, (((1 << bits) - number) << 32) // number + 1)
        self._shifts = [dr.opaque(mi.UInt32, n) for n in (min(bits, 1), max(bits - 1, 0))]

    def split(self, index: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Quotient and rest."""
        product = dr.mul_hi(index, self._factor)
        quotient = (((index - product) >> self._shifts[0]) + product) >> self._shifts[1]
        return quotient, index - quotient * self._number


def unravelled(index: mi.UInt32, sides: Sequence[Divisor]) -> tuple[mi.UInt32, ...]:
    """Places along all axes, the fastest first, of flat indices; ``sides`` are those of all axes
    but the last, which may have any.
    """
    places = []
    for side in sides:
        index, place = side.split(index)
        places.append(place)
    return (*places, index)


def least(a: mi.Float, b: mi.Float) -> mi.Float:
    """The less of two numbers, one instruction: ``dr.minimum`` takes six, to hand on what is no
    number and to tell the zeros apart. Likewise `greatest`, `clipped`.
    """
    return dr.select(a < b, a, b)


def greatest(a: mi.Float, b: mi.Float) -> mi.Float:
    """The greater of two numbers."""
    return dr.select(a > b, a, b)


def clipped(value: mi.Float, lower: mi.Float, upper: mi.Float) -> mi.Float:
    """``value`` between two others."""
    return least(greatest(value, lower), upper)
