"""The hazards: everything in a scene that may break arithmetic, each with what must hold of it.

Every case runs with both solvers, all quadratures, grey and in colour, unless it says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.stability import properties as p
from experiments.stability.worlds import (
    RESOLUTION,
    SAMPLES,
    Camera,
    Matter,
    World,
    blob,
    scene,
    texture,
)
from mitsuba_irrcache.projection import QUADRATURES

SOLVERS = ("sweep", "path")
#: What a cache is asked for; roulette is put off, since its weights grow without end in furnaces.
SETTINGS = {"resolution": RESOLUTION, "cache_spp": 64, "rr_depth": 200}


@dataclass(frozen=True)
class Case:
    """One scene of a hazard.

    Attributes:
        build: makes the scene with an integrator of these properties.
        properties: what must hold; that all is finite and not negative always must.
        settings: of the integrator, where they differ from `SETTINGS`.
        solvers, quadratures: those that it runs with.
        rays: along which to look instead of through the camera.
        refused: a part of the message with which the scene must be refused.
    """

    hazard: str
    name: str
    build: Callable[[dict], mi.Scene]
    properties: tuple = ()
    settings: dict = field(default_factory=dict)
    solvers: tuple[str, ...] = SOLVERS
    quadratures: tuple[str, ...] = QUADRATURES
    rays: Callable[[], mi.Ray3f] | None = None
    refused: str = ""

    def observe(self, settings: dict) -> p.Found:
        """What this case looks like with an integrator of these properties."""
        return p.observe(self.build(settings), settings, SAMPLES, self.rays)

    def judge(self, settings: dict) -> list[p.Verdict]:
        """Every property with its error and the largest one admitted."""
        settings = SETTINGS | self.settings | settings
        if self.refused:
            said = p.refusal(lambda: self.observe(settings))
            return [(f"refused ({said or 'rendered'})", float(self.refused not in said), 0.0)]
        found = self.observe(settings)
        return [check(found) for check in (p.finite, p.not_negative, *self.properties)]


def _case(
    hazard: str, name: str, *properties, matter=None, light=None, camera=None, world=None, **options
) -> Case:
    """A case whose scene `worlds.scene` makes of these."""
    return Case(
        hazard,
        name,
        lambda settings: scene(settings, matter, light, camera, world),
        properties,
        **options,
    )


CLOUD = Matter(blob(8, 3.0), 0.9)
FURNACE = Matter(texture((5, 6, 7), 0.0, 3.0), 1.0, (2.0, 1.6, 1.2), turn=20)


def _same_as(matter: Matter, **changes) -> Callable[[dict], p.Found]:
    """What another description of the same problem looks like, with ``changes`` of the settings;
    rendered once for all cases.
    """
    known: dict[tuple, p.Found] = {}

    def observed(settings: dict) -> p.Found:
        settings = settings | changes
        key = (mi.variant(), *sorted(settings.items()))
        if key not in known:
            known[key] = p.observe(scene(settings, matter), settings, SAMPLES)
        return known[key]

    return observed


def cases() -> list[Case]:
    """All of them, hazard by hazard."""
    makers = (
        optical_depths,
        extinctions,
        albedos,
        scales,
        offsets,
        voxels,
        grids,
        rays,
        cameras,
        lights,
        colours,
        films,
        empty_media,
        many_samples,
        refusals,
    )
    return [case for make in makers for case in make()]


def optical_depths() -> list[Case]:
    """Of the whole medium, from nothing to walls. From 1e3 on no path that starts in the middle of
    a voxel comes out, so that only `sweep` knows that a furnace is white; and from 1e4 on per
    voxel the image is that of the surface alone.
    """
    found = []
    for depth in (0, 1e-30, 1e-8, 1e-3, 1, 10, 80, 104, 1e3, 1e4, 1e8, 1e30):
        matter = Matter(depth / 2, 1.0)
        solvers = SOLVERS if depth <= 10 else ("sweep",)
        found.append(
            _case(
                "optical depth",
                f"{depth:g}, white",
                p.furnace,
                p.no_brighter(),
                matter=matter,
                solvers=solvers,
            )
        )
        dim = replace(matter, albedo=0.5)
        found.append(_case("optical depth", f"{depth:g}, grey", p.no_brighter(), matter=dim))
    for depth in (1e-3, 1e3, 1e30):
        varied = Matter(texture((6, 6, 6), 0, depth / 2), 0.7)
        found.append(_case("optical depth", f"{depth:g}, varied", p.no_brighter(), matter=varied))
    return found


def extinctions() -> list[Case]:
    """Of single voxels beside others: denormal numbers, and large factors between neighbours. What
    `path` takes for the air around a voxel grows with the voxel's extinction: up to 1e3 here.
    """
    found = []
    for low, high in ((1e-38, 1e-38), (1e-45, 1e-40), (1e-38, 1.0), (0.0, 1e3), (0.0, 1e6)):
        values = np.full((5, 5, 5), low, np.float32)
        values[2, 2, 2] = high
        found.append(
            _case(
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
        found.append(_case("extinction", f"a wall at face {face}", p.no_brighter(), matter=wall))
    return found


def albedos() -> list[Case]:
    """0, where the picture is the transmittance; 1 and just below."""
    black = Matter(texture((5, 6, 7), 0.0, 3.0), 0.0)
    found = [
        _case(
            "albedo",
            "0",
            p.no_brighter(),
            p.like(_same_as(black, max_depth=1), 1e-6, 1e-6),
            matter=black,
        )
    ]
    for albedo in (1.0, 1 - 1e-7, 1 - 1e-4, 1e-30):
        matter = replace(FURNACE, albedo=albedo)
        properties = (p.furnace, p.no_brighter()) if albedo > 0.99 else (p.no_brighter(),)
        found.append(_case("albedo", f"{albedo:.7g}", *properties, matter=matter))
    spots = replace(CLOUD, albedo=(texture((8, 8, 8), 0, 1) > 0.5).astype(np.float32))
    found.append(_case("albedo", "0 and 1 side by side", p.no_brighter(), matter=spots))
    return found


def scales() -> list[Case]:
    """The same cloud in worlds of other units."""
    same = p.like(_same_as(CLOUD), 1e-3, 0.02)
    return [
        _case("world scale", f"{scale:g}", same, p.no_brighter(), matter=CLOUD, world=World(scale))
        for scale in (1e-6, 1e-5, 1e-3, 0.1, 10.0, 1e3, 1e5, 1e6)
    ]


def offsets() -> list[Case]:
    """The same cloud far away from the origin: where single precision can tell its voxels apart,
    the same picture; else it is refused.
    """
    same = p.like(_same_as(CLOUD), 0.01, 0.03)
    found = [
        _case(
            "offset", f"{offset:g}", same, p.no_brighter(), matter=CLOUD, world=World(1.0, offset)
        )
        for offset in (1.0, 1e2, 1e3, 1e4, 1e5)
    ]
    found += [
        _case(
            "offset",
            f"{offset:g}",
            matter=CLOUD,
            world=World(1.0, offset),
            refused="move it to the origin",
        )
        for offset in (1e6, 1e7)
    ]
    big = World(1e6, 1e6)
    found.append(_case("offset", "1e6, of a scale of 1e6", same, matter=CLOUD, world=big))
    return found


def voxels() -> list[Case]:
    """Far from cubic ones, turned and mirrored: a constant grid is a homogeneous medium."""
    plain = Matter(0.8, 0.9)
    same = p.like(_same_as(plain), 0.01, 0.03)
    found = []
    for shape in ((1, 100, 100), (100, 1, 100), (100, 100, 1), (2, 50, 100), (200, 2, 2)):
        constant = replace(plain, sigma_t=np.full(shape, 0.8, np.float32))
        name = ":".join(f"{max(shape) / n:g}" for n in shape[::-1])
        found.append(_case("voxels", name, same, p.no_brighter(), matter=constant))
        varied = replace(FURNACE, sigma_t=texture(shape, 0.0, 2.0))
        found.append(_case("voxels", f"{name}, furnace", p.furnace, matter=varied))
    for edges in ((2.0, 2.0, 200.0), (200.0, 2.0, 0.02), (0.02, 0.02, 2.0)):
        long = Matter(texture((4, 4, 4), 0, 1), 1.0, edges, turn=30, mirror=True)
        name = ":".join(f"{e / min(edges):g}" for e in edges)
        found.append(
            _case("voxels", f"a box of {name}", p.furnace, matter=long, settings={"resolution": 32})
        )
    return found


def grids() -> list[Case]:
    """One voxel, one layer, prime numbers of them; caches of one voxel."""
    plain = Matter(0.8, 0.9)
    same = p.like(_same_as(plain), 0.01, 0.03)
    found = []
    for shape in ((1, 1, 1), (1, 1, 5), (1, 7, 3), (3, 1, 2), (7, 11, 13), (2, 2, 2), (1, 1, 31)):
        name = "x".join(map(str, shape[::-1]))
        constant = replace(plain, sigma_t=np.full(shape, 0.8, np.float32))
        found.append(_case("grid", name, same, matter=constant))
        varied = replace(FURNACE, sigma_t=texture(shape, 0.2, 2.0))
        found.append(_case("grid", f"{name}, furnace", p.furnace, matter=varied))
    for resolution in (1, 2, 3, 41):
        found.append(
            _case(
                "grid",
                f"a cache of {resolution}",
                p.furnace,
                matter=FURNACE,
                settings={"resolution": resolution, "cache_spp": 64 if resolution < 41 else 32},
            )
        )
    return found


def _bundle(*lines: tuple) -> Callable[[], mi.Ray3f]:
    """Rays of these origins and directions."""

    def make() -> mi.Ray3f:
        origins, directions = (np.float32(part).T for part in zip(*lines, strict=True))
        return mi.Ray3f(
            mi.Point3f([mi.Float(v.tolist()) for v in origins]),
            mi.Vector3f([mi.Float(v.tolist()) for v in directions]),
        )

    return make


def rays() -> list[Case]:
    """Along axes, in faces and edges, grazing, with denormal components."""
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
        found.append(_case("rays", f"{name}, furnace", p.furnace, matter=box, rays=bundle))
        through = np.array([_chord(*line) for line in lines])
        inside = ~np.isnan(through)
        kept = _bundle(*(line for line, ok in zip(lines, inside, strict=True) if ok))
        expected = np.exp(-0.8 * through[inside])[:, None]
        found.append(
            _case(
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
    """Length of a ray in the box [-1, 1]^3; NaN where it lies in a face, and has none or all of it,
    or misses one by less than single precision can tell.
    """
    o, d = np.float64(np.float32(origin)), np.float64(np.float32(direction))
    with np.errstate(divide="ignore", invalid="ignore"):
        lower, upper = (-1 - o) / d, (1 - o) / d
    near, far = np.fmax.reduce(np.fmin(lower, upper)), np.fmin.reduce(np.fmax(lower, upper))
    on_a_face = (np.abs(np.abs(o) - 1) < 5e-6) & (np.abs(d) < 1e-5)
    return np.nan if on_a_face.any() or abs(far - near) < 1e-5 else max(far - near, 0.0)


def cameras() -> list[Case]:
    """On faces, edges and corners, far away; within the box but not in its medium."""
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
        _case("camera", f"{name} ({matter.shape})", p.furnace, matter=matter, camera=camera)
        for matter in (box, ball)
        for name, camera in places.items()
    ]


def _sky(texel: float) -> dict:
    """An environment of 1 with one texel of ``texel``."""
    image = np.ones((8, 16, 3), np.float32)
    image[2, 5] = texel
    return {"type": "envmap", "bitmap": mi.Bitmap(image)}


def lights() -> list[Case]:
    """One very bright texel, no light, lights in odd places."""

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
    step = 2 / RESOLUTION  # a voxel of the cache, whose corners lie outside of a ball
    ball = replace(CLOUD, sigma_t=np.full((8, 8, 8), 1.0, np.float32), shape="sphere")
    corner = [1 - step / 2] * 3
    places = {
        "at a voxel's centre beside a ball": (corner, ball),
        "just above a face": ([0.1, 0.1, 1.000001], CLOUD),
        "above a voxel's centre": ([step / 2, step / 2, 1 + 1e-4], CLOUD),
        "1e6 away": ([1e6, 0, 0], CLOUD),
    }
    for name, (place, matter) in places.items():
        lamp = {"type": "point", "position": place, "intensity": 1.0}
        found.append(Case("light", f"a point {name}", under(lambda s=lamp: s, matter)))
    for name, place in (("on a face", [0.1, 0.1, 1.0]), ("at a voxel's centre", [step / 2] * 3)):
        lamp = {"type": "point", "position": place, "intensity": 1.0}
        found.append(
            Case("light", f"a point {name}", under(lambda s=lamp: s), refused="inside the medium")
        )
    return found


def colours() -> list[Case]:
    """Extinctions far apart in their channels: each as if it were alone."""

    def alone(settings: dict) -> p.Found:
        found = [known(settings) for known in grey]
        image = np.stack([f.image[..., c] for c, f in enumerate(found)], axis=-1)
        return replace(found[0], image=image)

    sigma = blob(8, 1.0)
    factors = (1.0, 10.0, 100.0)
    grey = [_same_as(Matter(sigma * f, 0.9)) for f in factors]
    coloured = Matter(sigma[..., None] * np.float32(factors), 0.9)
    same = (p.like(alone, 0.01, 0.05),)
    return [
        Case(
            "colour",
            "extinctions of 1:10:100",
            lambda settings: scene(settings, coloured),
            same if not mi.is_monochromatic else (),
        ),
        _case(
            "colour",
            "extinctions of 0:1:10",
            p.no_brighter(),
            matter=Matter(sigma[..., None] * np.float32([0, 1, 10]), 0.9),
        ),
        _case(
            "colour", "albedo of 0, 0.5, 1", p.no_brighter(), matter=Matter(sigma, (0.0, 0.5, 1.0))
        ),
    ]


def films() -> list[Case]:
    """One pixel, a crop, none at all."""
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
        _case("film", name, p.furnace, matter=FURNACE, camera=Camera(film=size))
        for name, size in sizes.items()
    ]
    nothing = {"crop_width": 0, "crop_height": 0, "crop_offset_x": 0, "crop_offset_y": 0}
    found.append(
        _case("film", "a crop of 0x0", matter=FURNACE, camera=Camera(film=nothing), refused="crop")
    )
    return found


def empty_media() -> list[Case]:
    """Nothing at all, in several ways."""
    return [
        _case("empty", "a grid of zeros", p.is_sky, matter=Matter(np.zeros((4, 4, 4)), 0.9)),
        _case("empty", "an extinction of 0", p.is_sky, matter=Matter(0.0, 0.9)),
        _case("empty", "1e-38 everywhere", p.is_sky, matter=Matter(np.full((3, 3, 3), 1e-38), 1.0)),
        _case("empty", "no medium", p.is_sky),
        _case(
            "empty",
            "a grid of zeros, turned",
            p.is_sky,
            matter=Matter(np.zeros((1, 1, 1)), 1.0, turn=40),
        ),
    ]


def many_samples() -> list[Case]:
    """2^25 samples of one voxel: in the middle of a ball every ray is as long, so the mean of all
    samples is that of each.
    """
    ball = Matter(0.7, 0.5, shape="sphere")
    return [
        _case(
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
    """What no medium can be."""
    bad = {
        "a NaN": (np.nan, "not finite"),
        "an infinity": (np.inf, "not finite"),
        "a negative": (-1e-30, "negative"),
    }
    found = []
    for name, (value, said) in bad.items():
        values = np.ones((3, 3, 3), np.float32)
        values[1, 1, 1] = value
        found.append(_case("refused", f"{name} voxel", matter=Matter(values, 0.5), refused=said))
    too_white = Matter(texture((3, 3, 3), 0, 1), 1 + 1e-5)
    found.append(_case("refused", "an albedo of 1 + 1e-5", matter=too_white, refused="albedo"))
    return found


def clear() -> None:
    """Frees what Dr.Jit holds on to between cases."""
    dr.flush_malloc_cache()
