"""The scenes of experiments/validation/random_scenes match their descriptions, and wrong images
are detected.
"""

from __future__ import annotations

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.random_scenes import generate, references, run
from experiments.validation.random_scenes.generate import SIDE, RandomScene

COUNT = 60
OPTIONS = {
    "grid": generate.GRIDS,
    "pattern": generate.PATTERNS,
    "contrast": generate.CONTRASTS,
    "albedo": generate.ALBEDOS,
    "tint": generate.TINTS,
    "phase": generate.PHASES,
    "boundary": generate.BOUNDARIES,
    "emitter": generate.EMITTERS,
    "camera": generate.CAMERAS,
    "surroundings": generate.SURROUNDINGS,
    "max_depth": generate.MAX_DEPTHS,
}

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture(scope="module")
def drawn() -> list[RandomScene]:
    """Return the scenes of the experiment."""
    return [RandomScene.draw(1, index) for index in range(COUNT)]


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_is_drawn(drawn, name):
    assert {getattr(case, name) for case in drawn} == set(OPTIONS[name])


def test_a_seed_and_an_index_make_a_scene(drawn):
    again = RandomScene.draw(1, 17)
    assert again == drawn[17]
    assert again != RandomScene.draw(2, 17)
    heterogeneous = next(case for case in drawn if case.pattern == "uniform" and case.grid)
    assert np.array_equal(heterogeneous.voxels(), replace(heterogeneous).voxels())


def test_mitsuba_loads_all_scenes(drawn, tmp_path):
    """Mitsuba loads all scenes with the emitters, media and shapes of their descriptions."""
    for case in drawn:
        scene = mi.load_dict(case.build({"type": "volpath"}, tmp_path))
        shapes = {shape.id(): shape for shape in scene.shapes()}
        assert shapes["boundary"].interior_medium() is not None
        assert len(scene.emitters()) == 1 + case.sky
        medium = scene.sensors()[0].get_medium()
        assert (medium is not None) == (case.camera == "inside")
        emitting = shapes.get("light")
        if "inside" in case.emitter and emitting is not None:
            assert emitting.exterior_medium() is not None
        assert ("ground" in shapes) == (case.surroundings == "ground")


def test_the_optical_depth_is_that_of_mitsuba_s_medium(drawn, tmp_path):
    """The stated optical depth is that of the densest axis-parallel line through voxel centres."""
    for case in drawn:
        scene = mi.load_dict(case.build({"type": "volpath"}, tmp_path))
        shapes = {shape.id(): shape for shape in scene.shapes()}
        medium = shapes["boundary"].interior_medium()
        shape = case.grid or (4, 4, 4)
        centres = np.stack(
            [(i + 0.5) / n for i, n in zip(np.indices(shape), shape, strict=True)][::-1]
        ).reshape(3, -1)
        interaction = mi.MediumInteraction3f()
        interaction.p = mi.Transform4f(case._grid_place()) @ mi.Point3f(centres)
        sigma_t = medium.get_scattering_coefficients(interaction, True)[2]
        values = np.broadcast_to(np.array(sigma_t), (3, np.prod(shape))).max(axis=0).reshape(shape)
        longest = max(values.mean(axis=axis).max() for axis in range(3))
        assert longest * 2 * SIDE == pytest.approx(case.depth, rel=2e-2), case.describe()


def test_cameras_and_emitters_are_placed_as_described(drawn, tmp_path):
    """Cameras and emitters are inside or outside of the boundary as described.

    A ray from the centre to the object crosses the boundary, or does not.
    """
    for case in drawn:
        scene = mi.load_dict(case.build({"type": "volpath"}, tmp_path))
        # The boundary alone: no other object obstructs the ray.
        boundary = mi.load_dict({"type": "scene", "shape": case._boundary(tmp_path)})

        def within(point, boundary=boundary):
            start, direction = mi.Point3f(0.0), mi.Vector3f(*map(float, point))
            return not bool(boundary.ray_test(mi.Ray3f(start, direction, 1.0, 0.0, []))[0])

        origin = scene.sensors()[0].world_transform().translation()
        assert within(np.array(origin).ravel()) == (case.camera == "inside"), case.describe()
        light = next((s for s in scene.shapes() if s.id() == "light"), None)
        if light is not None:
            box = light.bbox()
            corners = np.array(
                [[(box.min, box.max)[k >> i & 1][i] for i in range(3)] for k in range(8)]
            )
            inside = [within(corner) for corner in corners]
            expected = "inside" in case.emitter
            assert all(inside) if expected else not any(inside), case.describe()


def test_the_mesh_is_closed_and_faces_outwards():
    lines = [line.split() for line in generate.icosahedron().splitlines()]
    corners = np.array([[float(v) for v in line[1:]] for line in lines if line[0] == "v"])
    faces = np.array([[int(v) - 1 for v in line[1:]] for line in lines if line[0] == "f"])
    assert (len(corners), len(faces)) == (12, 20)
    edges = [(f[i], f[(i + 1) % 3]) for f in faces for i in range(3)]
    assert len(set(edges)) == 60
    assert all((b, a) in edges for a, b in edges)
    a, b, c = (corners[faces[:, i]] for i in range(3))
    assert ((np.cross(b - a, c - a) * a).sum(axis=1) > 0).all()


def test_placements_keep_angles():
    """Placements preserve angles; Mitsuba shears if a rotation axis is not of unit length."""
    for index in range(5):
        random = np.random.default_rng(index)
        matrix = np.array(generate._rotation(random, 10, 80).matrix)[:3, :3]
        assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-6)


# -- errors of images ------------------------------------------------------------------------------


def rendered(error, noise: float = 0.02, seed: int = 0, unscattered: float = 0.5) -> dict:
    """Return a row for images of mean 1 with an ``error`` and noise."""
    random = np.random.default_rng(seed)
    a, b, x, y = (1 + noise * random.normal(size=(24, 24, 3)) for _ in range(4))
    direct = np.full_like(a, unscattered)
    return run.compare(a, b, direct, x + error, y + error) | {"solver": "sweep"}


def test_noise_alone_is_no_disagreement():
    rows = [rendered(0.0, noise, seed) for seed in range(50) for noise in (0.0, 0.05, 0.3)]
    assert not [row for row in rows if run.verdict(row).startswith("DISAGREES")]
    assert run.verdict(rows[0]) == "agrees"


@pytest.mark.parametrize(
    ("share", "unscattered", "expected"),
    [(0.015, 0.0, {"mean", "RMSE"}), (0.008, 0.0, set()), (0.008, 0.7, {"mean of volume"})],
)
def test_an_error_of_the_mean_is_found(share, unscattered, expected):
    said = run.verdict(rendered(share, unscattered=unscattered))
    for word in expected:
        assert word in said
    assert said.startswith("DISAGREES") == bool(expected)


def test_an_error_without_a_mean_is_found():
    signs = np.where(np.indices((24, 24)).sum(axis=0) % 2, 1, -1)[..., None]
    assert run.verdict(rendered(0.02 * signs, unscattered=0.0)) == "DISAGREES: RMSE"


def test_a_wrong_block_is_found_where_it_is():
    error = np.zeros((24, 24, 3))
    error[6:12, 18:24] = 0.036
    row = rendered(error, unscattered=0.0)
    assert run.verdict(row) == "DISAGREES: block"
    assert row["block"]["at"] == [6, 18]
    assert row["block"]["error"] == pytest.approx(0.036, abs=4 * row["block"]["noise"])


def test_error_absent_from_another_cache_is_noise():
    random = np.random.default_rng(3)
    a, b, x, y = (1 + 0.01 * random.normal(size=(24, 24, 3)) for _ in range(4))
    row = run.compare(a, b, np.zeros_like(a), x + 0.03, y - 0.03) | {"solver": "sweep"}
    assert run.verdict(row) == "undecided"


def test_what_the_reference_does_not_resolve_is_undecided():
    assert run.verdict(rendered(0.0, noise=0.3)) == "undecided"


def test_references_are_refined_until_they_are_exact_enough(tmp_path, monkeypatch):
    """Batches are added until the standard error suffices; a stored reference is continued."""
    seeds, random = [], np.random.default_rng(5)

    def rendered(_, __, seed: int) -> np.ndarray:
        seeds.append(seed)
        return np.full((24, 24, 3), 1 + 0.03 * random.normal())

    monkeypatch.setattr(references, "picture", rendered)
    first = references.Reference("volpath", 50, 16)
    first.refine(None, seconds=0.0)  # the time is spent at once
    assert len(first.means) == 2
    assert not first.is_enough
    first.save(tmp_path / "a.npz", "scene")
    assert references.Reference.read(tmp_path / "a.npz", "another scene") is None
    found = references.Reference.read(tmp_path / "a.npz", "scene")
    found.refine(None, seconds=60.0)
    assert found.is_enough
    assert len(set(seeds)) == len(seeds) == len(found.means) >= references.BATCHES
    assert found.noise == pytest.approx(references.TARGET, rel=0.1)
    a, b = found.halves()
    assert 0.5 * (a.mean() + b.mean()) == pytest.approx(np.mean(found.means), rel=1e-2)


def test_outdated_rows_are_computed_again(drawn):
    case = drawn[3]
    row = rendered(0.0, noise=0.3)
    row |= {"drawn": json.loads(json.dumps(case.as_dict())), "seconds_granted": 5}
    assert not run.is_outdated(row, case, 5)
    assert run.is_outdated(row, case, 6)  # the result is undecided
    assert run.is_outdated(None, case, 5)
    assert run.is_outdated(row, drawn[4], 5)
    assert not run.is_outdated(row | rendered(0.0), case, 6)


def test_nonfinite_images_and_failures_are_reported():
    row = rendered(np.where(np.arange(24) == 3, np.nan, 0.0)[:, None, None])
    assert run.verdict(row) == "NOT FINITE"
    assert run.verdict({"failed": "no", "refused": True}) == "refused"
    assert run.verdict({"failed": "no", "refused": False}) == "ERROR"
