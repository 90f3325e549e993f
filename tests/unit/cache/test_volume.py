"""The cache: its active voxels, the meaning of its statistics, saving and merging."""

from __future__ import annotations

import io
import json
import zipfile

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels
from mitsuba_irrcache.io.mitsuba_vol import read_vol
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.base import SolverTask
from mitsuba_irrcache.solvers.path.solver import PathSolver

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture
def make(scenes):
    """Return a function that makes a cache of a small cloud under a sky and a sun.

    It is filled by these calls of the solver (seed, samples).
    """
    to_world = scenes.placement((2.0, 1.0, 1.5), turn=20)
    sigma_t = scenes.texture((4, 3, 5), 0.0, 2.0, 1)
    shape = scenes.boundary(scenes.medium(sigma_t, 0.8, to_world), to_world)
    scene = scenes.load({"type": "irrcache", "solver": "path"}, shape)
    description = compile_scene(scene)
    (medium,) = description.visible

    def run(*calls: tuple[int, int], max_depth: int = 3, resolution: int = 6) -> IrradianceCache:
        grid = Grid.near_cubic(medium.frame, resolution)
        active = active_voxels(medium, grid)
        cache = IrradianceCache(grid, active, 3, max_depth, {"medium": "a", "emitters": "b"})
        for seed, samples in calls:
            task = SolverTask(scene, description, medium, cache, seed, rr_depth=100)
            PathSolver(task).refine(samples)
        return cache

    return run


def values(tensor) -> np.ndarray:
    return np.array(tensor, dtype=np.float64)


# Active voxels


@pytest.mark.parametrize("turn", [0.0, 45.0])
@pytest.mark.parametrize("resolution", [7, 16, 40])
def test_active_voxels_are_those_that_lookups_read(scenes, turn, resolution):
    """Active are all voxels that a lookup with sigma_t > 0 reads, and none far from the medium.

    This is checked at 2e5 points, also beyond a grid that is smaller than its boundary; "far" is
    more than a macrocell.
    """
    density = np.zeros((16, 20, 24), np.float32)
    density[2:5, 14:19, 3:9] = 1.0
    density[9:10, 3:4, 22:24] = 1.0  # at the border, so that it extends beyond the grid
    to_world = scenes.placement((1.6, 1.4, 1.2), turn=turn)
    field = GridField(Grid(density.shape, to_world), mi.Float(density.ravel()), 1)
    size = 1.3 * scenes.placement((2.0, 2.0, 2.0))
    boundary = Boundary("box", np.diag([1.3, 1.3, 1.3, 1.0]))
    medium = MediumGrid(field, ConstantField(np.array([1.0])), boundary)
    size[3, 3] = 1
    grid = Grid.near_cubic(size, resolution)
    active = np.zeros(grid.voxel_count, bool)
    active[np.array(active_voxels(medium, grid))] = True

    p = mi.Point3f(np.float32(np.random.default_rng(1).uniform(-1.3, 1.3, (3, 200000))))
    occupied = np.array(field.at_world(p)) > 0
    counts = grid.resolution[:, None]
    s = np.clip(np.array(grid.coordinates.point(p))[:, occupied] - 0.5, 0, counts - 1)
    needed = np.zeros(grid.voxel_count, bool)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = np.minimum(s.astype(int) + np.array(corner)[:, None], counts - 1)
        needed[(z * counts[1] + y) * counts[0] + x] = True
    assert needed.any()
    assert not (needed & ~active).any()

    # Surplus within the grid: within a macrocell (0.3 across) and two voxels of required ones.
    at = np.stack(np.unravel_index(np.arange(grid.voxel_count), grid.shape)[::-1], axis=1)
    reach = 0.3 * resolution / 2.6 * (1 if turn == 0 else 2.2) + 3
    chosen = at[needed]
    centers = grid.centers(dr.arange(mi.UInt32, grid.voxel_count))
    local = np.array(field.grid.coordinates.point(centers)) / field.grid.resolution[:, None]
    within = ((local > 0) & (local < 1)).all(axis=0)
    extra = at[active & ~needed & within]
    nearest = [np.abs(chosen - e).max(axis=1).min() for e in extra[:: max(1, len(extra) // 200)]]
    assert max(nearest, default=0) <= reach


def test_empty_medium_has_no_active_voxels(scenes):
    field = GridField(Grid((8, 8, 8), scenes.placement()), dr.zeros(mi.Float, 512), 1)
    medium = MediumGrid(field, ConstantField(np.array([1.0])), Boundary("box", np.eye(4)))
    assert dr.width(active_voxels(medium, field.grid)) == 0


# Statistics


def test_layers_add_up(make):
    cache = make((0, 32))
    total = values(cache.irradiance)
    np.testing.assert_allclose(total, values(cache.uncollided) + values(cache.scattered), rtol=1e-6)
    assert values(cache.scattered).min() >= 0 and values(cache.uncollided).min() > 0
    assert total.shape == (*cache.grid.shape, 3)


def test_lookup_at_a_centre_is_the_value(make):
    """At a voxel centre, a lookup returns the value, corrected for the bias of noisy roots."""
    cache = make((0, 8192))
    p = cache.grid.centers(dr.arange(mi.UInt32, cache.grid.voxel_count))
    looked_up = np.array(cache.field().at_world(p)).T.reshape(values(cache.irradiance).shape)
    np.testing.assert_allclose(looked_up, values(cache.irradiance), rtol=2e-3)


def test_noise_does_not_shift_lookups(make):
    """The mean lookup in 512 caches of the default 16 samples equals that of a converged one.

    The bound is 0.2 % and 3 standard errors, each below 0.05 %; without the correction the
    difference is 0.5 %.
    """
    rng = np.random.default_rng(1)
    exact = make((999, 1 << 14), resolution=10)
    u = rng.uniform(0, 1, (3, 4096)) * exact.grid.resolution[:, None]
    p = exact.grid.world.point(mi.Point3f(np.float32(u)))
    expected = values(exact.field().at_world(p)).mean()
    noisy = [values(make((s, 16), resolution=10).field().at_world(p)).mean() for s in range(512)]
    error = np.std(noisy, ddof=1) / 512**0.5
    assert error < 5e-4 * expected
    assert np.mean(noisy) == pytest.approx(expected, abs=2e-3 * expected + 3 * error)


def test_standard_error_is_the_scatter_of_repetitions(make):
    """The scatter of 48 caches of 64 samples agrees with their standard errors.

    Pooled over some 100 voxels, the bound of 10 % is 6 deviations.
    """
    caches = [make((seed, 64)) for seed in range(48)]
    scatter = np.var([values(c.irradiance) for c in caches], axis=0, ddof=1)
    claimed = np.mean([values(c.standard_error) ** 2 for c in caches], axis=0)
    assert scatter.mean() / claimed.mean() == pytest.approx(1, abs=0.1)


def test_no_standard_error_from_one_batch(make):
    assert np.isnan(values(make((0, BATCH)).standard_error)).all()


def test_resuming_equals_a_single_run(make):
    """32 samples and then 32 more equal 64 at once, to the rounding of float32 sums."""
    parts, whole = make((5, 32), (5, 32)), make((5, 64))
    assert parts.streams == whole.streams == {5: 64}
    np.testing.assert_allclose(values(parts.irradiance), values(whole.irradiance), rtol=2e-6)
    np.testing.assert_allclose(
        values(parts.standard_error), values(whole.standard_error), rtol=1e-3
    )


def test_streams_are_independent(make):
    """Errors of two seeds are uncorrelated over the voxels (|r| < 4 / sqrt(n))."""
    truth = values(make((99, 8192)).uncollided)[..., 0].ravel()
    a, b = (values(make((seed, 64)).uncollided)[..., 0].ravel() - truth for seed in (1, 2))
    assert abs(np.corrcoef(a, b)[0, 1]) < 4 / np.sqrt(a.size)
    assert (a != b).all()


# Merging


def test_merging_equals_one_longer_run(make):
    """Merged caches of seeds 1 and 2 equal one run over both streams, weighted by samples."""
    merged, other = make((1, 64)), make((2, 32))
    expected = (64 * values(merged.irradiance) + 32 * values(other.irradiance)) / 96
    merged.merge(other)
    assert merged.samples == 96 and merged.streams == {1: 64, 2: 32}
    np.testing.assert_allclose(values(merged.irradiance), expected, rtol=1e-6)
    together = make((1, 64), (2, 32))
    np.testing.assert_allclose(values(merged.irradiance), values(together.irradiance), rtol=2e-6)
    np.testing.assert_allclose(
        values(merged.standard_error), values(together.standard_error), rtol=1e-3
    )


def test_equal_seeds_are_refused(make):
    cache, other = make((1, 16), (3, 16)), make((3, 32))
    before = values(cache.irradiance)
    with pytest.raises(IrrcacheError, match="cache_seed 3"):
        cache.merge(other)
    np.testing.assert_array_equal(values(cache.irradiance), before)
    assert cache.samples == 32


def test_caches_of_other_emitters_are_not_merged(make):
    cache, other = make((1, 16)), make((2, 16))
    other.fingerprint["emitters"] = "c"
    with pytest.raises(IrrcacheError, match="emitters differs"):
        cache.merge(other)


@pytest.mark.parametrize("change", [{"resolution": 5}, {"max_depth": 2}])
def test_caches_of_other_shapes_are_not_merged(make, change):
    with pytest.raises(IrrcacheError, match="does not fit"):
        make((1, 16)).merge(make((2, 16), **change))


# Files


def test_saved_and_loaded(make, tmp_path):
    """All statistics are restored bit by bit, and a loaded cache can be refined and merged."""
    cache = make((4, 48))
    cache.save(tmp_path / "light.npz")
    loaded = IrradianceCache.load(tmp_path / "light.npz")
    assert loaded.fingerprint == cache.fingerprint
    assert loaded.streams == {4: 48} and loaded.max_depth == cache.max_depth
    np.testing.assert_array_equal(loaded.grid.to_world, cache.grid.to_world)
    for name in ("irradiance", "uncollided", "scattered", "standard_error"):
        np.testing.assert_array_equal(values(getattr(loaded, name)), values(getattr(cache, name)))
    loaded.merge(make((5, 16)))
    assert loaded.samples == 64
    assert [p.name for p in tmp_path.iterdir()] == ["light.npz"]


def damaged(content: bytes, how: str) -> bytes:
    arrays = dict(np.load(io.BytesIO(content)))
    if how == "truncated":
        return content[: len(content) // 2]
    if how == "empty":
        return b""
    if how == "garbage":
        return b"not a cache at all" * 100
    if how == "flipped":
        middle = len(content) // 2
        return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]
    if how == "array missing":
        del arrays["totals"]
    if how == "pickle":
        arrays["totals"] = np.array([{"evil": 1}], dtype=object)
    if how == "not finite":
        arrays["totals"][0, 0] = np.nan
    if how == "short":
        arrays["totals"] = arrays["totals"][..., :-1]
    if how == "voxel outside":
        arrays["active"][-1] = 10**6
    if how in ("other format", "huge grid"):
        description = json.loads(arrays["description"].tobytes())
        change = {"format": "else 7"} if how == "other format" else {"shape": [-1, 2, 3]}
        arrays["description"] = np.frombuffer(json.dumps(description | change).encode(), np.uint8)
    file = io.BytesIO()
    (np.savez_compressed if how == "compressed" else np.savez)(file, **arrays)
    return file.getvalue()


@pytest.mark.parametrize(
    "how",
    [
        "truncated", "empty", "garbage", "flipped", "array missing", "pickle", "compressed",
        "not finite", "short", "voxel outside", "other format", "huge grid",
    ],
)  # fmt: skip
def test_damaged_files_are_refused_by_name(make, tmp_path, how):
    file = tmp_path / "light.npz"
    make((4, 16)).save(file)
    file.write_bytes(damaged(file.read_bytes(), how))
    with pytest.raises(CacheFileError, match=r"light\.npz"):
        IrradianceCache.load(file)


def test_oversized_header_is_refused_before_reading(make, tmp_path):
    """A small file whose header declares 2^40 values is refused before its data are read."""
    file = tmp_path / "light.npz"
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("description", "active", "totals", "spreads"):
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)}
            )
            archive.writestr(f"{name}.npy", header.getvalue())
    with pytest.raises(CacheFileError, match=r"light\.npz"):
        IrradianceCache.load(file)


def test_a_failure_while_writing_leaves_the_old_file(make, tmp_path, monkeypatch):
    file = tmp_path / "light.npz"
    cache = make((4, 16))
    cache.save(file)
    before = file.read_bytes()

    def fail(target, **arrays):
        target.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", fail)
    with pytest.raises(KeyboardInterrupt):
        cache.save(file)
    assert file.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["light.npz"]


def test_export_to_mitsuba(make, tmp_path):
    """The exported .vol file holds the irradiance and is read by Mitsuba."""
    cache = make((4, 16))
    cache.export_vol(tmp_path / "phi.vol")
    array, bounds = read_vol(tmp_path / "phi.vol")
    np.testing.assert_allclose(array, values(cache.irradiance), rtol=1e-6)
    volume = mi.load_dict(
        {"type": "gridvolume", "filename": str(tmp_path / "phi.vol"), "raw": True}
    )
    assert tuple(mi.traverse(volume)["data"].shape) == array.shape
    corners = np.vstack([np.array(list(np.ndindex(2, 2, 2))).T, np.ones(8)])
    world = (cache.grid.to_world @ corners)[:3]
    np.testing.assert_allclose(bounds, [world.min(axis=1), world.max(axis=1)], rtol=1e-5)
