"""Slices of a volume's values in the image."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.io.display import linear
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.picture import Look, Samples
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.slices import Slices
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.scene import SceneSettings
from mitsuba_irrcache.volumes.transfer import DensityMapping

pytestmark = pytest.mark.usefixtures("rgb")


def ray_of(origin: np.ndarray, direction: np.ndarray) -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(direction.tolist()))


@pytest.mark.parametrize("axis", range(3))
def test_slices_lie_where_their_voxels_are(axis):
    """A ray across a voxel of a slice ends at its centre, and sees its value."""
    values = np.random.default_rng(axis).uniform(0, 1, (5, 4, 3)).astype(np.float32)
    axes = np.eye(3)[[1, 0, 2]]
    volume = VolumeData(values, (1, 2, 3), origin=(7, 8, 9), direction=axes)
    share, index = 0.5, [1, 2, 3]
    index[axis] = round(share * (volume.size[axis] - 1))
    centre, away = (volume.index_to_world @ [*index, 1])[:3], axes[axis]
    shares = tuple(share if n == axis else None for n in range(3))
    for direction in (away, -away):
        ray = ray_of(centre - 20 * direction, direction)
        distance, grey = Slices(volume, shares, (0, 1)).intersect(ray)
        assert distance[0] == pytest.approx(20, rel=1e-5)
        assert grey[0] == pytest.approx(values[index[2], index[1], index[0]], abs=1e-5)
    beside = ray_of(centre + 40 * axes[(axis + 1) % 3], away)
    assert Slices(volume, shares, (0, 1)).intersect(beside)[0][0] == np.inf


def test_slices_are_seen_through_the_medium_in_front():
    """Three planes at once: the first one is seen, by the transmittance up to it, whatever the
    exposure is.

    Elsewhere nothing changes.
    """
    values = np.full((8, 8, 8), 0.5, np.float32)
    mapping = DensityMapping(scale=1.0, albedo=(0.5,) * 3)
    settings = SceneSettings(integrator="irrcache", max_depth=2, hide_emitters=True)
    session = Session(Appearance(VolumeData(values), mapping).document(settings))
    session.start()
    try:
        volume = VolumeData(values)
        camera = Camera((3.5, -40.0, 3.5), (3.5, 3.5, 3.5), (0, 0, 1), 20)
        look = Look(exposure=2.0, background=(0.0, 0.0, 1.0))

        def samples(slices: Slices | None) -> Samples:
            found = Samples(session.light.snapshot(True, False), camera, (32, 32), slices=slices)
            found.add(1)
            return found

        def compare() -> None:
            whole = samples(None)
            found = samples(Slices(volume, (None, 1.0, None), (0, 1)))
            # the last of 8 slices: 7.5 voxels of extinction 0.5 are in front of it
            expected = np.exp(-0.5 * 7.5) * linear(0.5)
            np.testing.assert_allclose(found.backdrop(look)[16, 16], expected, rtol=0.02)
            assert 0 < found.image()[16, 16, 1] < whole.image()[16, 16, 1]
            np.testing.assert_array_equal(found.backdrop(look)[0, 0], (0, 0, 1))
            np.testing.assert_array_equal(whole.image()[0, 0], found.image()[0, 0])
            several = samples(Slices(volume, (0.5, 0.0, 1.0), (0, 1)))
            first = several.backdrop(look)[16, 16]  # half a voxel behind the front
            np.testing.assert_allclose(first, np.exp(-0.25) * linear(0.5), rtol=0.02)

        session.call(compare)
    finally:
        session.stop()
