"""Cache errors projected along rays, weighted by the radiance that each point contributes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import quad

from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.render.raymarch import CachedFields, Projection

pytestmark = pytest.mark.usefixtures("rgb")


class Errors:
    """Relative errors that rise or fall along x, in place of those of voxels."""

    count = 2

    def at_world(self, p, phi, active):
        return [0.1 * (p.x + 1), 0.1 * (1 - p.x)]


@pytest.mark.parametrize("offset", [1.0, 0.5])
@pytest.mark.parametrize("quadrature", ["trapezoid", "exponential"])
def test_errors_are_weighted_by_radiance(quadrature, offset):
    """Projected errors are int T sigma_s Phi / (4 pi) e dt within 1 %.

    The medium is homogeneous and the steps are few; errors of one end of a segment would be off by
    several %.
    """
    sigma, steps = 1.2, 12
    place = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]])
    grid = Grid((1, 1, steps), place)
    field = GridField(grid, dr.full(mi.Float, sigma, steps), 1)
    light = GridField(grid, dr.full(mi.Float, 4 * dr.pi, steps), 1)
    medium = MediumGrid(field, ConstantField(np.array([1.0])), Boundary("box", np.eye(4)))
    projection = Projection(
        medium, light, quadrature, 1.0, layered=True, cached=CachedFields(uncertainty=Errors())
    )
    ray = mi.Ray3f(mi.Point3f(-3, 0, 0), mi.Vector3f(1, 0, 0))
    _, near, far = medium.intersect(ray)
    *_, gathered, _ = projection.march(
        ray, near, far, mi.Spectrum(0), mi.Float(offset), mi.Bool(True)
    )
    for found, error in zip(
        gathered[2:], (lambda t: 0.1 * t, lambda t: 0.1 * (2 - t)), strict=True
    ):
        exact = quad(lambda t, e=error: np.exp(-sigma * t) * sigma * e(t), 0, 2)[0]
        assert float(found[0]) == pytest.approx(exact, rel=0.01)
