"""Angular quadrature: directions spread evenly over the sphere, and their weights."""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.polynomial.legendre import legval

from mitsuba_irrcache.core.sequences import GENERALISED_GOLDEN_RATIOS, fibonacci_hemisphere

#: What a set, of several that share their directions, is to integrate, and how much it matters:
#: spherical harmonics by their degree.
DEGREES = {2: 4.0, 4: 2.0, 6: 0.5, 8: 0.2}


#: Rounds of exchange between sets, at most; few are needed.
ROUNDS = 8


def spread(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """``count`` directions (n, 3) of one hemisphere, and the solid angle (n) that each of them
    stands for; so does its opposite.
    """
    return spread_together(1, count, rng)[0]


def spread_together(
    sets: int, count: int, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """As many ``sets`` of `spread` directions, which are spread evenly together, too."""
    points, members = _shared_out(sets, count)
    points = points @ _rotation(rng).T
    return [(points[own], _weights(points[own])) for own in members]


@lru_cache(maxsize=32)
def _shared_out(sets: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions of one hemisphere on a Fibonacci spiral, and which of them each set has."""
    points, turn = fibonacci_hemisphere(sets * count)
    members = strata(sets, turn, 1 / GENERALISED_GOLDEN_RATIOS[1])
    # The squared error of a set's integrals is the sum of this over all pairs of its points, by the
    # addition theorem. Two sets exchange those two points that lower it most.
    factors = np.zeros(max(DEGREES) + 1)
    for degree, weight in DEGREES.items():
        factors[degree] = weight * (2 * degree + 1)
    error = legval(points @ points.T, factors)
    for _ in range(ROUNDS):
        exchanged = False
        for a, b in combinations(range(sets), 2):
            first, second = members[a], members[b]
            within, beyond = error[np.ix_(first, first)], error[np.ix_(second, second)]
            between = error[np.ix_(first, second)]
            out = between.sum(axis=1) - within.sum(axis=1) + np.diag(within)
            into = between.sum(axis=0) - beyond.sum(axis=1) + np.diag(beyond)
            change = out[:, None] + into - 2 * between
            i, j = np.unravel_index(change.argmin(), change.shape)
            if change[i, j] < -1e-9:
                first[i], second[j], exchanged = second[j], first[i], True
        if not exchanged:
            break
    return points, members


def strata(sets: int, place: np.ndarray, step: float) -> np.ndarray:
    """Numbers (sets, n) of points for each of so many ``sets``: one of each as many in a row, by
    the order of their ``place`` in [0, 1), which goes round by ``step`` from row to row.
    """
    rows = place.reshape(-1, sets) - step * np.arange(len(place) // sets)[:, None]
    order = np.argsort(rows % 1, axis=1)
    return np.ascontiguousarray((order + sets * np.arange(len(order))[:, None]).T)


def _weights(points: np.ndarray) -> np.ndarray:
    """The weights nearest to equal ones that integrate all products of two coordinates."""
    count = len(points)
    x, y, z = points.T
    moments = np.stack([np.ones(count), x * x, y * y, x * y, y * z, z * x])
    wanted = 2 * np.pi * np.array([1, 1 / 3, 1 / 3, 0, 0, 0])
    equal = np.full(count, 2 * np.pi / count)
    correction, *_ = np.linalg.lstsq(moments, wanted - moments @ equal, rcond=None)
    weights = equal + correction
    return weights if weights.min() > 0.25 * equal[0] else equal


def _rotation(rng: np.random.Generator) -> np.ndarray:
    """A uniformly random rotation matrix."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)
