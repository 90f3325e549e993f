"""What a cache and the integrator show in a terminal and in a notebook."""

from __future__ import annotations

import base64
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (4, 6, 8)
IMAGE = re.compile(
    r'<img src="data:image/png;base64,([^"]+)" width="(\d+)" height="(\d+)".*?alt="([^"]+)"'
)


def filled(batches: int) -> IrradianceCache:
    """Return a cache of voxels with edges 1, 2, 3 whose irradiance is 1 + x index."""
    to_world = np.diag([8.0, 12.0, 12.0, 1.0])
    cache = IrradianceCache(Grid(SHAPE, to_world), dr.arange(mi.UInt32, 192), 1, -1)
    values = 1.0 + np.arange(192) % 8
    double = dr.float64_array_t(mi.Float)
    for number in range(batches):
        deviation = 0.1 * (-1) ** number
        totals = [double((values + deviation).tolist()), double(np.zeros(192).tolist())]
        cache.add(0, 8, [(totals, [double(np.zeros(192).tolist())])])
    return cache


def images(text: str) -> dict[str, np.ndarray]:
    """Return the images of a page by their alternative text, and check their shapes."""
    found = {}
    for data, width, height, about in IMAGE.findall(text):
        stream = mi.MemoryStream()
        content = base64.b64decode(data)
        stream.write(content)
        stream.seek(0)
        found[about] = np.array(mi.Bitmap(stream)).astype(float)
        found[about, "aspect"] = int(width) / int(height)
    return found


def test_text_states_grid_samples_and_error():
    text = repr(filled(2))
    assert text.startswith("IrradianceCache[\n") and text.endswith("\n]")
    for part in (
        "voxels = 8 x 6 x 4, of 1 x 2 x 3",
        "active = 192 (100.0%)",
        "samples = 16 per voxel, in 1 stream(s)",
        "irradiance = mean 4.5, maximum 8",
    ):
        assert part in text
    error = float(re.search(r"relative error = ([\d.]+)%", text)[1])
    assert error == pytest.approx(100 * filled(2).relative_error, abs=0.01) and error > 1


def test_text_of_caches_without_an_error():
    assert "relative error = unknown" in repr(filled(1))
    empty = repr(filled(0))
    assert "samples = 0 per voxel" in empty and "error" not in empty and "mean" not in empty


def test_notebooks_show_slices_the_right_way_up():
    found = images(filled(2)._repr_html_())
    across = found["irradiance, slice z = 2"]
    assert across.shape[:2] == SHAPE[1:]  # rows y, columns x
    assert (np.diff(across[0, :, 0]) > 0).all()  # brighter with x
    assert found["irradiance, slice z = 2", "aspect"] == pytest.approx(8 / 12, rel=0.02)
    assert found["irradiance, slice x = 4", "aspect"] == pytest.approx(1.0, rel=0.02)
    assert found["irradiance, slice y = 3"].shape[:2] == (SHAPE[0], SHAPE[2])
    relative = found["relative standard error, slice z = 2"]
    assert (np.diff(relative[0, :, 0]) < 0).all()  # the same error of a brighter voxel
    assert "relative standard error" not in filled(1)._repr_html_()
    assert not images(filled(0)._repr_html_())


def test_integrator_shows_properties_and_caches(scenes):
    to_world = scenes.placement((2.0, 1.0, 1.5))
    shape = scenes.boundary(scenes.medium(scenes.texture((4, 3, 5), 0.1, 2.0, 1), 0.8), to_world)
    scene = scenes.load({"type": "irrcache", "solver": "auto", "resolution": 6}, shape)
    integrator = scene.integrator()
    assert "resolution = 6" in integrator._repr_html_() and not images(integrator._repr_html_())
    integrator.prepare(scene)
    text = integrator._repr_html_()
    assert "IrradianceCache" in text and len(images(text)) >= 6
