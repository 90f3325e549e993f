"""Splitting of paths at surfaces that reflect and transmit: both parts together are the whole."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.render.path_splitting import no_waiting, split
from mitsuba_irrcache.transport.path import sample_bsdf

pytestmark = pytest.mark.usefixtures("mono")

GLASS, ROUGH = {"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.3}
MIRROR = {"type": "conductor"}
BSDFS = {
    "dielectric": GLASS,
    "roughdielectric": ROUGH,
    "thindielectric": {"type": "thindielectric"},
    "mask of a mirror": {"type": "mask", "opacity": 0.3, "nested": MIRROR},
    "mask of a rough mirror": {
        "type": "mask", "opacity": 0.3, "nested": {"type": "roughconductor", "alpha": 0.3},
    },
    "mask of glass": {"type": "mask", "opacity": 0.6, "nested": GLASS},
    "blend of glass and a mirror": {"type": "blendbsdf", "weight": 0.4, "a": GLASS, "b": MIRROR},
    "bumps on glass": {"type": "bumpmap", "scale": 0.05, "nested": ROUGH},
}  # fmt: skip
SAMPLES = 1 << 18


@pytest.mark.parametrize("name", BSDFS)
def test_both_parts_are_what_the_bsdf_scatters(name):
    """Compare moments of the throughput over directions with those without splitting.

    Some BSDFs sample lobes that they were asked to leave out. A masked mirror then transmitted
    twice and reflected nothing.
    """
    bsdf = dict(BSDFS[name])
    if bsdf["type"] == "bumpmap":
        heights = np.random.default_rng(1).random((8, 8, 1), np.float32)
        bsdf["texture"] = {"type": "bitmap", "bitmap": mi.Bitmap(heights), "raw": True}
    scene = mi.load_dict({"type": "scene", "plate": {"type": "rectangle", "bsdf": bsdf}})
    rng = mi.PCG32(SAMPLES)
    x, y = (rng.next_float32() - 0.5 for _ in range(2))
    towards = dr.normalize(mi.Vector3f(0.5, 0.1, -1.0))
    ray = mi.Ray3f(mi.Point3f(x, y, 0) - 2 * towards, towards)
    si, active = scene.ray_intersect(ray), mi.Bool(True)
    sample = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    pointer, throughput = dr.zeros(mi.MediumPtr, SAMPLES), mi.Spectrum(1)
    vertex = dr.zeros(mi.Interaction3f, SAMPLES)
    waiting, found = split(
        no_waiting(ray, pointer), si, (pointer, throughput, mi.Float(1), vertex), sample, active
    )
    parts = [(found[0], dr.select(active, found[1], 0))]
    parts += [(path[0].d, dr.select(taken, path[2], 0)) for taken, *path in waiting]
    whole = sample_bsdf(si, *sample, active)[:2]
    mine, expected = _moments(parts), _moments([whole])
    assert expected[:2].max() > 0
    np.testing.assert_allclose(mine, expected, atol=0.006)


def _moments(parts: list[tuple[mi.Vector3f, mi.Spectrum]]) -> np.ndarray:
    """Return the mean throughput of directions up and down, and its first moments there."""
    sums = np.zeros(8)
    for direction, throughput in parts:
        weight = np.array(throughput, dtype=np.float64).reshape(-1)
        d = np.array(direction, dtype=np.float64)
        for k, side in enumerate((d[2] > 0, d[2] < 0)):
            values = [np.ones(SAMPLES), *d]
            sums[k::2] += [(weight * side * value).mean() for value in values]
    return sums
