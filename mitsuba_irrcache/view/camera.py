"""Cameras that orbit: how they see, and how they lie in the scene and in a browser."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

#: Sensors of scenes that an orbiting camera can stand for.
SENSORS = ("PerspectiveCamera", "ThinLensCamera")
#: Fields of view that make sense, in degrees.
NARROWEST, WIDEST = 1.0, 150.0
#: Of a sensor's own upward direction and a world axis: above this they are taken as one.
UPRIGHT = 0.2


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        position, target: points (3), scene units; ``target`` is what it orbits about.
        up: direction (3) that is up in the picture.
        fov: vertical field of view in degrees.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors (3, 3): rows point right, up and forward in the picture."""
        forward = _unit(np.subtract(self.target, self.position))
        side = np.cross(forward, self.up)
        if np.linalg.norm(side) < 1e-6 * np.linalg.norm(self.up):  # it looks straight up or down
            side = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
        right = _unit(side)
        return np.stack([right, np.cross(right, forward), forward])

    @property
    def distance(self) -> float:
        """From the position to the target."""
        return float(np.linalg.norm(np.subtract(self.target, self.position)))

    def rays(self, place: mi.Point2f, aspect: float) -> mi.Ray3f:
        """Rays through each ``place`` of the picture: (0, 0) is its upper left corner, (1, 1) the
        lower right one; ``aspect`` is width over height.

        All numbers are opaque, so that one kernel serves all cameras and sizes.
        """
        height = np.tan(np.radians(self.fov) / 2)
        right, up, forward = self.axes
        corner = forward - height * aspect * right + height * up
        origin, corner, across, down = (
            mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in vector))
            for vector in (
                np.array(self.position),
                corner,
                2 * height * aspect * right,
                -2 * height * up,
            )
        )
        direction = dr.normalize(corner + place.x * across + place.y * down)
        return mi.Ray3f(mi.Point3f(origin), direction)


def camera_of(sensor: mi.Sensor, centre: np.ndarray) -> Camera:
    """The camera at the place of a scene's ``sensor`` that orbits about the point of its line of
    sight next to ``centre``. What a lens or a shutter adds is left out.
    """
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    position, forward, up = matrix[:3, 3], _unit(matrix[:3, 2]), _unit(matrix[:3, 1])
    distance = float(np.dot(centre - position, forward))
    if distance <= 1e-3 * np.linalg.norm(centre - position):  # it looks elsewhere
        distance = max(float(np.linalg.norm(centre - position)), 1e-3)
    size = sensor.film().size()
    # Mitsuba tells the horizontal field of view, whatever the scene gave.
    width = np.tan(np.radians(float(mi.traverse(sensor)["x_fov"][0])) / 2)
    fov = float(np.degrees(2 * np.arctan(width * size[1] / size[0])))
    return Camera(
        tuple(position.tolist()),
        tuple((position + distance * forward).tolist()),
        tuple(_upright(up, forward).tolist()),
        float(np.clip(fov, NARROWEST, WIDEST)),
    )


def sensors_of(scene: mi.Scene) -> dict[str, mi.Sensor]:
    """The sensors of a scene that a camera can stand for, by name, in their order."""
    found: dict[str, mi.Sensor] = {}
    for number, sensor in enumerate(scene.sensors()):
        if sensor.class_name() in SENSORS:
            named = sensor.id() and not sensor.id().startswith("_")
            name = sensor.id() if named else f"sensor {number}"
            found[name if name not in found else f"{name} ({number})"] = sensor
    return found


@dataclass(frozen=True)
class Placement:
    """How a scene lies in the browser: its ``centre`` in the origin, its ``radius`` as 1. So zoom,
    pan and near planes fit scenes of all sizes.
    """

    centre: np.ndarray
    radius: float

    @classmethod
    def around(cls, frame: np.ndarray) -> Placement:
        """Of the unit cube that ``frame`` (4, 4) places."""
        corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
        world = frame[:3, :3] @ corners + frame[:3, 3:]
        centre = world.mean(axis=1)
        return cls(centre, float(np.linalg.norm(world - centre[:, None], axis=0).max()))

    def to_browser(self, point: np.ndarray) -> np.ndarray:
        """Of a point in scene units."""
        return (np.asarray(point) - self.centre) / self.radius

    def to_scene(self, point: np.ndarray) -> np.ndarray:
        """The inverse of `to_browser`."""
        return np.asarray(point, dtype=np.float64) * self.radius + self.centre


def cameras_of(scene: mi.Scene, placement: Placement) -> dict[str, Camera]:
    """The cameras at the places of the scene's sensors, by name; one in front where there are
    none.
    """
    centre = placement.centre
    found = {name: camera_of(sensor, centre) for name, sensor in sensors_of(scene).items()}
    if found:
        return found
    away = centre + placement.radius * np.array([0.0, -4.0, 1.0])
    return {"front": Camera(tuple(away), tuple(centre), (0.0, 0.0, 1.0), 30.0)}


def _upright(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The world axis that a camera is upright by, else its own upward direction: one orbits about
    it.
    """
    axis = np.zeros(3)
    axis[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    right = np.cross(forward, up)
    return axis if abs(np.dot(right, axis)) < 1e-4 and np.dot(up, axis) > UPRIGHT else up


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)
