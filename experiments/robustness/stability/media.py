"""Hazards of media: extreme optical depths, albedos and grids."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from experiments.robustness.stability import properties as p
from experiments.robustness.stability.case import CLOUD, FURNACE, SOLVERS, Case, case, same_as
from experiments.robustness.stability.worlds import Matter, blob, scene, texture


def optical_depths() -> list[Case]:
    """Return optical depths of the whole medium, from 0 to opaque.

    From 1e3 on no path from the middle of a voxel leaves the medium, so that only `sweep` solves a
    furnace; and from 1e4 per voxel on the image depends on the surface alone.
    """
    found = []
    for depth in (0, 1e-30, 1e-8, 1e-3, 1, 10, 80, 104, 1e3, 1e4, 1e8, 1e30):
        matter = Matter(depth / 2, 1.0)
        solvers = SOLVERS if depth <= 10 else ("sweep",)
        found.append(
            case(
                "optical depth",
                f"{depth:g}, white",
                p.furnace,
                p.no_brighter(),
                matter=matter,
                solvers=solvers,
            )
        )
        dim = replace(matter, albedo=0.5)
        found.append(case("optical depth", f"{depth:g}, grey", p.no_brighter(), matter=dim))
    for depth in (1e-3, 1e3, 1e30):
        varied = Matter(texture((6, 6, 6), 0, depth / 2), 0.7)
        found.append(case("optical depth", f"{depth:g}, varied", p.no_brighter(), matter=varied))
    return found


def extinctions() -> list[Case]:
    """Return extinctions of single voxels: denormal numbers, and large factors between
    neighbours.

    The empty space that `path` assumes around a voxel grows with the voxel's extinction: up to 1e3
    here.
    """
    found = []
    for low, high in ((1e-38, 1e-38), (1e-45, 1e-40), (1e-38, 1.0), (0.0, 1e3), (0.0, 1e6)):
        values = np.full((5, 5, 5), low, np.float32)
        values[2, 2, 2] = high
        found.append(
            case(
                "extinction",
                f"{low:g} and {high:g}",
                p.no_brighter(),
                matter=Matter(values, 0.9),
                solvers=SOLVERS if high <= 1e3 else ("sweep",),
            )
        )
    for face in range(6):
        values = np.zeros((6, 6, 6), np.float32)
        np.moveaxis(values, face // 2, 0)[-(face % 2)] = 1e3
        wall = Matter(values, 0.9)
        found.append(case("extinction", f"a wall at face {face}", p.no_brighter(), matter=wall))
    return found


def albedos() -> list[Case]:
    """Return albedos of 0, where the image is the transmittance, of 1 and just below."""
    black = Matter(texture((5, 6, 7), 0.0, 3.0), 0.0)
    found = [
        case(
            "albedo",
            "0",
            p.no_brighter(),
            p.like(same_as(black, max_depth=1), 1e-6, 1e-6),
            matter=black,
        )
    ]
    for albedo in (1.0, 1 - 1e-7, 1 - 1e-4, 1e-30):
        matter = replace(FURNACE, albedo=albedo)
        properties = (p.furnace, p.no_brighter()) if albedo > 0.99 else (p.no_brighter(),)
        found.append(case("albedo", f"{albedo:.7g}", *properties, matter=matter))
    spots = replace(CLOUD, albedo=(texture((8, 8, 8), 0, 1) > 0.5).astype(np.float32))
    found.append(case("albedo", "0 and 1 side by side", p.no_brighter(), matter=spots))
    return found


def voxels() -> list[Case]:
    """Return non-cubic, rotated and mirrored voxels: a constant grid is a homogeneous medium."""
    plain = Matter(0.8, 0.9)
    same = p.like(same_as(plain), 0.01, 0.03)
    found = []
    for shape in ((1, 100, 100), (100, 1, 100), (100, 100, 1), (2, 50, 100), (200, 2, 2)):
        constant = replace(plain, sigma_t=np.full(shape, 0.8, np.float32))
        name = ":".join(f"{max(shape) / n:g}" for n in shape[::-1])
        found.append(case("voxels", name, same, p.no_brighter(), matter=constant))
        varied = replace(FURNACE, sigma_t=texture(shape, 0.0, 2.0))
        found.append(case("voxels", f"{name}, furnace", p.furnace, matter=varied))
    for edges in ((2.0, 2.0, 200.0), (200.0, 2.0, 0.02), (0.02, 0.02, 2.0)):
        long = Matter(texture((4, 4, 4), 0, 1), 1.0, edges, turn=30, mirror=True)
        name = ":".join(f"{e / min(edges):g}" for e in edges)
        found.append(
            case("voxels", f"a box of {name}", p.furnace, matter=long, settings={"resolution": 32})
        )
    return found


def grids() -> list[Case]:
    """Return grids of one voxel, one layer, and prime sizes; and caches of one voxel."""
    plain = Matter(0.8, 0.9)
    same = p.like(same_as(plain), 0.01, 0.03)
    found = []
    for shape in ((1, 1, 1), (1, 1, 5), (1, 7, 3), (3, 1, 2), (7, 11, 13), (2, 2, 2), (1, 1, 31)):
        name = "x".join(map(str, shape[::-1]))
        constant = replace(plain, sigma_t=np.full(shape, 0.8, np.float32))
        found.append(case("grid", name, same, matter=constant))
        varied = replace(FURNACE, sigma_t=texture(shape, 0.2, 2.0))
        found.append(case("grid", f"{name}, furnace", p.furnace, matter=varied))
    for resolution in (1, 2, 3, 41):
        found.append(
            case(
                "grid",
                f"a cache of {resolution}",
                p.furnace,
                matter=FURNACE,
                settings={"resolution": resolution, "cache_spp": 64 if resolution < 41 else 32},
            )
        )
    return found


def colours() -> list[Case]:
    """Return extinctions far apart in their channels: each must equal a separate solution."""

    def alone(settings: dict) -> p.Found:
        found = [known(settings) for known in grey]
        image = np.stack([f.image[..., c] for c, f in enumerate(found)], axis=-1)
        return replace(found[0], image=image)

    sigma = blob(8, 1.0)
    factors = (1.0, 10.0, 100.0)
    grey = [same_as(Matter(sigma * f, 0.9)) for f in factors]
    coloured = Matter(sigma[..., None] * np.float32(factors), 0.9)
    same = (p.like(alone, 0.01, 0.05),)
    return [
        Case(
            "colour",
            "extinctions of 1:10:100",
            lambda settings: scene(settings, coloured),
            same if not mi.is_monochromatic else (),
        ),
        case(
            "colour",
            "extinctions of 0:1:10",
            p.no_brighter(),
            matter=Matter(sigma[..., None] * np.float32([0, 1, 10]), 0.9),
        ),
        case(
            "colour", "albedo of 0, 0.5, 1", p.no_brighter(), matter=Matter(sigma, (0.0, 0.5, 1.0))
        ),
    ]


def empty_media() -> list[Case]:
    """Return empty media of several kinds."""
    return [
        case("empty", "a grid of zeros", p.is_sky, matter=Matter(np.zeros((4, 4, 4)), 0.9)),
        case("empty", "an extinction of 0", p.is_sky, matter=Matter(0.0, 0.9)),
        case("empty", "1e-38 everywhere", p.is_sky, matter=Matter(np.full((3, 3, 3), 1e-38), 1.0)),
        case("empty", "no medium", p.is_sky),
        case(
            "empty",
            "a grid of zeros, turned",
            p.is_sky,
            matter=Matter(np.zeros((1, 1, 1)), 1.0, turn=40),
        ),
    ]


def phases() -> list[Case]:
    """Return anisotropic phase functions: at all depths, in few voxels, among empty ones.

    From 0.6 on a forward peak is delta-M scaled.
    """
    found = []
    for g in (-0.5, 0.5, 0.85):
        for depth in (1e-30, 1e-8, 1, 80, 1e4, 1e30):
            white = Matter(depth / 2, 1.0, g=g)
            solvers = SOLVERS if depth <= 1 and g < 0.6 else ("sweep",)
            name = f"g = {g:g}, depth {depth:g}"
            checks = (p.furnace, p.no_brighter())
            found.append(case("phase", name, *checks, matter=white, solvers=solvers))
        for shape in ((1, 1, 1), (1, 1, 31), (7, 11, 13)):
            values = np.where(texture(shape, 0, 1) > 0.7, np.float32(1e3), np.float32(0))
            matter = Matter(values, 0.9, g=g)
            name = f"g = {g:g}, 0 and 1e3 in {'x'.join(map(str, shape[::-1]))}"
            found.append(
                case("phase", name, p.no_brighter(1.02), matter=matter, solvers=("sweep",))
            )
    return found


def phases_over_the_ground() -> list[Case]:
    """Return the same over the ground, with all albedos and illumination from one side."""
    place = mi.ScalarTransform4f().look_at([0, -1.2, 0], [0, 0, 0.001], [0, 1, 0]).scale(4)
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    ground = {"ground": {"type": "rectangle", "to_world": place, "bsdf": white}}
    found = []
    for g in (0.0, 0.5, 0.85):
        for depth in (1e-8, 1, 1e4, 1e30):
            found.append(
                case(
                    "phase over the ground",
                    f"g = {g:g}, depth {depth:g}",
                    p.furnace_of_voxels,
                    matter=Matter(depth / 2, 1.0, g=g),
                    beside=ground,
                    solvers=("sweep",),
                    quadratures=("exponential",),
                )
            )
    return found


def many_samples() -> list[Case]:
    """Return 2^25 samples of one voxel.

    At the centre of a ball all rays have equal length, so the mean of all samples is that of each.
    """
    ball = Matter(0.7, 0.5, shape="sphere")
    return [
        case(
            "samples",
            "2^25 in one voxel",
            p.centre_is(np.exp(-0.7), 1e-6),
            matter=ball,
            settings={"resolution": 1, "cache_spp": 1 << 25, "max_depth": 2},
            solvers=("path",),
            quadratures=("exponential",),
        ),
    ]


def refusals() -> list[Case]:
    """Return invalid media."""
    bad = {
        "a NaN": (np.nan, "not finite"),
        "an infinity": (np.inf, "not finite"),
        "a negative": (-1e-30, "negative"),
    }
    found = []
    for name, (value, said) in bad.items():
        values = np.ones((3, 3, 3), np.float32)
        values[1, 1, 1] = value
        found.append(case("refused", f"{name} voxel", matter=Matter(values, 0.5), refused=said))
    too_white = Matter(texture((3, 3, 3), 0, 1), 1 + 1e-5)
    found.append(case("refused", "an albedo of 1 + 1e-5", matter=too_white, refused="albedo"))
    return found
