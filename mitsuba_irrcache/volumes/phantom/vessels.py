"""A branching tree of vessels through scattered points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsuba_irrcache.volumes.phantom.distance import Segment

# Murray's law: this power of a vessel's radius is the sum over its branches. The law's exponent 3
# is for laminar flow; that of measured pulmonary arteries is smaller.
MURRAY_EXPONENT = 2.8


def vessel_tree(
    root: Sequence[float], points: np.ndarray, tip_radius: float = 0.8, detour: float = 0.5
) -> list[Segment]:
    """Return the segments of a tree from ``root`` to all ``points`` (n, 3), mm.

    Starting at the root, each point is connected to the vessel with the least new length plus
    ``detour`` times the distance to the root along the tree. Radii follow Murray's law from
    ``tip_radius``.
    """
    points = points[np.argsort(np.linalg.norm(points - root, axis=1), kind="stable")]
    nodes = np.vstack([root, points])
    parents = _parents(nodes, detour)
    tips = _tips(parents)
    radii = tip_radius * tips ** (1 / MURRAY_EXPONENT)
    return [
        Segment(nodes[parent], nodes[child], radii[child], radii[child])
        for child, parent in enumerate(parents)
        if child > 0
    ]


def _parents(nodes: np.ndarray, detour: float) -> np.ndarray:
    """Return the index of each node's parent; the root's is 0."""
    parents = np.zeros(len(nodes), dtype=np.intp)
    way = np.zeros(len(nodes))
    for child in range(1, len(nodes)):
        length = np.linalg.norm(nodes[:child] - nodes[child], axis=1)
        parents[child] = np.argmin(length + detour * way[:child])
        way[child] = way[parents[child]] + length[parents[child]]
    return parents


def _tips(parents: np.ndarray) -> np.ndarray:
    """Return the number of leaves below each node; a leaf counts itself."""
    tips = np.zeros(len(parents))
    for child in range(len(parents) - 1, 0, -1):
        tips[child] = max(tips[child], 1)
        tips[parents[child]] += tips[child]
    return tips
