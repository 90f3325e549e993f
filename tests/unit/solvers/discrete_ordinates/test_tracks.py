"""Sweeps along parallel tracks, compared with NumPy track by track."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates import tracks
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import FIXED_POINT_ONE
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import SweptBox, Tracks, values_at_centres

SHAPES = [(8, 8, 8), (7, 12, 5), (1, 6, 9), (5, 1, 1), (9, 4, 1)]
#: Directions along axes, edges and diagonals, almost along them, and between.
DIRECTIONS = np.array(
    [
        [1, 0, 0],
        [0, 0, 1],
        [0, 1, -1],
        [1, -1, 1],
        [1, 1e-9, -1e-7],
        [-1e-4, 1, 1e-6],
        [1, 0.9999999, 0.3],
        [0.2, -0.7, -0.5],
        [0.6, 0.1, 0.2],
        [-0.3, 0.4, 0.8],
    ]
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@pytest.fixture(params=["together", "apart"], autouse=True)
def mode(request, monkeypatch, rgb):
    """Launch all directions at once, or one by one, with voxels accumulating over tracks."""
    monkeypatch.setattr(tracks, "SECOND_DIFFERENCE", 0.0)
    if request.param == "apart":
        monkeypatch.setattr(tracks, "SMALL_GRID", 0)
    return request.param


def offsets(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((count, 2))


def lines(grid: Grid, sigma_t, box=None) -> Tracks:
    """Return the tracks of a medium (z, y, x), in a box (lower, upper) of (x, y, z)."""
    values = np.broadcast_to(np.float32(sigma_t), grid.shape).ravel()
    lower, upper = ([0, 0, 0], grid.resolution) if box is None else box
    return Tracks(grid, mi.Float(values), np.array(lower), np.array(upper))


def carried(lines: Tracks, light, places: np.ndarray, directions=DIRECTIONS) -> np.ndarray:
    """Return the irradiance (z, y, x) of radiance (n, 2) along pairs of directions."""
    light = np.broadcast_to(light, (len(directions), 2))
    volume = lines.uncollided(directions, light, places)
    return np.array(volume, dtype=np.float64).reshape(lines.grid.shape)


def passages(grid: Grid, direction: np.ndarray, offset, box=None) -> np.ndarray:
    """Return where the track of each voxel crosses its middle slice: voxel coordinates (z, y, x,
    3).
    """
    lower = np.zeros(3, int) if box is None else np.array(box[0])
    velocity = grid.coordinates.matrix[:3, :3] @ direction
    axis = int(np.abs(velocity).argmax())
    at = np.moveaxis(np.indices(grid.shape)[::-1], 0, -1) + 0.5
    for k, start in zip([k for k in range(3) if k != axis], offset, strict=True):
        slope = round(velocity[k] / velocity[axis] * FIXED_POINT_ONE) or 1
        steps = (at[..., axis] - 0.5 - lower[axis]).astype(int)
        at[..., k] += (
            int(start * FIXED_POINT_ONE) + steps * slope
        ) % FIXED_POINT_ONE / FIXED_POINT_ONE - 0.5
    return at


def lengths(grid: Grid, at: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the world distance from points ``at`` back along ``direction`` to the side of
    entry.
    """
    velocity = grid.coordinates.matrix[:3, :3] @ direction
    ways = [
        (at[..., k] - (0 if v > 0 else grid.resolution[k])) / v
        for k, v in enumerate(velocity)
        if abs(v) > 1e-12
    ]
    return np.min(ways, axis=0)


# Positions of tracks


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_each_voxel_is_crossed_once_per_direction(shape):
    """Each voxel is crossed exactly once per direction.

    Each direction carries its own power of two without extinction, so that the sum identifies
    directions that are missing or counted twice.
    """
    light = 2.0 ** np.arange(2 * len(DIRECTIONS)).reshape(-1, 2)
    for seed in range(3):
        places = np.round(offsets(len(DIRECTIONS), seed) * 4) / 4 if seed else offsets(10)
        places = np.minimum(places, 1 - 2**-30)
        found = carried(lines(Grid(shape, np.eye(4)), 0.0), light, places)
        np.testing.assert_array_equal(found, light.sum())


def test_each_voxel_of_a_box_is_crossed_once_per_direction(scenes):
    """In a rotated, stretched, mirrored grid, each voxel of the box is crossed once per
    direction.

    Nothing is written outside of the box.
    """
    grid = Grid((9, 8, 7), scenes.placement((1.0, 3.0, 0.5), turn=35, mirror=True))
    light = 2.0 ** np.arange(2 * len(DIRECTIONS)).reshape(-1, 2)
    box = (2, 1, 3), (6, 7, 8)
    expected = np.zeros(grid.shape)
    expected[3:8, 1:7, 2:6] = light.sum()
    found = carried(lines(grid, 0.0, box), light, offsets(len(DIRECTIONS), 1))
    np.testing.assert_array_equal(found, expected)


def test_launches_per_batch(mode, kernels):
    """The number of launches per batch is bounded.

    Eight pairs at once take a launch per axis and one to add up; otherwise one per pair, and one
    per axis for its corners. One per axis sharpens, and one restores the order of slices.
    """
    grid = Grid((8, 8, 8), np.eye(4))
    medium = lines(grid, 1.0)
    carried(medium, 1.0, offsets(8), DIRECTIONS[2:])
    history = kernels(lambda: carried(medium, 1.0, offsets(8, 5), DIRECTIONS[2:]))
    launches = [k for k in history if k["size"] >= grid.voxel_count // 8]
    assert len(launches) <= (10 if mode == "together" else 15)
    assert all(k["cache_hit"] for k in history)


# Attenuation


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("depth", [0.05, 0.31, 1.25])
def test_homogeneous_medium_is_exact_along_each_track(scenes, shape, depth):
    """In a homogeneous medium, transmittance is exp(-sigma_t d) from the exact point of entry.

    It is compared for each direction and voxel; ``depth`` is the optical depth of a voxel. A track
    that enters at the slice instead of between two is off by up to ``depth`` / 2.
    """
    edges = np.array(shape[::-1]) * [0.1, 0.13, 0.08]
    grid = Grid(shape, scenes.placement(edges, turn=20))
    sigma_t, places = depth / 0.1, offsets(len(DIRECTIONS), 2)
    medium = lines(grid, sigma_t)
    for d, place in zip(DIRECTIONS, places, strict=True):
        at = passages(grid, d, place)
        for light, way in (([[1, 0]], d), ([[0, 1]], -d)):
            expected = np.exp(-sigma_t * lengths(grid, at, way))
            found = carried(medium, light, place[None], d[None])
            # Positions are known to 2^-24 of a voxel, and so are slopes: a near-axis track enters
            # late.
            near_axis = (np.abs(way) < 1e-5).any() and (np.abs(way) > 0).all()
            if not near_axis:
                np.testing.assert_allclose(found, expected, rtol=3e-5, atol=1e-7)
            else:
                np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-4)


def smooth(p: np.ndarray) -> np.ndarray:
    """Return the extinction at points (..., 3) of the unit cube; nonzero at its sides."""
    x, y, z = np.moveaxis(p, -1, 0)
    return 5 * (1 + 0.5 * np.sin(4 * x + 1) * np.cos(3 * y) + 0.4 * z * np.sin(5 * z + x))


def test_heterogeneous_medium_is_of_order_two():
    """In a smooth medium, the error decreases with the square of the voxel size.

    The reference is a fine march through the smooth medium along the tracks; mean and RMS error
    over voxels and directions are compared. Entering at slices instead of between is of order 1.
    """
    errors = []
    directions = DIRECTIONS[[3, 7, 8, 9]]
    for n in (8, 16, 32):
        grid = Grid((n, n, n), np.eye(4))
        centres = np.moveaxis(np.indices(grid.shape)[::-1] + 0.5, 0, -1) / n
        medium = lines(grid, smooth(centres))
        off = []
        for d, place in zip(directions, offsets(len(directions), 3), strict=True):
            at = passages(grid, d, place)[:: n // 8, :: n // 8, :: n // 8]
            for light, way in (([[1, 0]], d), ([[0, 1]], -d)):
                length = lengths(grid, at, way)
                steps = (np.arange(200) + 0.5) / 200 * length[..., None]
                march = smooth(at[..., None, :] / n - steps[..., None] * way).mean(axis=-1) * length
                found = carried(medium, light, place[None], d[None])
                off.append(found[:: n // 8, :: n // 8, :: n // 8] / np.exp(-march) - 1)
        errors.append((abs(np.mean(off)), np.sqrt(np.mean(np.square(off)))))
    (_, coarse), (_, middle), (mean, fine) = errors
    assert np.log2(coarse / middle) > 1.6 and np.log2(middle / fine) > 1.6
    assert fine < 5e-3 and mean < 2e-3


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [0, -1])
def test_no_shadow_through_the_opposite_face(axis, side):
    """An opaque voxel beside a face shadows only voxels behind it on the same track.

    A track is attenuated if and only if it passed that voxel's slice within a voxel of its centre
    *after* its entry. Tracks that leave continue at the opposite side, where a shadow must not
    persist.
    """
    grid = Grid((9, 9, 9), np.eye(4))
    dense = np.full(3, 4)
    dense[axis] = 0 if side == 0 else 8
    sigma_t = np.zeros(grid.shape)
    sigma_t[tuple(dense[::-1])] = 1e5
    medium = lines(grid, sigma_t)
    shadows = 0
    for d, place in zip(DIRECTIONS, offsets(len(DIRECTIONS), 4), strict=True):
        at = passages(grid, d, place)
        main = int(np.abs(d).argmax())
        for light, way in (([[1, 0]], d), ([[0, 1]], -d)):
            found = carried(medium, light, place[None], d[None])
            back = (at[..., main] - dense[main] - 0.5) / way[main]  # since the dense slice
            crossing = at - back[..., None] * way
            across = np.delete(crossing - dense - 0.5, main, axis=-1)
            inside = ((crossing > -0.5) & (crossing < 9.5)).all(axis=-1)
            shadow = (back >= 0) & (np.abs(across) < 1 + 1e-5).all(axis=-1) & inside
            np.testing.assert_array_equal(found[~shadow], 1.0)
            shadows += (found < 0.1).sum()
    assert shadows > 100


def test_both_modes_agree(monkeypatch):
    """Both launch modes agree on a random medium in a cropped box.

    Irradiance agrees to rounding, and so do all tallies of scattered radiance.
    """
    grid = Grid((7, 12, 5), np.eye(4))
    rng = np.random.default_rng(6)
    sigma_t, source = rng.exponential(8.0, grid.shape), rng.random(grid.voxel_count)
    box = (1, 2, 0), (5, 11, 6)
    places = offsets(len(DIRECTIONS), 6)
    light, weights = rng.random((10, 2)), rng.random(10)
    results = []
    for small in (0, 40**3):
        monkeypatch.setattr(tracks, "SMALL_GRID", small)
        medium = lines(grid, sigma_t, box)
        assert medium.one_launch == (small > 0)
        volume = np.zeros((grid.voxel_count, 4), np.float32)
        volume[:, 0] = source
        volume = mi.Float(volume.ravel())
        medium.sweep(volume, medium.table(DIRECTIONS, light, weights, places))
        results.append((carried(medium, light, places), np.array(volume).reshape(-1, 4)))
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=3e-6)
    np.testing.assert_allclose(results[0][1], results[1][1], rtol=2e-5, atol=1e-6)


# Quantised extinction


def test_quantisation_is_exact_at_zero_and_maximum():
    """Quantisation represents zero and the maximum exactly.

    Half of a grid is empty, the other half has the largest extinction: the irradiance has full
    precision in both.
    """
    grid = Grid((6, 4, 4), np.eye(4))
    sigma_t = np.zeros(grid.shape)
    sigma_t[3:] = 7.3
    sigma_t[5, 0, 0] = 7.2
    found = carried(lines(grid, sigma_t), [[1, 0]], np.zeros((1, 2)), np.array([[0.0, 0, 1]]))
    np.testing.assert_array_equal(found[:3], 1.0)
    expected = np.exp(-7.3 / 6 * np.array([0.5, 1.5]))
    np.testing.assert_allclose(
        found[3:5, 2:, 2:], expected[:, None, None] * np.ones((2, 2, 2)), 2e-6
    )


def test_quantisation_preserves_fog_beside_an_opaque_voxel():
    """Quantisation preserves thin fog in a grid with an opaque voxel.

    The fog has an optical depth of 1e-3, the voxel of 1e6 lies beside the tracks: transmittance is
    accurate to 2e-3 along each track, and its mean over 900 tracks to 5 % of the loss. Rounding
    down, or to the nearest level of the densest voxel, would remove the fog.
    """
    grid = Grid((32, 32, 64), np.eye(4))
    sigma_t = np.full(grid.shape, 1e-3)
    sigma_t[0, 0, 0] = 1e6
    found = carried(lines(grid, sigma_t), [[1, 0]], offsets(1), np.array([[1.0, 0, 0]]))
    end = found[2:, 2:, -1]
    expected = np.exp(-1e-3 * 63.5 / 64)
    assert np.abs(end - expected).max() < 2e-3
    assert 1 - end.mean() == pytest.approx(1 - expected, rel=0.05)


# Track grids other than the medium's


@pytest.mark.parametrize("detail", [(5, 12, 6), (10, 3, 12), (5, 4, 3), (4, 7, 9)], ids=str)
@pytest.mark.parametrize("axis", range(3))
def test_tracks_integrate_the_detail_of_the_medium(detail, axis):
    """Tracks on a coarse grid integrate the medium's own interpolation.

    On a grid of (5, 6, 6) voxels, the attenuation along an axis is that of the medium, whether its
    grid is finer, coarser or the same along each axis.
    """
    grid, medium = Grid((5, 6, 6), np.eye(4)), Grid(detail, np.eye(4))
    sigma_t = np.random.default_rng(0).uniform(0, 8, detail)
    values = mi.Float(sigma_t.ravel())
    both = Tracks(grid, values, np.zeros(3, int), grid.resolution, medium)
    direction, places = np.eye(3)[axis], offsets(1, 3)
    at = passages(grid, direction, places[0]) / grid.resolution
    field = GridField(medium, values, 1)
    steps = 400
    depth = 0
    for k in range(steps):
        back = at.copy()
        back[..., axis] *= (k + 0.5) / steps
        depth += np.array(field.at_world(mi.Point3f(back.reshape(-1, 3).T))) / steps
    expected = np.exp(-depth * at[..., axis].ravel())
    found = carried(both, [[1, 0]], places, direction[None]).ravel()
    exact = detail[2 - axis] in (grid.shape[2 - axis], 3, 12, 10)  # of 5 and 6
    np.testing.assert_allclose(found, expected, rtol=1e-3 if exact else 3e-2)


# Sharpening


def laid(values: np.ndarray, axis: int) -> mi.Float:
    """Return (z, y, x) in the order of slices across ``axis``: x slowest for those across it."""
    return mi.Float((np.moveaxis(values, 2, 0) if axis == 0 else values).ravel())


def test_sharpening_recovers_values_from_means(monkeypatch):
    """Sharpening converts means of a quadratic over voxels to its values at their centres.

    Values outside of the box do not matter; a constant is unchanged, at the borders too.
    """
    monkeypatch.undo()
    grid, box = Grid((8, 5, 7), np.eye(4)), (np.array([1, 0, 2]), np.array([7, 4, 8]))
    inside = np.s_[2:8, 0:4, 1:7]
    z, y, x = np.indices(grid.shape)
    values = 100 + 3.0 * x**2 + y**2 - 2 * z**2 + x * y
    index = np.arange(grid.voxel_count).reshape(grid.shape)

    def at(voxels, means: np.ndarray, axis: int) -> np.ndarray:
        wanted = mi.UInt32(index[voxels].ravel().tolist())
        return np.array(values_at_centres(laid(means, axis), SweptBox(grid, *box, axis), wanted))

    for axis, curvature in enumerate((1 - 2, 3 - 2, 3 + 1)):
        means = np.zeros(grid.shape)
        means[inside] = (values + curvature / 12)[inside]
        inner = np.s_[3:7, 1:3, 2:6]
        np.testing.assert_allclose(at(inner, means, axis), values[inner].ravel(), rtol=3e-6)
        flat = np.zeros(grid.shape)
        flat[inside] = 2.5
        np.testing.assert_array_equal(at(inside, flat, axis), np.full(6 * 4 * 6, 2.5))


@pytest.mark.parametrize(("scale", "halves"), [(1.0, True), (0.01, False)])
def test_dense_voxels_have_two_halves(scale, halves):
    """Dense voxels have two halves, so that tracks collide where the linear interpolant is.

    Each voxel has an eighth of either neighbour. Thin voxels have a single value, which halves the
    work.
    """
    grid, layers = Grid((8, 8, 8), np.eye(4)), scale * np.array([0, 1, 5, 8, 2, 0, 3, 1.0])
    sweep = lines(grid, np.broadcast_to(layers[:, None, None], grid.shape))
    volume = dr.opaque(mi.Float, 0, grid.voxel_count * 4)
    directions = np.array([[0.0, 0.0, 1.0]])
    sweep.sweep(volume, sweep.table(directions, np.zeros((1, 2)), np.ones(1), offsets(1)))
    # The sum of both directions, over the cross section.
    depth = np.array(volume).reshape(*grid.shape, 4)[..., 3]
    beside = np.concatenate([layers[:1], layers, layers[-1:]])
    expected = (beside[:-2] + 6 * layers + beside[2:]) / 8 if halves else layers
    wanted = np.broadcast_to(2 * expected[:, None, None], grid.shape)
    np.testing.assert_allclose(depth, wanted, atol=1e-3 * layers.max())
