"""Lookups between voxels that lie on different sides of a surface.

Interpolation in a cell, the box between eight voxel centres, would mix the irradiance of both sides
of a surface that cuts it. Each cut cell has a plane that approximates the surface, and a second one
where surfaces meet at an edge; a lookup weights only those voxels that lie on its own side of both
planes.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import ExtendedField, Extension, RootField
from mitsuba_irrcache.transport.path import is_solid

CORNERS = list(itertools.product((0, 1), repeat=3))
#: Segments in a cell that are intersected with surfaces, as pairs of `CORNERS`: its edges and
#: diagonals.
SEGMENTS = [
    (a, b)
    for a, b in itertools.combinations(range(8), 2)
    if sum(x != y for x, y in zip(CORNERS[a], CORNERS[b], strict=True)) in (1, 3)
]

#: Cosine between the normals of two surfaces below which a cell has a plane for each of them.
EDGE = 0.9


class CutCells:
    """The cells of a cache over ``grid`` that surfaces intersect, with one or two planes each.

    Surfaces that bound ``medium``, if given, are ignored.
    """

    def __init__(self, scene: mi.Scene, grid: Grid, medium: mi.MediumPtr | None = None) -> None:
        self._medium = medium
        self.grid = Extension(grid).grid  #: the grid that lookups interpolate on
        self.cells = tuple(n - 1 for n in self.grid.sides)
        count = int((self.grid.resolution - 1).prod())
        cell = dr.arange(mi.UInt32, count)
        nearest, plane, normal = self._plane(scene, cell, mi.Normal3f(0))
        cut = nearest < dr.inf
        dr.eval(cut, plane, normal)
        found = dr.compress(cut)
        #: number of cut cells; without any, no lookups are corrected
        self.count = dr.width(found)
        if not self.count:
            return
        number = dr.arange(mi.UInt32, self.count) + 1
        self._number = dr.zeros(mi.UInt32, count)
        dr.scatter(self._number, number, found)
        nearest, other, _ = self._plane(scene, found, dr.gather(mi.Normal3f, normal, found))
        # Without an edge, the second plane is one that has all positions in front of it.
        everywhere = mi.Vector4f(0, 0, 0, 1)
        other = dr.select(nearest < dr.inf, other, everywhere)
        planes = dr.gather(mi.Vector4f, plane, found), other
        self._planes, self._others = (dr.zeros(mi.Float, 4 * (self.count + 1)) for _ in range(2))
        for data, values in zip((self._planes, self._others), planes, strict=True):
            dr.scatter(data, values, number)
        dr.eval(self._number, self._planes, self._others)

    @symbolic
    def _plane(self, scene: mi.Scene, cell: mi.UInt32, known: mi.Normal3f):
        """Find the tangent planes of the surface points nearest to the centres of cells.

        Points whose normals are nearly parallel to ``known`` are ignored (0: none is). Returns the
        distances of the points from the centres, infinite where there is no point; the planes
        (g, c), with g s + c = 0 for coordinates s in voxels that are 0 at the centre of the first
        voxel; and the normals.
        """
        sides = [Divisor(int(n) - 1) for n in self.grid.resolution[:2]]
        first = mi.Point3f(*unravelled(cell, sides)) + 0.5
        middle = self.grid.world.point(first + 0.5)
        starts, ends = _table(0), _table(1)
        nearest, hit, normal = mi.Float(dr.inf), mi.Point3f(0), mi.Normal3f(0)
        k, count = mi.UInt32(0), dr.opaque(mi.UInt32, len(SEGMENTS))
        while dr.hint(k < count, label="cut cells"):
            a = self.grid.world.point(first + _corner(dr.gather(mi.UInt32, starts, k)))
            b = self.grid.world.point(first + _corner(dr.gather(mi.UInt32, ends, k)))
            length = dr.norm(b - a)
            ray = mi.Ray3f(a, (b - a) / length)
            ray.maxt = length
            si = scene.ray_intersect(ray)
            solid = is_solid(si) & (dr.abs(dr.dot(si.n, known)) < EDGE)
            if dr.hint(self._medium is not None, mode="scalar"):
                solid &= si.shape.interior_medium() != self._medium
            distance = dr.norm(si.p - middle)
            nearer = si.is_valid() & solid & (distance < nearest)
            nearest = dr.select(nearer, distance, nearest)
            hit = dr.select(nearer, si.p, hit)
            normal = dr.select(nearer, si.n, normal)
            k += 1
        # Distances from the plane at the centre, and a voxel further along each axis.
        steps = mi.Vector3f(
            dr.dot(normal, self.grid.world.vector(mi.Vector3f(1, 0, 0))),
            dr.dot(normal, self.grid.world.vector(mi.Vector3f(0, 1, 0))),
            dr.dot(normal, self.grid.world.vector(mi.Vector3f(0, 0, 1))),
        )
        offset = dr.dot(normal, middle - hit) - dr.dot(steps, first)
        return nearest, mi.Vector4f(steps.x, steps.y, steps.z, offset), normal

    @symbolic
    def corrected(
        self, field: RootField | ExtendedField, p: mi.Point3f, phi: mi.Float | mi.Color3f, active
    ):
        """Correct ``phi``, the value of ``field`` at the world position ``p``, in cut cells.

        There it becomes the mean of the voxels on the same side of the planes as ``p``.
        """
        s = self._clamped(p)
        cell = self._cell(s)
        lower = mi.Vector3i(cell)
        index = mi.UInt32((lower.z * self.cells[1] + lower.y) * self.cells[0] + lower.x)
        number = dr.gather(mi.UInt32, self._number, index, active)
        if active & (number > 0):
            planes = (
                dr.gather(mi.Vector4f, self._planes, number),
                dr.gather(mi.Vector4f, self._others, number),
            )
            phi = self._one_sided(field, planes, s, lower, phi)
        return phi

    def _clamped(self, p: mi.Point3f) -> mi.Point3f:
        """Convert a world position to voxels, 0 at the centre of the first one, clamped."""
        u = self.grid.coordinates.point(p) - 0.5
        last = mi.Point3f([mi.Float(n) for n in self.cells])
        return dr.minimum(dr.maximum(u, 0), last)

    def _cell(self, s: mi.Point3f) -> mi.Vector3f:
        """Return the cell that contains ``s``; the last one at the upper border."""
        return dr.minimum(dr.floor(s), mi.Vector3f([mi.Float(n - 1) for n in self.cells]))

    def _one_sided(
        self,
        field: RootField | ExtendedField,
        planes: tuple[mi.Vector4f, mi.Vector4f],
        s: mi.Point3f,
        lower: mi.Vector3i,
        phi: mi.Float | mi.Color3f,
    ) -> mi.Float | mi.Color3f:
        """Return the mean, with trilinear weights, of the voxels on the same side as ``s``.

        Voxels on the same side of both planes are used; if there are none, those on the same side
        of the first plane; if there are none either, the result is ``phi``.
        """
        ahead = [_is_ahead(plane, s) for plane in planes]
        fraction = s - mi.Point3f(lower)
        nx, ny, _ = self.grid.sides
        totals, sums = [dr.zeros(type(phi)) for _ in planes], [mi.Float(0) for _ in planes]
        for corner in CORNERS:
            place = [n + c for n, c in zip(lower, corner, strict=True)]
            parts = [f if c else 1 - f for f, c in zip(fraction, corner, strict=True)]
            weight = parts[0] * parts[1] * parts[2]
            value = _roots(field, mi.UInt32((place[2] * ny + place[1]) * nx + place[0]))
            for i, plane in enumerate(planes):
                same = _is_ahead(plane, mi.Point3f(*place)) == ahead[i]
                weight = dr.select(same, weight, 0)
                totals[i] += weight * value
                sums[i] += weight
        for total, weights in zip(totals, sums, strict=True):
            known = weights > 1e-6
            phi = dr.select(known, field.decoded(total / dr.select(known, weights, 1)), phi)
        return phi


def _is_ahead(plane: mi.Vector4f, s: mi.Point3f) -> mi.Bool:
    """Return whether voxel coordinates lie on the side to which the normal of ``plane`` points."""
    return dr.dot(mi.Vector3f(plane.x, plane.y, plane.z), s) + plane.w > 0


def _corner(index: mi.UInt32) -> mi.Vector3f:
    """Return the corner of a cell with this index in `CORNERS`."""
    return mi.Vector3f((index >> 2) & 1, (index >> 1) & 1, index & 1)


def _table(end: int) -> mi.UInt32:
    """Return one end of all `SEGMENTS`."""
    return mi.UInt32([segment[end] for segment in SEGMENTS])


def _roots(field: RootField | ExtendedField, voxel: mi.UInt32) -> mi.Float | mi.Color3f:
    """Return the stored values, square roots for a `RootField`, of voxels."""
    n = field.channels
    values = [dr.gather(mi.Float, field.data, voxel * n + c) for c in range(n)]
    return values[0] if n == 1 else mi.Color3f(values)
