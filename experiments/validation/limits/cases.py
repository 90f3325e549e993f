"""Scenes for the convergence test: coarse grids of high contrast, one emitter, one phase function.

All media fill the cube [-1, 1]^3 and are seen by an orthographic camera whose film lies within the
cube's silhouette, so that no pixel has an edge that only many samples resolve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

PIXELS = 16
#: Half the width of the film, and the position of the camera.
HALF_WIDTH, CAMERA = 0.6, (1.6, 0.7, -4.8)
#: Ratio of largest to smallest extinction, and the mean optical depth from face to face.
CONTRAST, DEPTH = 1e5, 6.0
ALBEDO = 0.8
#: Shapes (z, y, x) of the grids.
GRIDS = {"4x4x4": (4, 4, 4), "3x5x2": (3, 5, 2), "1x1x6": (1, 1, 6)}


def look(origin, target, up=(0.0, 0.0, 1.0)) -> mi.ScalarTransform4f:
    """Return a transformation that looks from ``origin`` at ``target``."""
    return mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))


def point(position) -> dict:
    """Return a point light."""
    return {"type": "point", "position": list(position), "intensity": 1.0}


def spot(cutoff: float, beam: float) -> dict:
    """Return a spot light above the cube that points into it."""
    place = look((0.5, 3.0, 0.3), (-0.1, 0.0, -0.3))
    angles = {"cutoff_angle": cutoff, "beam_width": beam}
    return {"type": "spot", "to_world": place, "intensity": 1.0} | angles


def lamp(kind: str, centre, size: float) -> dict:
    """Return an area light that faces the centre of the cube.

    A ``size`` of 1 is a radius or half an edge of 1.
    """
    emitter = {"type": "area", "radiance": 1.0}
    if kind == "sphere":
        return {"type": kind, "center": list(centre), "radius": size, "emitter": emitter}
    place = look(centre, (0, 0, 0)) @ mi.ScalarTransform4f().scale(size)
    return {"type": kind, "to_world": place, "emitter": emitter}


def sky_with_spot() -> dict:
    """Return an environment map that is dim except for four texels."""
    texels = np.full((16, 32, 3), 0.2, dtype=np.float32)
    texels[3:5, 8:10] = 100.0
    return {"type": "envmap", "bitmap": mi.Bitmap(texels), "scale": 1.0}


#: Emitters by name. A number of edges or a distance at the end gives the position.
EMITTERS = {
    "constant": lambda: {"type": "constant", "radiance": 1.0},
    "envmap": sky_with_spot,
    "directional": lambda: {"type": "directional", "direction": [0.4, -1.0, 0.55]},
    "point outside": lambda: point((0.4, 2.5, -0.3)),
    "point beside": lambda: point((0.3, 1.1, -0.2)),
    "point inside": lambda: point((-0.83, -0.4, -0.87)),
    "point in view": lambda: point((0.13, 0.22, -0.3)),
    "spot wide": lambda: spot(40.0, 25.0),
    "spot narrow": lambda: spot(8.0, 5.0),
    "rectangle far": lambda: lamp("rectangle", (1.0, 4.0, 0.5), 0.5),
    "rectangle near": lambda: lamp("rectangle", (0.2, 1.3, 0.1), 0.3),
    "rectangle large": lambda: lamp("rectangle", (0.0, 1.5, 0.0), 2.0),
    "disk far": lambda: lamp("disk", (1.0, 4.0, 0.5), 0.5),
    "disk near": lambda: lamp("disk", (0.2, 1.3, 0.1), 0.3),
    "sphere far": lambda: lamp("sphere", (1.0, 4.0, 0.5), 0.5),
    "sphere near": lambda: lamp("sphere", (0.2, 1.4, 0.1), 0.3),
}
#: Phase functions by name.
PHASES = {
    "isotropic": {"type": "isotropic"},
    "hg 0.3": {"type": "hg", "g": 0.3},
    "hg 0.58": {"type": "hg", "g": 0.58},
    "hg -0.4": {"type": "hg", "g": -0.4},
    "hg 0.85": {"type": "hg", "g": 0.85},
    "rayleigh": {"type": "rayleigh"},
}


@dataclass(frozen=True)
class Case:
    """One scene."""

    emitter: str
    phase: str = "isotropic"
    grid: str = "4x4x4"
    max_depth: int = 2

    @property
    def name(self) -> str:
        """Return the name for tables."""
        depth = "all orders" if self.max_depth < 0 else f"max_depth {self.max_depth}"
        return f"{self.emitter}, {self.phase}, {self.grid}, {depth}"

    @property
    def position(self) -> list[float] | None:
        """Return the position of a visible point light."""
        return EMITTERS[self.emitter]()["position"] if self.emitter == "point in view" else None

    @property
    def has_direction(self) -> bool:
        """Return whether the emitter illuminates every point from a single direction."""
        return self.emitter.startswith(("directional", "point", "spot"))

    def extinction(self) -> np.ndarray:
        """Return voxels (z, y, x) in random order, half of them thin and half of them dense."""
        shape = GRIDS[self.grid]
        count = int(np.prod(shape))
        thin = np.geomspace(1 / CONTRAST, 100 / CONTRAST, count // 2)
        values = np.concatenate([thin, np.linspace(0.4, 1, count - count // 2)])
        values = np.random.default_rng(3).permutation(values).reshape(shape)
        return np.float32(values * (DEPTH / 2 / values.mean()))

    def scene(self, **integrator) -> mi.Scene:
        """Load the scene with a cold cache."""
        place = look(CAMERA, (0, 0, 0), (0, 1, 0)) @ mi.ScalarTransform4f().scale(HALF_WIDTH)
        film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
        film |= {"component_format": "float32", "pixel_format": "rgb"}
        cube = mi.ScalarTransform4f().translate(-1).scale(2)
        grid = mi.VolumeGrid(self.extinction()[..., None])
        sigma_t = {"type": "gridvolume", "grid": grid, "raw": True, "to_world": cube}
        medium = {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": ALBEDO}
        medium |= {"phase": PHASES[self.phase]}
        settings = {"max_depth": self.max_depth, "hide_emitters": True}
        return mi.load_dict({
            "type": "scene",
            "integrator": {"type": "irrcache"} | settings | integrator,
            "sensor": {
                "type": "orthographic", "to_world": place, "film": film,
                "sampler": {"type": "multijitter"},
            },
            "body": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
            "emitter": EMITTERS[self.emitter](),
        })  # fmt: skip


def cases() -> list[Case]:
    """Return every emitter with every phase function and depth that is relevant to it."""
    found = [Case(emitter) for emitter in EMITTERS]
    found += [replace(c, grid=grid) for grid in ("3x5x2", "1x1x6") for c in found[:10:3]]
    for phase in ("hg 0.3", "hg 0.58", "hg -0.4", "rayleigh"):
        found += [Case(emitter, phase) for emitter in EMITTERS]
    for depth in (-1, 3):
        found += [Case(emitter, max_depth=depth) for emitter in EMITTERS if "view" not in emitter]
    for phase in ("hg 0.3", "hg 0.58", "rayleigh", "hg 0.85"):
        emitters = "constant", "envmap", "directional", "point outside", "rectangle near"
        found += [Case(emitter, phase, max_depth=-1) for emitter in emitters]
    return found
