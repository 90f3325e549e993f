"""Ends of ray-marching segments: their positions and their weights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.grids.occupancy import active_voxels
from mitsuba_irrcache.media.emission import Emission
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.render.raymarch import Projection

pytestmark = pytest.mark.usefixtures("rgb")


def rays(count: int, reach: float) -> mi.Ray3f:
    """Return rays from a sphere around the origin to points near it."""
    rng = np.random.default_rng(7)
    origin = rng.normal(size=(3, count))
    origin *= 4 / np.linalg.norm(origin, axis=0)
    way = rng.uniform(-reach, reach, (3, count)) - origin
    way /= np.linalg.norm(way, axis=0)
    return mi.Ray3f(mi.Point3f(np.float32(origin)), mi.Vector3f(np.float32(way)))


def box(place: np.ndarray) -> Boundary:
    """Return the ``to_world`` of the unit cube of this placement."""
    unit = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
    return Boundary("box", place @ unit)


def blobs(scenes) -> MediumGrid:
    """Return two blobs in an otherwise empty grid, longer along x than along z."""
    rng, density = np.random.default_rng(5), np.zeros((10, 14, 22), np.float32)
    density[2:6, 3:8, 2:7] = rng.uniform(0.5, 9, (4, 5, 5))
    density[5:9, 8:12, 14:21] = rng.uniform(0.5, 3, (4, 4, 7))
    place = scenes.placement((2.6, 1.8, 1.4), turn=25)
    field = GridField(Grid(density.shape, place), mi.Float(density.ravel()), 1)
    return MediumGrid(field, ConstantField(np.array([1.0])), box(place))


# Segment ends


@pytest.mark.parametrize("quadrature", ["riemann", "exponential"])
@pytest.mark.parametrize("elsewhere", [0.0, 0.3])
def test_empty_voxels_do_not_contribute(scenes, quadrature, elsewhere):
    """Cache values at empty voxels do not contribute.

    With albedo 1 in a constant radiance field, the image is the opacity 1 - T, although the cache
    is usually zero at voxels that no lookup in the medium reads.
    """
    medium = blobs(scenes)
    grid = Grid((7, 9, 12), medium.boundary.frame)
    phi = np.full(grid.voxel_count, elsewhere * 4 * np.pi, np.float32)
    active = np.array(active_voxels(medium, grid))
    assert 0.1 < len(active) / grid.voxel_count < 0.8
    phi[active] = 4 * np.pi
    projection = Projection(medium, GridField(grid, mi.Float(phi), 1), quadrature, 1.0)
    ray = rays(4096, 0.6)
    hit, near, far = medium.intersect(ray)
    offset = mi.Float(np.random.default_rng(8).uniform(0.01, 1, 4096).astype(np.float32))
    near = dr.maximum(near, 0)
    radiance, passed, *_ = projection.march(ray, near, far, mi.Spectrum(0), offset, hit)
    opacity = 1 - np.array(passed.x)[np.array(hit)]
    assert 0.1 < opacity.mean() < 0.9
    # Rays terminate when at most 1e-4 can be added.
    np.testing.assert_allclose(np.array(radiance.x)[np.array(hit)], opacity, atol=2e-4)


# Long steps


class Along:
    """A smooth field along x that replaces a grid's."""

    channels, grid, minimum = 1, None, 0.0

    def __init__(self, function, maximum: float) -> None:
        self.function, self.maximum = function, maximum

    def at_world(self, p, active=True):
        return self.function(p.x)


@pytest.mark.parametrize("offset", [1.0, 0.37])
def test_long_steps_resolve_variation_behind_opaque_parts(offset):
    """Longer steps behind an opaque part are still shorter than the variation of the medium.

    Behind a transmittance of 1.5 %, extinction and irradiance are waves of 24 steps, which
    contribute 1 %: the radiance is accurate to 5e-4.
    """
    steps, wave = 192, 2 * np.pi / (24 * 2.0 / 192)

    def wall(x, module):
        return 9.0 / (1 + module.exp(40 * (x + 0.55)))

    def extinction(x, module=np):
        return wall(x, module) + 1.5 * (1 + 0.9 * module.sin(wave * x))

    def light(x, module=np):
        return 1 + 0.9 * module.sin(wave * x + 0.4)

    def slope(t, state):
        sigma = extinction(t - 1)
        return [sigma, np.exp(-state[0]) * sigma * light(t - 1)]

    exact = solve_ivp(slope, (0, 2), [0, 0], rtol=1e-10, atol=1e-12, max_step=0.01)
    depth = np.interp(0.5, exact.t, exact.y[0])
    assert 0.005 < np.exp(-depth) < 0.02
    medium = MediumGrid(
        ConstantField(np.array([12.0])),
        ConstantField(np.array([1.0])),
        Boundary("box", np.eye(4)),
    )
    sigma_t = Along(lambda x: extinction(x, dr), 12.0)
    medium = medium.replaced(sigma_t=sigma_t, macrocells=medium.macrocells)
    irradiance = Along(lambda x: 4 * dr.pi * light(x, dr), 4 * np.pi * 1.9)
    projection = Projection(medium, irradiance, "exponential", 1.0)
    projection.step = dr.opaque(mi.Float, 2.0 / steps)
    ray = mi.Ray3f(mi.Point3f(-3, 0, 0), mi.Vector3f(1, 0, 0))
    _, near, far = medium.intersect(ray)
    radiance, *_ = projection.march(ray, near, far, mi.Spectrum(0), mi.Float(offset), mi.Bool(True))
    assert float(radiance.x[0]) == pytest.approx(exact.y[1, -1], rel=5e-4)


# Emission


def flame(scenes) -> Emission:
    """Return a few emissive voxels inside of a grid that is rotated relative to all others."""
    values = np.zeros((20, 20, 24), np.float32)
    values[9:11, 9:11, 17:19] = 2.0
    place = scenes.placement((2.4, 2.0, 2.0), turn=-20, center=(0.3, 0.2, 0.1))
    return Emission(GridField(Grid(values.shape, place), mi.Float(values.ravel()), 1))


def test_emission_begins_and_ends_within_the_ray(scenes):
    """The emission interval lies within the ray and contains all points with emission on it."""
    emission, ray = flame(scenes), rays(4096, 0.8)
    rng = np.random.default_rng(9)
    near = mi.Float(np.float32(rng.uniform(2, 5, 4096)))
    far = near + mi.Float(np.float32(rng.uniform(0, 3, 4096)))
    begin, end = emission.interval(ray, near, far)
    assert dr.all(begin >= near)[0] and dr.all(end <= far)[0]
    lane = dr.arange(mi.UInt32, 4096 * 64)
    t = dr.lerp(
        dr.gather(mi.Float, near, lane // 64),
        dr.gather(mi.Float, far, lane // 64),
        mi.Float(lane % 64) / 63,
    )
    glows = emission.at_world(dr.gather(mi.Ray3f, ray, lane // 64)(t)) > 0
    begin, end = (dr.gather(mi.Float, x, lane // 64) for x in (begin, end))
    assert dr.count(glows)[0] > 200
    assert dr.all(~glows | ((t >= begin - 1e-3) & (t <= end + 1e-3)))[0]


def test_macrocells_that_emission_reaches(scenes):
    """Each macrocell with emission is marked, and most others are not.

    The grid has sides of different lengths.
    """
    medium, emission = blobs(scenes), flame(scenes)
    cells = Macrocells.build(medium.sigma_t, medium.boundary, 2)
    reached = np.array(emission.reaches(cells))
    rng = np.random.default_rng(10)
    p = medium.sigma_t.grid.world.point(
        mi.Point3f(np.float32(rng.uniform(0, 1, (3, 1 << 16)) * np.array([[22], [14], [10]])))
    )
    glows = np.array(emission.at_world(p)) > 0
    cell = np.clip(np.floor(np.array(cells.coordinates.point(p))).astype(int), 0, None)
    nz, ny, nx = cells.shape
    index = (np.minimum(cell[2], nz - 1) * ny + np.minimum(cell[1], ny - 1)) * nx
    index = index + np.minimum(cell[0], nx - 1)
    assert glows.sum() > 200 and len(set(cells.shape)) > 1
    assert reached[index[glows]].all()
    assert reached.mean() < 0.5
