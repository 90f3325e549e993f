"""Sums over batches of samples, and what the noise of a mean does to its root."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def concatenated(pieces: tuple):
    """The values of all blocks, or None."""
    if pieces[0] is None:
        return None
    return dr.concat(list(pieces)) if len(pieces) > 1 else pieces[0]


def total(terms):
    """Of arrays, or None for 0."""
    known = [t for t in terms if t is not None]
    return sum(known[1:], known[0]) if known else None


def totals_of_pairs(first: list, second: list) -> list:
    """Term by term."""
    return [total(pair) for pair in zip(first, second, strict=True)]


def root_correction(variance: mi.Float) -> mi.Float:
    """Makes interpolated roots of noisy values right on average.

    With relative ``variance`` v of the voxels, E[(sum w_i sqrt(x_i))^2] = mu (1 - (1 - sum w_i^2) v
    / 4) to first order, and sum w_i^2 is (2/3)^3 on average over a cell. Without it 16 samples read
    some 1 % too little light.
    """
    # docs/primer, eq. (2.3)
    return dr.rsqrt(1 - (1 - 8 / 27) / 4 * variance)
