"""Solid angles of area emitters of simple shapes, in closed form.

A rectangle, disk, sphere or box with the same radiance L everywhere causes the irradiance
(fluence rate) L Omega at a position from which it is seen under the solid angle Omega, if nothing
lies in between. It varies by an order of magnitude within a voxel next to the emitter.
"""

from __future__ import annotations

from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import opaque_point
from mitsuba_irrcache.grids.boundary import box_frame, sphere_frame
from mitsuba_irrcache.grids.grid import Affine
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of, varies_in_space

#: Number of sides of the regular polygon of the same area that represents a disk.
DISK_SIDES = 16
#: Tolerated deviation of four corners from a parallelogram, relative to its size.
FLAT_TOLERANCE = 1e-4
#: Minimum distance from the plane of a face for which points on it are sampled, relative to the
#: distance of the closest point and to the size of the face: in the plane itself the solid angle is
#: 0, and sampling by solid angle is undefined.
LOWEST, SMALLEST = 0.1, 1e-3
#: Corners of the faces of the cube [-1, 1]^3, in order around each face.
FACES = [
    [np.insert([a, b], axis, side) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    for axis in range(3)
    for side in (-1.0, 1.0)
]


class SolidAngle:
    """Solid angle under which a convex shape is seen from its front, and its closest point.

    ``kind`` is "sphere", "box", "rectangle" (any parallelogram) or "disk"; ``frame`` maps the unit
    sphere, the cube [-1, 1]^3, or the square or unit disk in the plane z = 0 to the world.
    ``normal`` is the front of a flat shape.
    """

    def __init__(self, kind: str, frame: np.ndarray, normal: np.ndarray | None = None) -> None:
        self.kind, self.frame = kind, frame
        self.is_flat = kind in ("rectangle", "disk")
        self._world, self._local = Affine(frame), Affine(np.linalg.inv(frame))
        self._centre = opaque_point(frame[:3, 3])
        self._radius = dr.opaque(mi.Float, float(np.linalg.norm(frame[:3, 0])))
        self._polygons = [
            ([opaque_point(v) for v in corners], opaque_point(front))
            for corners, front in _polygons(kind, frame, normal)
        ]
        self._faces = _faces(kind, frame)

    @classmethod
    def of(cls, emitter: mi.Emitter) -> SolidAngle | None:
        """Return the solid angle of an emitter; None if its shape or radiance is not supported."""
        shape = emitter.get_shape()
        if kind_of(emitter) is not EmitterKind.AREA or shape is None or varies_in_space(emitter):
            return None
        found = _shape_frame(shape)
        if found is None:
            return None
        kind, frame = found
        record = shape.sample_position(0.0, mi.Point2f(0.4, 0.3))
        position, normal = (np.array(v, dtype=np.float64).ravel() for v in (record.p, record.n))
        if kind in ("rectangle", "disk"):
            return cls(kind, frame, normal)
        # Shapes that emit inwards are seen from inside, where they have no closest point.
        return cls(kind, frame) if normal @ (position - frame[:3, 3]) > 0 else None

    def at(self, p: mi.Point3f) -> mi.Float:
        """Evaluate the solid angle at world positions; 0 behind a flat shape."""
        if self.kind == "sphere":
            ratio = dr.minimum(dr.square(self._radius) / dr.squared_norm(p - self._centre), 1)
            return 2 * dr.pi * ratio / (1 + dr.sqrt(1 - ratio))
        total = mi.Float(0)
        for corners, front in self._polygons:
            seen = dr.dot(front, p - corners[0]) > 0
            total += dr.select(seen, _polygon_solid_angle(corners, p), 0)
        return total

    def closest(self, p: mi.Point3f) -> mi.Point3f:
        """Return the closest point of the shape to ``p``, approximately if its frame has shear or
        different scales.
        """
        local = self._local.point(p)
        if self.kind in ("sphere", "disk"):
            if self.kind == "disk":
                local.z = 0
            return self._world.point(local * dr.rcp(dr.maximum(dr.norm(local), 1)))
        local = dr.clip(local, -1, 1)
        if self.is_flat:
            local.z = 0
        return self._world.point(local)

    def shares(self, p: mi.Point3f) -> list[mi.Float]:
        """Return the share of each face in the solid angle at world positions, for `sample`.

        Flat shapes have one face. From inside of a box, which sees no face, all shares are 0.
        """
        if len(self._polygons) < 2:
            return [mi.Float(1)]
        angles = [
            dr.select(dr.dot(front, p - corners[0]) > 0, _polygon_solid_angle(corners, p), 0)
            for corners, front in self._polygons
        ]
        total = sum(angles)
        return [angle / dr.maximum(total, 1e-30) for angle in angles]

    def sample(
        self, p: mi.Point3f, shares: list[mi.Float], sample: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Sample a point of any shape but a sphere, approximately uniformly by solid angle.

        Both sides of a flat shape are sampled alike. ``shares`` is the result of `shares`. Returns
        the direction and distance of the point, and the solid angle that it represents (the inverse
        of its density), which varies smoothly and by a small factor between the points; 0 from
        inside of a box.

        Lines parallel to one edge are sampled uniformly by the angle in the plane perpendicular to
        them, and points on a line by their solid angle, whose distribution is invertible.
        """
        x, (face, share) = sample.x, (self._faces[0], shares[0])
        begin = mi.Float(0)
        for other, its_share in zip(self._faces[1:], shares[1:], strict=True):
            is_next = (x >= begin + share) & (its_share > 0)
            begin = dr.select(is_next, begin + share, begin)
            share = dr.select(is_next, its_share, share)
            face = [dr.select(is_next, b, a) for a, b in zip(face, other, strict=True)]
        if len(self._faces) > 1:
            x = dr.clip((x - begin) / dr.maximum(share, 1e-30), 0, 1)
        centre, normal, across, along, half, shear, length = face
        offset = mi.Vector3f(centre - p)
        height, middle, start = (dr.dot(offset, axis) for axis in (normal, across, along))
        # The distributions are those for a position at least this far from the plane of the face.
        closest = dr.norm(self.closest(p) - p)
        away = dr.maximum(dr.abs(height), dr.maximum(LOWEST * closest, SMALLEST * length))
        first, last = (dr.atan((middle + side * half) / away) for side in (-1, 1))
        low, high = middle - half, middle + half
        s = dr.clip(away * dr.tan(dr.lerp(first, last, x)), low, high)
        a = (s - middle) / half
        reach = length
        if self.kind == "disk":
            reach = length * dr.safe_sqrt(1 - a * a)
        start += a * shear
        distance = dr.square(away) + dr.square(s)
        low, high = start - reach, start + reach
        before, after = (t * dr.rsqrt(distance + dr.square(t)) for t in (low, high))
        part = dr.lerp(before, after, sample.y)
        t = part * dr.sqrt(distance / dr.maximum(1 - part * part, 1e-12))
        t = dr.clip(t, low, high)
        direction = height * normal + s * across + t * along
        length = dr.norm(direction)
        ratio = dr.sqrt(distance + dr.square(t)) / dr.maximum(length, 1e-30)
        angle = dr.abs(height) / away * ratio * dr.square(ratio) * (last - first) * (after - before)
        angle = dr.select(share > 0, angle / dr.maximum(share, 1e-30), 0)
        return direction / dr.maximum(length, 1e-30), length, angle


def _shape_frame(shape: mi.Shape) -> tuple[str, np.ndarray] | None:
    """Return the kind and frame of a shape for `SolidAngle`; None for other shapes."""
    name, params = shape.class_name(), mi.traverse(shape)
    if name == "Sphere":
        return "sphere", sphere_frame(shape)
    if name in ("Rectangle", "Disk"):
        matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        normal = np.cross(matrix[:3, 0], matrix[:3, 1])
        matrix[:3, 2] = normal / np.linalg.norm(normal)  # the scale along it may be 0
        return name.lower(), matrix
    if not shape.is_mesh() or "vertex_positions" not in params:
        return None
    vertices = np.array(params["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    area = float(np.ravel(shape.surface_area())[0])
    kind, frame = "box", box_frame(vertices)
    if frame is None:
        kind, frame = "rectangle", _parallelogram_frame(vertices)
    if frame is None:
        return None
    edges = 2 * frame[:3, :3].T
    pairs = [(0, 1)] if kind == "rectangle" else [(0, 1), (1, 2), (2, 0)]
    sides = sum(np.linalg.norm(np.cross(edges[i], edges[j])) for i, j in pairs)
    expected = float(sides) * (1 if kind == "rectangle" else 2)
    # Reject meshes with missing or duplicate faces.
    return (kind, frame) if abs(expected - area) < 1e-3 * area else None


def _parallelogram_frame(vertices: np.ndarray) -> np.ndarray | None:
    """Return the affine map of the square [-1, 1]^2 onto four corners; None for other meshes."""
    corners = np.unique(vertices, axis=0)
    if len(corners) != 4:
        return None
    first, *others = corners
    for k in range(3):  # the corner opposite to the first one
        a, b = (corner - first for i, corner in enumerate(others) if i != k)
        size = max(np.linalg.norm(a), np.linalg.norm(b))
        if np.abs(first + a + b - others[k]).max() <= FLAT_TOLERANCE * size:
            frame = np.eye(4)
            normal = np.cross(a, b)
            frame[:3, :3] = np.stack([a / 2, b / 2, normal / np.linalg.norm(normal)], axis=1)
            frame[:3, 3] = first + (a + b) / 2
            return frame
    return None


def _polygons(
    kind: str, frame: np.ndarray, normal: np.ndarray | None
) -> list[tuple[list[np.ndarray], np.ndarray]]:
    """Return the corners and the front normal of each face of a shape."""
    if kind == "sphere":
        return []
    if kind == "box":
        faces = FACES
    elif kind == "rectangle":
        faces = [[(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]]
    else:
        angles = (np.arange(DISK_SIDES) + 0.5) * (2 * np.pi / DISK_SIDES)
        radius = np.sqrt(2 * np.pi / (DISK_SIDES * np.sin(2 * np.pi / DISK_SIDES)))
        circle = [np.cos(angles), np.sin(angles), np.zeros(DISK_SIDES)]
        faces = [radius * np.stack(circle, axis=1)]
    found = []
    for face in faces:
        corners = [frame[:3, :3] @ np.array(v, dtype=float) + frame[:3, 3] for v in face]
        front = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        outwards = np.mean(corners, axis=0) - frame[:3, 3] if normal is None else normal
        found.append((corners, front * np.sign(front @ outwards)))
    return found


def _faces(kind: str, frame: np.ndarray) -> list[list[mi.Vector3f | mi.Float]]:
    """Return the placement of each face.

    Each is a list: centre, normal, two orthonormal axes in the plane of the face, half of the
    face's extent along the first axis, its shear (the offset along the second axis at that extent),
    and half the length of its edge along the second axis.
    """
    if kind == "sphere":
        return []
    found = []
    axes = range(3) if kind == "box" else (2,)
    for axis in axes:  # in the order of `FACES`
        for side in (-1.0, 1.0) if kind == "box" else (0.0,):
            u, v = (frame[:3, k] for k in range(3) if k != axis)
            length = np.linalg.norm(v)
            along = v / length
            across = u - (u @ along) * along
            half = np.linalg.norm(across)
            across /= half
            centre = frame[:3, 3] + side * frame[:3, axis]
            vectors = centre, np.cross(across, along), across, along
            numbers = half, u @ along, length
            found.append(
                [mi.Vector3f(opaque_point(value)) for value in vectors]
                + [dr.opaque(mi.Float, float(value)) for value in numbers]
            )
    return found


def _polygon_solid_angle(corners: list[mi.Point3f], p: mi.Point3f) -> mi.Float:
    """Compute the solid angle of a convex polygon.

    It is the sum over a fan of triangles, each twice the argument of a complex number (Van Oosterom
    and Strackee 1983). The sum of the arguments, which is less than pi, is the argument of the
    product.
    """
    # docs/primer, eq. (2.11)
    towards = [dr.normalize(mi.Vector3f(corner - p)) for corner in corners]
    first, real, imaginary = towards[0], mi.Float(1), mi.Float(0)
    for a, b in pairwise(towards[1:]):
        x = 1 + dr.dot(first, a) + dr.dot(first, b) + dr.dot(a, b)
        y = dr.dot(first, dr.cross(a, b))
        real, imaginary = real * x - imaginary * y, real * y + imaginary * x
    return 2 * dr.abs(dr.atan2(imaginary, real))
