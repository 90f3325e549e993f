"""Separate the meshes that bound media from surfaces that lie in their faces.

Mitsuba offsets every ray that leaves or crosses a shape. Where a floor lies in a face of the box
that bounds a medium, a ray that crosses the face skips the floor, or begins beyond the face and
stays in the wrong medium: the image is wrong there, also that of ``volpath``. Such a scene is
replaced by one that has the same objects, but whose box ends a few offsets before the surface.
Analytic shapes (spheres, disks) are not replaced, but named in a warning.
"""

from __future__ import annotations

from threading import RLock

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.lights.emitters import varies_in_space
from mitsuba_irrcache.scene.consistency import described, ray_offset
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
#: Weight of the condition that vertices stay in the planes of faces that do not touch surfaces.
OTHER_FACES = 1e-3
#: Parameters of shapes that describe where they are. Normals are among them, because Mitsuba
#: computes those of a mesh anew if only its vertices have changed.
POSITION_PARAMETERS = ("vertex_positions", "vertex_normals", "to_world", "control_points", "data")
#: Excludes other threads while objects, which scenes share, have other names and bounds.
_NAMING = RLock()


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
        if not (any(map(_only_bounds_medium, shapes)) and any(map(is_surface, shapes))):
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
    boundaries = [*filter(_only_bounds_medium, shapes)]
    if not boundaries:
        return None
    # Groups of shapes, of which there may be instances, are not among the shapes of a scene.
    groups = [n for n in mi.traverse(scene).hierarchy if n.class_name() == "ShapeGroupPlugin"]
    solid = [_without_texture(shape) for shape in filter(is_surface, shapes)]
    surfaces = _scene_of([*groups, *solid, *scene.sensors()])
    smaller = {}
    for shape in boundaries:
        if not _has_vertices(shape) and _is_touched(shape, surfaces):
            _warn(
                shape
            )  # a sphere, or a disk that closes a cylinder: they have no vertices to move
    for shape, clearance in _clearances([*filter(_has_vertices, boundaries)]).items():
        boundary = _Boundary(shape, clearance, surfaces)
        if boundary.is_touched:
            made = boundary.smaller()
            if made is None:
                _warn(shape)
            else:
                smaller[shape] = made
    if not smaller:
        return None
    emitters = [e for e in scene.emitters() if e.get_shape() is None]
    replaced = [smaller.get(shape, shape) for shape in shapes]
    with _NAMING:
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


def _without_texture(shape: mi.Shape) -> mi.Shape:
    """Return ``shape``, or a mesh of the same form if it is a mesh with textured emission.

    Such a mesh refers to the scene that was created last with it: once that scene has been freed,
    sampling its emission crashes if it has not been sampled before or was edited since.
    """
    emitter = shape.emitter()
    if emitter is None or not _has_vertices(shape) or not varies_in_space(emitter):
        return shape
    positions = np.array(mi.traverse(shape)["vertex_positions"], dtype=np.float64)
    return _mesh_like(shape, positions.reshape(-1, 3))


def _scene_of(objects: list[mi.Object]) -> mi.Scene:
    """Return a scene of existing objects."""
    _mark_groups_as_moved(objects)
    with _NAMING:
        names = [obj.id() for obj in objects]
        numbered = {f"object{number}": obj for number, obj in enumerate(objects)}
        scene = mi.load_dict({"type": "scene", **numbered}, optimize=False)
        for obj, name in zip(objects, names, strict=True):
            obj.set_id(name)  # Mitsuba has replaced it by the key
    return scene


def _mark_groups_as_moved(objects: list[mi.Object]) -> None:
    """Make the next scene build its own acceleration structures of groups of shapes.

    On GPUs, Mitsuba 3.9 builds them only for groups that have changed since the last scene with
    them, and otherwise reads beyond the end of an empty list.
    """
    if dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        return
    for group in objects:
        if group.class_name() == "ShapeGroupPlugin":
            mark_as_moved(group)


def mark_as_moved(group: mi.Object) -> None:
    """Declare the positions of shapes as changed, without a change."""
    params = mi.traverse(group)
    for key in params.keys():
        if key.rpartition(".")[2] in POSITION_PARAMETERS:
            params.set_dirty(key)
    params.update()


def _only_bounds_medium(shape: mi.Shape) -> bool:
    """Return whether a shape bounds a medium without being a surface."""
    return shape.interior_medium() is not None and not is_surface(shape)


def _has_vertices(shape: mi.Shape) -> bool:
    """Return whether a shape is a mesh."""
    return shape.is_mesh() and "vertex_positions" in mi.traverse(shape)


def _is_touched(shape: mi.Shape, surfaces: mi.Scene) -> bool:
    """Return whether surfaces coincide with parts of an analytic shape.

    They are searched for by rays from positions on it, up to the offset of Mitsuba's rays.
    """
    box = shape.bbox()
    offset = ray_offset(np.array([box.min, box.max]))
    samples = mi.Point2f(np.random.default_rng(POSITIONS).random((2, POSITIONS)))
    found = shape.sample_position(0.0, samples)
    # All values are arrays: Dr.Jit cannot compile an intersection with one direction for all rays.
    position, normal = (np.array(v) for v in (found.p, found.n + 0 * found.p))
    ray = mi.Ray3f(mi.Point3f(position - offset * normal), mi.Vector3f(normal))
    ray.maxt = mi.Float(2 * offset)
    si = surfaces.ray_intersect(ray)
    touched = si.is_valid() & (dr.abs(dr.dot(si.n, ray.d)) > PARALLEL)
    return dr.count(touched)[0] >= FEWEST


def _matters(name: str, node: mi.Object) -> bool:
    """Return whether a parameter matters for the second scene: shapes, and how often emitters are
    sampled, of which each scene has a table.
    """
    return isinstance(node, mi.Shape) or name.endswith("sampling_weight")


def _clearances(boundaries: list[mi.Shape]) -> dict[mi.Shape, float]:
    """Return the distance from surfaces at which each of the boundaries is to end.

    One within another keeps a distance from that, too.
    """
    boxes = {b: (np.array(b.bbox().min), np.array(b.bbox().max)) for b in boundaries}
    found: dict[mi.Shape, float] = {}
    for shape in sorted(boundaries, key=lambda b: -np.linalg.norm(np.subtract(*boxes[b]))):
        lower, upper = boxes[shape]
        around = [
            found[b]
            for b in found
            if b.interior_medium() == shape.exterior_medium()
            and (boxes[b][0] <= lower).all()
            and (boxes[b][1] >= upper).all()
        ]
        found[shape] = CLEARANCE * ray_offset(boxes[shape]) + max(around, default=0.0)
    return found


class _Boundary:
    """The mesh that bounds a medium, and the faces in which ``surfaces`` lie.

    Where they do, it is to end at a distance of ``clearance`` from them.
    """

    def __init__(self, shape: mi.Shape, clearance: float, surfaces: mi.Scene) -> None:
        self._shape, self._clearance, self._surfaces = shape, clearance, surfaces
        values = mi.traverse(shape)
        self._vertices = np.array(values["vertex_positions"], dtype=np.float64).reshape(-1, 3)
        self._offset = ray_offset(self._vertices)
        self._faces = np.array(values["faces"]).reshape(-1, 3)
        a, b, c = self._vertices[self._faces.T]
        across = np.cross(b - a, c - a)
        self._areas = np.linalg.norm(across, axis=1)
        self._normals = across / np.maximum(self._areas, 1e-300)[:, None]
        if shape.has_flipped_normals():
            self._normals = -self._normals
        self._size = np.ptp(self._vertices, axis=0).min()
        #: for each triangle, the distance by which it has to move inwards
        self._distances = self._touched()

    @property
    def is_touched(self) -> bool:
        """Whether surfaces lie in a face."""
        return bool((self._distances > 0).any())

    def smaller(self) -> mi.Mesh | None:
        """Return a mesh that ends before the surfaces; None if it would be much smaller, or if
        moving its vertices does not suffice.
        """
        moved = self._vertices + self._moves()
        if np.abs(moved - self._vertices).max() > LARGEST_CLEARANCE * self._size:
            return None
        mesh = _mesh_like(self._shape, moved)
        if _Boundary(mesh, self._clearance, self._surfaces).is_touched:
            return None
        return mesh

    def _moves(self) -> np.ndarray:
        """Return the displacements (n, 3) of the vertices that move each triangle by its distance
        in the direction of its normal, by weighted least squares.
        """
        _, place = np.unique(self._vertices, axis=0, return_inverse=True)
        corners = place.ravel()[self._faces]
        count = corners.max() + 1
        # Other faces stay in their planes as far as possible: boxes remain boxes.
        weight = np.where(self._distances > 0, 1.0, OTHER_FACES)
        matrix = np.zeros((count, 3, 3))
        right = np.zeros((count, 3))
        products = weight[:, None, None] * self._normals[:, :, None] * self._normals[:, None, :]
        targets = (-weight * self._distances)[:, None] * self._normals
        for corner in corners.T:
            np.add.at(matrix, corner, products)
            np.add.at(right, corner, targets)
        matrix += np.eye(3) * (OTHER_FACES * 1e-3)
        return np.linalg.solve(matrix, right[:, :, None])[place.ravel(), :, 0]

    def _touched(self) -> np.ndarray:
        """Return the distance of each triangle to where the boundary has to end; 0 without contact.

        Surfaces are searched for by rays from positions on the boundary: up to the offset of
        Mitsuba's rays outside of it, and, as far as they are parallel to it, further within.
        """
        distances = np.zeros(len(self._faces))
        if not 0 < self._areas.sum() < np.inf:
            return distances  # no boundary: other checks refuse it
        depth = max(TILT_DEPTH * self._size, self._clearance)
        p, n, triangle = self._positions()
        position, normal = (mi.Point3f(np.float32(v.T)) for v in (p, n))
        ray = mi.Ray3f(position - mi.Float(depth) * mi.Vector3f(normal), mi.Vector3f(normal))
        ray.maxt = mi.Float(depth + self._offset)
        si = self._surfaces.ray_intersect(ray)
        found = si.is_valid() & (dr.abs(dr.dot(si.n, ray.d)) > PARALLEL)
        within = np.array(dr.select(found, mi.Float(depth) - si.t, -dr.inf), dtype=np.float64)
        left = np.abs(within) <= self._offset
        while left.any():
            # all positions and triangles in the plane of the first position that is left
            first_p, first_n = p[left][0], n[left][0]
            own = (n @ first_n > PARALLEL) & (np.abs((p - first_p) @ first_n) < self._offset)
            if np.count_nonzero(own & left) >= FEWEST:
                away = np.abs((self._vertices[self._faces] - first_p) @ first_n).max(axis=1)
                same = (self._normals @ first_n > PARALLEL) & (away < self._offset)
                same[triangle[own]] = True
                distances[same] = max(within[own].max(), 0.0) + self._clearance
            left &= ~own
        return distances

    def _positions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sample positions uniformly; return them, the normals there (n, 3), and the triangles."""
        rng = np.random.default_rng(POSITIONS)
        chosen = rng.choice(len(self._areas), POSITIONS, p=self._areas / self._areas.sum())
        u, v = rng.random((2, POSITIONS, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        a, b, c = self._vertices[self._faces[chosen].T]
        return a + u * (b - a) + v * (c - a), self._normals[chosen], chosen


def _mesh_like(shape: mi.Shape, vertices: np.ndarray) -> mi.Mesh:
    """Return a mesh with the faces, media and BSDF of ``shape``, and other ``vertices`` (n, 3)."""
    props = mi.Properties()
    props["flip_normals"] = shape.has_flipped_normals()
    props["bsdf"] = shape.bsdf()
    media = {"interior": shape.interior_medium(), "exterior": shape.exterior_medium()}
    for side, medium in media.items():
        if medium is not None:
            props[side] = medium
    faces = mi.traverse(shape)["faces"]
    mesh = mi.Mesh(shape.id(), len(vertices), len(faces) // 3, props=props)
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = mi.Float(np.float32(vertices.ravel())), faces
    values.update()
    mesh.set_id(shape.id())
    return mesh


def _warn(shape: mi.Shape) -> None:
    """Log a warning for a boundary of a medium that surfaces touch, and that is not replaced."""
    mi.Log(
        mi.LogLevel.Warn,
        f"irrcache: surfaces lie in a face of {described(shape)}, which bounds a medium, or so "
        "close to it that Mitsuba's rays, which are offset from shapes, skip them, also in "
        "volpath: the image is wrong around them. Extend the boundary beyond the surfaces, or "
        "leave a gap of a thousandth of its size.",
    )
