"""Angular moments of the radiance along tracks have the right direction and sign."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.phase import Phase
from mitsuba_irrcache.solvers.discrete_ordinates import antidiffusion
from mitsuba_irrcache.solvers.discrete_ordinates.moments import AnisotropicMultigridLevel, Moments
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import FIXED_POINT_ONE
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks
from tests.support.incoming_radiance import sampled_rays, without_paths

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (5, 7, 5)
MIDDLE = (2, 3, 2)
#: Two per octant, with all dominant axes.
WAYS = np.array(
    [
        s * np.roll([0.8, 0.5, 0.3], k)
        for k in (0, 1, 2)
        for s in np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]])
    ]
)
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)


def moments_of(g: float, order: int = 2) -> Moments:
    return Moments(AngularBasis(Phase(None, g ** np.arange(32), 1.0), []), order)


def lines(extinction: float) -> Tracks:
    grid = Grid(SHAPE, np.diag([1.0, 1.4, 1.0, 1]))
    sigma_t = dr.full(mi.Float, extinction, grid.voxel_count)
    return Tracks(grid, sigma_t, np.zeros(3, int), grid.resolution)


def harmonics(moments: Moments, towards: np.ndarray) -> np.ndarray:
    """Return the contribution of radiance from a direction to each moment."""
    basis = moments.basis(mi.Vector3f(*towards.tolist()))
    return np.array([np.array(y).ravel()[0] for y in basis], np.float64)


@pytest.mark.parametrize("way", WAYS, ids=lambda w: ",".join(f"{x:.1f}" for x in w))
@pytest.mark.parametrize("back", [False, True])
def test_moments_without_extinction(way, back):
    """Moments refer to the direction from which radiance comes, opposite to that of propagation.

    This holds for either direction of a pair and any sign of its largest component.
    """
    moments, light = moments_of(0.5), np.array([[0.0, 2.0]] if back else [[2.0, 0.0]])
    found = moments.sweep_uncollided(lines(0.0), way[None], light, np.array([[0.3, 0.6]]))
    found = np.array(found, np.float64).reshape(moments.count, -1)
    expected = 2 * harmonics(moments, way if back else -way)
    np.testing.assert_allclose(found, np.broadcast_to(expected[:, None], found.shape), atol=1e-5)


def centred(level: AnisotropicMultigridLevel, ways: np.ndarray) -> np.ndarray:
    """Return offsets for which tracks pass through the centre of the central voxel.

    The set of all tracks is then symmetric about it.
    """
    velocities = ways @ level.grid.coordinates.matrix[:3, :3].T
    offsets = []
    for velocity in velocities:
        axis = int(np.abs(velocity).argmax())
        across = [k for k in range(3) if k != axis]
        half = (level.grid.resolution[axis] - 1) / 2
        offsets.append([(0.5 - half * velocity[k] / velocity[axis]) % 1 for k in across])
    return np.array(offsets)


def test_scattering_voxel_radiates_forward(monkeypatch):
    """A voxel with g = 0.5, irradiated from one direction, scatters forward along all tracks.

    Reversing the irradiation mirrors the result; the voxels ahead receive 4 pi p of the angle, and
    so do those behind.
    """
    # Otherwise its neighbours have a source, too.
    monkeypatch.setattr(antidiffusion, "NEGLIGIBLE_DEPTH", np.inf)
    moments, of_matter = moments_of(0.5), lines(0.2)
    fields = (
        dr.full(mi.Float, 0.2, of_matter.active_count),
        dr.full(mi.Float, 1.0, of_matter.active_count),
    )
    level = AnisotropicMultigridLevel(*fields, of_matter, moments=moments)
    ways = WAYS[:15]
    table = ways, np.zeros((15, 2)), np.full(15, 2 * np.pi / 15), centred(level, ways)
    heading, received = np.array([0.6, 0.48, 0.64]), []
    for sign in (1, -1):
        phi = np.zeros((moments.count, *SHAPE))
        phi[(slice(None), *MIDDLE)] = harmonics(moments, -sign * heading)
        light, _ = level.sweep(mi.Float(phi.ravel().tolist()), of_matter.table(*table))
        received.append(np.array(light, np.float64).reshape(phi.shape)[0])
    ahead, behind = received
    np.testing.assert_allclose(np.flip(behind), ahead, rtol=2e-3, atol=1e-5 * ahead.max())
    at = np.moveaxis(np.indices(SHAPE)[::-1], 0, -1) - np.array(MIDDLE)[::-1]
    cosine = (at * level.grid.voxel_size) @ heading
    forwards = (cosine > 0) & (ahead > 0)
    assert ahead[forwards].sum() > 3 * behind[forwards].sum()
    # Tracks receive p truncated to the available moments.
    lit = ahead + behind > 1e-6
    lit[MIDDLE] = False
    share = (ahead - behind)[lit] / (ahead + behind)[lit]
    mean = [(1 + 5 * 0.25 * 0.5 * (3 * c * c - 1), 3 * 0.5 * c) for c in ways @ heading]
    bounds = max(abs(odd / even) for even, odd in mean)
    assert np.abs(share).max() == pytest.approx(bounds, rel=0.05)


def test_paths_continue_their_tracks(scenes, monkeypatch):
    """A path that continues a track passes the centres of all slices at points of the tracks.

    These are a whole number of voxels from the first track.
    """
    without_paths(monkeypatch)
    grid = Grid((12, 10, 8), scenes.placement((1.0, 3.0, 2.0), turn=35))
    lower, upper = np.array([2, 2, 0]), np.array([8, 8, 10])
    tracks = Tracks(grid, dr.zeros(mi.Float, grid.voxel_count), lower, upper)
    offsets = np.random.default_rng(3).random((len(WAYS), 2))
    _, (number, _, hit, ray, _) = sampled_rays(tracks, WAYS, offsets)
    row, hit = np.array(number) // 2, np.array(hit)
    start = np.array(grid.coordinates.point(ray.o), np.float64)[:, hit].T
    velocities = WAYS @ grid.coordinates.matrix[:3, :3].T
    assert hit.sum() > 1000
    for i, velocity in enumerate(velocities):
        own = start[row[hit] == i]
        axis = int(np.abs(velocity).argmax())
        for k, offset in zip([k for k in range(3) if k != axis], offsets[i], strict=True):
            slope = round(velocity[k] / velocity[axis] * FIXED_POINT_ONE) / FIXED_POINT_ONE
            first = own[:, k] + slope * (lower[axis] + 0.5 - own[:, axis])
            away = (first - offset + 0.5) % 1 - 0.5
            assert np.quantile(np.abs(away), 0.95) < 5e-3


def test_any_number_of_ordinates_is_sampled_by_one_kernel(monkeypatch, kernels):
    """Each ordinate is found among 3 and among 15, without compiling the search anew.

    The kernel that traces radiance from surfaces, one of the largest, is compiled once per scene.
    """
    without_paths(monkeypatch)
    tracks, found = lines(0.0), []

    def sample(count: int) -> None:
        offsets = np.full((count, 2), 0.5)
        number, _, hit, ray, _ = sampled_rays(tracks, WAYS[:count], offsets)[1]
        dr.eval(number, hit, ray.d)
        found.append((np.array(number), np.array(hit), np.array(ray.d)))

    sample(3)
    used = kernels(lambda: sample(len(WAYS)))
    sampling = [k for k in used if k["operation_count"] > 100]  # without conversions to NumPy
    assert sampling and all(k["cache_hit"] for k in sampling)
    for count, (number, hit, direction) in zip((3, len(WAYS)), found, strict=True):
        assert set(number[hit]) == set(range(2 * count))
        sign = 1 - 2.0 * (number % 2)
        towards = np.abs((sign * direction * WAYS[number // 2].T).sum(axis=0))
        np.testing.assert_allclose(towards[hit], 1, rtol=1e-5)
