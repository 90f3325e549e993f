"""Unnecessary work is skipped, as counted by solver calls, samples and kernels."""

from __future__ import annotations

import gc
import re
import weakref
from collections import Counter

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture
def scene(scenes):
    """Return a cloud with a second sensor."""
    return cloud_scene(scenes)


def cloud_scene(scenes, density=None, albedo=0.8, **settings) -> mi.Scene:
    to_world = scenes.placement(turn=20)
    density = scenes.texture((6, 5, 7), 0.2, 2.0, 1) if density is None else density
    shape = scenes.boundary(scenes.medium(density, albedo, to_world), to_world)
    second = scenes.description({}, None, size=12)["sensor"]
    second["to_world"] = mi.ScalarTransform4f().look_at([4.0, 1.0, 2.0], [0, 0, 0], [0, 1, 0])
    integrator = {"type": "irrcache", "max_depth": 3, "resolution": 12, "cache_spp": 32}
    return scenes.load(integrator | settings, shape, second=second, default_solver="path")


def edit(scene: mi.Scene, ending: str, change) -> None:
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith(ending)]
    params[key] = change(params[key])
    params.update()


def test_the_cache_is_built_once(scenes, scene, refine_calls):
    """Changing seed, sensor, samples or camera does not call the solver again."""
    scenes.image(scene, spp=2)
    scenes.image(scene, spp=2, seed=1)
    scenes.image(scene, spp=5, sensor=1)
    edit(scene, "second.to_world", lambda m: m @ type(m)().rotate([0, 1, 0], 5))
    scenes.image(scene, spp=2, sensor=1)
    assert refine_calls == [32]


def test_second_image_runs_the_ray_march_only(scenes, scene, kernels):
    """A second image launches one kernel per pass, no solver kernel, and compiles none."""
    first = kernels(lambda: scenes.image(scene, spp=2))
    second = kernels(lambda: scenes.image(scene, spp=2, seed=1))
    voxels = scene.integrator().cache.active_count
    assert any(k["size"] >= voxels * 32 for k in first)
    assert second and len(second) < len(first) / 2
    assert all(k["size"] < voxels * 32 for k in second)
    assert all(k["cache_hit"] for k in second)


def test_a_second_scene_compiles_nothing(scenes, kernels):
    """A second scene of the same kind reuses all kernels.

    Its densities, placements, emitters and seeds differ.
    """
    scenes.image(cloud_scene(scenes), spp=2)
    other = cloud_scene(scenes, scenes.texture((6, 5, 7), 0.1, 3.0, 9), cache_seed=5)
    again = kernels(lambda: scenes.image(other, spp=2, seed=4))
    assert any(k["size"] > 10000 for k in again)
    assert [k["hash"] for k in again if not k["cache_hit"]] == []


def test_passes_compile_nothing(scenes, kernels, monkeypatch):
    """All launches of a cache build use the same kernels, including a shorter last one."""
    from mitsuba_irrcache.solvers.path import solver as path_solver

    monkeypatch.setattr(path_solver, "LANES", 1 << 11)
    scene = cloud_scene(scenes, cache_spp=64)
    history = kernels(lambda: scene.integrator().prepare(scene))
    launches = Counter(k["hash"] for k in history if k["size"] == 1 << 11)
    assert min(launches.values()) == max(launches.values()) >= 8


def test_a_scene_is_freed_with_all_its_arrays(scenes):
    """A scene that is no longer referenced is freed with all its arrays.

    The integrator belongs to the scene, so it must not own the scene.
    """
    scene = cloud_scene(scenes)
    scenes.image(scene, spp=1)
    integrator = weakref.ref(scene.integrator())
    del scene
    gc.collect()
    assert integrator() is None


EDITS = {
    "sigma_t.data": lambda v: mi.TensorXf(np.array(v) * 3),
    "medium.scale": lambda v: v * 3,
    "albedo.value.value": lambda v: v * 0.25,
    "emitter.radiance.value": lambda v: v * 0.1,
    "sun.irradiance.value": lambda v: v * 4,
}


@pytest.mark.parametrize("ending", EDITS)
def test_edits_renew_the_cache(scenes, scene, refine_calls, ending):
    """After params.update() the image equals, bit by bit, that of a cache built for the edited
    scene.
    """
    before = scenes.image(scene, spp=8)
    edit(scene, ending, EDITS[ending])
    after = scenes.image(scene, spp=8)
    assert refine_calls == [32, 32]
    assert np.abs(after - before).mean() > 0.02 * before.mean()
    fresh = cloud_scene(scenes)
    edit(fresh, ending, EDITS[ending])
    np.testing.assert_allclose(after, scenes.image(fresh, spp=8), rtol=1e-4, atol=1e-5)


def test_another_scene_renews_the_cache(scenes, scene, refine_calls):
    """One integrator renders two scenes in turn."""
    integrator = scene.integrator()
    other = cloud_scene(scenes, albedo=0.2)
    own = np.array(mi.render(scene, integrator=integrator, spp=4))
    borrowed = np.array(mi.render(other, integrator=integrator, spp=4))
    assert refine_calls == [32, 32]
    np.testing.assert_allclose(borrowed, scenes.image(other, spp=4), rtol=1e-4, atol=1e-5)
    assert not np.allclose(own, borrowed)


@pytest.mark.parametrize("max_depth", [0, 1])
def test_no_cache_for_direct_views(scenes, refine_calls, max_depth):
    scene = cloud_scene(scenes, max_depth=max_depth)
    scenes.image(scene, spp=2)
    assert refine_calls == []
    assert scene.integrator().cache is None


def test_no_samples_where_nothing_scatters(scenes, kernels):
    """With albedo 0 or an empty medium, no voxels are sampled, and the image is that of
    max_depth 1.
    """
    for density, albedo in ((None, 0.0), (np.zeros((6, 6, 6), np.float32), 0.9)):
        scene = cloud_scene(scenes, density, albedo)
        history = kernels(lambda scene=scene: scene.integrator().prepare(scene))
        assert scene.integrator().cache.active_count == 0
        assert max((k["size"] for k in history), default=0) < 12**3 * 32
        plain = cloud_scene(scenes, density, albedo, max_depth=1)
        np.testing.assert_allclose(
            scenes.image(scene, spp=4), scenes.image(plain, spp=4), rtol=1e-5
        )


def test_empty_voxels_are_not_sampled(scenes, kernels):
    """In a large empty grid, only voxels near the medium are sampled."""
    density = np.zeros((40, 40, 40), np.float32)
    density[16:22, 16:22, 16:22] = 1.0
    scene = cloud_scene(scenes, density, resolution=40, cache_spp=8)
    history = kernels(lambda: scene.integrator().prepare(scene))
    cache = scene.integrator().cache
    assert cache.active_count < 0.08 * cache.grid.voxel_count
    # One lane per voxel marks and lists occupied voxels, and one per value of the padded field,
    # which has a voxel more on each side; then 8 lanes per sampled voxel.
    assert max(k["size"] for k in history) <= max(42**3 * 3, cache.active_count * 8)


def test_single_scattering_traces_no_paths(scenes):
    """With max_depth 2 the scattered layer is exactly zero."""
    scene = cloud_scene(scenes, max_depth=2)
    scene.integrator().prepare(scene)
    assert not np.array(scene.integrator().cache.scattered).any()
    assert np.array(scene.integrator().cache.uncollided).any()


def test_more_samples_continue_a_file(scenes, refine_calls, tmp_path):
    """A file of 32 samples is continued to 64, with the result of 64 at once."""
    file = str(tmp_path / "light.npz")
    cloud_scene(scenes, cache_file=file, cache_spp=32).integrator()
    for spp in (32, 64, 64):
        scene = cloud_scene(scenes, cache_file=file, cache_spp=spp)
        scene.integrator().prepare(scene)
    assert refine_calls == [32, 32]
    whole = cloud_scene(scenes, cache_spp=64)
    whole.integrator().prepare(whole)
    np.testing.assert_allclose(
        np.array(scene.integrator().cache.irradiance),
        np.array(whole.integrator().cache.irradiance),
        rtol=3e-6,
    )


def test_an_interrupted_build_goes_on(scenes, tmp_path, monkeypatch):
    """After Ctrl-C in the progress callback, the next render completes the cache.

    No file is written before that.
    """
    from mitsuba_irrcache.solvers.path import solver as path_solver

    monkeypatch.setattr(path_solver, "LANES", 1 << 13)
    file = tmp_path / "light.npz"
    scene = cloud_scene(scenes, cache_spp=64, cache_file=str(file))
    integrator = scene.integrator()
    calls = []

    def stop(stage, done, total):
        calls.append((stage, done, total))
        if done > total / 2:
            raise KeyboardInterrupt

    integrator.progress = stop
    with pytest.raises((KeyboardInterrupt, RuntimeError)):
        scenes.image(scene, spp=2)
    assert list(tmp_path.iterdir()) == []
    assert 0 < integrator.cache.samples < 64
    integrator.progress = None
    image = scenes.image(scene, spp=2)
    assert integrator.cache.samples == 64 and [p.name for p in tmp_path.iterdir()] == ["light.npz"]
    whole = cloud_scene(scenes, cache_spp=64)
    np.testing.assert_allclose(image, scenes.image(whole, spp=2), rtol=1e-4, atol=1e-6)
    assert all(stage == "cache" and total == calls[0][2] for stage, _, total in calls)
    assert np.all(np.diff([done for _, done, _ in calls]) > 0)


def test_wrappers_use_the_cache(scenes, refine_calls):
    """Nested in ``aov`` as ``sample``, the image is the same, with one cache build."""
    to_world = scenes.placement()
    shape = scenes.boundary(
        scenes.medium(scenes.texture((6, 5, 7), 0.2, 2.0, 1), 0.8, to_world), to_world
    )
    inner = {"type": "irrcache", "solver": "path", "max_depth": 3, "resolution": 12}
    inner |= {"cache_spp": 32}
    plain = scenes.image(scenes.load(inner, shape, default_solver="path"), spp=64)
    refine_calls.clear()
    wrapped = scenes.load({"type": "aov", "aovs": "depth:depth", "inner": inner}, shape)
    image = scenes.image(wrapped, spp=64, seed=3)
    scenes.image(wrapped, spp=2, seed=4)
    assert refine_calls == [32]
    assert image[..., :3].mean() == pytest.approx(plain.mean(), rel=0.01)


def test_gradients_do_not_change_the_cache(scenes, scene):
    """A medium with gradients enabled renders like one without."""
    expected = scenes.image(scene, spp=4)
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith("sigma_t.data")]
    dr.enable_grad(params[key])
    params.update()
    np.testing.assert_allclose(scenes.image(scene, spp=4), expected, rtol=1e-4, atol=1e-5)


# Memory reads and launches of an image


def reads(kernels, scene) -> tuple[int, int]:
    """Count array loads and ray intersections in the largest kernel of a second image."""
    mi.render(scene, spp=4)
    history = kernels(lambda: mi.render(scene, spp=4, seed=1))
    largest = max(history, key=lambda k: k["operation_count"])["ir"].getvalue()
    return largest.count("gather"), largest.count("rtcIntersect") + largest.count("embree")


def plain_scene(scenes, sigma_t, albedo, **more) -> mi.Scene:
    to_world = scenes.placement()
    shape = scenes.boundary(scenes.medium(sigma_t, albedo, to_world), to_world)
    integrator = {"type": "irrcache", "max_depth": 2, "resolution": 8, "cache_spp": 8}
    return scenes.load(
        integrator | more, shape, emitter={"type": "constant"}, sun=None, default_solver="path"
    )


def test_constants_are_not_looked_up(scenes, kernels):
    """Constant parameters are not looked up during the ray march.

    A constant albedo takes fewer loads, a constant extinction the fewest, and no ray is intersected
    with the scene.
    """
    if not mi.variant().startswith("llvm"):
        pytest.skip("counts loads in the code for LLVM")
    values = scenes.texture((8, 8, 8), 0.2, 2.0, 1)
    albedos = scenes.texture((8, 8, 8, 3), 0.2, 0.9, 2)
    varied, constant, homogeneous = (
        reads(kernels, plain_scene(scenes, *parts))
        for parts in ((values, albedos), (values, 0.8), (1.5, 0.8))
    )
    assert varied[0] > constant[0] > homogeneous[0] > 0
    assert varied[1] == constant[1] == homogeneous[1] == 0


def test_grey_media_are_solved_in_one_channel(scenes, kernels):
    """A grey medium in RGB takes the launches of one channel, a coloured one three times as many.

    The channels of a grey medium under a coloured sky differ by a factor.
    """

    def launches(sigma_t, radiance) -> int:
        to_world = scenes.placement()
        shape = scenes.boundary(scenes.medium(sigma_t, 0.8, to_world), to_world)
        integrator = {"type": "irrcache", "solver": "sweep", "max_depth": 2}
        integrator |= {"resolution": 44, "cache_spp": 32}
        sky = {"type": "constant", "radiance": radiance}
        scene = scenes.load(integrator, shape, size=4, emitter=sky, sun=None, default_solver="path")
        history = kernels(lambda: scene.integrator().prepare(scene))
        return sum(k["size"] == 44 * 44 and k["operation_count"] > 100 for k in history)

    grey = scenes.texture((6, 6, 6), 0.2, 2.0, 1)
    coloured = scenes.texture((6, 6, 6, 3), 0.2, 2.0, 1)
    blue = {"type": "rgb", "value": [0.2, 0.4, 0.9]}
    assert launches(grey, 1.0) == launches(grey, blue) == 16
    assert launches(coloured, blue) == 48


def test_no_filter_no_layers(scenes, kernels):
    """Without filter and AOVs, the film has fewer channels and there are fewer launches."""
    values = scenes.texture((8, 8, 8), 0.2, 2.0, 1)
    counts = []
    for settings in ({}, {"filter": "fixed"}):
        scene = plain_scene(scenes, values, 0.8, **settings)
        mi.render(scene, spp=4)
        history = kernels(lambda scene=scene: mi.render(scene, spp=4, seed=1))
        counts.append((len(history), max(k["operation_count"] for k in history)))
    assert counts[0][0] < counts[1][0] and counts[0][1] < counts[1][1]


def test_single_scattering_takes_no_solution(scenes, kernels):
    """max_depth 2 takes launches for 16 pairs of directions without a solution; max_depth 3
    takes more.
    """
    launches = []
    for max_depth in (2, 3):
        values = scenes.texture((6, 6, 6), 0.2, 2.0, 1)
        settings = {"solver": "sweep", "resolution": 44, "cache_spp": 32}
        scene = plain_scene(scenes, values, 0.8, max_depth=max_depth, **settings)
        history = kernels(lambda scene=scene: scene.integrator().prepare(scene))
        launches.append(sum(k["size"] == 44 * 44 and k["operation_count"] > 100 for k in history))
    assert launches[0] == 16 < launches[1]


def stored() -> float:
    """Return the MiB of all live arrays."""
    gc.collect()
    dr.eval()
    size, unit = re.search(
        r"Storage\s*: ([\d.]+) (\w+) on device", dr.whos(as_string=True)
    ).groups()
    return float(size) * {"B": 2**-20, "KiB": 2**-10, "MiB": 1, "GiB": 2**10}[unit]


def test_few_numbers_per_voxel_are_stored(scenes):
    """Grey single scattering stores at most four numbers per voxel besides the medium's own.

    These are two words for the ray march, the irradiance, the indices of occupied voxels, and half
    a word of extinction for tracks.
    """
    to_world = scenes.placement()
    density = scenes.texture((64, 64, 64), 0.2, 2.0, 1)
    shape = scenes.boundary(scenes.medium(density, 0.8, to_world), to_world)
    integrator = {"type": "irrcache", "solver": "sweep", "max_depth": 2, "cache_spp": 32}
    scene = scenes.load(integrator, shape, emitter={"type": "constant"}, default_solver="path")
    before = stored()
    scenes.image(scene, spp=1)
    assert scene.integrator().cache.grid.voxel_count == 64**3
    kept = stored() - before
    assert 2.5 < kept < 5  # in MiB, as a volume; the copy for rays has a tenth more voxels
