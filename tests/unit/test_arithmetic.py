"""Indices taken apart without division."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.arithmetic import Divisor, unravelled

pytestmark = pytest.mark.usefixtures("rgb")

LARGEST = 2**32 - 1


@settings(max_examples=200, deadline=None)
@given(number=st.integers(1, LARGEST), index=st.lists(st.integers(0, LARGEST), min_size=1))
@pytest.mark.parametrize("nearby", [False, True])
def test_quotients_and_rests(nearby, number, index):
    """Of all numbers of 32 bits; where they err if they do, beside multiples."""
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
