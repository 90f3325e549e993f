"""Unseen scenes for images with a tolerance: no constant of the package was chosen with them.

Half of them are listed: grids of 1^3 to 256^3 voxels of patterns that other experiments do not
have. The others are drawn, see experiments/validation/random_scenes/generate.py, with a seed of
their own; those without any scattering are left out, because they have no cache.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.validation.defaults.cases import Case, noise, radius
from experiments.validation.random_scenes.generate import RandomScene

#: Seed and number of the drawn scenes.
SEED, DRAWN = 2611, 20


def even(count: int) -> np.ndarray:
    """Matter of constant extinction."""
    return np.ones((count,) * 3)


def corner(count: int) -> np.ndarray:
    """Dense in one corner."""
    z, y, x = (np.indices((count,) * 3) + 0.5) / count
    return np.exp(-4 * (x + y + z))


def stratus(count: int) -> np.ndarray:
    """A flat broken cloud."""
    height = (np.arange(count)[None, :, None] + 0.5) / count
    cover = np.maximum(0.3 + noise(count, 1.8, 11), 0)
    return cover * np.exp(-(((height - 0.45) / 0.12) ** 2))


def plume(count: int) -> np.ndarray:
    """A rising column that widens."""
    z, y, x = (np.indices((count,) * 3) + 0.5) / count * 2 - 1
    width = 0.12 + 0.18 * (y + 1)
    bent = x - 0.25 * np.sin(2.5 * y)
    column = np.exp(-(bent**2 + z**2) / width**2) / width**2
    return column * np.exp(0.7 * noise(count, 1.9, 12)) * (radius(count) < 1.1)


def rock(count: int) -> np.ndarray:
    """Porous matter: two thirds are dense."""
    return np.where(noise(count, 1.6, 13) > -0.4, 1.0, 0.02) * (radius(count) < 0.95)


def fibres(count: int) -> np.ndarray:
    """Dense threads of one or two voxels along two axes."""
    rng = np.random.default_rng(14)
    found = np.zeros((count,) * 3)
    for axis in (0, 2):
        for _ in range(12):
            i, j = rng.integers(count // 8, count - count // 8, 2)
            index = [slice(i, i + 1), slice(j, j + 2)]
            index.insert(axis, slice(count // 10, -(count // 10) or None))
            found[tuple(index)] = 1.0
    return found


def bubbles(count: int) -> np.ndarray:
    """Empty spheres in even matter."""
    rng = np.random.default_rng(15)
    at = (np.indices((count,) * 3) + 0.5) / count
    found = np.ones((count,) * 3)
    for _ in range(14):
        centre, size = rng.uniform(0.1, 0.9, 3), rng.uniform(0.05, 0.16)
        found[sum((a - c) ** 2 for a, c in zip(at, centre, strict=True)) < size**2] = 0.0
    return found


def stone(count: int) -> np.ndarray:
    """A small dense ball in thin fog."""
    z, y, x = (np.indices((count,) * 3) + 0.5) / count * 2 - 1
    ball = (x - 0.2) ** 2 + (y + 0.1) ** 2 + (z - 0.1) ** 2 < 0.3**2
    return np.where(ball, 1.0, 0.01)


def grains(count: int) -> np.ndarray:
    """Random values in a ball, the same in 2^3 voxels."""
    half = np.random.default_rng(16).gamma(0.3, size=(count // 2,) * 3)
    return half.repeat(2, 0).repeat(2, 1).repeat(2, 2) * (radius(count) < 0.9)


def sheets(count: int) -> np.ndarray:
    """Thin folded sheets."""
    return np.exp(-((noise(count, 2.3, 17) / 0.15) ** 2)) * np.exp(-2 * radius(count) ** 4)


def _sized(field, count: int):
    """Return ``field`` on ``count``^3 voxels, with a name for tables."""
    found = partial(field, count)
    found.__name__ = f"{field.__name__} {count}^3,"
    return found


class Listed(Case):
    """A listed scene, with the interface of a drawn one."""

    is_chromatic = False

    def describe(self) -> str:
        """Return one line for a table."""
        return self.name

    def build(self, integrator: dict, folder: Path | None = None) -> dict:
        """Return the dictionary for `mi.load_dict`."""
        return super().build(integrator)


def _listed() -> list[Listed]:
    def case(field, count: int, *args, **kwargs) -> Listed:
        return Listed(_sized(field, count), *args, **kwargs)

    return [
        case(even, 1, 2.0, "sun"), case(even, 2, 12.0, "sky", albedo=0.98),
        case(corner, 12, 3.0, "point"), case(corner, 40, 8.0, "side", "hg 0.5"),
        case(stratus, 72, 9.0, "sun in sky", albedo=0.999),
        case(stratus, 72, 5.0, "sun", "hg 0.8", albedo=0.99), case(plume, 56, 2.0, "constant"),
        case(plume, 88, 4.0, "window"), case(plume, 56, 3.0, "sun", ground=True),
        case(rock, 48, 10.0, "sky"), case(rock, 96, 25.0, "lamp", albedo=0.7),
        case(fibres, 64, 1.5, "constant"), case(fibres, 96, 2.5, "sun", max_depth=2),
        case(bubbles, 80, 4.0, "side", edges=(2.0, 2.0, 1.0)),
        case(bubbles, 40, 2.0, "point inside"), case(stone, 64, 6.0, "sky"),
        case(stone, 32, 3.0, "lamp", ground=True), case(grains, 64, 3.0, "constant", max_depth=2),
        case(sheets, 160, 4.0, "sun", albedo=0.8), case(sheets, 256, 3.0, "sky"),
    ]  # fmt: skip


def _drawn() -> list[RandomScene]:
    """Return the first `DRAWN` scenes of `SEED` that scatter."""
    found, index = [], 0
    while len(found) < DRAWN:
        case = RandomScene.draw(SEED, index)
        index += 1
        if case.max_depth > 1 or case.max_depth == -1:
            found += [case] if case.albedo != "0" else []
    return found


def unseen() -> list[tuple[str, Listed | RandomScene]]:
    """Return the scenes with their titles, listed and drawn ones in turn."""
    listed = [(case.describe(), case) for case in _listed()]
    drawn = [(f"random {case.index}: {case.describe()}", case) for case in _drawn()]
    return [scene for pair in zip(listed, drawn, strict=True) for scene in pair]


def load(case: Listed | RandomScene, integrator: str, folder: Path, **settings) -> mi.Scene:
    """Load a scene with a cold cache."""
    return mi.load_dict(case.build({"type": integrator} | case.properties | settings, folder))
