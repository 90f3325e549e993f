"""Integer division by constants, and fast approximations of functions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.core.fast_math import clipped, decay, maximum, minimum
from mitsuba_irrcache.core.jit import Divisor, unravelled

pytestmark = pytest.mark.usefixtures("rgb")

LARGEST = 2**32 - 1


@settings(max_examples=200, deadline=None)
@given(number=st.integers(1, LARGEST), index=st.lists(st.integers(0, LARGEST), min_size=1))
@pytest.mark.parametrize("nearby", [False, True])
def test_quotients_and_remainders(nearby, number, index):
    """Quotients and remainders are exact for all 32-bit numbers, tested next to multiples."""
    index = np.array(index, dtype=np.uint64)
    if nearby:
        index = index // number * number
        index = np.concatenate([np.maximum(index, 1) - 1, index, np.minimum(index + 1, LARGEST)])
    quotient, rest = Divisor(number).split(mi.UInt32(index.astype(np.uint32)))
    np.testing.assert_array_equal(quotient, index // number)
    np.testing.assert_array_equal(rest, index % number)


def test_places():
    places = unravelled(dr.arange(mi.UInt32, 60), [Divisor(5), Divisor(4)])
    np.testing.assert_array_equal(places, np.unravel_index(np.arange(60), (3, 4, 5))[::-1])


def test_other_numbers_are_the_same_kernel():
    def split(number: int) -> None:
        dr.eval(Divisor(number).split(dr.arange(mi.UInt32, 64)))

    split(7)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        for number in (1, 8, 13):
            split(number)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(kernels) == 3
    assert all(k["cache_hit"] for k in kernels)


def test_decay():
    """e^-x agrees with NumPy, without bias that would accumulate over steps; 0 if opaque."""
    x = np.float32(np.concatenate([np.geomspace(1e-30, 80, 4001), [0.0]]))
    expected = np.exp(-np.float64(x))
    relative = np.float64(decay(mi.Float(x))) / expected - 1
    assert (np.abs(relative) <= 1e-7 * (1 + x)).all()
    thin = np.float32(np.random.default_rng(1).uniform(0, 0.1, 1 << 16))
    bias = np.float64(decay(mi.Float(thin))) / np.exp(-np.float64(thin)) - 1
    assert abs(bias.mean()) < 3e-9
    np.testing.assert_array_equal(decay(mi.Float([0.0, 90.0, 1e30, np.inf])), [1, 0, 0, 0])
    colours = decay(mi.Color3f(0.0, 1.0, 2.0))
    np.testing.assert_allclose(np.ravel(colours), np.exp([0.0, -1.0, -2.0]), rtol=3e-7)


def test_extremes():
    a, b = mi.Float([1.0, 2.0, -0.0, np.inf]), mi.Float([2.0, 1.0, 0.0, 3.0])
    np.testing.assert_array_equal(minimum(a, b), [1, 1, 0, 3])
    np.testing.assert_array_equal(maximum(a, b), [2, 2, 0, np.inf])
    np.testing.assert_array_equal(clipped(a, -1.0, 1.5), [1, 1.5, 0, 1.5])
