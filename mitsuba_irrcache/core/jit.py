"""Dr.Jit loops written in Python syntax, integer division, opaque points, arrays from NumPy, and
concatenation.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import wraps

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError

#: Alignment of arrays from NumPy, in values.
ALIGNMENT = 16


def symbolic(function: Callable) -> Callable:
    """Apply ``dr.syntax`` when the function is called for the first time.

    The transformation takes some milliseconds for each function, and a program calls only a few of
    the functions that it imports. ``dr.syntax`` reads the source by line numbers, so a file that
    changed after its import would yield the wrong lines; this raises an error instead.
    """
    transformed, file = None, function.__code__.co_filename
    imported = _modification_time(file)

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        nonlocal transformed
        if transformed is None:
            if _modification_time(file) != imported:
                raise IrrcacheError(
                    f'irrcache: "{file}" was changed after it was imported; restart Python.'
                )
            transformed = dr.syntax(function)
        return transformed(*args, **kwargs)

    return call


def _modification_time(file: str) -> int | None:
    """Return the modification time of ``file`` [ns], or None if it does not exist."""
    try:
        return os.stat(file).st_mtime_ns
    except OSError:
        return None


class Divisor:
    """Division of UInt32 by a ``number`` from 1 to 2^32 - 1 without recompiling for another number.

    There is no vector instruction for integer division; scalar division dominated kernels that
    reorder volumes. It is replaced by a product and two shifts (Granlund and Montgomery, *Division
    by invariant integers using multiplication*, 1994).
    """

    def __init__(self, number: int) -> None:
        bits = (number - 1).bit_length()
        self._number = dr.opaque(mi.UInt32, number)
        self._factor = dr.opaque(mi.UInt32, (((1 << bits) - number) << 32) // number + 1)
        self._shifts = [dr.opaque(mi.UInt32, n) for n in (min(bits, 1), max(bits - 1, 0))]

    def split(self, index: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Return quotient and remainder."""
        product = dr.mul_hi(index, self._factor)
        quotient = (((index - product) >> self._shifts[0]) + product) >> self._shifts[1]
        return quotient, index - quotient * self._number


def unravelled(index: mi.UInt32, sides: Sequence[Divisor]) -> tuple[mi.UInt32, ...]:
    """Convert flat indices to indices along all axes, fastest first.

    ``sides`` holds the sizes of all axes but the last one.
    """
    places = []
    for side in sides:
        index, place = side.split(index)
        places.append(place)
    return (*places, index)


def opaque_point(values: Iterable[float]) -> mi.Point3f:
    """Return a point that is an argument of kernels and not a constant in them."""
    return mi.Point3f([dr.opaque(mi.Float, float(v)) for v in values])


def from_numpy(values: np.ndarray) -> mi.Float:
    """Return all ``values`` as a flat array, in single precision.

    Dr.Jit references the memory of NumPy, and its kernels depend on the alignment, which therefore
    is always the same.
    """
    buffer = np.empty(values.size + ALIGNMENT, dtype=np.float32)
    start = -(buffer.ctypes.data // buffer.itemsize) % ALIGNMENT
    aligned = buffer[start : start + values.size]
    aligned[:] = values.ravel()
    return mi.Float(aligned)


def concatenated(parts: Sequence[dr.ArrayBase]) -> dr.ArrayBase:
    """Concatenate arrays of one type.

    Unlike those of ``dr.concat``, the kernels do not depend on the widths of the arrays.
    """
    if len(parts) == 1:
        return parts[0]
    result = dr.empty(type(parts[0]), sum(dr.width(part) for part in parts))
    start = 0
    for part in parts:
        dr.scatter(result, part, dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, start))
        start += dr.width(part)
    dr.eval(result)
    return result


def graph_variables(value: object) -> list[int]:
    """Return the indices of the variables in Dr.Jit's AD graph of which a value consists.

    The value is an array or a transform. Derivatives may be suspended.
    """
    if not dr.is_array_v(value):
        # Points accept any attribute name as a swizzle.
        return graph_variables(value.matrix) if hasattr(value, "matrix") else []
    if dr.is_tensor_v(value):
        return graph_variables(value.array)
    if dr.depth_v(value) > 1:
        return [index for part in value for index in graph_variables(part)]
    index = getattr(value, "index_ad", 0)
    return [index] if index else []
