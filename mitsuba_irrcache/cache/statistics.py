"""Sums over batches of samples, and what the noise of a mean does to its root."""

from __future__ import annotations

import drjit as dr


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
