"""Slabs: runs of slices across an axis, symmetric about the middle of the volume."""

from __future__ import annotations

from collections.abc import Iterator

#: A slab: its first slice, and the one after its last.
Slab = tuple[int, int]


def symmetric_slabs(slices: int, most: int) -> list[Slab]:
    """Divide a number of ``slices`` into slabs of at most ``most``, such that the i-th from either
    end have the same number: tracks in both directions cross one each at a time.
    """
    outer, rest = divmod(slices // 2, most)
    rest = slices - 2 * outer * most  # at most 2 most + 1
    half = rest // 2
    middle = [rest] if rest <= most else [half, rest - 2 * half, half]
    sizes = [n for n in outer * [most] + middle + outer * [most] if n]
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    return list(zip([0, *ends[:-1]], ends, strict=True))


def even_slabs(slices: int, most: int) -> Iterator[Slab]:
    """Yield slabs of ``most`` slices, the last one of fewer."""
    for first in range(0, slices, most):
        yield first, min(first + most, slices)
