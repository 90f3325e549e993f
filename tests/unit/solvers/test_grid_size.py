"""Defaults for parameters that the user left unset: resolution of the cache, and directions."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumContext, MediumGrid
from mitsuba_irrcache.solvers import grid_size
from mitsuba_irrcache.solvers.base import solver_named
from mitsuba_irrcache.solvers.discrete_ordinates import solver as sn_solver
from mitsuba_irrcache.solvers.grid_size import choose_grid

pytestmark = pytest.mark.usefixtures("rgb")


def medium(values: np.ndarray, edges=(1.0, 1.0, 1.0)) -> MediumGrid:
    """Return a medium of these extinctions (z, y, x) in a box of these edges (x, y, z)."""
    frame = np.diag([*edges, 1.0])
    field = GridField(Grid(values.shape, frame), mi.Float(values.astype(np.float32).ravel()), 1)
    unit = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]])
    boundary = Boundary("box", frame @ np.linalg.inv(unit))
    return MediumGrid(field, ConstantField(np.array([0.5])), boundary)


def chosen(values: np.ndarray, edges=(1.0, 1.0, 1.0), solver="sweep") -> tuple[int, ...]:
    return choose_grid(medium(values, edges), 0, solver_named(solver).size_rule)[0].shape


def in_air(count: int, sigma_t: float) -> np.ndarray:
    """Return a cube of medium surrounded by empty voxels, so that the boundary does not cut it."""
    values = np.zeros((count, count, count))
    inner = slice(count // 8, -(count // 8))
    values[inner, inner, inner] = sigma_t
    return values


def test_thin_media_use_the_resolution_of_the_data():
    assert chosen(in_air(40, 2.0)) == (40, 40, 40)  # optical depth per voxel
    assert chosen(np.zeros((40, 48, 56))) == (40, 48, 56)
    assert chosen(np.full((40, 48, 56), 1.0)) == (40, 48, 56)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (4, 6, 8)])
def test_small_grids_get_more_voxels(shape):
    """Small grids get more voxels: irradiance has more detail than the data, at a negligible
    cost.
    """
    assert chosen(np.full(shape, 1.0)) == (32, 32, 32)
    assert chosen(np.full(shape, 1.0), (1.0, 0.5, 0.25)) == (max(8, shape[0]), 16, 32)


@pytest.mark.parametrize(("sigma_t", "expected"), [(3.0, 48), (0.8, 40), (0.01, 16)])
def test_an_albedo_of_finer_data_is_resolved_where_it_matters(sigma_t, expected):
    """Stripes of albedo in a homogeneous medium were lost between voxels chosen by its depth."""
    frame = np.diag([1.0, 1.0, 1.0, 1.0])
    turned = np.array([[0, 0, 1.0, 0], [0, 1, 0, 0], [-1, 0, 0, 1], [0, 0, 0, 1]])
    for to_world, axis in ((frame, 0), (turned, 2)):
        stripes = np.tile([0.0, 0.9], 24).reshape(48, 1, 1)  # along z of the grid
        albedo = GridField(Grid(stripes.shape, to_world), mi.Float(np.float32(stripes.ravel())), 1)
        extinction = ConstantField(np.array([sigma_t]))
        found = MediumGrid(extinction, albedo, medium(np.ones((1, 1, 1))).boundary)
        shape = choose_grid(found, 0, solver_named("path").size_rule)[0].shape
        assert shape[axis] == expected


def test_long_media_with_surfaces_have_as_many_voxels_as_cubes():
    """A corridor had 11 voxels across, and lamps under its ceiling an error of 12 % in a block."""
    corridor = medium(np.full((1, 1, 1), 0.1), (2.0, 2.0, 8.0))
    rule = solver_named("sweep").size_rule
    assert choose_grid(corridor, 0, rule)[0].shape == (32, 8, 8)
    among = {"is_isolated": False}
    for more, expected in (({}, (80, 20, 20)), ({"holds_emitters": True}, (120, 30, 30))):
        other = corridor.replaced(context=MediumContext(**among, **more))
        assert choose_grid(other, 0, rule)[0].shape == expected
    layer = medium(np.full((1, 1, 1), 0.1), (100.0, 100.0, 1.0))
    layer = layer.replaced(context=MediumContext(**among))
    assert choose_grid(layer, 0, rule)[0].shape == (1, 128, 128)


def test_dense_grids_are_refined_by_optical_depth():
    """Dense grids are refined per axis by the optical depth, by a factor of eight at most, which
    is even from four on; opaque ones by ten.

    For ``path`` they are not, since its noise exceeds the discretisation error.
    """
    thin, dense, opaque = (chosen(in_air(40, 40 * depth)) for depth in (0.1, 1.0, 1000.0))
    assert thin == (40, 40, 40)
    assert dense == (64, 64, 64)  # 1 / 0.7 for each data voxel would be 57
    assert chosen(in_air(40, 48.0)) == (68, 68, 68)
    assert chosen(in_air(40, 40.0 * 1.2 * 4)) == (127, 127, 127)  # 4^0.45 times as many
    assert chosen(in_air(40, 40 * 59.0)) == (256, 256, 256)  # 2^24 voxels
    assert opaque == (322, 322, 322)  # 2^25
    assert chosen(in_air(20, 20 * 59.0)) == (160, 160, 160)
    assert chosen(in_air(20, 20000.0)) == (200, 200, 200)
    assert chosen(in_air(40, 40000.0), solver="path") == (40, 40, 40)
    assert chosen(np.full((4, 4, 4), 500.0), solver="path") == (32, 32, 32)
    assert chosen(np.full((1, 1, 1), 1.0), solver="path") == (16, 16, 16)


def test_contrast_and_a_cut_boundary_need_more_voxels():
    """High contrast requires five voxels per mean free path, up to 64; a cut boundary up to 128."""
    speck = np.zeros((4, 4, 4))
    speck[1:3, 1:3, 1:3] = 8.0
    assert chosen(speck) == (40, 40, 40)
    assert chosen(100 * speck) == (64, 64, 64)
    assert chosen(np.full((4, 4, 4), 15.0)) == (75, 75, 75)
    assert chosen(np.full((4, 4, 4), 500.0)) == (128, 128, 128)


def test_homogeneous_media_get_the_resolution_of_an_equal_grid():
    """A homogeneous medium gets the resolution of the same medium on a grid."""
    rule = solver_named("sweep").size_rule
    for sigma_t in (0.5, 10.0, 1000.0):
        grid = medium(np.full((4, 4, 4), sigma_t))
        same = MediumGrid(ConstantField(np.array([sigma_t])), grid.albedo, grid.boundary)
        shapes = [choose_grid(m, 0, rule)[0].shape for m in (same, grid)]
        assert shapes[0] == shapes[1]


def test_resolution_depends_on_where_collisions_happen():
    """The resolution depends on the extinction where collisions happen, not on the volume's
    mean.
    """
    values = np.full((40, 40, 40), 0.01)
    values[16:24, 16:24, 16:24] = 40.0
    assert chosen(values) == (64, 64, 64)


@pytest.mark.parametrize(
    ("sizes", "data", "expected"),
    [
        ((), 1, 50),
        ((6.0,), 1, 71),  # an object of 6 % of the side in a haze of optical depth 10
        ((6.0, 60.0), 1, 71),
        ((60.0,), 1, 50),  # voxels resolve it already
        ((4.0,), 1, 50),  # smaller than is considered
        ((6.0,), 4, 64),  # it may lie in a part of the data that is empty
    ],
)
def test_voxels_resolve_the_shadows_of_objects(sizes, data, expected):
    """A floor of three voxels in homogeneous haze, seen from close by, had an error of 3 %."""
    values = np.full((data,) * 3, 0.1)
    haze = medium(values, (100.0,) * 3).replaced(context=MediumContext(object_sizes=sizes))
    if data == 1:
        haze = haze.replaced(sigma_t=ConstantField(np.array([0.1])))
    shape = choose_grid(haze, 0, solver_named("sweep").size_rule)[0].shape
    assert shape == (expected,) * 3


def test_finer_voxels_have_a_limit(monkeypatch):
    monkeypatch.setattr(grid_size, "MOST_REFINED", 70000)
    assert chosen(in_air(40, 40 * 59.0)) == (41, 41, 41)
    monkeypatch.setattr(grid_size, "MOST_IN_OPAQUE_DATA", 80000)
    assert chosen(in_air(40, 40000.0)) == (43, 43, 43)
    monkeypatch.setattr(grid_size, "MOST_VOXELS", 30000)
    assert chosen(in_air(40, 40000.0)) == (31, 31, 31)


@pytest.mark.parametrize(
    ("samples", "batch"),
    [(1, 32), (32, 32), (33, 64), (96, 96), (128, 128), (256, 256), (257, 160), (1000, 256)],
)
def test_size_of_batches(samples, batch):
    """A batch holds all directions, or equal parts of up to 256."""
    assert sn_solver.batch_of(samples, sn_solver.SMALLEST_BATCH) == batch


def soft(count: int, sigma_t: float) -> np.ndarray:
    """Return a blob whose extinction decays smoothly to all sides."""
    at = (np.arange(count) + 0.5) / count * 2 - 1
    x, y, z = np.meshgrid(at, at, at)
    return sigma_t * np.exp(-8 * (x * x + y * y + z * z))


def in_light(values: np.ndarray, detail: Detail, **changes) -> tuple[int, ...]:
    lit = medium(values).replaced(context=MediumContext(detail=detail), **changes)
    return choose_grid(lit, 0, solver_named("sweep").size_rule)[0].shape


def test_voxels_are_larger_in_smooth_light():
    """They are where data are smooth and no voxel is dense, in light that has no sharp shadows."""
    rough = np.random.default_rng(1).uniform(0, 10, (72, 72, 72)) * (soft(72, 1.0) > 0.1)
    for detail in (Detail.UNIFORM, Detail.SMOOTH):
        assert in_light(soft(72, 5.0), detail) == (32, 32, 32)
        assert in_light(np.zeros((72, 96, 80)), detail) == (32, 42, 35)
        assert in_light(rough, detail) == (72, 72, 72)
        assert 32 < in_light(soft(72, 150.0), detail)[0] < chosen(soft(72, 150.0))[0]
    for values in (soft(72, 5.0), rough, soft(72, 150.0)):
        assert in_light(values, Detail.SHARP) == chosen(values)


def test_a_cut_boundary_needs_fewer_voxels_in_smooth_light():
    """Where nothing casts sharp shadows, the error at the boundary decreases faster with voxels."""
    cut, bright = np.full((4, 4, 4), 15.0), ConstantField(np.array([0.95]))
    assert in_light(cut, Detail.SHARP) == (75, 75, 75)
    assert in_light(cut, Detail.SMOOTH, albedo=bright) == (45, 45, 45)
    assert in_light(cut, Detail.SMOOTH, albedo=ConstantField(np.array([0.85]))) == (75, 75, 75)
    smooth = {"context": MediumContext(detail=Detail.SMOOTH), "albedo": bright}
    matter = medium(np.full((4, 4, 4), 36.0)).replaced(**smooth)
    grid, _ = choose_grid(matter, 0, solver_named("sweep").size_rule)
    assert grid.shape == (108, 108, 108)
    assert grid_size.border_error(matter, grid) == pytest.approx(0.5, rel=0.02)  # rounded down
    # Estimates are never larger than without smooth light.
    coarse = Grid((2, 2, 2), np.eye(4))
    sharp = medium(np.full((4, 4, 4), 600.0)).replaced(albedo=bright)
    matter = sharp.replaced(**smooth)
    assert grid_size.border_error(matter, coarse) == grid_size.border_error(sharp, coarse)


def test_albedos_with_detail_need_voxels_in_smooth_light():
    values = np.random.default_rng(2).uniform(0, 1, 72**3).astype(np.float32)
    grid = Grid((72, 72, 72), np.eye(4))
    albedo = GridField(grid, mi.Float(values), 1)
    thin = soft(72, 5.0)
    assert in_light(thin, Detail.SMOOTH, albedo=albedo)[0] > in_light(thin, Detail.SMOOTH)[0]


def test_directions_by_default(scenes):
    """The default is 128 directions in one batch, twice as many for single scattering, half as many
    for all orders in uniform light.

    If an error estimate is required, there are two batches; directions requested later count.
    """
    shape = scenes.boundary(scenes.medium(scenes.texture((4, 4, 4), 0.5, 3.0, 1), 0.9))
    uniform = {"emitter": {"type": "constant"}}
    for wanted, asked, expected in (
        ({}, 0, (128, 128)),
        ({"max_depth": 2}, 0, (256, 256)),
        (uniform, 0, (64, 64)),
        (uniform | {"max_depth": 2}, 0, (256, 256)),
        ({"filter": "bilateral"}, 0, (128, 64)),
        ({}, 64, (64, 64)),
    ):
        settings = {"type": "irrcache", "max_depth": -1, "solver": "auto"} | wanted
        light = {key: settings.pop(key) for key in uniform if key in settings}
        scene = scenes.load(settings, shape, size=2, **light)
        if asked:
            scene.integrator().cache_spp = asked
        scene.integrator().prepare(scene)
        cache = scene.integrator().cache
        assert (cache.samples, cache.batch) == expected


@pytest.mark.parametrize(
    ("count", "depth", "max_depth", "warns"),
    [
        (64, 20.0, -1, True),  # 5 voxels for each 4 of the data
        (64, 20.0, 2, False),
        (16, 150.0, -1, True),  # 10 voxels along each data voxel, of depth 15
        (16, 80.0, -1, False),  # of depth 8
        (16, 30.0, -1, False),  # 6 voxels, of depth 5
        (64, 2.0, -1, False),
    ],
)
def test_opaque_voxels_are_announced(count, depth, max_depth, warns, monkeypatch):
    """A cache that is too coarse for opaque data, because of its number of voxels, says so."""
    monkeypatch.setattr(grid_size, "MOST_REFINED", 80**3 if count == 64 else 1 << 24)
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append((level, text)))
    dense = medium(in_air(count, count * depth))
    grid, _ = choose_grid(dense, 0, solver_named("sweep").size_rule)
    grid_size.warn_of_opaque_voxels(dense, grid, max_depth)
    assert bool(messages) is warns
    assert all(level == mi.LogLevel.Warn and "Raise resolution" in t for level, t in messages)


@pytest.mark.parametrize(
    ("size", "sigma_t", "voxels", "error"),
    [(10.0, 0.1, 20, 6), (10.0, 0.1, 64, None), (10.0, 0.003, 20, None), (2.0, 0.1, 20, None)],
)
def test_voxels_that_are_large_beside_surfaces_are_announced(
    size, sigma_t, voxels, error, monkeypatch
):
    """Shadows of large surfaces in haze need voxels of a part of their size; thin haze and small
    surfaces do not.
    """
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    sparse = medium(np.full((2, 2, 2), sigma_t), (100.0,) * 3)
    sparse = sparse.replaced(context=MediumContext(object_sizes=(size,)))
    grid_size.warn_of_unresolved_objects(sparse, Grid((voxels,) * 3, sparse.frame))
    assert not messages
    haze = sparse.replaced(sigma_t=ConstantField(np.array([sigma_t])))
    grid_size.warn_of_unresolved_objects(haze, Grid((voxels,) * 3, haze.frame))
    assert len(messages) == (error is not None)
    assert all(f"errors of about {error} %" in text for text in messages)


def specks(count: int, sigma_t: float) -> np.ndarray:
    """Return single dense voxels in air."""
    rng = np.random.default_rng(3)
    return np.where(rng.random((count,) * 3) < 0.004, sigma_t, 0.0)


def test_the_border_is_as_dense_as_the_densest_channel():
    """Blue matter is as opaque at its boundary as grey matter of the same maximum."""

    def error(rgb: list[float]) -> float:
        frame = np.eye(4)
        values = mi.Float(np.tile(rgb, 8).astype(np.float32))
        field = GridField(Grid((2, 2, 2), frame), values, 3)
        boundary = medium(np.ones((2, 2, 2))).boundary
        matter = MediumGrid(field, ConstantField(np.array([0.5])), boundary)
        return grid_size.border_error(matter, Grid((8, 8, 8), frame))

    assert error([0.1, 0.1, 4.0]) == pytest.approx(error([4.0, 4.0, 4.0]))
    assert error([4.0, 0.1, 0.1]) == pytest.approx(grid_size.BORDER_ERROR * 0.5**1.2)


def test_the_border_of_a_sphere_is_its_surface():
    """Matter that ends at a sphere is dense at the boundary, although its box has empty faces."""
    z, y, x = np.meshgrid(*[(np.arange(64) + 0.5) / 32 - 1] * 3, indexing="ij")
    values = np.where(x * x + y * y + z * z < 1.03, 8.0, 0.0) * (abs(x) < 0.9)
    cube = medium(values)
    sphere = cube.replaced(boundary=Boundary("sphere", cube.boundary.to_world))
    voxels = Grid((16, 16, 16), np.eye(4))
    assert grid_size.border_error(cube, voxels) < 0.1 * grid_size.border_error(sphere, voxels)
    expected = 6 * 0.5**0.5 * 0.5**1.4  # an albedo and a depth per voxel of 0.5
    assert grid_size.border_error(sphere, voxels) == pytest.approx(expected, rel=0.1)
    single = grid_size.border_error(sphere, voxels, max_depth=2)
    assert single == pytest.approx(6 * 0.5**1.4, rel=0.1)


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize(("max_depth", "sigma_t"), [(-1, 9.0), (-1, 3.0), (2, 9.0)])
def test_meshes_that_cut_dense_voxels_are_announced(monkeypatch, exact, max_depth, sigma_t):
    """Under a sun, several orders of scattering in a prism are 2.8 % too dark with 0.14 optical
    depths per voxel.
    """
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    matter = medium(np.full((2, 2, 2), sigma_t))
    matter = matter.replaced(context=MediumContext(has_exact_boundary=exact))
    grid_size.warn_of_dense_border(matter, Grid((64, 64, 64), np.eye(4)), max_depth)
    assert bool(messages) is (not exact and max_depth == -1 and sigma_t > 6)


def test_dense_detail_needs_more_voxels():
    """Single dense voxels need more voxels than even matter of the same extinction; thin ones do
    not, nor does `path`, whose noise is larger.
    """
    for depth, finer in ((0.1, False), (1.0, True)):
        sizes = [max(chosen(of(40, 40 * depth))) for of in (specks, in_air)]
        assert (sizes[0] > 1.2 * sizes[1]) is finer
    assert chosen(specks(40, 40.0), solver="path") == (40, 40, 40)


def test_unresolved_detail_is_announced(monkeypatch):
    """A cache that cannot be fine enough says so, with the error that is expected."""
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append((level, text)))
    monkeypatch.setattr(grid_size, "MOST_FOR_DETAIL", 40**3)
    for values, warns in ((specks(40, 40.0), True), (soft(40, 40.0), False)):
        messages.clear()
        grid, _ = choose_grid(medium(values), 0, solver_named("sweep").size_rule)
        grid_size.warn_of_unresolved_detail(medium(values), grid)
        assert bool(messages) is warns
    assert all("% of the mean is expected" in text for _, text in messages)
