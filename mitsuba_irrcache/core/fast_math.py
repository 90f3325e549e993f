"""Arithmetic that processors do fast with many numbers at once, in place of what they do slowly."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

#: 2^f = 1 + f (c0 + f (c1 + ...)) for f in [0, 1], to 2e-9: what is left adds up over many steps.
POWER_OF_TWO = (
    0.69314706,
    0.24022909,
    0.055486184,
    0.0096737752,
    0.0012482289,
    0.00021565972,
)
#: From here on e^-x is 0; below, 1 - e^-x is known from its series.
ENDLESS, THIN = 87.0, 0.05


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


def decay(x):
    """e^-x of what is not negative, to 1e-7 (1 + x) of it: half the instructions of ``dr.exp``."""
    if dr.depth_v(x) > 1:
        return type(x)([decay(channel) for channel in x])
    power = x * -math.log2(math.e)
    whole = dr.floor(power)
    part, value = power - whole, mi.Float(0)
    for factor in reversed(POWER_OF_TWO):
        value = dr.fma(value, part, factor)
    bits = dr.reinterpret_array(mi.Int32, dr.fma(value, part, 1)) + (mi.Int32(whole) << 23)
    return dr.select(x < ENDLESS, dr.reinterpret_array(mi.Float, bits), 0)


def absorbed(depth, passed):
    """1 - e^-depth without cancellation, where e^-depth, ``passed``, is known."""
    series = dr.fma(depth, dr.fma(depth, dr.fma(depth, -1 / 24, 1 / 6), -1 / 2), 1)
    return dr.select(depth < THIN, depth * series, 1 - passed)


def absorptance(tau):
    """1 - e^-tau without cancellation.

    Of a 16th of ``tau`` by its series, then four times 1 - e^-2x = a (2 - a) with a = 1 - e^-x:
    right to 1e-6, for half an exponential's price.
    """
    x = least(tau, 16.0) * (1 / 16)
    series = dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, 1 / 120, -1 / 24), 1 / 6), -1 / 2), 1)
    a = x * series
    for _ in range(4):
        a = a * (2 - a)
    return a
