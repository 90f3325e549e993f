"""Surfaces that reach into a medium in the cube [-1, 1]^3."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from experiments.validation.thick.cases import SKY, SUN, lamp, medium, objects

DIM = {"sky": {"type": "constant", "radiance": 0.3}}


def fog(sigma_t: float, albedo: float = 0.9) -> dict:
    """Return a homogeneous medium."""
    return medium(None, 2 * sigma_t, albedo)


def smoke(depth: float) -> dict:
    """Return a medium with 24^3 smooth random voxels, empty in part."""
    frequency = np.fft.fftfreq(24) * 24
    squared = sum(np.meshgrid(*[frequency**2] * 3))
    noise = np.random.default_rng(1).normal(size=(24, 24, 24))
    values = np.fft.ifftn(np.fft.fftn(noise) * np.exp(-squared / 8)).real
    return medium(np.clip(values / values.std() + 0.3, 0, None), depth)


def grey(value: float) -> dict:
    """Return a diffuse BSDF."""
    return {"type": "diffuse", "reflectance": value}


def ball(centre: tuple, radius: float, bsdf: dict, **more) -> dict:
    """Return a sphere."""
    return {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": bsdf} | more


def sheet(centre: tuple, towards: tuple, size: float, bsdf: dict) -> dict:
    """Return a square of half-width ``size`` whose front faces a direction."""
    target = [c + t for c, t in zip(centre, towards, strict=True)]
    place = mi.ScalarTransform4f().look_at(list(centre), target, [0.1, 0.3, 1]).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def box(centre: tuple, half: tuple, bsdf: dict) -> dict:
    """Return a box with these half-edges."""
    place = mi.ScalarTransform4f().translate(list(centre)).scale(list(half))
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def rod(radius: float, bsdf: dict) -> dict:
    """Return an oblique cylinder."""
    ends = {"p0": [-0.7, -0.5, 0.1], "p1": [0.7, 0.6, -0.2]}
    return {"type": "cylinder", "radius": radius, "bsdf": bsdf} | ends


def two_sided(value: float) -> dict:
    """Return a BSDF that is diffuse on both sides."""
    return {"type": "twosided", "bsdf": grey(value)}


def corner() -> dict:
    """Return three walls in the fog, a lamp above them, and a box."""
    walls = {
        "floor": box((0, -0.9, 0), (0.9, 0.03, 0.9), grey(0.7)),
        "left": box((-0.9, 0, 0), (0.03, 0.9, 0.9), grey(0.6)),
        "back": box((0, 0, -0.9), (0.9, 0.9, 0.03), grey(0.5)),
    }
    emitter = {"type": "area", "radiance": 10.0}
    light = sheet((0, 0.8, 0), (0, -1, 0.001), 0.3, grey(0)) | {"emitter": emitter}
    return walls | {"light": light, "box": box((0.3, -0.5, 0), (0.3, 0.36, 0.3), grey(0.4))}


#: Surfaces with emitters, the medium, and ``max_depth``.
CASES: dict[str, Callable[[], tuple[dict, dict, int]]] = {
    "ball, fog, sky": lambda: (SKY | {"a": ball((0.1, 0, 0), 0.4, grey(0.5))}, fog(1.0), -1),
    "ball, fog, sky, single": lambda: (SKY | {"a": ball((0.1, 0, 0), 0.4, grey(0.5))}, fog(1.0), 2),
    "black rod, fog, sun": lambda: (DIM | SUN | {"a": rod(0.08, grey(0.0))}, fog(1.5), -1),
    "thin rod, fog, sun": lambda: (DIM | SUN | {"a": rod(0.03, grey(0.0))}, fog(1.5), -1),
    "two-sided sheet, fog, sun": lambda: (
        DIM | SUN | {"a": sheet((0, 0.13, 0), (0.3, 1, 0.2), 0.6, two_sided(0.7))}, fog(1.0), -1,
    ),
    "comb of six sheets, fog, sun": lambda: (
        DIM | SUN | {
            f"a{i}": box((-0.75 + 0.3 * i, -0.5, 0), (0.03, 0.5, 0.8), grey(0.8 - 0.1 * i))
            for i in range(6)
        }, fog(1.2), -1,
    ),
    "ground cuts smoke, sky and sun": lambda: (
        DIM | SUN | {"a": sheet((0, -0.4, 0), (0, 1, 0.001), 5.0, grey(0.4))}, smoke(6), -1,
    ),
    "mirror and glossy balls, fog, lamp": lambda: (
        DIM | lamp() | {
            "a": ball((-0.4, -0.2, 0.3), 0.35, {"type": "conductor"}),
            "b": ball((0.4, 0.1, -0.2), 0.3, {"type": "roughconductor", "alpha": 0.3}),
        }, fog(0.8), -1,
    ),
    "metal rod in dense matter, sky": lambda: (
        SKY | {"a": rod(0.12, {"type": "roughconductor", "alpha": 0.2})}, smoke(25), -1,
    ),
    "luminous ball in fog": lambda: (
        {"a": ball((0.2, 0.1, 0), 0.25, grey(0.5), emitter={"type": "area", "radiance": 3.0})},
        fog(2.0), -1,
    ),
    "corner of a room, fog, lamp": lambda: (corner(), fog(0.5), -1),
}  # fmt: skip


def build(name: str) -> tuple[dict, int]:
    """Return the objects of a case and its ``max_depth``."""
    surfaces, interior, depth = CASES[name]()
    return objects(interior, surfaces), depth
