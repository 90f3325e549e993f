"""Random scenes: a medium with a boundary, emitters, a camera, and surrounding objects.

Scene ``index`` depends on the seed and the index alone. Every property (grid, boundary, emitter,
...) has a list of options that is repeatedly shuffled and traversed, so that each option occurs in
about as many scenes, in random combinations.

The medium fills about the cube [-5, 5]^3. volpath offsets its rays by about 9e-5 (1 + max |p|), an
absolute length that would matter in smaller scenes.
"""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

SIDE = 5.0  #: half an edge of the medium
PIXELS = 32  #: of an image, per side

#: (z, y, x) voxels; None: a homogeneous medium
GRIDS = (
    (1, 1, 1), (2, 2, 2), (4, 4, 4), (1, 1, 9), (9, 1, 1), (1, 9, 1), (3, 5, 7), (8, 8, 8),
    (1, 12, 12), (2, 30, 5), (16, 16, 16), (24, 24, 24), (40, 40, 40), (31, 17, 23), None, None,
)  # fmt: skip
PATTERNS = ("constant", "uniform", "logarithmic", "blob", "step", "single", "shell", "checkers")
#: Largest over smallest extinction of a voxel; infinite: some voxels are empty.
CONTRASTS = (3.0, 1e2, 1e4, 1e8, np.inf)
DEPTHS = (0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 100.0, 300.0)
ALBEDOS = ("0", "0.5", "0.9", "0.99", "1", "rgb", "grid", "rgb grid")
#: Extinction of red : green : blue.
TINTS = ((1.0, 1.0, 1.0),) * 4 + ((1.0, 0.5, 0.25), (0.1, 0.4, 1.0))
PHASES = (
    *("isotropic",) * 8, "hg -0.4", "hg 0.3", "hg 0.58", "hg 0.7", "hg 0.8", "hg 0.85",
    "rayleigh", "blend", "tab", "hg 0.95",
)  # fmt: skip
BOUNDARIES = (
    "cube", "cube", "rotated cube", "stretched cube", "sphere", "stretched sphere", "mesh",
    "cube, smaller grid", "cube, larger grid", "sphere, turned grid",
)  # fmt: skip
EMITTERS = (
    "constant", "sun in envmap", "turned envmap", "directional", "point inside", "point near",
    "point far", "spot", "spot inside", "rectangle near", "rectangle far", "disk near",
    "sphere near", "sphere far", "mesh near", "rectangle inside",
)  # fmt: skip
#: Distances of area emitters from the centre, beyond every corner of cubes, or a share of the
#: shortest edge; and their sizes, both in units of `SIDE`.
LAMP_DISTANCES = {"near": 2.2, "far": 5.0, "inside": 0.45}
LAMP_SIZES = {"near": 0.4, "far": 0.6, "inside": 0.08}
ENVIRONMENTS = {"constant", "sun in envmap", "turned envmap"}
#: "against the light" has the emitter behind the medium.
CAMERAS = (
    "outside", "outside", "outside", "outside, turned", "close", "inside", "against the light",
)  # fmt: skip
SURROUNDINGS = (
    "none", "none", "none", "none", "none", "ground", "room", "second medium", "ball beside",
    "ball inside",
)  # fmt: skip
MAX_DEPTHS = (2, -1, -1, 3, 2, -1, 5, 1)
#: A visible area light has more noise than all scattered radiance.
HIDES_EMITTERS = (True, False, True)


@dataclass(frozen=True)
class RandomScene:
    """The properties of a scene; `describe` returns them in a line, `build` makes the scene."""

    seed: int
    index: int
    grid: tuple[int, int, int] | None
    pattern: str
    contrast: float
    depth: float  #: optical, along the densest line through the medium parallel to an edge
    albedo: str
    tint: tuple[float, float, float]
    phase: str
    boundary: str
    emitter: str
    sky: bool  #: a dim constant environment in addition to the other emitter
    camera: str
    surroundings: str
    max_depth: int
    hide_emitters: bool

    @classmethod
    def draw(cls, seed: int, index: int) -> RandomScene:
        """Draw the properties of scene ``index``."""

        def pick(name: str, options: tuple) -> object:
            block, place = divmod(index, len(options))
            order = _stream(seed, name, block).permutation(len(options))
            return options[order[place]]

        emitter = pick("emitter", EMITTERS)
        drawn = {
            "grid": pick("grid", GRIDS), "pattern": pick("pattern", PATTERNS),
            "contrast": pick("contrast", CONTRASTS), "depth": pick("depth", DEPTHS),
            "albedo": pick("albedo", ALBEDOS), "tint": pick("tint", TINTS),
            "phase": pick("phase", PHASES), "boundary": pick("boundary", BOUNDARIES),
            # Mitsuba supports one environment at most.
            "sky": not ENVIRONMENTS & {emitter} and pick("sky", (True, False, False)),
            "camera": pick("camera", CAMERAS), "surroundings": pick("surroundings", SURROUNDINGS),
            "max_depth": pick("max_depth", MAX_DEPTHS),
            "hide_emitters": pick("hide_emitters", HIDES_EMITTERS),
        }  # fmt: skip
        if drawn["depth"] > 40 and drawn["albedo"] in ("0.99", "1"):
            drawn["albedo"] = "0.9"  # the paths of volpath would be too long for a reference
        if drawn["phase"] in ("hg 0.7", "hg 0.8", "hg 0.85"):
            drawn["max_depth"] = -1  # refused at other depths
        case = cls(seed, index, emitter=emitter, **drawn)
        hides = case.hide_emitters and not case._has_lamp_in_front()
        return replace(case, depth=case._renderable_depth(), hide_emitters=hides)

    def _has_lamp_in_front(self) -> bool:
        """Whether an area emitter is between the camera and the medium.

        volpath samples the distance to the first collision wrongly behind a hidden one: the medium
        is up to three times too bright there.
        """
        kind, _, where = self.emitter.partition(" ")
        if where not in LAMP_DISTANCES or kind in ("point", "spot"):
            return False
        distance, size = self._lamp_distance(where), LAMP_SIZES[where]
        lamp = distance * SIDE * self._towards_emitter(self.stream("emitter"))
        origin = self._view()[0]
        axis, towards = -origin / np.linalg.norm(origin), lamp - origin
        sines = 1.8 * SIDE / np.linalg.norm(origin), 1.5 * size * SIDE / np.linalg.norm(towards)
        angles = np.arcsin(np.minimum(sines, 1)).sum()
        between = np.arccos(np.clip(axis @ towards / np.linalg.norm(towards), -1, 1))
        return bool(np.linalg.norm(towards) < np.linalg.norm(origin) and between < angles)

    def _renderable_depth(self) -> float:
        """Limit the optical depth where volpath would be wrong.

        Between the grid and a larger boundary, its exp(-majorant length) underflows, and 0 / 0
        counts as 0.
        """
        if self.boundary != "cube, smaller grid" or self.grid is None:
            return self.depth
        return float(f"{self.depth * min(1, 40 / self.voxels().max()):.2g}")

    def describe(self) -> str:
        """Return one line for a table."""
        matter = "homogeneous"
        if self.grid:
            size = " x ".join(map(str, self.grid[::-1]))
            matter = f"{size} {self.pattern}"
            if self.pattern != "constant" and self.grid != (1, 1, 1):
                matter += f" 1:{self.contrast:g}"
        tint = "" if len(set(self.tint)) == 1 else f", rgb {':'.join(f'{t:g}' for t in self.tint)}"
        around = "" if self.surroundings == "none" else f", {self.surroundings}"
        sky = " + sky" if self.sky else ""
        hidden = ", hide_emitters" if self.hide_emitters else ""
        return (
            f"{matter}, depth {self.depth:g}{tint}, albedo {self.albedo}, {self.phase}, "
            f"{self.boundary}, {self.emitter}{sky}, camera {self.camera}{around}, "
            f"max_depth {self.max_depth}{hidden}"
        )

    def as_dict(self) -> dict:
        """Return the properties for a file of results."""
        return asdict(self) | {"contrast": str(self.contrast)}

    @property
    def is_chromatic(self) -> bool:
        """Return whether the extinction differs between channels."""
        return len(set(self.tint)) > 1

    def stream(self, name: str) -> np.random.Generator:
        """Return random numbers for a part of the scene."""
        return _stream(self.seed, name, self.index)

    @property
    def properties(self) -> dict:
        """Return the properties of the integrator that affect the image."""
        return {"max_depth": self.max_depth, "hide_emitters": self.hide_emitters}

    def build(self, integrator: dict, folder: Path, pixels: int = PIXELS) -> dict:
        """Return the dictionary for `mi.load_dict`; meshes are written to ``folder``."""
        folder.mkdir(parents=True, exist_ok=True)
        parts = {"type": "scene", "integrator": integrator, "medium": self._medium()}
        inside = {"type": "ref", "id": "medium"}
        parts["boundary"] = self._boundary(folder) | {"bsdf": {"type": "null"}, "interior": inside}
        parts |= self._emitters(folder) | self._surroundings() | {"sensor": self._sensor(pixels)}
        return parts

    # -- media -------------------------------------------------------------------------------------

    def voxels(self) -> np.ndarray:
        """Return the relative extinction (z, y, x), scaled to the requested optical depth.

        The depth is that of the densest line along an axis of the grid, in a cube with edges of 1.
        """
        random = self.stream("voxels")
        z, y, x = (
            (i + 0.5) / n * 2 - 1 for i, n in zip(np.indices(self.grid), self.grid, strict=True)
        )
        turned = random.normal(size=3)
        s = np.sin(6 * x + 3 * np.sin(4 * y)) * np.sin(5 * z + 2 * x) * np.sin(5 * y - z)
        share = {
            "constant": np.ones(self.grid),
            "uniform": random.random(self.grid),
            "logarithmic": random.random(self.grid),
            "blob": np.clip(1.2 - np.sqrt(x**2 + y**2 + z**2), 0, 1) * (0.7 + 0.3 * s),
            "step": (turned @ np.stack([x, y, z]).reshape(3, -1) > 0).reshape(self.grid) * 1.0,
            "single": (np.arange(z.size) == random.integers(z.size)).reshape(self.grid) * 1.0,
            "shell": (np.abs(np.sqrt(x**2 + y**2 + z**2) - 0.8) < 0.2) * 1.0,
            "checkers": np.indices(self.grid).sum(axis=0) % 2 * 1.0,
        }[self.pattern]
        if share.max() <= 0:
            share = np.ones(self.grid)
        share = share / share.max()
        if self.pattern == "constant" or share.size == 1:
            density = np.ones(self.grid)
        elif np.isinf(self.contrast):
            density = np.where(share < 0.3, 0, share)
        elif self.pattern == "logarithmic":
            density = self.contrast ** (share - 1)
        else:
            density = 1 / self.contrast + (1 - 1 / self.contrast) * share
        lines = [density.mean(axis=axis).max() for axis in range(3)]
        return density / max(lines) * self.depth

    def _medium(self) -> dict:
        tint = np.array(self.tint) / max(self.tint)
        medium: dict = {"id": "medium", "phase": self._phase(), "albedo": self._albedo()}
        if self.grid is None:
            # Mitsuba allows no colour above 1 there.
            medium |= {"type": "homogeneous", "sigma_t": _rgb(*tint)}
            return medium | {"scale": self.depth / (2 * SIDE)}
        density = self.voxels()[..., None] * (tint if self.is_chromatic else np.ones(1))
        medium |= {"type": "heterogeneous", "sigma_t": self._grid(density)}
        # Otherwise volpath loses paths that leave opaque data long before they leave the boundary:
        # the transmittance e^-(sigma_t s) by which it divides, for the length s in between, is 0.
        medium["has_spectral_extinction"] = self.is_chromatic
        return medium | {"scale": 1 / (2 * SIDE)}

    def _albedo(self) -> dict:
        uniform = {"rgb": [0.9, 0.6, 0.2], "grid": [0.8] * 3, "rgb grid": [0.95, 0.5, 0.8]}
        value = uniform[self.albedo] if self.albedo in uniform else [float(self.albedo)] * 3
        if self.grid is None:
            return {"type": "rgb", "value": value}
        if "grid" not in self.albedo:
            return {"type": "constvolume", "value": {"type": "rgb", "value": value}}
        channels = 3 if self.albedo == "rgb grid" else 1
        return self._grid(self.stream("albedo").random((*self.grid, channels)))

    def _grid(self, values: np.ndarray) -> dict:
        grid = mi.VolumeGrid(np.ascontiguousarray(values, np.float32))
        return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": self._grid_place()}

    def _grid_place(self):
        place = mi.ScalarTransform4f()
        if self.boundary in ("rotated cube", "stretched cube", "sphere, turned grid"):
            place = place @ self._turn() @ place.scale(list(self._edges()))
        elif self.boundary == "stretched sphere":
            place = place.scale(list(self._edges()))
        elif self.boundary == "cube, smaller grid":
            place = place.translate([1.0, -0.5, 0.3]).scale(0.6)
        elif self.boundary == "cube, larger grid":
            place = place.translate([0.5, 1.0, -0.7]).scale(1.7)
        return place @ mi.ScalarTransform4f().translate([-SIDE] * 3).scale(2 * SIDE)

    def _turn(self):
        return _rotation(self.stream("turn"), 10, 80)

    def _edges(self) -> np.ndarray:
        if "stretched" not in self.boundary:
            return np.ones(3)
        return self.stream("edges").permutation([0.3, 0.7, 1.2])

    def _phase(self) -> dict:
        kind, _, g = self.phase.partition(" ")
        if kind == "hg":
            return {"type": "hg", "g": float(g)}
        if kind == "blend":
            parts = {"a": {"type": "hg", "g": 0.5}, "b": {"type": "hg", "g": -0.2}}
            return {"type": "blendphase", "weight": 0.3} | parts
        if kind == "tab":
            return {"type": "tabphase", "values": "0.6, 0.4, 0.4, 0.7, 1.1"}
        return {"type": kind}

    def _boundary(self, folder: Path) -> dict:
        place = mi.ScalarTransform4f()
        if self.boundary == "mesh":
            path = folder / "icosahedron.obj"
            path.write_text(icosahedron())
            return {"type": "obj", "filename": str(path), "to_world": place.scale(0.95 * SIDE)}
        if self.boundary in ("rotated cube", "stretched cube"):
            place = place @ self._turn()
        shape = "sphere" if "sphere" in self.boundary else "cube"
        place = place @ mi.ScalarTransform4f().scale((SIDE * self._edges()).tolist())
        return {"type": shape, "to_world": place}

    # -- emitters ----------------------------------------------------------------------------------

    def _emitters(self, folder: Path) -> dict:
        random = self.stream("emitter")
        towards = self._towards_emitter(random)
        colour = random.uniform(0.4, 1.0, 3)
        kind, _, where = self.emitter.partition(" ")
        found = {}
        if self.sky:
            found["sky"] = {"type": "constant", "radiance": _rgb(0.05, 0.06, 0.08)}
        if kind == "constant":
            light = {"type": "constant", "radiance": _rgb(*colour)}
        elif "envmap" in self.emitter:
            light = self._envmap(random)
        elif kind == "directional":
            irradiance = _rgb(*(3 * colour))
            light = {"type": kind, "direction": (-towards).tolist(), "irradiance": irradiance}
        elif kind in ("point", "spot"):
            far = 3.0 if self.surroundings == "room" else 6.0
            leaves = self._leaves(towards)
            distance = {
                "inside": min(0.35, 0.6 * leaves), "near": 1.1 * leaves, "": 2.5, "far": far,
            }[where]  # fmt: skip
            position = distance * SIDE * towards
            intensity = _rgb(*(10 * (1 + distance**2) * colour))
            light = {"type": kind, "intensity": intensity}
            if kind == "point":
                light["position"] = position.tolist()
            else:
                aim = self.stream("aim").uniform(-1, 1, 3)
                light["cutoff_angle"] = float(random.uniform(12, 40))
                light["to_world"] = _look(position, aim)
        else:
            return found | {"light": self._lamp(kind, where, towards, colour, folder)}
        return found | {"light": light}

    def _leaves(self, direction: np.ndarray) -> float:
        """Return where a ray from the centre leaves the boundary, in units of SIDE."""
        turn = np.eye(3)
        if self.boundary in ("rotated cube", "stretched cube"):
            turn = np.array(self._turn().matrix)[:3, :3]
        local = np.abs(turn.T @ direction) / self._edges()
        if self.boundary == "mesh":
            return 0.95
        return 1 / (np.linalg.norm(local) if "sphere" in self.boundary else local.max())

    def _lamp_distance(self, where: str) -> float:
        """Return the distance of an area emitter from the centre in units of `SIDE`."""
        if where == "near" and ("sphere" in self.boundary or self.boundary == "mesh"):
            return 1.7
        if where == "far" and self.surroundings == "room":
            return 3.0
        return LAMP_DISTANCES[where] * (self._edges().min() if where == "inside" else 1)

    def _lamp(self, kind: str, where: str, towards: np.ndarray, colour, folder: Path) -> dict:
        distance, size = self._lamp_distance(where), LAMP_SIZES[where] * SIDE
        radiance = 6.0 * (distance * SIDE / size / 2) ** 2
        place = _look(distance * SIDE * towards, (0.1, 0.2, 0.0)) @ mi.ScalarTransform4f().scale(
            size
        )
        emitter = {"type": "area", "radiance": _rgb(*(radiance * colour))}
        lamp = {"type": "rectangle" if kind == "rectangle" else kind, "to_world": place}
        if kind == "mesh":
            path = folder / "icosahedron.obj"
            path.write_text(icosahedron())
            lamp |= {"type": "obj", "filename": str(path)}
        if where == "inside":
            lamp["exterior"] = {"type": "ref", "id": "medium"}  # it emits from its front only
        return lamp | {"emitter": emitter, "bsdf": _diffuse(0.3, 0.3, 0.3)}

    def _envmap(self, random: np.random.Generator) -> dict:
        height, width = 32, 64
        row, column = np.indices((height, width))
        pixels = np.stack([0.2 + 0.1 * np.sin(column / 9), 0.3 + 0 * row, 0.6 - row / 80], axis=-1)
        y, x = int(random.integers(3, 14)), int(random.integers(0, width))
        pixels[y, x] = random.uniform(200, 2000)
        light = {"type": "envmap", "bitmap": mi.Bitmap(pixels.astype(np.float32))}
        if self.emitter == "turned envmap":
            light["to_world"] = _rotation(random, 10, 60)
        return light

    def _towards_emitter(self, random: np.random.Generator) -> np.ndarray:
        """Return the direction of emitters that have one, the first numbers of their stream."""
        towards = random.normal(size=3)
        towards[1] = abs(towards[1]) + 0.3  # not from below the ground
        if self.surroundings == "second medium":
            towards[0] = -abs(towards[0])
        elif self.surroundings == "ball beside":
            towards[0] = abs(towards[0])
        return towards / np.linalg.norm(towards)

    # -- camera and surroundings -------------------------------------------------------------------

    def _view(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the position of the camera, that at which it looks, and its field of view."""
        random = self.stream("camera")
        target, fov = random.uniform(-0.1, 0.1, 3) * SIDE, 36.0
        origin = np.array([0.8, 0.9, -4.5]) * SIDE
        if self.camera == "outside, turned":
            angle = random.uniform(0, 2 * np.pi)
            origin = np.array([4.3 * np.sin(angle), 1.5, 4.3 * np.cos(angle)]) * SIDE
        elif self.camera == "against the light" and self.surroundings not in ("ground", "room"):
            towards = self._towards_emitter(self.stream("emitter")) + random.normal(size=3) * 0.1
            origin = -4.5 * SIDE * towards / np.linalg.norm(towards)
        elif self.camera == "close":
            origin, fov = np.array([0.4, 0.5, -2.4]) * SIDE, 45.0
        elif self.camera == "inside":
            # Inside of every boundary, including the thinnest of the stretched ones.
            origin, fov = 0.1 * np.array([0.5, 0.4, -0.7]) * SIDE, 70.0
            target = np.array([0.1, 0.0, 1.0]) * SIDE
        if self.surroundings == "room" and self.camera != "inside":
            origin, fov = np.array([0.2, 0.3, -3.4]) * SIDE, 45.0
        if self.surroundings in ("second medium", "ball beside") and self.camera != "inside":
            fov = 58.0  # so that they are visible
        return origin, target, fov

    def _sensor(self, pixels: int) -> dict:
        origin, target, fov = self._view()
        film = {
            "type": "hdrfilm", "width": pixels, "height": pixels, "component_format": "float32",
            "rfilter": {"type": "box"},
        }  # fmt: skip
        sensor = {
            "type": "perspective",
            "fov": fov,
            "to_world": _look(origin, target),
            "film": film,
        }
        if self.camera == "inside":
            sensor["medium"] = {"type": "ref", "id": "medium"}
        return sensor

    def _surroundings(self) -> dict:
        reach = 2.2 * SIDE
        ball = {"type": "sphere", "bsdf": _diffuse(0.8, 0.4, 0.2)}
        if self.surroundings == "ground":
            return {"ground": _wall((0, -reach, 0), (0, 0, 0.01), 5 * SIDE)}
        if self.surroundings == "room":
            size = 3.6 * SIDE
            return {
                "floor": _wall((0, -size, 0), (0, 0, 0.01), size),
                "ceiling": _wall((0, size, 0), (0, 0, 0.01), size, (0.3, 0.5, 0.7)),
                "left": _wall((-size, 0, 0), (0, 0, 0), size, (0.6, 0.1, 0.1)),
                "right": _wall((size, 0, 0), (0, 0, 0), size, (0.1, 0.5, 0.1)),
                "back": _wall((0, 0, size), (0, 0, 0), size),
            }
        if self.surroundings == "second medium":
            fluid = {"type": "homogeneous", "sigma_t": 0.4, "albedo": _rgb(0.9, 0.6, 0.3)}
            place = {"center": [2.6 * SIDE, 0.4 * SIDE, 0], "radius": 0.6 * SIDE}
            return {
                "second": {"type": "sphere", **place, "bsdf": {"type": "null"}, "interior": fluid}
            }
        if self.surroundings == "ball beside":
            return {
                "ball": ball | {"center": [-2.5 * SIDE, 0.5 * SIDE, -0.5], "radius": 0.6 * SIDE}
            }
        if self.surroundings == "ball inside":
            # Away from the camera and from the emitters in the medium.
            medium = {"exterior": {"type": "ref", "id": "medium"}}
            return {
                "ball": ball | medium | {"center": [0.02 * SIDE, -0.16 * SIDE, 0.1 * SIDE],
                                         "radius": 0.08 * SIDE}
            }  # fmt: skip
        return {}


def icosahedron() -> str:
    """Return a closed mesh of twenty triangles in the unit sphere, as an OBJ file."""
    golden = (1 + 5**0.5) / 2
    corners = np.array(
        [p for a in (-1, 1) for b in (-golden, golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))]
    ) / np.hypot(1, golden)  # fmt: skip
    edge = 2 / np.hypot(1, golden)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners]
    for i in range(12):
        for j in range(i + 1, 12):
            for k in range(j + 1, 12):
                a, b, c = corners[[i, j, k]]
                sides = [np.linalg.norm(s) for s in (a - b, b - c, c - a)]
                if np.allclose(sides, edge):
                    outwards = np.dot(np.cross(b - a, c - a), a) > 0
                    face = (i, j, k) if outwards else (i, k, j)
                    lines.append("f " + " ".join(str(n + 1) for n in face))
    return "\n".join(lines) + "\n"


def _stream(seed: int, name: str, number: int) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode()), number])


def _rotation(random: np.random.Generator, least: float, most: float) -> mi.ScalarTransform4f:
    """Return a rotation about a random axis, normalised as Mitsuba requires."""
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    return mi.ScalarTransform4f().rotate(axis.tolist(), float(random.uniform(least, most)))


def _rgb(*value: float) -> dict:
    return {"type": "rgb", "value": [float(v) for v in value]}


def _diffuse(*value: float) -> dict:
    return {"type": "diffuse", "reflectance": _rgb(*value)}


def _look(origin, target):
    origin, target = ([float(v) for v in p] for p in (origin, target))
    return mi.ScalarTransform4f().look_at(origin, target, [0.1, 1, 0.2])


def _wall(centre, towards, size: float, colour=(0.6, 0.6, 0.5)) -> dict:
    place = _look(centre, towards) @ mi.ScalarTransform4f().scale([size, size, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": _diffuse(*colour)}
