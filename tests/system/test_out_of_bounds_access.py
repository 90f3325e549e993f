"""No kernel accesses memory outside of its arrays, as checked by Dr.Jit's debug mode.

Values from there are arbitrary: with a weight of 0 they change nothing, unless they are NaN.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.packed_fields import Lookups
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.scene.cut_cells import CutCells

pytestmark = pytest.mark.usefixtures("rgb")


def test_debug_mode_detects_an_access(out_of_bounds):
    """Debug mode detects a gather and a scatter beyond the end of an array."""
    values = mi.Float([1, 2, 3, 4])
    assert out_of_bounds(lambda: dr.eval(dr.gather(mi.Float, values, mi.UInt32([1, 4]))))
    assert out_of_bounds(
        lambda: dr.scatter(values, mi.Float(1), mi.UInt32([1, 9])) or dr.eval(values)
    )


@pytest.mark.parametrize("shape", [(4, 5, 6), (1, 7, 1), (1, 1, 1)], ids=str)
def test_lookups(out_of_bounds, shape):
    """Lookups of one and two fields stay in bounds inside, on the border and outside of the
    grid.
    """
    grid, rng = Grid(shape, np.eye(4)), np.random.default_rng(1)
    count = grid.voxel_count
    grey = GridField(grid, mi.Float(np.float32(rng.random(count))), 1)
    colour = GridField(grid, mi.Float(np.float32(rng.random(3 * count))), 3)
    places = rng.choice([-0.5, 0.0, 0.3, 0.999999, 1.0, 1.5], (3, 2000))
    p = mi.Point3f(np.float32(places))

    def action() -> None:
        for fields in ([grey], [grey, colour]):
            dr.eval(Lookups(fields).at_world(p, mi.Bool(True)))
            dr.eval([field.at_world(p) for field in fields])

    assert not out_of_bounds(action)


def test_lookups_in_cut_cells(out_of_bounds):
    """Lookups in cut cells stay in bounds, up to the last corner of the grid and beyond."""
    grid, rng = Grid((3, 4, 5), np.eye(4)), np.random.default_rng(2)
    ball = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.6}
    edges = CutCells(mi.load_dict({"type": "scene", "ball": ball}), grid)
    field = RootField(grid, mi.Float(np.float32(rng.random(60) + 0.5)), 1)
    p = mi.Point3f(np.float32(rng.choice([-0.5, 0.0, 0.4, 1.0, 1.2, 1.5], (3, 500))))
    active = dr.full(mi.Bool, True, 500)
    assert not out_of_bounds(lambda: dr.eval(edges.corrected(field, p, field.at_world(p), active)))


HG = {"type": "hg", "g": 0.5}
SCENES = {
    "single scattering": ({"max_depth": 2}, {}, {}),
    "by direction": ({}, {"phase": HG}, {}),
    "with layers": ({"aovs": "noise,bias,depth", "filter": "bilateral"}, {}, {}),
    "path": ({"solver": "path", "max_depth": 3, "aovs": "noise"}, {}, {}),
    "lamp inside": (
        {}, {}, {"emitter": {"type": "point", "position": [0.3, 0.2, 0.1], "intensity": 2.0}},
    ),
    "surfaces": ({}, {}, {"ball": {"type": "sphere", "center": [0, -2.2, 0], "radius": 1.0}}),
}  # fmt: skip


@pytest.mark.parametrize(("settings", "medium", "objects"), SCENES.values(), ids=SCENES)
def test_images(scenes, out_of_bounds, settings, medium, objects):
    """Rendering stays in bounds for odd grid sizes, with a rotated sparse cloud of oblong
    voxels.
    """
    density = scenes.texture((7, 5, 9), 0.0, 4.0, 3)
    density[:3, :3] = 0
    place = scenes.placement((2.0, 1.5, 1.0), turn=20)
    albedo = scenes.texture((7, 5, 9, 3), 0.5, 1.0, 4)
    shape = scenes.boundary(scenes.medium(density, albedo, place, **medium), place)
    integrator = {"type": "irrcache", "solver": "auto", "resolution": 11, "cache_spp": 128}
    if settings.get("solver") == "path":
        integrator["cache_spp"] = 16
    scene = scenes.load(integrator | settings, shape, 6, **objects, default_solver="path")
    assert not out_of_bounds(lambda: scenes.image(scene, spp=2))
