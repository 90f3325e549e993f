"""Loops of Dr.Jit in Python's words, transformed when they are needed."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.symbolic import symbolic


@symbolic
def triangular(n: mi.UInt32, step: int = 1):
    """Sum of the numbers from 1 to ``n``."""
    total, k = mi.UInt32(0), mi.UInt32(0)
    while k < n:
        k += step
        total += k
    return total


def test_a_function_is_transformed_once_when_it_is_called(rgb, monkeypatch):
    transformed, original = [], dr.syntax
    monkeypatch.setattr(dr, "syntax", lambda f: transformed.append(f.__name__) or original(f))
    later = symbolic(triangular.__wrapped__)
    assert later.__name__ == "triangular" and later.__doc__.startswith("Sum")
    assert transformed == []
    assert list(later(mi.UInt32([0, 1, 2, 3, 10]))) == [0, 1, 3, 6, 55]
    assert list(later(mi.UInt32([4, 5]), step=2)) == [6, 12]
    assert transformed == ["triangular"]
