"""The sweep is its own transpose; resampling and delta-M scaling have exact ones."""

from __future__ import annotations

from operator import mul

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import Case
from mitsuba_irrcache.gradients.forward_peak import with_forward_peak
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature
from mitsuba_irrcache.gradients.splatting import GridSplat
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives, TransportSettings
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.delta_m import without_forward_peak
from mitsuba_irrcache.scene.compile import compile_scene

pytestmark = pytest.mark.usefixtures("rgb")


def medium_of(case: Case):
    scene = case.load()
    (medium,) = compile_scene(scene).visible
    return scene, medium


SETTINGS = TransportSettings((0, 1), pairs=64, single=False)


def test_a_sweep_is_its_own_transpose():
    """Weighted by the scattering coefficient, for smooth fields."""
    case = Case(data=20, cache=20)
    scene, medium = medium_of(case)
    grid = Grid.near_cubic(medium.frame, 20)
    transport = AdjointTransport(scene, medium, grid, (), SETTINGS)
    ((level, own),) = transport.levels
    table = level.tracks.table(*transport.ordinates.scattering().without_incoming())
    z, y, x = np.mgrid[:20, :20, :20] / 20
    pair = (1 + np.sin(3 * x + y), 1 + np.cos(2 * z - 4 * y))
    fields = [mi.Float(np.repeat(f.ravel(), len(own)).tolist()) for f in pair]
    swept = [level.sweep(field, table)[1] for field in fields]
    first = level._scattered_sums(mul, fields[0], swept[1])
    second = level._scattered_sums(mul, fields[1], swept[0])
    np.testing.assert_allclose(first, second, rtol=2e-3)


def test_a_sweep_of_moments_is_its_own_transpose(mono):
    """What is scattered into each direction is weighted by what comes from the opposite one."""
    case = Case(data=20, cache=20, g=0.4)
    scene, medium = medium_of(case)
    grid = Grid.near_cubic(medium.frame, 20)
    transport = AdjointTransport(scene, medium, grid, (), SETTINGS)
    ((level, _),), scattering = transport.levels, transport.scattering
    table = level.tracks.table(*transport.ordinates.scattering().without_incoming())
    z, y, x = np.mgrid[:20, :20, :20] / 20
    pair = []
    for phase in (0.3, 1.1):
        waves = [
            1 + np.sin(3 * x + phase * y),
            *(0.2 * np.cos(k * y - 2 * z + phase) for k in range(1, scattering.count)),
        ]
        pair.append([mi.Float(wave.ravel().tolist()) for wave in waves])
    swept = [
        scattering.separated(level.sweep(scattering.joined([components]), table)[1], 1)[0]
        for components in pair
    ]
    weight = level.sigma_t * transport.albedo[0]
    sums = [float(dr.sum(weight * scattering.product(pair[i], swept[1 - i]))[0]) for i in (0, 1)]
    assert sums[0] == pytest.approx(sums[1], rel=2e-3)


@pytest.mark.parametrize("count", [8, 5])
def test_delta_m_scaling_has_an_exact_transpose(mono, count):
    """For an albedo on the grid of the extinction, and on another one."""
    _, scaled = medium_of(Case(data=8, cache=8, g=0.7))
    original, rng = scaled.original, np.random.default_rng(5)
    grids = {"sigma_t": original.sigma_t.grid, "albedo": Grid((count,) * 3, scaled.frame)}
    data = {name: rng.uniform(0.3, 0.9, grid.voxel_count) for name, grid in grids.items()}

    def medium(data: dict):
        fields = {n: GridField(grids[n], mi.Float(np.float32(v)), 1) for n, v in data.items()}
        return without_forward_peak(original.replaced(**fields))

    scaled = medium(data)
    # The scaled fields may have finer voxels.
    counts = {name: dr.width(getattr(scaled, name).data) for name in grids}
    worth = {name: rng.uniform(-1, 1, count) for name, count in counts.items()}
    found = {name: mi.Float(np.float32(values)) for name, values in worth.items()}
    found = with_forward_peak(scaled, found, 1, {"sigma_t": 1, "albedo": 1})
    for name, values in data.items():
        step = 0.02 * rng.uniform(-1, 1, len(values))
        ends = [medium(data | {name: values + sign * step}) for sign in (1, -1)]
        above, below = (
            sum(np.array(getattr(end, n).data, dtype=np.float64) @ worth[n] for n in worth)
            for end in ends
        )
        expected = np.array(found[name], dtype=np.float64) @ step
        assert expected == pytest.approx(0.5 * (above - below), rel=2e-3)


@pytest.mark.parametrize(
    "case",
    [
        Case(data=8, cache=8),
        Case(data=16, cache=8),
        Case(data=7, cache=16, turn=30.0),
        Case(data=8, cache=8, shape="sphere"),
    ],
    ids=["same grid", "finer data", "coarser data, turned", "sphere"],
)
def test_resampling_has_an_exact_transpose(case):
    """Sums of derivatives at voxels times means of a perturbation there are sums over the data."""
    _, medium = medium_of(case)
    grid = Grid.near_cubic(medium.frame, case.cache)
    quadrature, count = VoxelQuadrature(medium, grid), grid.voxel_count
    worth = [mi.Float(1 + 0.5 * np.sin(np.arange(count) * (c + 1.0))) for c in range(3)]
    none = [dr.zeros(mi.Float, count)] * 3
    splat = GridSplat(medium.sigma_t.grid, 1, 100.0)
    found = Derivatives(worth, none, none, [])
    quadrature.add(splat, None, found, [mi.Float(0)] * 3)
    data = np.array(medium.sigma_t.data, dtype=np.float64) * medium.sigma_t.scale[0]
    means = np.array(quadrature.extinction(), dtype=np.float64)
    if quadrature.points < 4:  # `extinction` has more points: a grid of so many is needed
        means = means_at(quadrature, medium, grid)
    volume = abs(np.linalg.det(grid.to_world[:3, :3])) / count
    expected = (np.array(worth, dtype=np.float64) * means).sum() * volume
    assert np.array(splat.values(), dtype=np.float64) @ data == pytest.approx(expected, rel=1e-5)


def means_at(quadrature: VoxelQuadrature, medium, grid: Grid) -> np.ndarray:
    """Means of the extinction over the points of ``quadrature``."""
    n, corner = (
        quadrature.points,
        mi.Point3f(*grid.voxel_indices(dr.arange(mi.UInt32, grid.voxel_count))),
    )
    total = np.zeros(grid.voxel_count)
    for z, y, x in np.ndindex(n, n, n):
        p = grid.world.point(corner + mi.Point3f((x + 0.5) / n, (y + 0.5) / n, (z + 0.5) / n))
        total += np.array(medium.sigma_t.at_world(p), dtype=np.float64)
    return np.repeat(total[None] / n**3, 3, axis=0)
