"""Orbiting cameras: their rays, and the mapping between scene and browser coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

#: Sensor plugins that an orbiting camera can represent.
SENSORS = ("PerspectiveCamera", "ThinLensCamera")
#: Accepted fields of view in degrees.
NARROWEST, WIDEST = 1.0, 150.0
#: Minimum cosine between a sensor's up vector and a world axis to use the axis instead.
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
        """Return the unit vectors (3, 3) that point right, up and forward in the image, as rows."""
        forward = _unit(np.subtract(self.target, self.position))
        side = np.cross(forward, self.up)
        if np.linalg.norm(side) < 1e-6 * np.linalg.norm(self.up):  # looking straight up or down
            side = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
        right = _unit(side)
        return np.stack([right, np.cross(right, forward), forward])

    @property
    def distance(self) -> float:
        """Return the distance from the position to the target."""
        return float(np.linalg.norm(np.subtract(self.target, self.position)))

    def rays(self, place: mi.Point2f, aspect: float) -> mi.Ray3f:
        """Return the rays through each ``place`` of the image.

        (0, 0) is the upper left corner and (1, 1) the lower right one; ``aspect`` is width over
        height. All numbers are opaque, so that one kernel serves all cameras and image sizes.
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
    """Return the orbiting camera at the position of a scene's ``sensor``.

    It orbits about the point on its optical axis that is nearest to ``centre``. Depth of field and
    shutter are ignored.
    """
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    position, forward, up = matrix[:3, 3], _unit(matrix[:3, 2]), _unit(matrix[:3, 1])
    distance = float(np.dot(centre - position, forward))
    if distance <= 1e-3 * np.linalg.norm(centre - position):  # the scene lies behind the sensor
        distance = max(float(np.linalg.norm(centre - position)), 1e-3)
    size = sensor.film().size()
    # Mitsuba exposes the horizontal field of view, whichever axis the scene specifies.
    width = np.tan(np.radians(float(mi.traverse(sensor)["x_fov"][0])) / 2)
    fov = float(np.degrees(2 * np.arctan(width * size[1] / size[0])))
    return Camera(
        tuple(position.tolist()),
        tuple((position + distance * forward).tolist()),
        tuple(_upright(up, forward).tolist()),
        float(np.clip(fov, NARROWEST, WIDEST)),
    )


def sensors_of(scene: mi.Scene) -> dict[str, mi.Sensor]:
    """Return the sensors that an orbiting camera can represent, by name, in scene order."""
    found: dict[str, mi.Sensor] = {}
    for number, sensor in enumerate(scene.sensors()):
        if sensor.class_name() in SENSORS:
            named = sensor.id() and not sensor.id().startswith("_")
            name = sensor.id() if named else f"sensor {number}"
            found[name if name not in found else f"{name} ({number})"] = sensor
    return found


@dataclass(frozen=True)
class Placement:
    """The mapping of a scene to browser coordinates: ``centre`` to the origin, ``radius`` to 1.

    The browser's zoom, pan and near planes then suit scenes of all sizes.
    """

    centre: np.ndarray
    radius: float

    @classmethod
    def around(cls, frame: np.ndarray) -> Placement:
        """Return the mapping for the unit cube transformed by ``frame`` (4, 4)."""
        corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
        world = frame[:3, :3] @ corners + frame[:3, 3:]
        centre = world.mean(axis=1)
        return cls(centre, float(np.linalg.norm(world - centre[:, None], axis=0).max()))

    def to_browser(self, point: np.ndarray) -> np.ndarray:
        """Map a point from scene to browser coordinates."""
        return (np.asarray(point) - self.centre) / self.radius

    def to_scene(self, point: np.ndarray) -> np.ndarray:
        """Map a point from browser to scene coordinates."""
        return np.asarray(point, dtype=np.float64) * self.radius + self.centre


def cameras_of(scene: mi.Scene, placement: Placement) -> dict[str, Camera]:
    """Return cameras at the scene's sensors, by name; a default camera if there is none."""
    centre = placement.centre
    found = {name: camera_of(sensor, centre) for name, sensor in sensors_of(scene).items()}
    if found:
        return found
    away = centre + placement.radius * np.array([0.0, -4.0, 1.0])
    return {"front": Camera(tuple(away), tuple(centre), (0.0, 0.0, 1.0), 30.0)}


def _upright(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the world axis nearest to the sensor's up vector, or that vector if no axis is near.

    The camera orbits about this direction.
    """
    axis = np.zeros(3)
    axis[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    right = np.cross(forward, up)
    return axis if abs(np.dot(right, axis)) < 1e-4 and np.dot(up, axis) > UPRIGHT else up


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector, dtype=np.float64) / np.linalg.norm(vector)
