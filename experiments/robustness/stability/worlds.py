"""Small scenes for hazards: a medium in a box or sphere, a sky, a camera, at any scale and
position.

All lengths are in units of a *world*, whose unit is ``scale`` scene units long and whose origin
lies at ``offset``; extinctions are per unit. So one description is the same problem at every scale.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)

PIXELS = 8
SAMPLES = 4  # per pixel
#: Cache voxels along the longest side, unless a case specifies others.
RESOLUTION = 8

WHITE_SKY = {"type": "constant", "radiance": 1.0}


@dataclass(frozen=True)
class World:
    """Scale and position of a scene.

    Attributes:
        scale: scene units per unit.
        offset: of the origin, in scene units, along x, y and z alike.
    """

    scale: float = 1.0
    offset: float = 0.0

    def place(self, linear: np.ndarray, origin: np.ndarray) -> mi.ScalarTransform4f:
        """Return the affine map with these columns, in units."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * linear
        matrix[:3, 3] = self.scale * np.asarray(origin) + self.offset
        return mi.ScalarTransform4f(matrix)

    def point(self, p: tuple[float, float, float]) -> list[float]:
        """Return a position given in units."""
        return [self.scale * v + self.offset for v in p]


@dataclass(frozen=True)
class Matter:
    """A medium in a box with edges of ``edges`` units about the origin, or in its inner sphere.

    Attributes:
        sigma_t: extinction per unit: a number or a colour, or voxels (z, y, x[, channel]).
        albedo: likewise.
        turn: degrees about an oblique axis.
        mirror: whether the box is mirrored in its own x axis.
        g: mean cosine of the scattering, by ``hg``.
    """

    sigma_t: object = 1.0
    albedo: object = 0.9
    edges: tuple[float, float, float] = (2.0, 2.0, 2.0)
    shape: str = "cube"
    turn: float = 0.0
    mirror: bool = False
    g: float = 0.0

    def _linear(self) -> np.ndarray:
        """Return half the edges of the box as columns."""
        axis = np.array([0.48, 0.64, 0.6])
        cross, angle = np.cross(np.eye(3), axis), np.deg2rad(self.turn)
        rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        sign = -1.0 if self.mirror else 1.0
        return rotation @ np.diag(0.5 * np.array(self.edges) * (sign, 1.0, 1.0))

    def description(self, world: World) -> dict:
        """Return the shape with its medium."""
        linear = self._linear()
        grid = world.place(2 * linear, -linear.sum(axis=1))
        outwards = np.diag([np.sign(np.linalg.det(linear)), 1.0, 1.0])
        varies = _is_grid(self.sigma_t)
        interior = {
            "type": "heterogeneous" if varies else "homogeneous",
            "sigma_t": _volume(self.sigma_t, grid),
            "albedo": _volume(self.albedo, grid),
            "scale": 1 / world.scale,
        }
        if self.g:
            interior["phase"] = {"type": "hg", "g": self.g}
        return {
            "type": self.shape,
            "to_world": world.place(linear @ outwards, np.zeros(3)),
            "bsdf": {"type": "null"},
            "interior": interior,
        }


@dataclass(frozen=True)
class Camera:
    """A perspective camera at ``origin`` that looks at ``target``, in units."""

    origin: tuple[float, float, float] = (1.0, 1.5, -5.0)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fov: float = 34.0
    film: dict = field(default_factory=dict)

    def description(self, world: World) -> dict:
        """Return the sensor; its near clip distance is a hundredth of a unit, as by default."""
        # Only directions matter here, and these are the same in every world.
        way = np.subtract(self.target, self.origin)
        look = mi.ScalarTransform4f().look_at([0, 0, 0], way.tolist(), [0.02, 1, 0.01])
        matrix = np.array(look.matrix, dtype=np.float64)
        matrix[:3, 3] = world.point(self.origin)
        film = {
            "type": "hdrfilm",
            "width": PIXELS,
            "height": PIXELS,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        distance = max(1.0, float(np.linalg.norm(way)))
        return {
            "type": "perspective",
            "fov": self.fov,
            "near_clip": 1e-6 * world.scale,
            "far_clip": 1e4 * distance * world.scale,
            "to_world": mi.ScalarTransform4f(matrix),
            "film": film | self.film,
        }


def scene(
    integrator: dict,
    matter: Matter | None,
    light: dict | None = None,
    camera: Camera | None = None,
    world: World | None = None,
    beside: dict | None = None,
) -> mi.Scene:
    """Return the scene, under a white sky unless ``light`` is given; ``beside``: more objects."""
    world = world or World()
    parts = {"type": "scene", "integrator": {"type": "irrcache"} | integrator}
    parts["sensor"] = (camera or Camera()).description(world)
    parts["light"] = light or WHITE_SKY
    parts |= beside or {}
    if matter is not None:
        parts["matter"] = matter.description(world)
    return mi.load_dict(parts)


def texture(shape: tuple[int, ...], low: float, high: float, seed: int = 1) -> np.ndarray:
    """Return random voxels in [low, high]."""
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def blob(n: int, peak: float) -> np.ndarray:
    """Return a smooth ball of n^3 voxels that is nearly empty at its borders."""
    c = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return (peak * np.exp(-4 * ((x - 0.2) ** 2 + (y + 0.1) ** 2 + z**2))).astype(np.float32)


def _is_grid(values: object) -> bool:
    return isinstance(values, np.ndarray) and values.ndim >= 3


def _volume(values: object, to_world: mi.ScalarTransform4f) -> dict:
    if _is_grid(values):
        grid = mi.VolumeGrid(values.reshape(*values.shape[:3], -1).astype(np.float32))
        return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": to_world}
    if np.ndim(values) == 0:
        return {"type": "constvolume", "value": float(values)}
    return {"type": "constvolume", "value": {"type": "rgb", "value": list(map(float, values))}}
