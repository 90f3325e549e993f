"""Validation of cache files, merging of caches, and availability of the standard error."""

from __future__ import annotations

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.storage import digest_of_arrays, digest_of_description
from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")

VOXELS = 8


def cache(seed: int = 0, batches: int = 2, batch: int = BATCH, correlated=False, **others):
    """Return a cache of 2^3 voxels with random sums."""
    active = dr.arange(mi.UInt32, VOXELS)
    grid = Grid((2, 2, 2), np.eye(4))
    made = IrradianceCache(
        grid, active, 1, -1, {"medium": "a"}, batch=batch, correlated=correlated, **others
    )
    rng = np.random.default_rng(seed)
    totals, spreads = (
        [made.real(rng.uniform(1, 2, VOXELS).tolist()) for _ in range(n)] for n in (2, 1)
    )
    if batches == 1:
        spreads = [None]
    made.add(seed, batches * batch, [(tuple(totals), tuple(spreads))])
    return made


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "light.cache"
    cache().save(path)
    return path


def rewrite(file, seal: bool, change) -> None:
    """Rewrite a file after ``change``; if ``seal``, with matching digests."""
    arrays = dict(np.load(file))
    description = json.loads(arrays.pop("description").tobytes())
    change(description, arrays)
    if seal:
        description["values"] = digest_of_arrays(arrays)
        description["digest"] = digest_of_description(description)
    encoded = np.frombuffer(json.dumps(description).encode(), np.uint8)
    with file.open("wb") as stream:
        np.savez(stream, description=encoded, **arrays)


def test_unchanged_rewritten_file_is_read(file):
    """A file rewritten without a change is read, so that other tests fail by their change only."""
    rewrite(file, True, lambda description, arrays: None)
    assert IrradianceCache.load(file).samples == 2 * BATCH
    rewrite(file, False, lambda description, arrays: None)
    assert IrradianceCache.load(file).samples == 2 * BATCH


@pytest.mark.parametrize("name", ["active", "totals", "spreads"])
def test_altered_values_are_refused(file, name):
    """Altered values are refused by their digests, although each is valid by itself."""

    def change(description, arrays):
        if name == "active":
            arrays[name] = arrays[name][:-1]
            arrays["totals"], arrays["spreads"] = (
                arrays[key][:, :-1] for key in ("totals", "spreads")
            )
        else:
            arrays[name] = arrays[name] * 1.5

    rewrite(file, False, change)
    with pytest.raises(CacheFileError, match="values are not those"):
        IrradianceCache.load(file)


@pytest.mark.parametrize(
    "lie",
    [
        {"batch": 1},
        {"batch": 4},
        {"streams": {"0": 10**12}},
        {"streams": {"0": 64}},
        {"streams": {"1": 16}},
        {"max_depth": 2},
        {"fingerprint": {"medium": "b"}},
        {"to_world": (2 * np.eye(4)).tolist()},
    ],
    ids=str,
)
def test_altered_descriptions_are_refused(file, lie):
    rewrite(file, False, lambda description, arrays: description.update(lie))
    for read in (IrradianceCache.load, IrradianceCache.description_of):
        with pytest.raises(CacheFileError, match=r"light\.cache"):
            read(file)


@pytest.mark.parametrize(
    ("lie", "said"),
    [
        ({"batch": 1}, "in batches of 1"),
        ({"batch": 4}, "in batches of 4"),
        ({"batch": 10**6, "correlated": True}, "type|batches"),
        ({"streams": {"0": 10**12}}, "samples"),
        ({"streams": {"-1": 16}}, "samples"),
        ({"streams": {"0": 8}}, "non-zero sums, but only 1 batch"),
        ({"streams": {}}, "non-zero sums, but only 0 batch"),
    ],
    ids=str,
)
def test_impossible_descriptions_are_refused(file, lie, said):
    """Invalid descriptions are refused although their digests match."""
    rewrite(file, True, lambda description, arrays: description.update(lie))
    with pytest.raises(CacheFileError, match=said):
        IrradianceCache.load(file)


@pytest.mark.parametrize(
    "other",
    [{"batch": 2 * BATCH}, {"correlated": True}, {"moments": 1}],
    ids=["batch", "correlated", "moments"],
)
def test_caches_whose_samples_differ_in_kind_are_not_merged(other):
    first, second = cache(0), cache(1)
    first.merge(second)  # equal
    assert first.samples == 4 * BATCH
    if "moments" in other:
        odd = IrradianceCache(first.grid, first.active, 1, -1, first.fingerprint, moments=1)
    else:
        odd = cache(2, **other)
    before = np.array(first.irradiance)
    for one, two in ((first, odd), (odd, first)):
        with pytest.raises(IrrcacheError, match="does not fit"):
            one.merge(two)
    np.testing.assert_array_equal(np.array(first.irradiance), before)
    assert first.streams == {0: 2 * BATCH, 1: 2 * BATCH}


def moved() -> IrradianceCache:
    """Return a cache whose grid is at another place than that of `cache`."""
    other = cache(1)
    other.grid = Grid(other.grid.shape, np.diag([1.0, 1.0, 1.01, 1.0]))
    return other


def shifted() -> IrradianceCache:
    """Return a cache with values in as many, but other voxels than `cache`."""
    other = cache(1)
    other.grid, other.active = Grid((2, 2, 4), np.eye(4)), other.active + 8
    return other


def of_unknown_scene() -> IrradianceCache:
    """Return a cache that was computed without a file, which has no digests of its scene."""
    other = cache(1)
    other.fingerprint = {}
    return other


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (moved, "at different places"),
        (shifted, "different voxels"),
        (of_unknown_scene, "not recorded to which scene the.*cache_file"),
    ],
)
def test_caches_that_may_be_of_different_scenes_are_not_merged(make, said):
    first, other = cache(0), make()
    if make is shifted:
        first.grid = other.grid
    for one, two in ((first, other), (other, first)):
        with pytest.raises(IrrcacheError, match=said):
            one.merge(two)
    if make is of_unknown_scene:
        with pytest.raises(IrrcacheError, match=said):
            make().merge(make())
    assert first.streams == {0: 2 * BATCH}


@pytest.mark.parametrize("solver", ["sweep", "path"])
@pytest.mark.parametrize("samples", [1, 8, 32, 64])
def test_error_estimates_take_two_batches(scenes, solver, samples):
    """A cache that needs an error estimate takes two batches; otherwise one suffices."""
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    common = {"type": "irrcache", "solver": solver, "resolution": 2, "max_depth": 2}
    for aovs, least in (("", 1), ("noise", 2)):
        settings = common | {"cache_spp": samples, "aovs": aovs}
        scene = scenes.load(settings, shape, emitter=scenes.sky, default_solver="path")
        scene.integrator().prepare(scene)
        made = scene.integrator().cache
        assert made.samples >= max(least * made.batch, samples)
        assert np.isfinite(np.array(made.standard_error)).all() == (made.samples > made.batch)
        assert least == 1 or made.samples >= 2 * made.batch
