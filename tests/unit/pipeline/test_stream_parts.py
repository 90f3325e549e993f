"""Parts of a random stream: computed apart, in any order, they give the bits of one run."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.stream_parts import StreamParts, missing_parts
from mitsuba_irrcache.solvers.path import solver as path_solver

pytestmark = pytest.mark.usefixtures("rgb")

#: Settings, and the numbers of parts: two and a half times as many paths as one launch has; and two
#: batches, as large as they become.
KINDS = {
    "path": ({"solver": "path", "resolution": 8, "cache_spp": 160}, 3),
    "sweep": ({"solver": "sweep", "resolution": 8, "cache_spp": 512}, 2),
    "moments": ({"solver": "path", "resolution": 6, "cache_spp": 64, "max_depth": 3}, 4),
}


@pytest.fixture
def build(scenes, monkeypatch):
    """Return a function that loads a scene with an integrator of some settings."""
    monkeypatch.setattr(path_solver, "LANES", 8**3 * 64)

    def build(settings: dict, **medium) -> mi.Scene:
        shape = scenes.boundary(
            scenes.medium(scenes.texture((6, 6, 6), 0.5, 4.0, 1), 0.8, **medium)
        )
        return scenes.load({"type": "irrcache"} | settings, shape)

    return build


def values(cache: IrradianceCache, path) -> dict[str, np.ndarray]:
    """Return all arrays of the file of a cache but its description."""
    cache.save(path)
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files if name != "description"}


@pytest.mark.parametrize("kind", KINDS)
def test_parts_give_the_bits_of_one_run(kind, build, tmp_path):
    settings, expected = KINDS[kind]
    phase = {"phase": {"type": "hg", "g": 0.4}} if kind == "moments" else {}
    scene = build(settings, **phase)
    scene.integrator().prepare(scene)
    whole = values(scene.integrator().cache, tmp_path / "whole")
    other = build(settings, **phase)
    (medium,) = other.integrator().cached_media(other)
    medium.use_file(other, tmp_path / "parts")
    parts, spans = StreamParts(other, medium), list(missing_parts(medium))
    assert len(spans) == expected
    for first, count in reversed(spans):
        parts.compute(first, count).save(tmp_path / f"{first}")
    assert medium.cache.samples == 0
    for first, _ in spans:
        medium.cache.append(IrradianceCache.load(tmp_path / f"{first}"), first)
    assert medium.cache.samples == settings["cache_spp"]
    assert list(missing_parts(medium)) == []
    for name, found in values(medium.cache, tmp_path / "appended").items():
        np.testing.assert_array_equal(found, whole[name])


def test_the_stream_of_another_seed_is_added_to_a_file(build, tmp_path):
    """As one run does that continues the file with another ``cache_seed``."""
    whole = {"solver": "path", "resolution": 8, "cache_file": str(tmp_path / "whole")}
    for seed, samples in ((0, 64), (3, 160), (0, 192)):
        scene = build(whole | {"cache_seed": seed, "cache_spp": samples})
        scene.integrator().prepare(scene)
        other = build({"solver": "path", "resolution": 8, "cache_seed": seed, "cache_spp": samples})
        (medium,) = other.integrator().cached_media(other)
        medium.use_file(other, tmp_path / "parts")
        parts = StreamParts(other, medium)
        for span in missing_parts(medium):
            medium.cache.append(parts.compute(*span), span[0])
        medium.cache.save(tmp_path / "parts")
    assert medium.cache.streams == {0: 96, 3: 96}
    assert (tmp_path / "parts").read_bytes() == (tmp_path / "whole").read_bytes()


def test_a_part_is_never_counted_twice_or_too_early(build, tmp_path):
    scene = build(KINDS["path"][0])
    (medium,) = scene.integrator().cached_media(scene)
    medium.use_file(scene, tmp_path / "cache")
    parts = StreamParts(scene, medium)
    (first, second, _) = list(missing_parts(medium))
    computed = [parts.compute(*span) for span in (first, second)]
    with pytest.raises(IrrcacheError, match=r"begins with batch 8 of cache_seed 0, but .* has 0"):
        medium.cache.append(computed[1], second[0])
    medium.cache.append(computed[0], first[0])
    with pytest.raises(IrrcacheError, match="begins with batch 0"):
        medium.cache.append(computed[0], first[0])
    assert medium.cache.samples == computed[0].samples


def test_parts_of_another_scene_are_refused(build, tmp_path):
    scene, other = build(KINDS["path"][0]), build(KINDS["path"][0] | {"max_depth": 3})
    (medium,) = scene.integrator().cached_media(scene)
    medium.use_file(scene, tmp_path / "cache")
    (strange,) = other.integrator().cached_media(other)
    with pytest.raises(IrrcacheError, match="settings differs"):
        medium.cache.append(StreamParts(other, strange).compute(0, 1), 0)


def test_a_tolerance_has_no_cache_without_a_view(build):
    scene = build({"solver": "path", "tolerance": 0.1})
    assert scene.integrator().depends_on_view
    with pytest.raises(IrrcacheError, match="tolerance cannot be used here, since it chooses"):
        scene.integrator().cached_media(scene)
