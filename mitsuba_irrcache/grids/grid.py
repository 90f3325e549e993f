"""Regular voxel grids: placement in the world, coordinates and trilinear stencils.

The convention is that of Mitsuba's ``gridvolume``: arrays are ``(z, y, x, channel)``, values are at
voxel *centres* and clamped at the border, and the grid fills the image of the unit cube under
``to_world``. *Voxel coordinates* ``u`` run from 0 to n along each axis, so voxel ``i`` is centred
at ``u = i + 0.5``.

These classes and those derived from them are not dataclasses: Dr.Jit would carry every array of a
dataclass through symbolic loops as a loop variable.
"""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.core.jit import Divisor, opaque_point, unravelled
from mitsuba_irrcache.errors import IrrcacheError


class Grid:
    """A voxel grid of ``shape`` (z, y, x) over the unit cube transformed by ``to_world`` (4x4)."""

    def __init__(self, shape: tuple[int, int, int], to_world: np.ndarray) -> None:
        matrix = np.array(to_world, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.linalg.det(matrix):
            raise IrrcacheError(
                f"Grid: to_world must be an invertible affine 4x4 matrix, got {to_world}"
            )
        if any(n < 1 for n in shape):
            raise IrrcacheError(f"Grid: every side needs at least one voxel, got shape {shape}")
        self.shape = tuple(int(n) for n in shape)
        self.to_world = matrix
        # Opaque values cannot be created inside a recorded loop, so create all of them here.
        forward = matrix @ np.diag([*(1.0 / self.resolution), 1.0])
        self.world = Affine(forward)  #: voxel coordinates -> world position
        self.coordinates = Affine(np.linalg.inv(forward))  #: world position -> voxel coordinates
        self.sides = tuple(dr.opaque(mi.Int32, n) for n in self.shape[::-1])  #: nx, ny, nz
        self._divisors = [Divisor(n) for n in self.shape[:0:-1]]

    @property
    def voxel_count(self) -> int:
        return int(np.prod(self.shape))

    @property
    def resolution(self) -> np.ndarray:
        """Number of voxels along x, y, z."""
        return np.array(self.shape[::-1])

    @cached_property
    def side_lengths(self) -> np.ndarray:
        """World lengths of the edges of the grid."""
        return np.linalg.norm(self.to_world[:3, :3], axis=0)

    @cached_property
    def voxel_size(self) -> np.ndarray:
        """World lengths of the edges of a voxel."""
        return self.side_lengths / self.resolution

    @cached_property
    def voxel_thickness(self) -> np.ndarray:
        """World distances between opposite faces of a voxel."""
        return 1 / np.linalg.norm(np.linalg.inv(self.to_world[:3, :3]), axis=1) / self.resolution

    def shared(self, *others: Grid | None) -> Grid:
        """Return the first of ``others`` with the same voxels as this grid, else this grid.

        Lookups that use the same grid object share the computation of voxel coordinates.
        """
        for other in others:
            if other is not None and other.shape == self.shape:
                tolerance = 1e-6 * self.side_lengths.max()
                if np.abs(other.to_world - self.to_world).max() <= tolerance:
                    return other
        return self

    def centers(self, index: mi.UInt32) -> mi.Point3f:
        """Return the world positions of the voxel centres with flat indices ``index``."""
        return self.world.point(mi.Point3f(*self.voxel_indices(index)) + 0.5)

    def voxel_indices(self, index: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Convert flat indices (x fastest) to voxel indices along x, y, z."""
        return unravelled(index, self._divisors)

    def index(self, x: mi.UInt32, y: mi.UInt32, z: mi.UInt32) -> mi.UInt32:
        """Convert voxel indices along x, y, z to flat indices: the inverse of `voxel_indices`."""
        nx, ny, _ = (mi.UInt32(n) for n in self.sides)
        return (mi.UInt32(z) * ny + mi.UInt32(y)) * nx + mi.UInt32(x)

    def corners(self, u: mi.Point3f) -> list[tuple[mi.UInt32, mi.Float]]:
        """Return flat indices and trilinear weights of the eight voxels around ``u``."""
        axes = []
        for c, n in zip(u, self.sides, strict=True):
            lower, weight, more = stencil(c, n)
            axes.append(((lower, 1 - weight), (lower + dr.select(more, 1, 0), weight)))
        return [
            (self.index(x, y, z), wx * wy * wz)
            for z, wz in axes[2]
            for y, wy in axes[1]
            for x, wx in axes[0]
        ]

    @staticmethod
    def near_cubic(to_world: np.ndarray, resolution: int) -> Grid:
        """Create a grid with ``resolution`` nearly cubic voxels along the longest side."""
        sides = np.linalg.norm(np.asarray(to_world, dtype=np.float64)[:3, :3], axis=0)
        counts = np.maximum(1, np.rint(resolution * sides / sides.max())).astype(int)
        return Grid(tuple(int(n) for n in counts[::-1]), to_world)


class Affine:
    """An affine map of points and vectors with opaque entries: another map reuses kernels.

    Points are first taken relative to the centre of the unit cube, so that a grid far from the
    world origin loses no more precision than its float32 positions already have.
    """

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = np.asarray(matrix, dtype=np.float64)
        linear = self.matrix[:3, :3]
        pivot = -np.linalg.solve(linear, self.matrix[:3, 3])
        self._linear = [[dr.opaque(mi.Float, float(v)) for v in row] for row in linear]
        self._pivot = opaque_point(pivot)

    def point(self, p: mi.Point3f) -> mi.Point3f:
        return mi.Point3f(self.vector(mi.Vector3f(p - self._pivot)))

    def vector(self, v: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f([dr.fma(a, v.x, dr.fma(b, v.y, c * v.z)) for a, b, c in self._linear])


def stencil(u: mi.Float, n: mi.Int32) -> tuple[mi.Int32, mi.Float, mi.Bool]:
    """Return the lower voxel around ``u``, the weight of the upper one, and whether it exists."""
    s = clipped(u - 0.5, 0.0, mi.Float(n - 1))
    lower = mi.Int32(s)
    return lower, s - mi.Float(lower), lower < n - 1
