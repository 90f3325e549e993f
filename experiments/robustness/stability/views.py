"""Hazards of positions and directions: worlds, rays, cameras, emitters and films."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi
import numpy as np

from experiments.robustness.stability import properties as p
from experiments.robustness.stability.case import CLOUD, FURNACE, Case, case, same_as
from experiments.robustness.stability.worlds import (
    RESOLUTION,
    Camera,
    Matter,
    World,
    scene,
    texture,
)


def scales() -> list[Case]:
    """Return the same cloud in worlds of other units."""
    same = p.like(same_as(CLOUD), 1e-3, 0.02)
    return [
        case("world scale", f"{scale:g}", same, p.no_brighter(), matter=CLOUD, world=World(scale))
        for scale in (1e-6, 1e-5, 1e-3, 0.1, 10.0, 1e3, 1e5, 1e6)
    ]


def offsets() -> list[Case]:
    """Return the same cloud far away from the origin.

    If single precision distinguishes its voxels, the image is the same; else it is refused.
    """
    same = p.like(same_as(CLOUD), 0.01, 0.03)
    found = [
        case("offset", f"{offset:g}", same, p.no_brighter(), matter=CLOUD, world=World(1.0, offset))
        for offset in (1.0, 1e2, 1e3, 1e4, 1e5)
    ]
    found += [
        case(
            "offset",
            f"{offset:g}",
            matter=CLOUD,
            world=World(1.0, offset),
            refused="move it to the origin",
        )
        for offset in (1e6, 1e7)
    ]
    big = World(1e6, 1e6)
    found.append(case("offset", "1e6, of a scale of 1e6", same, matter=CLOUD, world=big))
    return found


def _bundle(*lines: tuple) -> Callable[[], mi.Ray3f]:
    """Return rays with these origins and directions."""

    def make() -> mi.Ray3f:
        origins, directions = (np.float32(part).T for part in zip(*lines, strict=True))
        return mi.Ray3f(
            mi.Point3f([mi.Float(v.tolist()) for v in origins]),
            mi.Vector3f([mi.Float(v.tolist()) for v in directions]),
        )

    return make


def rays() -> list[Case]:
    """Return rays along axes, in faces and edges, grazing, with denormal components."""
    box = Matter(texture((4, 4, 4), 0.5, 2.0), 1.0)
    tiny = 1e-40
    bundles = {
        "along axes": [
            ((0.1, 0.2, -5), (0, 0, 1)),
            ((-5, 0.1, 0.2), (1, 0, 0)),
            ((0.1, 5, 0.2), (0, -1, 0)),
            ((0, 0, -5), (0, 0, 1)),
            ((0.5, 0.5, 5), (0, 0, -1)),
            ((0.25, -0.25, -5), (0, 0, 1)),
        ],
        "in faces and edges": [
            ((1, 0.2, -5), (0, 0, 1)),
            ((1, 1, -5), (0, 0, 1)),
            ((-1, -1, 5), (0, 0, -1)),
            ((-5, 1, 1), (1, 0, 0)),
            ((-3, -3, 1), (0.70710678, 0.70710678, 0)),
            ((-3, -3, -3), (0.57735027, 0.57735027, 0.57735027)),
        ],
        "grazing": [
            ((0.9999999, 0, -5), (0, 0, 1)),
            ((1.0000001, 0, -5), (0, 0, 1)),
            ((0.99999, 0, -5), (0, 0, 1)),
            ((1.00001, 0, -5), (0, 0, 1)),
            ((1 - 5e-6, 0, -5), (1e-6, 0, 1)),
            ((-5, 0.9999999, 0.9999999), (1, 0, 0)),
            ((3, -1, 0), (-0.70710678, 0.70710678, 0)),
        ],
        "denormal": [
            ((0.1, 0.2, -5), (tiny, tiny, 1)),
            ((0.1, 0.2, -5), (-tiny, 0, 1)),
            ((-5, 1, 0.2), (1, -tiny, tiny)),
            ((1, 0.2, -5), (-1e-30, 1e-30, 1)),
            ((0.1, 0.2, -5), (-0.0, -0.0, 1)),
            ((tiny, -tiny, -5), (0, 0, 1)),
        ],
    }
    found = []
    for name, lines in bundles.items():
        bundle = _bundle(*lines)
        found.append(case("rays", f"{name}, furnace", p.furnace, matter=box, rays=bundle))
        through = np.array([_chord(*line) for line in lines])
        inside = ~np.isnan(through)
        kept = _bundle(*(line for line, ok in zip(lines, inside, strict=True) if ok))
        expected = np.exp(-0.8 * through[inside])[:, None]
        found.append(
            case(
                "rays",
                f"{name}, transmittance",
                p.is_value(expected),
                matter=Matter(0.8, 0.0),
                rays=kept,
                settings={"max_depth": 1},
            )
        )
    return found


def _chord(origin: tuple, direction: tuple) -> float:
    """Return the length of a ray in the box [-1, 1]^3.

    NaN if it lies in a face, or passes one within single precision: any length is correct then.
    """
    o, d = np.float64(np.float32(origin)), np.float64(np.float32(direction))
    with np.errstate(divide="ignore", invalid="ignore"):
        lower, upper = (-1 - o) / d, (1 - o) / d
    near, far = np.fmax.reduce(np.fmin(lower, upper)), np.fmin.reduce(np.fmax(lower, upper))
    on_a_face = (np.abs(np.abs(o) - 1) < 5e-6) & (np.abs(d) < 1e-5)
    return np.nan if on_a_face.any() or abs(far - near) < 1e-5 else max(far - near, 0.0)


def cameras() -> list[Case]:
    """Return cameras on faces, edges and corners, far away; within the box but not in its
    medium.
    """
    places = {
        "on a face": Camera((0, 0, -1)),
        "on a face, along it": Camera((0, 0, -1), (1, 0, -1)),
        "on an edge": Camera((1, 0, -1)),
        "on a corner": Camera((1, 1, -1)),
        "in a face's plane": Camera((3, 0, -1), (0, 0, -1)),
        "1e4 away": Camera((0, 0, -1e4), fov=0.02),
        "1e6 away": Camera((0, 0, -1e6), fov=2e-4),
        "beside it": Camera((0, 3, 0), (0, 6, 0)),
        "inside": Camera((0.1, 0.1, 0.1), (1, 0, 0)),
        "of 179 degrees": Camera((0.0, 0.0, -1.01), fov=179.0),
    }
    box = Matter(texture((4, 4, 4), 0.5, 2.0), 1.0)
    ball = replace(box, shape="sphere")
    return [
        case("camera", f"{name} ({matter.shape})", p.furnace, matter=matter, camera=camera)
        for matter in (box, ball)
        for name, camera in places.items()
    ]


def _sky(texel: float) -> dict:
    """Return an environment of 1 with one texel of ``texel``."""
    image = np.ones((8, 16, 3), np.float32)
    image[2, 5] = texel
    return {"type": "envmap", "bitmap": mi.Bitmap(image)}


def lights() -> list[Case]:
    """Return environments with one very bright texel, no emitters, and emitters in unusual
    places.
    """

    def under(make: Callable[[], dict], matter: Matter = CLOUD) -> Callable[[dict], mi.Scene]:
        return lambda settings: scene(settings, matter, make())

    found = [
        Case("light", f"a texel of {t:g}", under(lambda t=t: _sky(t)), (p.no_brighter(t),))
        for t in (1e6, 1e30)
    ]
    for value in (0.0, 1e-38, 1e-30, 1e30):
        sky = {"type": "constant", "radiance": value}
        properties = (p.no_brighter(value),) if value else (p.is_value(0.0),)
        found.append(Case("light", f"a sky of {value:g}", under(lambda s=sky: s), properties))
    for direction in ((0, 0, 1), (1, 0, 0), (1, 1, 0), (1, 1, 1), (1e-30, 1e-38, -1)):
        sun = {"type": "directional", "direction": list(direction), "irradiance": 1e6}
        found.append(Case("light", f"a sun along {direction}", under(lambda s=sun: s)))
    step = 2 / RESOLUTION  # a voxel of the cache whose corners lie outside of the ball
    ball = replace(CLOUD, sigma_t=np.full((8, 8, 8), 1.0, np.float32), shape="sphere")
    corner = [1 - step / 2] * 3
    places = {
        "at a voxel's centre beside a ball": (corner, ball),
        "just above a face": ([0.1, 0.1, 1.000001], CLOUD),
        "above a voxel's centre": ([step / 2, step / 2, 1 + 1e-4], CLOUD),
        "on a face": ([0.1, 0.1, 1.0], CLOUD),
        "at a voxel's centre": ([step / 2] * 3, CLOUD),
        "1e6 away": ([1e6, 0, 0], CLOUD),
    }
    for name, (place, matter) in places.items():
        lamp = {"type": "point", "position": place, "intensity": 1.0}
        found.append(Case("light", f"a point {name}", under(lambda s=lamp: s, matter)))
    return found


def films() -> list[Case]:
    """Return films of one pixel, with a crop window, and of size 0."""
    sizes = {
        "1x1": {"width": 1, "height": 1},
        "1x9": {"width": 1, "height": 9},
        "a crop of one pixel": {
            "crop_offset_x": 7,
            "crop_offset_y": 7,
            "crop_width": 1,
            "crop_height": 1,
        },
    }
    found = [
        case("film", name, p.furnace, matter=FURNACE, camera=Camera(film=size))
        for name, size in sizes.items()
    ]
    nothing = {"crop_width": 0, "crop_height": 0, "crop_offset_x": 0, "crop_offset_y": 0}
    found.append(
        case("film", "a crop of 0x0", matter=FURNACE, camera=Camera(film=nothing), refused="crop")
    )
    return found
