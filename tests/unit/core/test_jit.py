"""Functions with Dr.Jit loops in Python syntax, transformed on first use; arrays from NumPy."""

from __future__ import annotations

import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.jit import from_numpy, symbolic
from mitsuba_irrcache.errors import IrrcacheError


@symbolic
def triangular(n: mi.UInt32, step: int = 1):
    """Return the sum of the numbers from 1 to ``n``."""
    total, k = mi.UInt32(0), mi.UInt32(0)
    while k < n:
        k += step
        total += k
    return total


def test_a_function_is_transformed_once_when_it_is_called(rgb, monkeypatch):
    transformed, original = [], dr.syntax
    monkeypatch.setattr(dr, "syntax", lambda f: transformed.append(f.__name__) or original(f))
    later = symbolic(triangular.__wrapped__)
    assert later.__name__ == "triangular" and later.__doc__.startswith("Return the sum")
    assert transformed == []
    assert list(later(mi.UInt32([0, 1, 2, 3, 10]))) == [0, 1, 3, 6, 55]
    assert list(later(mi.UInt32([4, 5]), step=2)) == [6, 12]
    assert transformed == ["triangular"]


def test_a_file_that_was_changed_after_its_import_is_refused(rgb, tmp_path):
    """A source file that changed after its import is refused.

    ``dr.syntax`` would compile whatever code is now at the function's line numbers.
    """
    file = tmp_path / "edited.py"
    source = "def half(x):\n    return x / 2\n"
    file.write_text(source)
    found: dict = {}
    exec(compile(source, str(file), "exec"), found)
    function = symbolic(found["half"])
    os.utime(file, ns=(1, 1))
    with pytest.raises(IrrcacheError, match="was changed after it was imported"):
        function(mi.Float(1))


def test_arrays_from_numpy_share_kernels(rgb):
    """Values are those of the array, whatever its layout, type and address, by one kernel."""
    values = np.arange(24.0).reshape(4, 6)
    hashes = set()
    for array in (values, values.T, values[:, 1:], values.astype(np.float32).ravel()[3:]):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            doubled = 2 * from_numpy(array)
            dr.eval(doubled)
            hashes |= {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
        np.testing.assert_array_equal(doubled, 2 * array.ravel())
    assert len(hashes) == 1
