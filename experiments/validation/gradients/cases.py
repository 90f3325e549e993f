"""Scenes of which gradients are compared with finite differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)

EDGE = 2.0
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}}
WHITE = {"type": "constant", "radiance": 1.0}
SUN = {
    "type": "directional",
    "direction": [0.4, -1.0, 0.55],
    "irradiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]},
}
POINT = {
    "type": "point",
    "position": [0.4, 3.0, 1.0],
    "intensity": {"type": "rgb", "value": [20.0, 15.0, 12.0]},
}
#: A sun behind the medium, almost in the line of sight of `Case.origin`.
BEHIND = SUN | {"direction": [1.05, 1.5, -5.0]}
LAMP = {"type": "point", "position": [0.13, 0.2, -0.1], "intensity": 1.0}


def blob(count: int, centre: tuple, width: float) -> np.ndarray:
    """A Gaussian on a grid of so many voxels along each side, in units of the grid's edge."""
    x = (np.arange(count) + 0.5) / count
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    cx, cy, cz = centre
    square = (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2
    return np.exp(-0.5 * square / width**2)


def matter(count: int) -> np.ndarray:
    """A smooth density of maximum 1 that falls off towards the boundary."""
    values = 0.9 * blob(count, (0.5, 0.5, 0.5), 0.17) + 0.35 * blob(count, (0.3, 0.62, 0.4), 0.1)
    return values / values.max()


def sky_with_sun() -> dict:
    """An environment map of 16 x 32 texels with a bright spot."""
    rows, columns = np.meshgrid(np.arange(16), np.arange(32), indexing="ij")
    values = 0.4 + 0.3 * np.cos(columns * np.pi / 16) * np.sin(rows * np.pi / 16)
    values = values[..., None] * [0.8, 0.9, 1.0]
    values[4, 7] += [60.0, 55.0, 40.0]
    return {"type": "envmap", "bitmap": mi.Bitmap(values.astype(np.float32))}


def spot() -> dict:
    """A narrow spot light."""
    look = mi.ScalarTransform4f().look_at([0.5, 3.0, 0.0], [0, 0, 0], [1, 0, 0])
    return {"type": "spot", "to_world": look, "intensity": 5.0, "cutoff_angle": 12.0}


@dataclass(frozen=True)
class Case:
    """A scene: voxels of its data and of the cache along a side, optical depth of the densest data
    voxel, and what differs from a grey cube under a constant sky.
    """

    data: int = 16
    cache: int = 16
    depth: float = 0.38
    max_depth: int = -1
    emitters: Callable[[], dict] = field(default=lambda: {"sky": WHITE})
    extinction: tuple[float, ...] = (1.0,)
    albedo: tuple[float, ...] = (0.85,)
    empty_below: float = 0.0
    #: no matter at larger x than this, in edges of the grid; and where perturbations are
    empty_beyond: float = 1.0
    changed: tuple[float, float] = (0.25, 0.75)
    turn: float = 0.0
    #: whether the density is the same up to the boundary
    even: bool = False
    shape: str = "cube"
    homogeneous: bool = False
    filter: str = "box"
    pixels: str = "rgb"
    emissive: bool = False
    #: mean cosine of a Henyey-Greenstein phase function; None: isotropic scattering
    g: float | None = None
    #: directions of the cache; 0: the default
    directions: int = 0
    parameters: tuple[str, ...] = ("sigma_t", "albedo")
    #: largest perturbation of the extinction, relative to its maximum
    step: float = 0.03
    #: camera samples of each pixel, and caches with other random numbers over which both the
    #: gradient and the differences are averaged
    samples: int = 64
    caches: int = 1
    #: position of the camera, which looks at the centre
    origin: tuple[float, float, float] = (1.0, 1.5, -5.0)
    #: further shapes, by their ids
    objects: Callable[[], dict] = field(default=dict)

    def sigma_t(self) -> np.ndarray:
        """Extinction (z, y, x, channel)."""
        values = np.ones((self.data,) * 3) if self.even else matter(self.data)
        values = np.where(values < self.empty_below, 0, values)
        values[:, :, round(self.empty_beyond * self.data) :] = 0
        peak = self.depth * self.data / EDGE
        return (values[..., None] * np.array(self.extinction) * peak).astype(np.float32)

    def albedos(self) -> np.ndarray:
        """Albedo (z, y, x, channel)."""
        values = 1 + 0.1 * blob(self.data, (0.6, 0.4, 0.5), 0.2)[..., None]
        return (values * np.array(self.albedo)).astype(np.float32)

    def emission(self) -> np.ndarray:
        """Emission coefficient (z, y, x, channel)."""
        plane = 0.5 * blob(self.data, (0.5, 0.45, 0.6), 0.15)[..., None]
        return (0.01 + plane * [1.0, 0.6, 0.3]).astype(np.float32)

    def load(self, **properties: object) -> mi.Scene:
        """Load the scene; ``properties`` are the integrator's."""
        place = placed(self.turn)
        integrator = {
            "type": "irrcache",
            "solver": "sweep",
            "resolution": self.cache,
            "max_depth": self.max_depth,
            "cache_spp": self.directions,
        }
        if self.emissive:
            integrator["emission"] = _volume(self.emission(), place)
        look = mi.ScalarTransform4f().look_at([*self.origin], [0, 0, 0], [0, 1, 0])
        film = {
            "type": "hdrfilm",
            "width": 32,
            "height": 32,
            "pixel_format": self.pixels,
            "component_format": "float32",
            "rfilter": {"type": self.filter},
        }
        centre = mi.ScalarTransform4f(
            place @ np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
        )
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": integrator | properties if "type" not in properties else properties,
                "sensor": {"type": "perspective", "fov": 34.0, "to_world": look, "film": film},
                "shape": {
                    "type": self.shape,
                    "to_world": centre,
                    "bsdf": {"type": "null"},
                    "interior": self._medium(place),
                },
            }
            | self.emitters()
            | self.objects()
        )

    def _medium(self, place: np.ndarray) -> dict:
        phase = {} if self.g is None else {"phase": {"type": "hg", "g": self.g}}
        return self._volumes(place) | phase

    def _volumes(self, place: np.ndarray) -> dict:
        if self.homogeneous:
            peak = self.depth * self.cache / EDGE
            extinction = [float(e) * peak for e in self.extinction]
            return {
                "type": "homogeneous",
                "sigma_t": _constant(extinction),
                "albedo": _constant(list(self.albedo)),
            }
        return {
            "type": "heterogeneous",
            "sigma_t": _volume(self.sigma_t(), place),
            "albedo": _volume(self.albedos(), place),
        }


def placed(turn: float) -> np.ndarray:
    """``to_world`` of the unit cube for a cube around the origin, turned by so many degrees."""
    axis = np.array([0.48, 0.64, 0.6])
    cross = np.cross(np.eye(3), axis)
    angle = np.deg2rad(turn)
    matrix = np.eye(4)
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    matrix[:3, :3] = EDGE * rotation
    matrix[:3, 3] = -0.5 * matrix[:3, :3].sum(axis=1)
    return matrix


def _volume(values: np.ndarray, place: np.ndarray) -> dict:
    grid = mi.VolumeGrid(values)
    return {
        "type": "gridvolume",
        "grid": grid,
        "raw": True,
        "to_world": mi.ScalarTransform4f(place),
    }


def _constant(values: list[float]) -> dict:
    value = {"type": "rgb", "value": values} if len(values) == 3 else values[0]
    return {"type": "constvolume", "value": value}


def _under(**emitters: dict) -> Callable[[], dict]:
    return lambda: emitters


def anisotropic() -> dict[str, Case]:
    """Cases with Henyey-Greenstein phase functions."""
    found = {}
    for label, emitters in (
        ("sky", _under(sky=WHITE)),
        ("sun", _under(sun=SUN)),
        ("envmap", lambda: {"sky": sky_with_sun()}),
    ):
        for g in (-0.4, 0.3):
            found[f"hg {g}, {label}, single"] = Case(g=g, emitters=emitters, max_depth=2)
        for g in (-0.4, 0.3, 0.6, 0.85):
            found[f"hg {g}, {label}"] = Case(g=g, emitters=emitters)
        found[f"hg 0.85, {label}, 512 directions"] = Case(g=0.85, emitters=emitters, directions=512)
    both, by_g = _under(sky=SKY, sun=SUN), {"parameters": ("g",)}
    empty = {"empty_beyond": 0.5, "changed": (0.75, 0.85)}
    return found | {
        "hg 0.3, point": Case(g=0.3, emitters=_under(point=POINT)),
        "hg 0.3, point in the medium": Case(g=0.3, emitters=_under(point=LAMP), samples=1024),
        "hg 0.6, spot": Case(g=0.6, emitters=lambda: {"spot": spot()}),
        "hg 0.6, coloured albedo": Case(g=0.6, emitters=both, albedo=(0.6, 0.75, 0.85)),
        "hg 0.3, coloured extinction": Case(g=0.3, extinction=(0.5, 0.8, 1.0), **COLOURED),
        "hg 0.6, voxel depth 1.2, sun": Case(g=0.6, depth=1.2, emitters=_under(sun=SUN)),
        "hg 0.3, empty voxels": Case(g=0.3, **empty),
        "hg 0.85, empty voxels": Case(g=0.85, **empty),
        "hg 0.6, no matter": Case(g=0.6, empty_beyond=0.0, parameters=("sigma_t",)),
        "hg 0.6, data finer than the cache": Case(data=24, cache=12, depth=0.2, g=0.6),
        "hg 0.3, sphere": Case(shape="sphere", g=0.3),
        "hg 0.6, homogeneous": Case(homogeneous=True, depth=0.1, g=0.6, emitters=both),
        "hg 0.54, sun, single": Case(g=0.54, emitters=_under(sun=SUN), max_depth=2, **by_g),
        "hg 0.54, envmap": Case(g=0.54, emitters=lambda: {"sky": sky_with_sun()}, **by_g),
        "hg -0.45, sun": Case(g=-0.45, emitters=_under(sun=SUN), **by_g),
        "hg 0.65, sun": Case(g=0.65, emitters=_under(sun=SUN), **by_g),
        "hg 0.65, coloured albedo": Case(g=0.65, emitters=both, albedo=(0.6, 0.75, 0.85), **by_g),
        "hg 0.65, spot": Case(g=0.65, emitters=lambda: {"spot": spot()}, **by_g),
        "hg 0.82, sun, 512 directions": Case(
            g=0.823, emitters=_under(sun=SUN), directions=512, **by_g
        ),
        "hg 0.8, sun behind": Case(g=0.8, emitters=_under(sun=BEHIND), directions=256, samples=256),
        "hg 0.8, sun behind, by g": Case(
            g=0.8, emitters=_under(sun=BEHIND), directions=256, samples=256, **by_g
        ),
        "hg 0.6, radiance of sky and sun": Case(g=0.6, emitters=both, parameters=("sky", "sun")),
        "hg 0.3, intensity of a point": Case(
            g=0.3, emitters=_under(point=POINT), parameters=("point",)
        ),
        "hg 0.6, texels of an envmap": Case(
            g=0.6, emitters=lambda: {"sky": sky_with_sun()}, parameters=("sky",)
        ),
        "hg 0.6, emission": Case(g=0.6, emissive=True, empty_beyond=0.5, parameters=("emission",)),
    }


def ground(reflectance: object = 0.5) -> dict:
    """A diffuse square below the medium."""
    place = mi.ScalarTransform4f().translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(6)
    bsdf = {"type": "diffuse", "reflectance": reflectance}
    return {"floor": {"type": "rectangle", "to_world": place, "bsdf": bsdf}}


def window() -> dict:
    """A thin pane of glass above the medium, which passes a part of the light unscattered."""
    place = mi.ScalarTransform4f().translate([0, 2.0, 0]).rotate([1, 0, 0], 90).scale(6)
    return {"pane": {"type": "rectangle", "to_world": place, "bsdf": {"type": "thindielectric"}}}


def distant() -> dict:
    """A small object far from the medium, so that rays are traced."""
    return {"far": {"type": "sphere", "center": [0, -3.0, 0], "radius": 0.05}}


def room() -> dict:
    """Five diffuse walls around the medium, open towards the camera."""
    walls = {}
    look = mi.ScalarTransform4f().look_at
    for number, (name, normal) in enumerate({
        "left": [1, 0, 0], "right": [-1, 0, 0], "bottom": [0, 1, 0], "top": [0, -1, 0],
        "back": [0, 0, -1],
    }.items()):  # fmt: skip
        origin = [-1.5 * n for n in normal]
        up = [0, 0, 1] if normal[1] else [0, 1, 0]
        place = look(origin, [o + n for o, n in zip(origin, normal, strict=True)], up)
        # Mitsuba merges shapes of equal BSDFs.
        bsdf = {"type": "diffuse", "reflectance": 0.4 + 0.05 * number}
        walls[name] = {"type": "rectangle", "to_world": place.scale(1.5), "bsdf": bsdf}
    return walls


def lamp() -> dict:
    """A square lamp above the medium."""
    place = mi.ScalarTransform4f().translate([0.2, 2.2, 0]).rotate([1, 0, 0], 90).scale(0.7)
    light = {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}}
    return {"lamp": {"type": "rectangle", "to_world": place, "emitter": light}}


def panel(edge: float, distance: float = 2.5) -> dict:
    """A square lamp behind the medium, as seen by the camera."""
    camera = np.array(Case.origin)
    place = -distance / np.linalg.norm(camera) * camera
    place = mi.ScalarTransform4f().look_at([*place], [0, 0, 0], [0, 1, 0]).scale(edge / 2)
    light = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 0.8, 0.6]}}
    return {"panel": {"type": "rectangle", "to_world": place, "emitter": light}}


def second_medium(away: float, g: float | None = None) -> dict:
    """A homogeneous cube beside the medium, at a distance."""
    place = mi.ScalarTransform4f().translate([-2.0 - away, 0, 0])
    interior = {"type": "homogeneous", "sigma_t": 0.8, "albedo": 0.9}
    if g is not None:
        interior["phase"] = {"type": "hg", "g": g}
    shape = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": interior}
    return {"other": shape}


def surrounded() -> dict[str, Case]:
    """Cases with surfaces, area emitters and several media.

    The irradiance of the cache has random noise there, which differences of images share only in
    part: it has many directions, and perturbations are larger.
    """
    colour = {"type": "rgb", "value": [0.6, 0.5, 0.4]}
    both, by_g = ("sigma_t", "albedo"), {"parameters": ("g",)}
    found = {
        "ground, sky": Case(objects=ground, parameters=(*both, "floor")),
        "ground, sky, 32^3": Case(cache=32, objects=ground),
        "ground, sun": Case(emitters=_under(sun=SUN), objects=ground, parameters=(*both, "floor")),
        "ground, sun, 32^3": Case(cache=32, emitters=_under(sun=SUN), objects=ground),
        "ground, sky and sun, in colour": Case(
            emitters=_under(sky=SKY, sun=SUN),
            objects=lambda: ground(colour),
            parameters=(*both, "floor", "sky", "sun"),
        ),
        "ground, sun through a window": Case(
            emitters=_under(sun=SUN), objects=lambda: ground() | window()
        ),
        "ground, point": Case(emitters=_under(point=POINT), objects=ground),
        "distant object, empty voxels": Case(
            empty_beyond=0.5, changed=(0.75, 0.85), objects=distant, parameters=("sigma_t",)
        ),
        "room, sky": Case(objects=room, parameters=(*both, "left"), caches=3),
        "lamp": Case(emitters=dict, objects=lamp, parameters=(*both, "lamp")),
        "lamp over a ground": Case(
            emitters=dict, objects=lambda: ground() | lamp(), parameters=(*both, "floor", "lamp")
        ),
        "two media, sky": Case(
            objects=lambda: second_medium(0.5), parameters=(*both, "other.interior_medium.sigma_t")
        ),
        "two media side by side, sun": Case(
            emitters=_under(sun=SUN), objects=lambda: second_medium(0.002)
        ),
        "ground, sky, single": Case(objects=ground, max_depth=2, parameters=(*both, "floor")),
        "ground, sun, single": Case(emitters=_under(sun=SUN), objects=ground, max_depth=2),
        "lamp over a ground, single": Case(
            emitters=dict,
            objects=lambda: ground() | lamp(),
            max_depth=2,
            parameters=(*both, "lamp"),
        ),
        "hg 0.5, ground, sky": Case(g=0.5, objects=ground, parameters=(*both, "floor")),
        "hg 0.5, ground, sun": Case(g=0.5, emitters=_under(sun=SUN), objects=ground),
        "hg 0.5, ground, sun, single": Case(
            g=0.5, emitters=_under(sun=SUN), objects=ground, max_depth=2
        ),
        "hg 0.5, ground, point": Case(g=0.5, emitters=_under(point=POINT), objects=ground),
        "hg 0.5, ground, envmap": Case(
            g=0.5, emitters=lambda: {"sky": sky_with_sun()}, objects=ground
        ),
        "hg -0.4, ground, spot": Case(g=-0.4, emitters=lambda: {"spot": spot()}, objects=ground),
        "hg 0.5, lamp over a ground": Case(
            g=0.5, emitters=dict, objects=lambda: ground() | lamp(), parameters=(*both, "lamp")
        ),
        "hg 0.5, two media, sun": Case(
            g=0.5,
            emitters=_under(sun=SUN),
            objects=lambda: second_medium(0.5, g=-0.4),
            parameters=(*both, "other.interior_medium.sigma_t"),
        ),
        "hg 0.5, distant object, empty voxels": Case(
            g=0.5,
            empty_beyond=0.5,
            changed=(0.75, 0.85),
            objects=distant,
            emitters=_under(sun=SUN),
            parameters=("sigma_t",),
        ),
        "emission alone": Case(emissive=True, emitters=dict, parameters=(*both, "emission")),
        "emission, ground, sky": Case(
            emissive=True, objects=ground, parameters=(*both, "emission", "floor")
        ),
        "emission, hg 0.5, sun, single": Case(
            emissive=True,
            g=0.5,
            emitters=_under(sun=SUN),
            max_depth=2,
            parameters=(*both, "emission"),
        ),
        "hg 0.54, ground, sky": Case(g=0.54, objects=ground, **by_g),
        "hg 0.54, ground, sun, single": Case(
            g=0.54, emitters=_under(sun=SUN), objects=ground, max_depth=2, **by_g
        ),
        "hg 0.54, lamp over a ground": Case(
            g=0.54, emitters=dict, objects=lambda: ground() | lamp(), **by_g
        ),
        "hg -0.45, room, sky": Case(g=-0.45, objects=room, **by_g),
        "hg 0.82, ground, sun": Case(g=0.823, emitters=_under(sun=SUN), objects=ground, **by_g),
        "hg 0.82, ground, sky": Case(g=0.823, objects=ground, **by_g),
        "hg 0.65, two media, sun": Case(
            g=0.65, emitters=_under(sun=SUN), objects=lambda: second_medium(0.5, g=-0.4), **by_g
        ),
        "hg 0.7, ground, sun behind": Case(
            g=0.7, emitters=_under(sun=BEHIND), objects=ground, parameters=(*both, "g")
        ),
        "hg 0.7, panel behind": Case(g=0.7, emitters=dict, objects=lambda: panel(2.0)),
        "hg 0.7, wide panel behind": Case(g=0.7, emitters=dict, objects=lambda: panel(8.0)),
        "hg 0.7, wide panel behind, by g": Case(
            g=0.7, emitters=dict, objects=lambda: panel(8.0), **by_g
        ),
        "hg 0.85, ground, sky": Case(g=0.85, objects=ground),
        "hg 0.85, ground, sun": Case(g=0.85, emitters=_under(sun=SUN), objects=ground),
        "hg 0.85, lamp over a ground": Case(
            g=0.85, emitters=dict, objects=lambda: ground() | lamp()
        ),
    }
    return {name: replace(case, **_exact(case)) for name, case in found.items()}


def _exact(case: Case) -> dict:
    """Settings with which differences among surfaces have a noise of about 1 %."""
    single = case.max_depth == 2
    return {
        "directions": (2048 if case.g > 0.8 else 512) if case.g else 256,
        # Single scattering is nearly free of noise, and larger steps are one-sided.
        "step": 0.05 if single else 0.12,
        # With 64 samples, differences for g = 0.85 are wrong by up to 8 %.
        "samples": 512 if case.g else 256,
    }


EVEN = {"even": True, "depth": 0.25, "changed": (0.05, 0.95), "parameters": ("sigma_t",)}
COLOURED = {"albedo": (0.6, 0.75, 0.85), "emitters": _under(sky=SKY)}
CASES = {
    "sky, single": Case(max_depth=2),
    "sky": Case(),
    "sky, 24^3": Case(24, 24),
    "sun, single": Case(max_depth=2, emitters=_under(sun=SUN)),
    "sun": Case(emitters=_under(sun=SUN)),
    "sky and sun": Case(emitters=_under(sky=SKY, sun=SUN)),
    "point, single": Case(max_depth=2, emitters=_under(point=POINT)),
    "point": Case(emitters=_under(point=POINT)),
    "point in the medium, single": Case(max_depth=2, emitters=_under(point=LAMP), samples=1024),
    "point in the medium": Case(emitters=_under(point=LAMP), samples=1024),
    "spot, single": Case(max_depth=2, emitters=lambda: {"spot": spot()}),
    "spot": Case(emitters=lambda: {"spot": spot()}),
    "envmap with a bright spot": Case(emitters=lambda: {"sky": sky_with_sun()}),
    "envmap, single": Case(max_depth=2, emitters=lambda: {"sky": sky_with_sun()}),
    "attenuation alone": Case(max_depth=1, parameters=("sigma_t",)),
    "coloured albedo": Case(**COLOURED),
    "coloured extinction": Case(**COLOURED, extinction=(0.5, 0.8, 1.0)),
    "coloured extinction, single": Case(**COLOURED, extinction=(0.5, 0.8, 1.0), max_depth=2),
    "voxel depth 0.8, single": Case(depth=0.8, max_depth=2),
    "voxel depth 0.8": Case(depth=0.8),
    "voxel depth 1.2": Case(depth=1.2),
    "voxel depth 2": Case(depth=2.0),
    "voxel depth 0.8, sun": Case(depth=0.8, emitters=_under(sun=SUN)),
    "dense up to the boundary, sun": Case(**EVEN, emitters=_under(sun=SUN)),
    "dense up to the boundary, sun, single": Case(**EVEN, emitters=_under(sun=SUN), max_depth=2),
    "dense up to the boundary, point": Case(**EVEN, emitters=_under(point=POINT)),
    "edges of matter": Case(empty_below=0.05),
    "empty voxels": Case(empty_beyond=0.5, changed=(0.75, 0.85)),
    "empty voxels, single": Case(empty_beyond=0.5, changed=(0.75, 0.85), max_depth=2),
    "no matter": Case(empty_beyond=0.0, parameters=("sigma_t",)),
    "no matter, sun": Case(
        empty_beyond=0.0, parameters=("sigma_t",), emitters=_under(sun=SUN), max_depth=2
    ),
    "data finer than the cache": Case(data=24, cache=12, depth=0.2),
    "data coarser than the cache": Case(data=8, cache=16, depth=0.5),
    "data of no common multiple": Case(data=10, cache=16, depth=0.5),
    "turned": Case(turn=35.0),
    "sphere": Case(shape="sphere"),
    "homogeneous": Case(homogeneous=True, depth=0.1),
    "homogeneous, single": Case(homogeneous=True, depth=0.1, max_depth=2),
    "homogeneous, coloured": Case(
        homogeneous=True, depth=0.1, extinction=(0.5, 0.8, 1.0), **COLOURED
    ),
    "homogeneous sphere": Case(homogeneous=True, depth=0.1, shape="sphere"),
    "homogeneous, sun": Case(homogeneous=True, depth=0.1, emitters=_under(sun=SUN)),
    "gaussian filter": Case(filter="gaussian"),
    "radiance of sky and sun": Case(emitters=_under(sky=SKY, sun=SUN), parameters=("sky", "sun")),
    "radiance of sky and sun, single": Case(
        emitters=_under(sky=SKY, sun=SUN), parameters=("sky", "sun"), max_depth=2
    ),
    "intensity of a point": Case(emitters=_under(point=POINT), parameters=("point",)),
    "intensity of a point in coloured extinction": Case(
        emitters=_under(point=POINT), extinction=(0.3, 0.6, 1.5), parameters=("point",)
    ),
    "texels of an envmap": Case(emitters=lambda: {"sky": sky_with_sun()}, parameters=("sky",)),
    "emission": Case(emissive=True, empty_beyond=0.5, parameters=("emission",)),
    "emission, single": Case(
        emissive=True, empty_beyond=0.5, parameters=("emission",), max_depth=2
    ),
    "alpha": Case(pixels="rgba", emitters=_under(sun=SUN)),
    **anisotropic(),
}
#: cases whose gradients are computed by paths
SURROUNDED = surrounded()
