"""Rays along which radiance enters a box of tracks, without surroundings."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.solvers.discrete_ordinates import boundary_condition
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import IncomingRadiance


class NoSurroundings:
    """Surroundings of a medium without emitters and surfaces."""

    refracts, carries_refracted = False, True

    has_sources, angular_basis, surfaces = False, None, None

    @staticmethod
    def crossings(tracks, ordinates) -> None:
        """There are no surfaces among the voxels."""


def without_paths(monkeypatch) -> None:
    """Replace the paths of `IncomingRadiance` by nothing."""
    nothing = None, None, None, mi.UInt32(0), None
    monkeypatch.setattr(boundary_condition, "_trace_cells", lambda *args: nothing)


def sampled_rays(tracks, directions: np.ndarray, offsets: np.ndarray) -> tuple:
    """Return the `IncomingRadiance` of tracks, and the result of its `sample_rays`."""
    count = len(directions)
    ordinates = directions, np.zeros((count, 2, 3)), np.ones(count), offsets
    found = IncomingRadiance(NoSurroundings, tracks, ordinates, True, (0, 0, 0))
    parameters = found._parameters(ordinates[0], [ordinates[1]], ordinates[2])[0]
    return found, found.sample_rays(parameters, (0, 0, 0))
