"""Shapes that lie in a box of voxels."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.core.sequences import kronecker_words, unit_floats
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.consistency import described
from mitsuba_irrcache.transport.path import (
    MOST_CROSSINGS,
    flags_of,
    is_solid,
    is_surface,
    transmits,
)

#: Number of rays per edge of a voxel that detect surfaces.
DETECTING_RAYS = 3
#: Margin in voxels: surfaces may lie on the faces of the box.
SLACK = 1e-3
#: Classes of shapes that rays hit from outside only, and the one of which there may be instances.
ONE_SIDED = "BSplineCurve", "LinearCurve", "Ellipsoids", "EllipsoidsMesh", "Instance"

_PICK = np.array(list(np.ndindex(2, 2, 2)), dtype=bool)  # corners of a box


def obstacle(scene: mi.Scene, grid: Grid, lower: np.ndarray, upper: np.ndarray) -> str | None:
    """Return the name of a shape, other than null boundaries, in a box of voxels; None without any.

    The box lies between ``lower`` and ``upper`` (x, y, z). The result is exact for shapes whose
    bounding boxes do not overlap the box, for shapes with a vertex in the box, and for shapes
    inside of it; parts of other shapes are found by `DETECTING_RAYS`^2 rays through each face of a
    voxel.
    """
    near = [s for s in scene.shapes() if is_surface(s) and may_meet(s, grid, lower, upper)]
    for shape in near:
        if _is_partly_within(shape, grid, lower, upper):
            return described(shape)
    for axis in range(3 if near else 0):
        met = _shapes_between(
            scene, *rays_through_faces(grid, lower, upper, axis, DETECTING_RAYS, SLACK)
        )
        dr.eval(met)
        if dr.any(met != None):  # noqa: E711
            return described(next((s for s in near if dr.any(met == mi.ShapePtr(s))), near[0]))
    return None


def rays_through_faces(
    grid: Grid, lower: np.ndarray, upper: np.ndarray, axis: int, per_edge: int, inset: float = 0.0
) -> tuple[mi.Point3f, mi.Point3f]:
    """Return both ends of rays along an axis of the grid through a box of voxels, ``per_edge``^2
    in each row of voxels: world positions, at most ``inset`` [voxels] from the faces of the box.

    The rays are not in a lattice, which would miss thin objects at the distances of voxels, such as
    fences: each lies anywhere in its square (a Kronecker sequence).
    """
    across = [k for k in range(3) if k != axis]
    count = [int(upper[k] - lower[k]) * per_edge for k in across]
    index = dr.arange(mi.UInt32, count[0] * count[1])
    square = unravelled(index, [Divisor(count[0])])
    within = unit_floats(kronecker_words(index, [mi.UInt32(1 << 31)] * 2))
    first, low, high = (_opaque(corner) for corner in (lower, lower + inset, upper - inset))
    start, stop = mi.Point3f(low), mi.Point3f(low)
    for k, number, shift in zip(across, square, within, strict=True):
        place = first[k] + (mi.Float(number) + shift) / per_edge
        start[k] = stop[k] = dr.clip(place, low[k], high[k])
    stop[axis] = high[axis]
    return grid.world.point(start), grid.world.point(stop)


def may_meet(shape: mi.Shape, grid: Grid, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return whether the bounds of a shape overlap the box."""
    box = shape.bbox()
    ends = np.array([box.min, box.max], dtype=np.float64)
    if not np.isfinite(ends).all():
        return True  # meshes that Mitsuba has merged have no bounds
    return boxes_meet(grid, lower, upper, np.where(_PICK, ends[1], ends[0]))


def boxes_meet(grid: Grid, lower: np.ndarray, upper: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether a box with these world ``corners`` (8, 3) may overlap the box of the voxels
    between ``lower`` and ``upper``: whether their extents along the axes of world and grid overlap.
    """
    own = np.where(_PICK, upper, lower)
    slack = SLACK * grid.voxel_size.min()
    for to_axes, small in ((np.eye(4), slack), (grid.coordinates.matrix, SLACK)):
        back = to_axes @ grid.world.matrix
        mine, other = _mapped(back, own), _mapped(to_axes, corners)
        if (other.max(axis=0) < mine.min(axis=0) + small).any():
            return False
        if (other.min(axis=0) > mine.max(axis=0) - small).any():
            return False
    return True


def corners_of(frame: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of the unit cube mapped by ``frame``."""
    return _mapped(frame, _PICK)


def bounding_sphere(frame: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre (3) and radius of the sphere around the unit cube mapped by ``frame``."""
    corners = corners_of(frame)
    centre = corners.mean(axis=0)
    return centre, float(np.linalg.norm(corners - centre, axis=1).max())


def _mapped(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply an affine map to points (n, 3)."""
    return (matrix[:3, :3] * points[:, None, :]).sum(axis=-1) + matrix[:3, 3]


def _is_partly_within(shape: mi.Shape, grid: Grid, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return whether a vertex of a mesh, or another shape as a whole, is in the box."""
    vertices = mi.traverse(shape).get("vertex_positions")
    if vertices is not None:
        u = grid.coordinates.point(dr.unravel(mi.Point3f, mi.Float(vertices)))
        low, high = (mi.Point3f(*(float(v) for v in end)) for end in (lower, upper))
        return bool(dr.any(dr.all((u > low + SLACK) & (u < high - SLACK))))
    box = shape.bbox()
    ends = np.where(_PICK, np.array(box.max), np.array(box.min))
    u = _mapped(grid.coordinates.matrix, ends)
    return bool((u > lower).all() and (u < upper).all())


def _opaque(values: Sequence[float]) -> mi.Vector3f:
    return mi.Vector3f([dr.opaque(mi.Float, float(v)) for v in (*values, 0, 0)[:3]])


@symbolic
def _shapes_between(scene: mi.Scene, start: mi.Point3f, stop: mi.Point3f):
    """Return the first shape between two points that is not a null boundary."""
    length = dr.norm(stop - start)
    direction = (stop - start) / length
    ray, found = mi.Ray3f(start, direction), dr.zeros(mi.ShapePtr, dr.width(start))
    ray.maxt = mi.Float(length)
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="obstacles"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        solid = active & is_solid(si)
        shape = dr.select(si.instance != None, si.instance, si.shape)  # noqa: E711
        found = dr.select(solid, shape, found)
        ray = si.spawn_ray(direction)
        ray.maxt = dr.maximum(length - dr.norm(si.p - start), 0)
        crossings += 1
        active &= ~solid & (crossings < MOST_CROSSINGS)
    return found


@symbolic
def first_surface(
    scene: mi.Scene,
    start: mi.Point3f,
    stop: mi.Point3f,
    active: mi.Bool,
    opaque: bool = False,
    ignored: mi.MediumPtr | None = None,
):
    """Find the first surface between ``start`` and ``stop`` that is not a null boundary; if
    ``opaque``, the first one that transmits nothing. Surfaces that bound the medium ``ignored``,
    if given, are skipped.

    Returns its distance from ``start`` (0 without one), its normal, and whether there is one.
    """
    distance, normal, found = _surface_ahead(scene, start, stop, active, opaque, ignored)
    if dr.hint(has_one_sided_shapes(scene), mode="scalar"):
        # From inside such a shape only the opposite ray hits the surface between both positions.
        back, other, met = _surface_ahead(scene, stop, start, active & ~found, opaque, ignored)
        distance = dr.select(met, dr.norm(stop - start) - back, distance)
        normal = dr.select(met, other, normal)
        found |= met
    return distance, normal, found


def has_one_sided_shapes(scene: mi.Scene) -> bool:
    """Return whether rays may start inside of shapes that they hit from outside only."""
    return any(shape.class_name() in ONE_SIDED for shape in scene.shapes())


@symbolic
def _surface_ahead(
    scene: mi.Scene,
    start: mi.Point3f,
    stop: mi.Point3f,
    active: mi.Bool,
    opaque: bool,
    ignored: mi.MediumPtr | None,
):
    """Find the surface that `first_surface` returns by a ray from ``start``."""
    length = dr.norm(stop - start)
    ray = mi.Ray3f(start, (stop - start) / dr.maximum(length, 1e-30))
    ray.maxt = mi.Float(length)
    distance, normal, found = mi.Float(0), mi.Normal3f(0), mi.Bool(False)
    crossed, crossings, active = mi.Float(0), mi.UInt32(0), mi.Bool(active) & (length > 0)
    while dr.hint(active, label="first surface"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        solid = active & is_solid(si)
        if dr.hint(opaque, mode="scalar"):
            solid &= ~transmits(si.bsdf().flags())
        if dr.hint(ignored is not None, mode="scalar"):
            solid &= si.shape.interior_medium() != ignored
        crossed = dr.norm(si.p - start)
        distance = dr.select(solid, crossed, distance)
        normal = dr.select(solid, si.n, normal)
        found |= solid
        ray = si.spawn_ray(ray.d)
        ray.maxt = dr.maximum(length - crossed, 0)
        crossings += 1
        active &= ~solid & (crossings < MOST_CROSSINGS)
    return distance, normal, found


def hole_in(scene: mi.Scene, medium: MediumGrid, grid: Grid, box: tuple) -> str | None:
    """Return the name of a shape that rays pass straight (null, thin glass, a mask) and that has
    ``medium`` as its exterior only: a hole in the medium.

    Only shapes in the ``box`` (lower, upper) of voxels of ``grid`` count; None without any.
    """
    for shape in scene.shapes():
        sides = shape.exterior_medium(), shape.interior_medium()
        outside, inside = (_is_medium(side, medium) for side in sides)
        if not flags_of(shape) & int(mi.BSDFFlags.Null) or inside or not outside:
            continue
        if may_meet(shape, grid, *box):
            return described(shape)
    return None


def _is_medium(found: mi.Medium | None, medium: MediumGrid) -> bool:
    """Return whether Mitsuba's medium ``found`` is that of ``medium``."""
    return found is not None and dr.all(mi.MediumPtr(found) == medium.pointer)
