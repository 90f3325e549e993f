"""Lookups between voxels that lie on different sides of a surface.

Interpolation in a cell, the box between eight voxel centres, would mix the irradiance of both sides
of a surface that cuts it. Each cut cell has a plane that approximates the surface; a lookup weights
only those voxels that lie on its own side of the plane.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import ExtendedField, Extension, RootField
from mitsuba_irrcache.transport.path import is_null

CORNERS = list(itertools.product((0, 1), repeat=3))
#: Segments in a cell that are intersected with surfaces, as pairs of `CORNERS`: its edges and
#: diagonals.
SEGMENTS = [
    (a, b)
    for a, b in itertools.combinations(range(8), 2)
    if sum(x != y for x, y in zip(CORNERS[a], CORNERS[b], strict=True)) in (1, 3)
]


class CutCells:
    """The cells of a cache over ``grid`` that surfaces intersect, and a plane for each of them."""

    def __init__(self, scene: mi.Scene, grid: Grid) -> None:
        self.grid = Extension(grid).grid  #: the grid that lookups interpolate on
        self.cells = tuple(n - 1 for n in self.grid.sides)
        count = int((self.grid.resolution - 1).prod())
        cell = dr.arange(mi.UInt32, count)
        cut, *plane = self._cut(scene, cell)
        dr.eval(cut, plane)
        found = dr.compress(cut)
        #: number of cut cells; without any, no lookups are corrected
        self.count = dr.width(found)
        if not self.count:
            return
        number = dr.arange(mi.UInt32, self.count) + 1
        self._number = dr.zeros(mi.UInt32, count)
        dr.scatter(self._number, number, found)
        self._planes = dr.zeros(mi.Float, 4 * (self.count + 1))
        kept = mi.Vector4f([dr.gather(mi.Float, v, found) for v in plane])
        dr.scatter(self._planes, kept, number)
        dr.eval(self._number, self._planes)

    @symbolic
    def _cut(self, scene: mi.Scene, cell: mi.UInt32):
        """Whether surfaces cut the cells, and the planes g s + c = 0 tangent to the surfaces at the
        points nearest to the cells' centres; s is in voxels, 0 at the centre of the first one.
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
            solid = ~is_null(si.bsdf().flags()) | (si.shape.emitter() != None)  # noqa: E711
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
        return nearest < dr.inf, steps.x, steps.y, steps.z, offset

    @symbolic
    def corrected(
        self, field: RootField | ExtendedField, p: mi.Point3f, phi: mi.Float | mi.Color3f, active
    ):
        """Correct ``phi``, the value of ``field`` at the world position ``p``, in cut cells.

        There it becomes the mean of the voxels on the same side of the plane as ``p``.
        """
        s = self._clamped(p)
        cell = self._cell(s)
        lower = mi.Vector3i(cell)
        index = mi.UInt32((lower.z * self.cells[1] + lower.y) * self.cells[0] + lower.x)
        number = dr.gather(mi.UInt32, self._number, index, active)
        if active & (number > 0):
            plane = dr.gather(mi.Vector4f, self._planes, number)
            phi = self._one_sided(field, plane, s, lower, phi)
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
        plane: mi.Vector4f,
        s: mi.Point3f,
        lower: mi.Vector3i,
        phi: mi.Float | mi.Color3f,
    ) -> mi.Float | mi.Color3f:
        """Return the mean of the voxels on the side of ``s`` with trilinear weights.

        ``phi`` if there are none.
        """
        gradient = mi.Vector3f(plane.x, plane.y, plane.z)
        ahead = dr.dot(gradient, s) + plane.w > 0
        fraction = s - mi.Point3f(lower)
        nx, ny, _ = self.grid.sides
        total, weights = dr.zeros(type(phi)), mi.Float(0)
        for corner in CORNERS:
            place = [n + c for n, c in zip(lower, corner, strict=True)]
            side = dr.dot(gradient, mi.Point3f(*place)) + plane.w > 0
            parts = [f if c else 1 - f for f, c in zip(fraction, corner, strict=True)]
            weight = dr.select(side == ahead, parts[0] * parts[1] * parts[2], 0)
            total += weight * _roots(field, mi.UInt32((place[2] * ny + place[1]) * nx + place[0]))
            weights += weight
        known = weights > 1e-6
        return dr.select(known, field.decoded(total / dr.select(known, weights, 1)), phi)


def _corner(index: mi.UInt32) -> mi.Vector3f:
    """Return the corner of a cell with this index in `CORNERS`."""
    return mi.Vector3f((index >> 2) & 1, (index >> 1) & 1, index & 1)


def _table(end: int) -> mi.UInt32:
    """Return one end of all `SEGMENTS`."""
    return mi.UInt32([segment[end] for segment in SEGMENTS])


def _roots(field: RootField | ExtendedField, voxel: mi.UInt32) -> mi.Float | mi.Color3f:
    n = field.channels
    values = [dr.gather(mi.Float, field.data, voxel * n + c) for c in range(n)]
    return values[0] if n == 1 else mi.Color3f(values)
