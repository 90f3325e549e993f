"""Separate the boxes that bound media from surfaces that lie in their faces.

Mitsuba offsets every ray that leaves or crosses a shape. Where a floor lies in a face of the box
that bounds a medium, a ray that crosses the face skips the floor, or begins beyond the face and
stays in the wrong medium: the image is wrong there, also that of ``volpath``. Such a scene is
replaced by one that has the same objects, but whose box ends a few offsets before the surface.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.boundary import Boundary, box_frame, points_outwards
from mitsuba_irrcache.scene.consistency import RAY_OFFSET
from mitsuba_irrcache.scene.fingerprint import SceneVersion
from mitsuba_irrcache.scene.occluders import corners_of
from mitsuba_irrcache.transport.path import is_surface

#: Number of points on a surface, their largest distance from a face of the boundary of a medium
#: over the edge of the box, and their smallest share, for which both are said to coincide.
POINTS, COINCIDENT, COINCIDENT_SHARE = 256, 1e-5, 0.1
#: Distance of a separated face from its former position, in units of the offset of rays. A surface
#: may lie one offset within the box, and rays start up to two offsets away from it.
CLEARANCE = 4.0
#: Largest such distance over the edge of the box; thinner boxes remain as they are.
LARGEST_CLEARANCE = 0.05
#: Shapes with flat parts, besides meshes; others, such as instances, need not sample positions.
FLAT = ("Rectangle", "Disk")


class SeparatedScene:
    """Provides the scene to render instead of one in which surfaces lie in faces of boxes.

    It is reused until shapes move, or objects are exchanged. Other edits apply to both scenes,
    which share all other objects.
    """

    def __init__(self) -> None:
        self._version: SceneVersion | None = None
        self._separated: mi.Scene | None = None

    def of(self, scene: mi.Scene) -> mi.Scene:
        """Return ``scene``, or another one with the same objects in which all surfaces are at a
        distance from the boxes that bound media.
        """
        if not _may_touch(scene):
            self._version = self._separated = None
            return scene
        with dr.suspend_grad():
            version = SceneVersion(scene, previous=self._version, selected=_matters)
            if self._version is None or version.changes(self._version):
                self._separated = separated(scene)
            self._version = version
        return self._separated or scene


def separated(scene: mi.Scene) -> mi.Scene | None:
    """Return a scene with the objects of ``scene``, but smaller boxes where surfaces touch them.

    None if no surface does, or if the boxes are too thin.
    """
    shapes = scene.shapes()
    if any(shape.class_name() == "Instance" for shape in shapes):
        return None  # their geometry cannot be part of a second scene
    surfaces = [(p, shape) for shape in shapes if (p := points_on(shape)) is not None]
    smaller = {shape: box for shape in shapes if (box := _smaller_box(shape, surfaces)) is not None}
    if not smaller:
        return None
    emitters = [e for e in scene.emitters() if e.get_shape() is None]
    objects = [*(smaller.get(shape, shape) for shape in shapes), *emitters, *scene.sensors()]
    names = [obj.id() for obj in objects]
    numbered = {f"object{number}": obj for number, obj in enumerate(objects)}
    result = mi.load_dict({"type": "scene", **numbered}, optimize=False)
    for obj, name in zip(objects, names, strict=True):
        obj.set_id(name)  # Mitsuba has replaced it by the key
    for emitter in emitters:
        emitter.set_scene(scene)  # the bounds of an environment remain those of its own scene
    changed = ", ".join(f'"{shape.id()}"' for shape in smaller)
    mi.Log(
        mi.LogLevel.Info,
        f"irrcache: surfaces lie in faces of {changed}, which bound media: it is rendered with a "
        "gap of a few offsets of Mitsuba's rays in between. Images of volpath are wrong there.",
    )
    return result


def _may_touch(scene: mi.Scene) -> bool:
    """Return whether a scene has both surfaces and boxes that may only bound media."""
    shapes = scene.shapes()
    return any(map(_may_be_replaced, shapes)) and any(map(is_surface, shapes))


def _may_be_replaced(shape: mi.Shape) -> bool:
    return shape.is_mesh() and shape.interior_medium() is not None and not is_surface(shape)


def _matters(name: str, node: mi.Object) -> bool:
    """Return whether a parameter matters for the second scene: shapes, and how often emitters are
    sampled, of which each scene has a table.
    """
    return isinstance(node, mi.Shape) or name.endswith("sampling_weight")


def points_on(shape: mi.Shape) -> np.ndarray | None:
    """Sample points (3, n) on a surface that may be flat; None for other shapes."""
    may_be_flat = shape.is_mesh() or shape.class_name() in FLAT
    bounds_medium = shape.interior_medium() or shape.exterior_medium()
    if not (may_be_flat and is_surface(shape)) or bounds_medium:
        return None
    sample = np.random.default_rng(POINTS).random((2, POINTS))
    record = shape.sample_position(0.0, mi.Point2f(np.float32(sample)))
    return np.array(record.p, dtype=np.float64)


def ray_offset(frame: np.ndarray) -> float:
    """Return by how much Mitsuba offsets rays from the unit cube mapped by ``frame``."""
    return float((1 + np.abs(corners_of(frame)).max()) * RAY_OFFSET)


def touched_faces(p: np.ndarray, frame: np.ndarray) -> list[tuple[int, int]]:
    """Return the faces (axis, 0 or 1) of the unit cube mapped by ``frame`` in whose plane, or
    within the offset of rays from it, a share of the points ``p`` (3, n) of a surface lies whose
    bounds overlap the face.
    """
    inverse, distance = np.linalg.inv(frame), ray_offset(frame)
    u = inverse[:3, :3] @ p + inverse[:3, 3:]
    found = []
    for axis, face in itertools.product(range(3), (0, 1)):
        edges = max(COINCIDENT, distance * np.linalg.norm(inverse[axis, :3]))
        own = np.abs(u[axis] - face) < edges
        if own.mean() < COINCIDENT_SHARE:
            continue
        across = np.delete(u[:, own], axis, axis=0)
        if (across.max(axis=1) > 0).all() and (across.min(axis=1) < 1).all():
            found.append((axis, face))
    return found


def _smaller_box(shape: mi.Shape, surfaces: list[tuple[np.ndarray, mi.Shape]]) -> mi.Shape | None:
    """Return a box like ``shape``, with a distance from the ``surfaces`` that lie in its faces;
    None if there are none, or for other shapes.
    """
    frame = _frame_of_box(shape)
    if frame is None:
        return None
    faces = {face for p, _ in surfaces for face in touched_faces(p, frame)}
    if not faces:
        return None
    lengths = np.linalg.norm(np.linalg.inv(frame)[:3, :3], axis=1)
    moved = CLEARANCE * ray_offset(frame) * lengths  # in units of the edges
    ends = np.array([[0.0, 1.0]] * 3)
    for axis, face in faces:
        if moved[axis] > LARGEST_CLEARANCE:
            return None
        ends[axis, face] += moved[axis] * (1 - 2 * face)
    inner = np.diag([*(0.5 * (ends[:, 1] - ends[:, 0])), 1.0])
    inner[:3, 3] = ends.mean(axis=1)
    to_world = frame @ inner
    if np.linalg.det(to_world[:3, :3]) < 0:
        to_world[:, 0] *= -1  # the box is the same, and its normals point outwards
    box = {"type": "cube", "to_world": mi.ScalarTransform4f(to_world), "bsdf": shape.bsdf()}
    box["interior"] = shape.interior_medium()
    if shape.exterior_medium() is not None:
        box["exterior"] = shape.exterior_medium()
    made = mi.load_dict(box)
    made.set_id(shape.id())
    return made


def _frame_of_box(shape: mi.Shape) -> np.ndarray | None:
    """Return the map (4, 4) of the unit cube onto a box that only bounds a medium; None for other
    shapes.
    """
    if not _may_be_replaced(shape):
        return None
    values = mi.traverse(shape)
    if "vertex_positions" not in values:
        return None
    frame = box_frame(np.array(values["vertex_positions"], dtype=np.float64).reshape(-1, 3))
    if frame is None or shape.has_flipped_normals() or not points_outwards(shape):
        return None
    return Boundary("box", frame).frame
