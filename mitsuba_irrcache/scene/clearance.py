"""Separate the meshes that bound media from surfaces that lie in their faces.

Mitsuba offsets every ray that leaves or crosses a shape. Where a floor lies in a face of the box
that bounds a medium, a ray that crosses the face skips the floor, or begins beyond the face and
stays in the wrong medium: the image is wrong there, also that of ``volpath``. Such a scene is
replaced by one that has the same objects, but whose box ends a few offsets before the surface.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.boundary import box_frame
from mitsuba_irrcache.scene.consistency import RAY_OFFSET, described
from mitsuba_irrcache.scene.fingerprint import SceneVersion
from mitsuba_irrcache.transport.path import is_surface

#: Number of positions on a boundary from which surfaces are searched for, and the minimum number
#: that must be within the offset of rays from one for a face to touch it.
POSITIONS, FEWEST = 1 << 13, 4
#: Depth within a boundary up to which a surface that touches it may be tilted, over the shortest
#: side of the boundary, and minimum cosine between their normals.
TILT_DEPTH, PARALLEL = 0.005, 0.999
#: Distance of a moved face from surfaces, in units of the offset of rays. Rays start up to one
#: offset away from a surface, and as far beyond a face that they cross.
CLEARANCE = 3.5
#: Largest distance by which a face is moved, over the shortest side of the boundary.
LARGEST_CLEARANCE = 0.05


class SeparatedScene:
    """Provides the scene to render instead of one in which surfaces touch boundaries of media.

    It is reused until shapes move, or objects are exchanged. Other edits apply to both scenes,
    which share all other objects.
    """

    def __init__(self) -> None:
        self._version: SceneVersion | None = None
        self._separated: mi.Scene | None = None

    def of(self, scene: mi.Scene) -> mi.Scene:
        """Return ``scene``, or another one with the same objects in which all surfaces are at a
        distance from the meshes that bound media.
        """
        shapes = scene.shapes()
        if not (any(map(_bounds_medium, shapes)) and any(map(is_surface, shapes))):
            self._version = self._separated = None
            return scene
        with dr.suspend_grad():
            version = SceneVersion(scene, previous=self._version, selected=_matters)
            if self._version is None or version.changes(self._version):
                self._separated = separated(scene)
            self._version = version
        return self._separated or scene


def separated(scene: mi.Scene) -> mi.Scene | None:
    """Return a scene with the objects of ``scene``, but smaller boundaries of media where surfaces
    touch them; None if no surface does.
    """
    shapes = scene.shapes()
    # Groups of shapes, of which there may be instances, are not among the shapes of a scene.
    groups = [n for n in mi.traverse(scene).hierarchy if n.class_name() == "ShapeGroupPlugin"]
    surfaces = _scene_of([*groups, *filter(is_surface, shapes), *scene.sensors()])
    smaller = {}
    boundaries = [*filter(_bounds_medium, shapes)]
    if not boundaries:
        return None
    # The same offset for all, so that nested boundaries remain nested.
    offset = max(map(_ray_offset, boundaries))
    for shape in boundaries:
        made, is_touched = _smaller(shape, surfaces, offset)
        if made is not None:
            smaller[shape] = made
        elif is_touched:
            _warn(shape)
    if not smaller:
        return None
    emitters = [e for e in scene.emitters() if e.get_shape() is None]
    replaced = [smaller.get(shape, shape) for shape in shapes]
    result = _scene_of([*groups, *replaced, *emitters, *scene.sensors()])
    for emitter in emitters:
        emitter.set_scene(scene)  # the bounds of an environment remain those of its own scene
    names = ", ".join(map(described, smaller))
    mi.Log(
        mi.LogLevel.Info,
        f"irrcache: surfaces lie in faces of {names}: the medium in it is rendered with a gap of a "
        "few offsets of Mitsuba's rays in between. Images by volpath are wrong there.",
    )
    return result


def _scene_of(objects: list[mi.Object]) -> mi.Scene:
    """Return a scene of existing objects."""
    names = [obj.id() for obj in objects]
    numbered = {f"object{number}": obj for number, obj in enumerate(objects)}
    scene = mi.load_dict({"type": "scene", **numbered}, optimize=False)
    for obj, name in zip(objects, names, strict=True):
        obj.set_id(name)  # Mitsuba has replaced it by the key
    return scene


def _bounds_medium(shape: mi.Shape) -> bool:
    """Return whether a shape is a mesh that only bounds a medium."""
    if not shape.is_mesh() or shape.interior_medium() is None or is_surface(shape):
        return False
    return "vertex_positions" in mi.traverse(shape)


def _matters(name: str, node: mi.Object) -> bool:
    """Return whether a parameter matters for the second scene: shapes, and how often emitters are
    sampled, of which each scene has a table.
    """
    return isinstance(node, mi.Shape) or name.endswith("sampling_weight")


@dataclass
class _Contact:
    """Positions ``p`` (n, 3) on the boundary of a medium with outward normals ``n`` (n, 3), where
    surfaces are at a ``depth`` (n) within it (negative: outside), and at most by the offset of rays
    away where they are ``near`` (n).
    """

    p: np.ndarray
    n: np.ndarray
    depth: np.ndarray
    near: np.ndarray

    def planes(self, offset: float) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
        """Yield a position, the normal, and the largest depth of surfaces for each plane of the
        boundary in which surfaces lie.
        """
        left = self.near.copy()
        while left.any():
            p, n = self.p[left][0], self.n[left][0]
            own = (self.n @ n > PARALLEL) & (np.abs((self.p - p) @ n) < offset)
            if np.count_nonzero(own & self.near) >= FEWEST:
                yield p, n, self.depth[own].max()
            left &= ~own


def _ray_offset(shape: mi.Shape) -> float:
    """Return by how much Mitsuba offsets rays from a shape."""
    box = shape.bbox()
    return float((1 + np.abs([box.min, box.max]).max()) * RAY_OFFSET)


def _smaller(shape: mi.Shape, surfaces: mi.Scene, offset: float) -> tuple[mi.Mesh | None, bool]:
    """Return a mesh like ``shape`` that ends before all surfaces that lie in its faces, and whether
    any do.

    It is None if none do, or if it would be much smaller.
    """
    values = mi.traverse(shape)
    vertices = np.array(values["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    size = np.ptp(vertices, axis=0).min()
    # A boundary within another one also keeps a distance from that.
    clearance = CLEARANCE * offset * (1 if shape.exterior_medium() is None else 2)
    frame, moved = box_frame(vertices), vertices.copy()
    contact = _contact(shape, surfaces, max(TILT_DEPTH * size, clearance), offset)
    touched = False
    for p, n, depth in contact.planes(offset):
        touched = True
        distance = max(depth, 0.0) + clearance
        if distance > LARGEST_CLEARANCE * size:
            return None, True
        # The sides of a box keep their directions.
        edges = (
            n[:, None] if frame is None else frame[:3, :3] / np.linalg.norm(frame[:3, :3], axis=0)
        )
        edge = edges[:, np.abs(n @ edges).argmax()]
        own = np.abs((vertices - p) @ n) < offset
        moved[own] -= distance / (n @ edge) * edge
    return (_mesh_like(shape, moved) if touched else None), touched


def _mesh_like(shape: mi.Shape, vertices: np.ndarray) -> mi.Mesh:
    """Return a mesh with the faces, media and BSDF of ``shape``, and other ``vertices`` (n, 3)."""
    props = mi.Properties()
    props["flip_normals"] = shape.has_flipped_normals()
    props["bsdf"], props["interior"] = shape.bsdf(), shape.interior_medium()
    if shape.exterior_medium() is not None:
        props["exterior"] = shape.exterior_medium()
    faces = mi.traverse(shape)["faces"]
    mesh = mi.Mesh(shape.id(), len(vertices), len(faces) // 3, props=props)
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = mi.Float(np.float32(vertices.ravel())), faces
    values.update()
    mesh.set_id(shape.id())
    return mesh


def _contact(shape: mi.Shape, surfaces: mi.Scene, depth: float, offset: float) -> _Contact:
    """Search for ``surfaces`` that are parallel to the boundary ``shape`` of a medium, up to a
    ``depth`` within it, and up to the ``offset`` of rays outside of it.
    """
    p, n = _positions(shape)
    position, normal = (mi.Point3f(np.float32(v.T)) for v in (p, n))
    ray = mi.Ray3f(position - mi.Float(depth) * mi.Vector3f(normal), mi.Vector3f(normal))
    ray.maxt = mi.Float(depth + offset)
    si = surfaces.ray_intersect(ray)
    found = si.is_valid() & (dr.abs(dr.dot(si.n, ray.d)) > PARALLEL)
    within = np.array(dr.select(found, mi.Float(depth) - si.t, -dr.inf), dtype=np.float64)
    return _Contact(p, n, within, np.abs(within) <= offset)


def _positions(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Sample positions on a mesh uniformly, and return them with the outward normals of their
    triangles (n, 3).
    """
    values = mi.traverse(mesh)
    vertices = np.array(values["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    a, b, c = vertices[np.array(values["faces"]).reshape(-1, 3).T]
    across = np.cross(b - a, c - a)
    areas = np.linalg.norm(across, axis=1)
    rng = np.random.default_rng(POSITIONS)
    chosen = rng.choice(len(areas), POSITIONS, p=areas / areas.sum())
    u, v = rng.random((2, POSITIONS, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    p = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    n = (across / np.maximum(areas, 1e-300)[:, None])[chosen]
    return p, -n if mesh.has_flipped_normals() else n


def _warn(shape: mi.Shape) -> None:
    """Log a warning for a boundary of a medium that surfaces touch, and that is not replaced."""
    mi.Log(
        mi.LogLevel.Warn,
        f"irrcache: surfaces lie in a face of {described(shape)}, which bounds a medium, or so "
        "close to it that Mitsuba's rays, which are offset from shapes, skip them, also in "
        "volpath: the image is wrong around them. Extend the boundary beyond the surfaces, or "
        "leave a gap of a thousandth of its size.",
    )
