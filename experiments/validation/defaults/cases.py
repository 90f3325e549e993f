"""Scenes of many kinds for the defaults: media, emitters, phase functions, and a ground.

Every medium is a grid in the cube [-1, 1]^3 (or a box, or a sphere in it); the camera sees all of
it. Sizes of grids are those of typical data, so that larger voxels of the cache would matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

PIXELS = 48


def noise(count: int, roughness: float, seed: int) -> np.ndarray:
    """Return Gaussian noise (z, y, x), of variance 1, whose amplitudes decay by frequency to the
    power of minus ``roughness``.
    """
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfftn(rng.standard_normal((count, count, count)))
    axes = np.fft.fftfreq(count), np.fft.fftfreq(count), np.fft.rfftfreq(count)
    frequency = np.sqrt(sum(f**2 for f in np.meshgrid(*axes, indexing="ij"))) * count
    frequency[0, 0, 0] = np.inf
    field = np.fft.irfftn(spectrum * np.maximum(frequency, 1) ** -roughness, s=(count,) * 3)
    return (field - field.mean()) / field.std()


def radius(count: int) -> np.ndarray:
    """Return the distances (z, y, x) of voxels from the centre, 1 at the faces."""
    at = (np.arange(count) + 0.5) / count * 2 - 1
    return np.sqrt(sum(x**2 for x in np.meshgrid(at, at, at, indexing="ij")))


def cumulus(count: int = 64) -> np.ndarray:
    """A cloud with a soft boundary."""
    return np.maximum(0.4 + 0.35 * noise(count, 2.2, 1) - radius(count) ** 2, 0)


def smoke(count: int = 64) -> np.ndarray:
    """Wisps of high contrast."""
    wisps = np.exp(1.3 * noise(count, 2.0, 2)) * np.exp(-3 * radius(count) ** 2)
    return wisps * (radius(count) < 0.9)


def fine_smoke() -> np.ndarray:
    """Smoke on a finer grid."""
    return smoke(112)


def fine_cumulus() -> np.ndarray:
    """A cloud on a finer grid."""
    return cumulus(112)


def haze(count: int = 64) -> np.ndarray:
    """A blob that decays smoothly."""
    return np.exp(-4 * radius(count) ** 2)


def head(count: int = 64) -> np.ndarray:
    """A skull of high contrast with soft contents."""
    r = radius(count) + 0.03 * noise(count, 2.5, 3)
    field = np.where(r < 0.85, 0.08, 0.0) + np.where((r > 0.65) & (r < 0.75), 1.0, 0.0)
    return field + np.where(r < 0.6, 0.05 * np.abs(noise(count, 1.5, 4)), 0)


def vessels(count: int = 64) -> np.ndarray:
    """Thin dense tubes in air."""
    return np.where(np.abs(noise(count, 2.5, 5)) < 0.06, 1.0, 0.0) * (radius(count) < 0.85)


def layers(count: int = 64) -> np.ndarray:
    """Even layers that the boundary cuts."""
    profile = 0.3 + np.sin(np.linspace(0, 12, count)) ** 2
    return np.broadcast_to(profile[:, None, None], (count,) * 3)


def dust(count: int = 64) -> np.ndarray:
    """Single dense voxels."""
    rng = np.random.default_rng(6)
    return np.where(rng.random((count,) * 3) < 0.004, 1.0, 0.0) * (radius(count) < 0.9)


def checkers(count: int = 64) -> np.ndarray:
    """Cubes of matter and air."""
    return np.float64((np.indices((count,) * 3) // 8).sum(axis=0) % 2) * (radius(count) < 0.9)


def slab(count: int = 64) -> np.ndarray:
    """Dense below, thin above: the boundary cuts both."""
    field = np.full((count,) * 3, 0.02)
    field[:, : count // 3] = 1.0
    return field


def speckle(count: int = 64) -> np.ndarray:
    """White noise that fills the box."""
    return np.random.default_rng(7).uniform(0, 1, (count,) * 3)


def _texels(of: Callable) -> dict:
    """Return an environment map of radiances by height (-1 to 1) and azimuth."""
    height = np.cos((np.arange(32) + 0.5) / 32 * np.pi)[:, None]
    azimuth = ((np.arange(64) + 0.5) / 64 * 2 * np.pi)[None]
    values = np.float32(np.broadcast_to(of(height, azimuth), (32, 64)))
    return {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(values[..., None], 3, axis=2).copy())}


#: Emitters by name; the first ones are smooth.
EMITTERS = {
    "constant": lambda: {"type": "constant", "radiance": 1.0},
    "sky": lambda: _texels(lambda z, a: np.where(z > 0, 0.6 + 0.8 * z, 0.25)),
    "side": lambda: _texels(lambda z, a: 1.0 + 0.9 * np.cos(a) * np.sqrt(1 - z * z)),
    "window": lambda: _texels(lambda z, a: np.where((abs(z - 0.4) < 0.25) & (a < 0.9), 9.0, 0.3)),
    "sun in sky": lambda: _texels(
        lambda z, a: np.where((abs(z - 0.7) < 0.05) & (abs(a - 1) < 0.1), 400.0, 0.6)
    ),
    "sun": lambda: {"type": "directional", "direction": [0.4, -1.0, 0.55], "irradiance": 3.0},
    "point": lambda: {"type": "point", "position": [0.6, 2.0, -0.8], "intensity": 4.0},
    "point inside": lambda: {"type": "point", "position": [0.3, 0.5, -0.3], "intensity": 1.0},
    "spot": lambda: {
        "type": "spot", "cutoff_angle": 20.0, "beam_width": 15.0, "intensity": 9.0,
        "to_world": mi.ScalarTransform4f().look_at([0.5, 3, 0.3], [0, 0, 0], [0, 0, 1]),
    },
    "lamp": lambda: {
        "type": "rectangle", "emitter": {"type": "area", "radiance": 8.0},
        "to_world": mi.ScalarTransform4f()
        .look_at([0, 1.6, 0], [0, 0, 0], [0, 0, 1])
        .scale(0.5),
    },
}  # fmt: skip
SMOOTH = ("constant", "sky", "side")


@dataclass(frozen=True)
class Case:
    """One scene.

    Attributes:
        field: extinction by voxels, up to a factor.
        depth: mean optical depth of the lines through the medium that meet any matter.
        emitter: one of `EMITTERS`.
        phase: "isotropic", "rayleigh", or "hg" and its g.
        albedo: of the medium.
        max_depth: orders of scattering.
        ground: whether a white square lies below.
        edges: of the box (x, y, z).
        emits: whether the medium emits where it is dense.
    """

    field: Callable[..., np.ndarray]
    depth: float
    emitter: str = "constant"
    phase: str = "isotropic"
    albedo: float = 0.9
    max_depth: int = -1
    ground: bool = False
    edges: tuple[float, float, float] = (2.0, 2.0, 2.0)
    emits: bool = False

    @property
    def name(self) -> str:
        """Return the name for tables."""
        parts = [f"{self.field.__name__} {self.depth:g}", self.emitter]
        parts += [self.phase] if self.phase != "isotropic" else []
        parts += [f"albedo {self.albedo:g}"] if self.albedo != 0.9 else []
        parts += ["ground"] if self.ground else []
        parts += ["emission"] if self.emits else []
        parts += ["flat"] if self.edges != (2.0, 2.0, 2.0) else []
        return ", ".join([*parts, "once" if self.max_depth == 2 else "all orders"])

    def extinction(self) -> np.ndarray:
        """Return sigma_t (z, y, x)."""
        values = np.asarray(self.field(), dtype=np.float64)
        along = values.mean(axis=0)
        return np.float32(values * (self.depth / self.edges[2] / along[along > 0].mean()))

    @property
    def properties(self) -> dict:
        """Return the properties of the integrator that affect the image."""
        return {"max_depth": self.max_depth, "hide_emitters": True}

    def scene(self, **integrator) -> mi.Scene:
        """Load the scene with a cold cache."""
        return mi.load_dict(self.build({"type": "irrcache"} | self.properties | integrator))

    def build(self, integrator: dict) -> dict:
        """Return the dictionary for `mi.load_dict`."""
        transform = mi.ScalarTransform4f
        place = transform().scale([e / 2 for e in self.edges])
        unit = place @ transform().translate(-1).scale(2)
        sigma_t = self.extinction()

        def volume(values: np.ndarray) -> dict:
            grid = mi.VolumeGrid(np.float32(values)[..., None])
            return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": unit}

        kind, *g = self.phase.split()
        phase = {"type": kind} | ({"g": float(g[0])} if g else {})
        medium = {"type": "heterogeneous", "sigma_t": volume(sigma_t), "albedo": self.albedo}
        emission = {"emission": volume(0.3 * sigma_t)} if self.emits else {}
        scene = {
            "type": "scene",
            "integrator": emission | integrator,
            "sensor": {
                "type": "perspective", "fov": 34.0,
                "to_world": transform().look_at([1.7, 1.4, -4.2], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm", "width": PIXELS, "height": PIXELS,
                    "rfilter": {"type": "box"}, "component_format": "float32",
                },
                "sampler": {"type": "multijitter"},
            },
            "body": {
                "type": "cube", "bsdf": {"type": "null"}, "to_world": place,
                "interior": medium | {"phase": phase},
            },
            "emitter": EMITTERS[self.emitter](),
        }  # fmt: skip
        if self.ground:
            below = transform().translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(3)
            scene["ground"] = {
                "type": "rectangle", "to_world": below,
                "bsdf": {"type": "diffuse", "reflectance": 0.5},
            }  # fmt: skip
        return scene


def cases() -> list[Case]:
    """Return the scenes; those in smooth light first."""
    smooth = [
        Case(haze, 0.3), Case(haze, 3.0), Case(haze, 30.0), Case(cumulus, 2.0),
        Case(cumulus, 10.0, albedo=0.99), Case(cumulus, 40.0, albedo=0.999),
        Case(smoke, 0.5), Case(smoke, 4.0, "sky"), Case(smoke, 12.0, "side"),
        Case(head, 3.0), Case(head, 15.0, "sky"), Case(vessels, 2.0), Case(vessels, 8.0, "side"),
        Case(layers, 2.0), Case(layers, 8.0, "sky"), Case(dust, 1.0), Case(checkers, 4.0),
        Case(slab, 4.0, "sky"), Case(speckle, 1.0), Case(speckle, 6.0, "side"),
        Case(cumulus, 8.0, "sky", "hg 0.6"), Case(cumulus, 4.0, "constant", "hg 0.85"),
        Case(smoke, 3.0, "side", "rayleigh"), Case(haze, 4.0, "side", "hg -0.4"),
        Case(fine_smoke, 1.0, "sky"), Case(fine_cumulus, 3.0),
        Case(cumulus, 6.0, "sky", edges=(2.0, 2.0, 0.7)),
        Case(haze, 3.0, max_depth=2), Case(cumulus, 6.0, "sky", max_depth=2),
        Case(smoke, 2.0, "side", max_depth=2), Case(head, 6.0, max_depth=2),
        Case(vessels, 4.0, "sky", max_depth=2), Case(dust, 1.0, "side", max_depth=2),
        Case(speckle, 3.0, max_depth=2),
    ]  # fmt: skip
    detailed = [
        Case(haze, 3.0, "sun"), Case(cumulus, 6.0, "sun in sky"), Case(smoke, 3.0, "window"),
        Case(head, 5.0, "point"), Case(smoke, 2.0, "point inside"), Case(haze, 2.0, "spot"),
        Case(cumulus, 6.0, "lamp"), Case(smoke, 3.0, emits=True),
        Case(cumulus, 6.0, "sky", ground=True), Case(vessels, 4.0, "sun", max_depth=2),
    ]  # fmt: skip
    return smooth + detailed
