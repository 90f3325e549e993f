"""Checks of the requested size before any memory is allocated."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

from mitsuba_irrcache.errors import IrrcacheError


def checked_shape(shape: Sequence[int], smallest: int) -> tuple[int, int, int]:
    """Return ``shape`` as three integers (z, y, x).

    Raises:
        IrrcacheError: a shape of other than three integers, or a side below ``smallest``.
    """
    try:
        sides = tuple(operator.index(side) for side in shape)
    except TypeError:
        sides = ()
    if len(sides) != 3 or min(sides) < smallest:
        raise IrrcacheError(
            f"phantom shape is {shape!r}; give three integers (z, y, x) of at least {smallest}"
        )
    return sides


def check_memory(
    shape: Sequence[int], voxels: Sequence[int], bytes_per_voxel: int, memory_limit: int
) -> None:
    """Refuse ``shape`` if its ``voxels`` (z, y, x) need more memory than the limit in bytes.

    Raises:
        IrrcacheError: both numbers of bytes are named.
    """
    needed = bytes_per_voxel * math.prod(voxels)
    if needed > memory_limit:
        raise IrrcacheError(
            f"a phantom of shape {shape} (z, y, x) needs {needed} bytes, more than the limit of "
            f"{memory_limit} bytes; give a smaller shape or a larger memory_limit"
        )
