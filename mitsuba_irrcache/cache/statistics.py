"""Sums over batches of samples, and the bias of square roots of noisy means."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def concatenated(pieces: tuple):
    """Concatenate the values of all blocks; None if they are None."""
    if pieces[0] is None:
        return None
    return dr.concat(list(pieces)) if len(pieces) > 1 else pieces[0]


def total(terms):
    """Add arrays, where None stands for 0."""
    known = [t for t in terms if t is not None]
    return sum(known[1:], known[0]) if known else None


def totals_of_pairs(first: list, second: list) -> list:
    """Add two lists element by element, where None stands for 0."""
    return [total(pair) for pair in zip(first, second, strict=True)]


def root_correction(variance: mi.Float) -> mi.Float:
    """Factor that removes the bias of interpolated square roots of noisy values.

    With relative ``variance`` v of the voxels, E[(sum w_i sqrt(x_i))^2] = mu (1 - (1 - sum w_i^2) v
    / 4) to first order, and the mean of sum w_i^2 over a cell is (2/3)^3. Without the correction,
    16 samples yield an irradiance that is about 1 % too small.
    """
    # docs/primer, eq. (2.3)
    return dr.rsqrt(1 - (1 - 8 / 27) / 4 * variance)
