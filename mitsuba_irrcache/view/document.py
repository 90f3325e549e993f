"""The displayed scene as XML: what the user edits is also what is rendered and saved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import write_vol
from mitsuba_irrcache.io.scene_files import filled, scene_of_text, scene_text
from mitsuba_irrcache.pipeline.cached_medium import CacheSettings
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.light import MarchSettings

#: Prefix of the names that the viewer gives to unnamed objects.
SUN_ID, MEDIUM_ID = "sun", "medium"
#: Samples per pixel in saved scenes.
SAVED_SAMPLES = 16
_ENVIRONMENTS = ("constant", "envmap")
_TRUE = ("true", "True")


@dataclass(frozen=True)
class Lighting:
    """The illumination parameters that a user can change.

    Attributes:
        environment: factor of the radiance that the scene gives its environment.
        rotation: of the environment about the upward axis, in degrees, added to the scene's.
        sun: irradiance of a sun on a surface that faces it; 0 for none.
        azimuth, elevation: direction to the sun in degrees: about the upward axis, and above the
            horizon.
    """

    environment: float = 1.0
    rotation: float = 0.0
    sun: float = 0.0
    azimuth: float = 30.0
    elevation: float = 50.0


class Document:
    """An editable scene XML whose relative file names refer to ``folder``.

    ``volumes`` holds the arrays (z, y, x[, channel]) of volumes that are not on disk, keyed by the
    names of the files to which `save` writes them.
    """

    def __init__(
        self, text: str, folder: str | Path, volumes: dict[str, np.ndarray] | None = None
    ) -> None:
        self._root = ElementTree.fromstring(text)
        self.folder = Path(folder)
        self._volumes: dict[str, np.ndarray] = {}
        self._grids: dict[str, mi.VolumeGrid] = {}
        self.set_volumes(volumes or {})
        if self._integrator is None or self._integrator.get("type") != "irrcache":
            raise IrrcacheError("view: the scene's integrator is not irrcache.")
        self._original = ElementTree.fromstring(text)
        self.orient((0.0, 0.0, 1.0))

    @classmethod
    def load(
        cls, path: Path, parameters: dict[str, str] | None = None, integrator: str | None = None
    ) -> Document:
        """Load a scene file; the arguments are those of `scene_files.load_scene`."""
        return cls(scene_text(path, parameters, integrator), path.parent)

    @classmethod
    def of_text(
        cls,
        text: str,
        volumes: dict[str, np.ndarray],
        parameters: dict[str, str] | None = None,
        integrator: str = "irrcache",
    ) -> Document:
        """Parse the XML of a scene with $parameters that refers to no files but ``volumes``."""
        return cls(filled(text, integrator, parameters), ".", volumes)

    # ------------------------------------------------------------------ contents

    def scene(self) -> mi.Scene:
        """Return the Mitsuba scene of the current XML."""
        return scene_of_text(self._text(self._root), self.folder, self._grids)

    @property
    def settings(self) -> CacheSettings:
        """Return the integrator's properties that affect the cache."""
        read = self._read
        return CacheSettings(
            max_depth=int(read("max_depth", -1)),
            rr_depth=int(read("rr_depth", 5)),
            solver=str(read("solver", "auto")),
            resolution=int(read("resolution", 0)),
            seed=int(read("cache_seed", 0)),
            warns=False,  # at every edit; windows show estimated errors
        )

    @property
    def march(self) -> MarchSettings:
        """Return the integrator's properties that affect only the ray march."""
        return MarchSettings(
            self._read("hide_emitters", "false") in _TRUE,
            str(self._read("quadrature", "exponential")),
            float(self._read("step", 1.0)),
        )

    @property
    def has_environment(self) -> bool:
        return self._environment(self._root) is not None

    @property
    def has_environment_map(self) -> bool:
        """Return whether the environment is not the same in all directions."""
        found = self._environment(self._root)
        return found is not None and found.get("type") != "constant"

    @property
    def density(self) -> float:
        """Return the factor of the extinction of all media."""
        scales = [float(m.find("float[@name='scale']").get("value")) for m in self._scaled()]
        return scales[0] / self._original_scale(0) if scales else 1.0

    def state(self) -> tuple:
        """Return everything that a user can change, as an argument for `restore`."""
        return self._text(self._root), dict(self._volumes), dict(self._grids), self.lighting

    def restore(self, state: tuple) -> None:
        """Restore the state that `state` returned."""
        text, volumes, grids, self.lighting = state
        self._root = ElementTree.fromstring(text)
        self._volumes, self._grids = dict(volumes), dict(grids)

    # ------------------------------------------------------------------ changes

    def set_volumes(self, volumes: dict[str, np.ndarray]) -> None:
        """Replace the values of the volumes of these names."""
        for name, values in volumes.items():
            self._volumes[name] = values
            self._grids[name] = mi.VolumeGrid(values.reshape(*values.shape[:3], -1))

    def set_max_depth(self, depth: int) -> None:
        if depth < -1 or depth == 0:
            raise IrrcacheError(f"max_depth is {depth}; it must be -1 (all orders) or at least 1.")
        _set(self._integrator, "integer", "max_depth", str(depth))

    def set_hide_emitters(self, hidden: bool) -> None:
        """Set whether cameras see emitters directly."""
        _set(self._integrator, "boolean", "hide_emitters", str(bool(hidden)).lower())

    def set_density(self, factor: float) -> None:
        """Multiply the extinction that the scene gives its media by a factor."""
        if not 0 < factor < 1e6:
            raise IrrcacheError(f"the density is {factor:g}; it must be above 0, and below 1e6.")
        for number, medium in enumerate(self._scaled()):
            _set(medium, "float", "scale", repr(self._original_scale(number) * factor))

    def orient(self, up: Sequence[float]) -> None:
        """Set the upward axis to which illumination angles refer; resets the illumination."""
        self.up = _unit(up)
        self.lighting = self._lighting()

    def set_lighting(self, lighting: Lighting) -> None:
        """Change the environment and the sun."""
        if not lighting.environment >= 0 or not lighting.sun >= 0:
            raise IrrcacheError("a light source cannot be negative; give 0 for none.")
        self._set_environment(lighting)
        self._set_sun(lighting)
        self.lighting = lighting

    @property
    def towards_sun(self) -> np.ndarray:
        """Return the unit vector towards the sun."""
        return _towards(self.lighting.azimuth, self.lighting.elevation, self.up)

    def angles(self, towards: Sequence[float]) -> tuple[float, float]:
        """Return azimuth and elevation in degrees of the direction ``towards`` the sun."""
        direction = _unit(towards)
        x, y = (np.dot(direction, axis) for axis in _horizon(self.up))
        elevation = np.arcsin(np.clip(np.dot(direction, self.up), -1, 1))
        return float(np.degrees(np.arctan2(y, x))), float(np.degrees(elevation))

    # ------------------------------------------------------------------ saving

    def save(
        self,
        path: Path,
        sensor: ElementTree.Element,
        medium: bool,
        integrator: dict[str, tuple[str, str]],
        note: str,
    ) -> list[Path]:
        """Save the scene as seen by a ``sensor``, see `sensor_of`.

        Volumes are written if they are not on disk yet. ``medium`` says whether the camera is
        inside the medium; ``integrator`` holds properties to set, as (kind, value) by name;
        ``note`` becomes a comment. Returns all files that were written.
        """
        root = ElementTree.fromstring(self._text(self._root))
        for default in root.findall("default"):
            root.remove(default)
        for former in root.findall("sensor"):
            root.remove(former)
        node = root.find("integrator")
        for name, (kind, value) in integrator.items():
            _set(node, kind, name, value)
        written = [path]
        for string in root.iter("string"):
            if string.get("name") == "filename":
                name = string.get("value")
                if name in self._volumes:
                    file = path.with_name(f"{path.stem}.{name}")
                    write_vol(file, self._volumes[name])
                    written.append(file)
                    string.set("value", file.name)
                elif (self.folder / name).exists():
                    string.set("value", str((self.folder / name).resolve()))
        if medium:
            inside = next(root.iter("medium"))
            inside.set("id", inside.get("id") or MEDIUM_ID)
            ElementTree.SubElement(sensor, "ref", name="medium", id=inside.get("id"))
        root.append(sensor)  # after the medium, which the sensor may refer to
        root.insert(0, ElementTree.Comment(f" {note} "))
        path.write_text(self._text(root), encoding="utf-8")
        return written

    # ------------------------------------------------------------------ details

    @property
    def _integrator(self) -> ElementTree.Element | None:
        return self._root.find("integrator")

    def _read(self, name: str, default: object) -> object:
        found = self._integrator.find(f"*[@name='{name}']")
        return default if found is None else found.get("value")

    @staticmethod
    def _text(root: ElementTree.Element) -> str:
        ElementTree.indent(root, "    ")
        return ElementTree.tostring(root, encoding="unicode") + "\n"

    def _scaled(self) -> list[ElementTree.Element]:
        """Return all media, each with an explicit ``scale``."""
        media = list(self._root.iter("medium"))
        for number, medium in enumerate(media):
            if medium.find("float[@name='scale']") is None:
                _set(medium, "float", "scale", repr(self._original_scale(number)))
        return media

    def _original_scale(self, number: int) -> float:
        medium = list(self._original.iter("medium"))[number]
        found = medium.find("float[@name='scale']")
        return 1.0 if found is None else float(found.get("value"))

    @staticmethod
    def _environment(root: ElementTree.Element) -> ElementTree.Element | None:
        return next((e for e in root.findall("emitter") if e.get("type") in _ENVIRONMENTS), None)

    @staticmethod
    def _sun(root: ElementTree.Element) -> ElementTree.Element | None:
        return next((e for e in root.findall("emitter") if e.get("type") == "directional"), None)

    def _lighting(self) -> Lighting:
        """Return the illumination of the original scene; the sun's is the mean of its channels."""
        sun = self._sun(self._root)
        if sun is None:
            return Lighting()
        colour = _numbers(sun.find("*[@name='irradiance']"), (1.0, 1.0, 1.0))
        return Lighting(sun=float(np.mean(colour)), **self._sun_angles(sun))

    def _sun_angles(self, sun: ElementTree.Element) -> dict[str, float]:
        vector, matrix = sun.find("vector[@name='direction']"), sun.find("transform/matrix")
        if vector is not None:
            direction = [float(vector.get(axis)) for axis in "xyz"]
        elif matrix is not None:
            direction = np.reshape(_numbers(matrix, ()), (4, 4))[:3, 2]
        else:
            direction = (0.0, 0.0, 1.0)  # Mitsuba's default
        azimuth, elevation = self.angles(-np.asarray(direction))
        return {"azimuth": azimuth, "elevation": elevation}

    def _set_environment(self, lighting: Lighting) -> None:
        node, original = self._environment(self._root), self._environment(self._original)
        if node is None:
            return
        if node.get("type") == "constant":
            _scale_colour(node, original, "radiance", lighting.environment)
            return
        scale = original.find("float[@name='scale']")
        scale = 1.0 if scale is None else float(scale.get("value"))
        _set(node, "float", "scale", repr(scale * lighting.environment))
        for transform in node.findall("transform"):
            node.remove(transform)
        given = original.find("transform")
        turned = ElementTree.SubElement(node, "transform", name="to_world")
        turned.extend([] if given is None else list(given))
        x, y, z = (repr(float(c)) for c in self.up)
        ElementTree.SubElement(turned, "rotate", x=x, y=y, z=z, angle=repr(lighting.rotation))

    def _set_sun(self, lighting: Lighting) -> None:
        node, original = self._sun(self._root), self._sun(self._original)
        if node is not None and lighting.sun == 0:
            self._root.remove(node)
            return
        if lighting.sun == 0:
            return
        if node is None:
            node = ElementTree.SubElement(self._root, "emitter", type="directional", id=SUN_ID)
        for child in list(node):
            if child.tag == "transform" or child.get("name") in ("direction", "to_world"):
                node.remove(child)
        direction = -_towards(lighting.azimuth, lighting.elevation, self.up)
        vector = dict(zip("xyz", (repr(float(c)) for c in direction), strict=True))
        ElementTree.SubElement(node, "vector", name="direction", **vector)
        factor, mean = lighting.sun, 1.0
        if original is not None:
            colour = _numbers(original.find("*[@name='irradiance']"), (1.0, 1.0, 1.0))
            mean = float(np.mean(colour)) or 1.0
        _scale_colour(node, original, "irradiance", factor / mean)


def _set(parent: ElementTree.Element, kind: str, name: str, value: str) -> None:
    """Set a property of a plugin, replacing one of the same name."""
    for child in parent.findall(f"*[@name='{name}']"):
        parent.remove(child)
    ElementTree.SubElement(parent, kind, name=name, value=value)


def _numbers(element: ElementTree.Element | None, default: tuple) -> tuple[float, ...]:
    if element is None or element.get("value") is None:
        return default
    values = element.get("value").replace(",", " ").split()
    numbers = tuple(float(v) for v in values)
    return numbers * 3 if len(numbers) == 1 else numbers


def _scale_colour(
    node: ElementTree.Element, original: ElementTree.Element | None, name: str, factor: float
) -> None:
    """Set a colour of an emitter to its value in the ``original`` times ``factor``."""
    given = None if original is None else original.find(f"*[@name='{name}']")
    colour = _numbers(given, (1.0, 1.0, 1.0))
    _set(node, "rgb", name, " ".join(repr(c * factor) for c in colour))


def _horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions at azimuth 0 and 90 degrees; 0 is along x, or along y if x is up."""
    start = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    first = _unit(start - np.dot(start, up) * up)
    return first, np.cross(up, first)


def _towards(azimuth: float, elevation: float, up: np.ndarray) -> np.ndarray:
    """Return the direction towards the sun."""
    a, e = np.radians((azimuth, elevation))
    first, second = _horizon(up)
    return np.cos(e) * (np.cos(a) * first + np.sin(a) * second) + np.sin(e) * up


def _unit(vector: Sequence[float]) -> np.ndarray:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)


def sensor_of(
    camera: Camera, size: tuple[int, int], with_alpha: bool = False
) -> ElementTree.Element:
    """Return a ``perspective`` sensor with a box filter, as the viewer uses.

    Its film has this ``size`` (width, height).
    """
    sensor = ElementTree.Element("sensor", type="perspective")
    _set(sensor, "float", "fov", repr(camera.fov))
    _set(sensor, "string", "fov_axis", "y")
    near = 1e-4 * camera.distance
    _set(sensor, "float", "near_clip", repr(near))
    _set(sensor, "float", "far_clip", repr(1e4 * camera.distance))
    transform = ElementTree.SubElement(sensor, "transform", name="to_world")
    origin, target, up = (
        ", ".join(repr(float(c)) for c in v) for v in (camera.position, camera.target, camera.up)
    )
    ElementTree.SubElement(transform, "lookat", origin=origin, target=target, up=up)
    sampler = ElementTree.SubElement(sensor, "sampler", type="independent")
    _set(sampler, "integer", "sample_count", str(SAVED_SAMPLES))
    film = ElementTree.SubElement(sensor, "film", type="hdrfilm")
    _set(film, "integer", "width", str(size[0]))
    _set(film, "integer", "height", str(size[1]))
    _set(film, "string", "pixel_format", "rgba" if with_alpha else "rgb")
    _set(film, "string", "component_format", "float32")
    ElementTree.SubElement(film, "rfilter", type="box")
    return sensor
