"""A solver is one class and one registration."""

from __future__ import annotations

import ast
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_irrcache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings
from mitsuba_irrcache.pipeline.defaults import choose_solver
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers import base
from mitsuba_irrcache.solvers.base import Solver, register, registered, solver_named
from mitsuba_irrcache.solvers.grid_size import REQUESTED, SizeRule

PACKAGE = Path(mitsuba_irrcache.__file__).parent


@pytest.fixture
def constant(rgb, monkeypatch) -> type[Solver]:
    """A third solver, which is registered while the test runs: irradiance 1 everywhere, in grey
    media only. There are no others than ``sweep`` and ``path`` beside it.
    """
    others = {name: solver_named(name) for name in ("sweep", "path")}
    monkeypatch.setattr(base, "_REGISTRY", others)

    @register
    class Constant(Solver):
        name = "constant"
        size_rule = SizeRule(1.0, fewest=4, most_by_contrast=4, most_by_border=4)

        @classmethod
        def why_not(cls, scene, medium, max_depth, resolution):
            return "the medium is coloured" if medium.channels > 1 else None

        @classmethod
        def why(cls, medium):
            return "it is quick"

        @classmethod
        def default_samples(cls, medium, max_depth, active_count):
            return 8

        @classmethod
        def batch_size(cls, medium, max_depth, samples, basis):
            return 8

        @classmethod
        def numbers_per_voxel(cls, medium, max_depth, moments, voxels, channels):
            return 6

        def __init__(self, task):
            self._cache = task.cache

        def refine(self, samples, progress=None):
            cache = self._cache
            batches = samples // cache.batch
            one = cache.real(np.full(cache.active_count, batches))
            layers = (one,) * cache.channels + (None,) * cache.channels
            cache.add(0, samples, [(layers, (None,) * cache.channels)])

    return Constant


def scene_with(scenes, albedo) -> mi.Scene:
    return scenes.load({"type": "volpath"}, scenes.boundary(scenes.medium(1.0, albedo)))


def test_a_new_solver_is_known_to_the_pipeline(scenes, constant):
    scene = scene_with(scenes, 0.5)
    builder = CacheBuilder(CacheSettings(solver="constant"))
    builder.update(scene)
    assert builder.solver == "constant" and builder.cache.samples == 8
    assert builder.cache.grid.shape == (4, 4, 4)
    assert np.array(builder.cache.irradiance).max() == pytest.approx(1)


def test_auto_takes_the_first_that_supports_the_scene(scenes, constant, monkeypatch):
    (medium,) = compile_scene(scene := scene_with(scenes, 0.5)).visible
    assert choose_solver(scene, medium, "auto")[0].name == "sweep"
    assert choose_solver(scene, medium, "constant") == (constant, REQUESTED)
    monkeypatch.setattr(base, "_REGISTRY", {"path": solver_named("path"), "constant": constant})
    assert choose_solver(scene, medium, "auto") == (constant, "it is quick")
    coloured = scene_with(scenes, (0.5, 0.6, 0.7))
    (medium,) = compile_scene(coloured).visible
    chosen, reason = choose_solver(coloured, medium, "auto")
    assert (chosen.name, reason) == ("path", "the medium is coloured")
    with pytest.raises(IrrcacheError, match=r'"constant" cannot be used.*coloured'):
        choose_solver(coloured, medium, "constant")
    monkeypatch.setattr(base, "_REGISTRY", {"constant": constant})
    with pytest.raises(IrrcacheError, match="coloured"):
        choose_solver(coloured, medium, "auto")


def test_names_are_unique_and_known(constant):
    assert [solver.name for solver in registered()] == ["sweep", "constant", "path"]
    with pytest.raises(ValueError, match="constant"):
        register(constant)
    with pytest.raises(IrrcacheError, match=r'"sweeep".*"sweep"'):
        solver_named("sweeep")


def test_no_module_but_a_solver_compares_with_the_name_of_one():
    """Whatever depends on the solver asks it."""
    compared = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for folder in ("scene", "cache", "solvers", "pipeline", "render", "view")
        for path in (PACKAGE / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Compare)
        for part in (node.left, *node.comparators)
        if isinstance(part, ast.Constant) and part.value in ("sweep", "path")
    ]
    assert compared == []
