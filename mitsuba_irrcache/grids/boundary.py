"""Convex bounding shape of a medium, with closed-form ray intersection.

Intersections need no epsilon offsets, so results depend neither on the scale nor on the position of
the scene. A box may have any affine transform; it is recognised from its mesh, whichever plugin
created it.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.grid import Affine

#: Meshes with more vertices are not tested for being a box. (Corners may occur several times.)
MAX_VERTICES = 256
#: Orientation test: number of rays, maximum number of crossings per ray, and tolerated share of
#: rays that hit a back face, which occurs at edges.
ORIENTATION_RAYS, MAX_CROSSINGS, MAX_INWARD_SHARE = 256, 256, 0.02

#: Relative radius at which `Boundary.drawn_inside` places positions.
INSIDE = 0.999


class Boundary:
    """Image of the cube [-1, 1]^3 ("box") or of the unit sphere ("sphere") under ``to_world``."""

    def __init__(self, kind: str, to_world: np.ndarray) -> None:
        self.kind = kind
        self.to_world = np.asarray(to_world, dtype=np.float64)
        inverse = np.linalg.inv(self.to_world)
        self._to_local = Affine(inverse)
        transposed = np.eye(4)
        transposed[:3, :3] = inverse[:3, :3].T
        self._normals = Affine(transposed)  # normals transform by the inverse transpose

    @property
    def frame(self) -> np.ndarray:
        """``to_world`` of the unit cube [0, 1]^3 that encloses the boundary."""
        unit = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]])
        return self.to_world @ unit

    def contains(self, position: np.ndarray) -> bool:
        """Return whether a world position (3,) lies inside or on the boundary."""
        local = np.linalg.inv(self.to_world) @ np.append(position, 1.0)
        order = np.inf if self.kind == "box" else 2
        return bool(np.linalg.norm(local[:3], order) <= 1.0)

    def surrounds(self, p: mi.Point3f) -> mi.Bool:
        """Return whether world positions lie inside or on the boundary."""
        local = self._to_local.point(p)
        if self.kind == "box":
            return dr.max(dr.abs(local)) <= 1
        return dr.squared_norm(local) <= 1

    def drawn_inside(self, p: mi.Point3f) -> mi.Point3f:
        """Move world positions that lie outside towards the centre, to just inside the boundary."""
        local = self._to_local.point(p)
        size = dr.max(dr.abs(local)) if self.kind == "box" else dr.norm(local)
        return Affine(self.to_world).point(local * dr.minimum(1, INSIDE / dr.maximum(size, 1e-6)))

    def intersect(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Intersect the line of a ray: whether it hits, and the distances of entry and exit.

        The entry distance is negative for rays that start inside.
        """
        origin = self._to_local.point(ray.o)
        direction = self._to_local.vector(ray.d)
        intersect = _intersect_box if self.kind == "box" else _intersect_sphere
        return intersect(origin, direction)

    def outward_normal(self, p: mi.Point3f) -> mi.Normal3f:
        """Return the outward unit normal at ``p``, a position on the boundary."""
        local = mi.Vector3f(self._to_local.point(p))
        if self.kind == "box":
            largest = dr.max(dr.abs(local))
            local = dr.select(dr.abs(local) == largest, dr.sign(local), 0)
        return mi.Normal3f(dr.normalize(self._normals.vector(local)))


def _intersect_box(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
    """Intersect the cube [-1, 1]^3 by the slab method, also for rays that lie in a face."""
    near, far = intersect_slabs(-1.0, 1.0, o, d)
    return near < far, near, far


def intersect_slabs(
    lower: mi.Point3f | float, upper: mi.Point3f | float, o: mi.Point3f, d: mi.Vector3f
) -> tuple[mi.Float, mi.Float]:
    """Return the distances at which lines enter and leave the box from ``lower`` to ``upper``."""
    rcp = safe_rcp(d)
    sides = (lower - o) * rcp, (upper - o) * rcp
    return dr.max(dr.minimum(*sides)), dr.min(dr.maximum(*sides))


def _intersect_sphere(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
    """Intersect the unit sphere.

    Computing the closest approach first preserves accuracy for distant cameras.
    """
    rcp_length = dr.rsqrt(dr.squared_norm(d))
    direction = d * rcp_length
    middle = -dr.dot(o, direction)
    closest = o + middle * direction
    half_squared = 1.0 - dr.squared_norm(closest)
    half = dr.sqrt(dr.maximum(half_squared, 0.0))
    return half_squared > 0, (middle - half) * rcp_length, (middle + half) * rcp_length


def safe_rcp(d: mi.Vector3f) -> mi.Vector3f:
    """Return 1 / d, finite also for components that are 0 or denormal."""
    return dr.rcp(dr.select(dr.abs(d) > 1e-20, d, dr.mulsign(mi.Vector3f(1e-20), d)))


def boundary_of(scene: mi.Scene, shape: mi.Shape) -> Boundary:
    """Return the boundary described by ``shape``: a sphere or a box (cube plugin or mesh).

    Raises UnsupportedSceneError for other shapes, and for shapes with inward normals: Mitsuba would
    treat their whole exterior as the interior medium (for example a cube mirrored by ``to_world``).
    """
    boundary = None
    if shape.class_name() == "Sphere":
        boundary = Boundary("sphere", sphere_frame(shape))
    elif shape.is_mesh() and "vertex_positions" in mi.traverse(
        shape
    ):  # rectangles lack this parameter
        vertices = np.array(mi.traverse(shape)["vertex_positions"], dtype=np.float64)
        frame = box_frame(vertices.reshape(-1, 3))
        area = float(np.ravel(shape.surface_area())[0])
        # Reject meshes with missing or duplicate faces.
        if frame is not None and abs(_box_area(frame) - area) < 1e-3 * area:
            boundary = Boundary("box", frame)
    name = f'shape "{shape.id()}" ({shape.class_name()})'
    if boundary is None:
        raise UnsupportedSceneError(
            f"irrcache: the medium is bounded by {name}, but only boxes (a cube with any to_world, "
            "or a mesh of this form) and spheres are supported; bound the medium by a cube, or use "
            '"volpath".'
        )
    _check_normals(scene, shape, name)
    return boundary


def sphere_frame(shape: mi.Shape) -> np.ndarray:
    """Return ``to_world`` of the unit sphere.

    Mitsuba's spheres are round whatever ``to_world`` is; the length of its first column is the
    radius.
    """
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    radius = np.linalg.norm(matrix[:3, 0])
    if np.abs(np.linalg.norm(matrix[:3, :3], axis=0) - radius).max() <= 1e-4 * radius:
        return matrix
    frame = np.diag([radius, radius, radius, 1.0])
    frame[:3, 3] = matrix[:3, 3]
    return frame


def _box_area(frame: np.ndarray) -> float:
    """Return the surface area of the cube [-1, 1]^3 mapped by ``frame``."""
    x, y, z = 2 * frame[:3, :3].T
    return 2 * sum(float(np.linalg.norm(np.cross(*pair))) for pair in ((x, y), (y, z), (z, x)))


def rays_through(shape: mi.Shape) -> mi.Ray3f:
    """Sample rays from outside through the bounding box of a shape."""
    rng = mi.PCG32(ORIENTATION_RAYS)
    lower, upper = mi.Point3f(shape.bbox().min), mi.Point3f(shape.bbox().max)
    u = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    target = lower + u * (upper - lower)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    direction = mi.warp.square_to_uniform_sphere(sample)
    return mi.Ray3f(target - 1.1 * dr.norm(upper - lower) * direction, direction)


def orientation(scene: mi.Scene, shape: mi.Shape) -> tuple[float, float]:
    """Estimate how consistently the normals of ``shape`` point outwards, ignoring other shapes.

    Returns two shares of the rays from outside that hit it: those that hit a back face first, and
    those that do not leave it as often as they enter.
    """
    first, depth = _crossings(scene, mi.ShapePtr(shape), rays_through(shape))
    dr.eval(first, depth)
    hits = max(int(dr.count(first != 0)[0]), 1)
    return int(dr.count(first < 0)[0]) / hits, int(dr.count(depth != 0)[0]) / hits


@symbolic
def _crossings(scene: mi.Scene, shape: mi.ShapePtr, ray: mi.Ray3f):
    """Trace rays through all crossings with ``shape``.

    Returns the first crossing (1: entering, -1: leaving, 0: none), and the sum over all crossings.
    """
    ray, first, depth = mi.Ray3f(ray), mi.Int32(0), mi.Int32(0)
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="crossings"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        step = dr.select(dr.dot(si.n, ray.d) < 0, mi.Int32(1), -1)
        step = dr.select(active & (si.shape == shape), step, 0)
        first = dr.select(first == 0, step, first)
        depth += step
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= crossings < MAX_CROSSINGS
    return first, depth


def _check_normals(scene: mi.Scene, shape: mi.Shape, name: str) -> None:
    """Reject a convex shape whose normals do not all point outwards.

    Rays tell inwards from outwards by their majority only: behind a wall that touches the shape,
    Mitsuba's ray offset steps over its boundary.
    """
    inwards, _ = orientation(scene, shape)
    mixed = shape.is_mesh() and not _is_consistently_wound(shape)
    if inwards > 0.5 or (mixed and inwards > MAX_INWARD_SHARE):
        some = "the normals" if inwards > 1 - MAX_INWARD_SHARE else f"{inwards:.0%} of the normals"
        raise UnsupportedSceneError(
            f"irrcache: {some} of {name} point inwards, so Mitsuba puts its interior medium "
            "outside of it; mirror its to_world once more (or drop flip_normals)."
        )


def _is_consistently_wound(mesh: mi.Mesh) -> bool:
    """Return whether all triangles of a convex mesh have the same side towards its centre."""
    values = mi.traverse(mesh)
    vertices = np.array(values["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    a, b, c = vertices[np.array(values["faces"]).reshape(-1, 3).T]
    volume = np.einsum("ij,ij->i", a - vertices.mean(axis=0), np.cross(b - a, c - a))
    return bool((volume >= 0).all() or (volume <= 0).all())


def box_frame(vertices: np.ndarray) -> np.ndarray | None:
    """Return the affine map of [-1, 1]^3 onto the box with these vertices; None if it is no box."""
    size = np.ptp(vertices, axis=0).max()
    tolerance = 1e-5 * size + 4 * np.finfo(np.float32).eps * np.abs(vertices).max()
    vertices = np.unique(vertices, axis=0)
    if len(vertices) > MAX_VERTICES:
        return None
    same = _distances(vertices, vertices) <= tolerance
    corners = vertices[np.unique(same.argmax(axis=1))]
    if len(corners) != 8:
        return None
    origin, others = corners[0], corners[1:] - corners[0]
    bits = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    for edges in itertools.combinations(others, 3):
        linear = np.stack(edges, axis=1)
        if abs(np.dot(edges[0], np.cross(edges[1], edges[2]))) < 1e-12 * size**3:
            continue
        built = origin + bits @ linear.T
        if _distances(built, corners).min(axis=1).max() <= tolerance:
            frame = np.eye(4)
            frame[:3, :3] = 0.5 * _ordered_edges(linear)
            frame[:3, 3] = np.mean(corners, axis=0)
            return frame
    return None


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the Chebyshev distances (n, m) between points (n, 3) and (m, 3)."""
    return np.abs(a[:, None] - b[None]).max(axis=-1)


def _ordered_edges(edges: np.ndarray) -> np.ndarray:
    """Order and sign the edges (columns) such that each points along its world axis if possible."""
    along = np.abs(edges) / np.linalg.norm(edges, axis=0)
    best = max(
        itertools.permutations(range(3)),
        key=lambda p: along[0, p[0]] * along[1, p[1]] * along[2, p[2]],
    )
    ordered = edges[:, list(best)]
    return ordered * np.where(np.diag(ordered) < 0, -1.0, 1.0)
