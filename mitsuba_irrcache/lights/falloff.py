"""Treatment of small emitters near the voxels of a cache.

Sample points keep a minimum distance from the emitters, and the inverse-square dependence of the
irradiance on the distance is divided out before interpolation.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import opaque_point, symbolic
from mitsuba_irrcache.core.sequences import kronecker_points
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import point_lights, position_of

#: Minimum distance of sample points from an emitter, relative to a voxel's shortest edge. It is
#: less than half an edge, the distance of voxel centres from an emitter on the face of a box.
MINIMUM_DISTANCE = 0.25
#: Maximum distance of an emitter from the voxels, and maximum radius, in voxel edges. The
#: irradiance of emitters that are larger or farther away is smooth enough for interpolation:
#: accurate to 0.3 % between the voxels.
MOST_DISTANCE, LARGEST = 16.0, 8.0
#: Maximum number of points that represent an area emitter, and that represent all emitters.
MOST_POINTS = 8
#: Number of positions at which the strength of a point-like emitter is evaluated.
POSITIONS = 1024
#: Lower bound of the distance to an emitter, in voxel edges, to avoid division by 0.
NEAREST = 1e-3
#: Length of a segment, relative to its distance from an emitter, below which W is evaluated at two
#: points instead of integrated.
SHORT = 0.05
#: Number of points along each axis over which W is averaged in voxels whose centre is within CLOSE
#: edges of an emitter; in other voxels 2.
FINEST, CLOSE = 24, 1.5


class VoxelSamplePoints:
    """Positions at which the irradiance of the voxels of ``grid`` is computed.

    These are the voxel centres, except that points closer to a point-like emitter than
    `MINIMUM_DISTANCE` are moved away from it: the irradiance diverges at the emitter, and lookups
    in neighbouring voxels would interpolate that value, even if the emitter lies outside of the
    medium.
    """

    def __init__(self, scene: mi.Scene, grid: Grid) -> None:
        self.grid = grid
        lamps = [position_of(e) for e in point_lights(scene)]
        self._lamps = [opaque_point(p) for p in lamps]
        self._minimum_distance = dr.opaque(
            mi.Float, MINIMUM_DISTANCE * float(grid.voxel_size.min())
        )

    def of(self, voxel: mi.UInt32) -> mi.Point3f:
        """Return the world positions for the voxels of these flat indices."""
        p = self.grid.centers(voxel)
        for lamp in self._lamps:
            offset = p - lamp
            distance = dr.norm(offset)
            away = dr.select(distance > 0, offset / distance, mi.Vector3f(0, 0, 1))
            p = dr.select(
                distance < self._minimum_distance, lamp + self._minimum_distance * away, p
            )
        return p


class InverseSquareFactor:
    """Inverse-square factor W of nearby small emitters, which tends to 1 far away from them.

        W = 1 + sum_k w_k D^2 h^2 / r_k^2,    sum_k w_k = 1,

    where h is the longest edge of a voxel, and D is `MOST_DISTANCE`. Lookups interpolate Phi / W
    and multiply by W. Phi / W is smooth where Phi falls off like 1/r^2: next to an emitter it is
    proportional to the transmittance.
    """

    # docs/primer, eq. (2.4)

    def __init__(
        self, sample_points: VoxelSamplePoints, points: list[tuple[np.ndarray, float, float]]
    ) -> None:
        """Store ``points``: positions, strengths (irradiance times squared distance, in any unit)
        and squared radii.
        """
        self.sample_points, edge = sample_points, float(sample_points.grid.voxel_size.max())
        total = sum(strength for _, strength, _ in points)
        self._points = [
            (
                opaque_point(position),
                dr.opaque(mi.Float, strength / total * (MOST_DISTANCE * edge) ** 2),
                dr.opaque(mi.Float, max(squared, (NEAREST * edge) ** 2)),
            )
            for position, strength, squared in points
        ]

    @classmethod
    def of(
        cls, scene: mi.Scene, grid: Grid, others: Sequence[mi.Emitter] = ()
    ) -> InverseSquareFactor | None:
        """Create the factor for emitters near the voxels, except ``others``; return None if there
        are no such emitters.
        """
        lights = [e for e in point_lights(scene) if e not in others]
        points = [p for e in lights for p in _of_point(e, grid)]
        shapes = [s for s in scene.shapes() if s.is_emitter() and s.emitter() not in others]
        points += [p for s in shapes for p in _of_area(s, grid)]
        points.sort(key=lambda point: -point[1])
        points = points[:MOST_POINTS]
        return cls(VoxelSamplePoints(scene, grid), points) if points else None

    def at(self, p: mi.Point3f) -> mi.Float:
        """Evaluate W at a world position."""
        result = mi.Float(1)
        for position, strength, squared in self._points:
            result += strength / (dr.squared_norm(p - position) + squared)
        return result

    def of_voxels(self, voxel: mi.UInt32) -> mi.Float:
        """Evaluate W at the sample points of voxels."""
        return self.at(self.sample_points.of(voxel))

    def maximum(self, voxel: mi.UInt32) -> float:
        """Return the maximum of W over these voxels."""
        return float(dr.max(self.of_voxels(voxel))[0])

    def along(self, ray: mi.Ray3f) -> list[tuple]:
        """Return the argument ``along`` of `means` for a ray.

        For each emitter point: the distance along the ray of the closest approach, the distance of
        the point from the ray there, and its strength.
        """
        found = []
        for position, strength, squared in self._points:
            offset = position - ray.o
            nearest = dr.dot(offset, ray.d)
            distance = dr.sqrt(dr.squared_norm(offset - nearest * ray.d) + squared)
            found.append((nearest, distance, strength))
        return found

    def means(self, along: list[tuple], a: mi.Float, b: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Compute two weighted means of W between the distances ``a`` and ``b`` along a ray.

        They are 2 int_0^1 (1 - u) W du and 2 int_0^1 u W du, where u runs from 0 at ``a`` to 1 at
        ``b``.
        """
        near, far = mi.Float(1), mi.Float(1)
        length = b - a
        for nearest, q, strength in along:
            x, y = a - nearest, b - nearest
            low, high = dr.fma(x, x, q * q), dr.fma(y, y, q * q)
            angle = dr.atan2(q * length, dr.fma(x, y, q * q)) / q  # int dx / (x^2 + q^2)
            ratio = 0.5 * dr.log(high / low)  # int x dx / (x^2 + q^2)
            scale = 2 / dr.square(length)
            # These differences cancel for short segments: evaluate W at the thirds instead.
            short = dr.square(length) < SHORT**2 * dr.minimum(low, high)
            third, more = x + length / 3, x + length * (2 / 3)
            first = dr.select(
                short, dr.rcp(dr.fma(third, third, q * q)), scale * (y * angle - ratio)
            )
            last = dr.select(short, dr.rcp(dr.fma(more, more, q * q)), scale * (ratio - x * angle))
            near, far = dr.fma(strength, first, near), dr.fma(strength, last, far)
        return near, far

    @symbolic
    def spread(self, voxel: mi.UInt32):
        """Compute the mean of W over voxels, relative to W at their sample points."""
        grid, total, k = self.sample_points.grid, mi.Float(0), mi.UInt32(0)
        corner = mi.Point3f(*grid.voxel_indices(voxel))
        near = mi.Bool(False)
        for position, _, _ in self._points:
            offset = grid.coordinates.point(position) - corner - 0.5
            near |= dr.max(dr.abs(mi.Vector3f(offset))) < CLOSE
        points = dr.select(near, mi.UInt32(FINEST), 2)
        count = points * points * points
        # The mean of 1/r^2 over a cube of edge d at a distance r >> d from an emitter is
        # 1/r^2 (1 + d^2 / 12 r^2), and over a cube centred at the emitter 7.6 / d^2.
        edge = float(grid.voxel_size.prod() ** (1 / 3))
        squares = dr.square(dr.opaque(mi.Float, edge) / mi.Float(points))
        while dr.hint(k < count, label="points in a voxel"):
            place = mi.Point3f(k % points, (k // points) % points, k // (points * points)) + 0.5
            p = grid.world.point(corner + place / mi.Float(points))
            total += 1
            for position, strength, squared in self._points:
                inverse = dr.rcp(
                    dr.maximum(dr.squared_norm(p - position) + squared, 0.19 * squares)
                )
                total += strength * inverse * dr.fma(squares / 12, inverse, 1)
            k += 1
        return total / mi.Float(count) / self.of_voxels(voxel)


def _of_point(emitter: mi.Emitter, grid: Grid) -> list[tuple[np.ndarray, float, float]]:
    """Return position, strength and squared radius of a point-like emitter; an empty list if it is
    not near.
    """
    position = position_of(emitter)
    if edges_away(position[:, None], grid) > MOST_DISTANCE:
        return []
    rng = np.random.default_rng(1)
    p = grid.world.point(mi.Point3f(rng.random((3, POSITIONS)) * grid.resolution[:, None]))
    at = dr.zeros(mi.Interaction3f, POSITIONS)
    at.p = p
    record, light = emitter.sample_direction(at, mi.Point2f(0.5))
    strength = float(dr.max(dr.mean(light) * dr.square(record.dist))[0])
    return [(position, strength, 0.0)] if strength > 0 else []


def _of_area(shape: mi.Shape, grid: Grid) -> list[tuple[np.ndarray, float, float]]:
    """Return points that represent the parts of an area emitter; an empty list if it is not small
    and near.
    """
    sample = mi.Point2f(np.float32(kronecker_points(np.arange(MOST_POINTS) + 0.5, 2)))
    found = shape.sample_position(0.0, sample)
    area, edge = float(dr.max(shape.surface_area())[0]), float(grid.voxel_size.max())
    positions = np.array(found.p, dtype=np.float64)
    if np.sqrt(area / np.pi) > LARGEST * edge or edges_away(positions, grid) > MOST_DISTANCE:
        return []
    si = dr.zeros(mi.SurfaceInteraction3f, MOST_POINTS)
    si.p, si.n, si.uv, si.wi = found.p, found.n, found.uv, mi.Vector3f(0, 0, 1)
    light = dr.mean(shape.emitter().eval(si))
    strengths = np.broadcast_to(np.array(light, dtype=np.float64), MOST_POINTS) * area
    count = int(np.clip(np.ceil(area / edge**2), 1, MOST_POINTS))
    part = area / count
    if count == 1:
        positions = positions.mean(axis=1, keepdims=True)
    return [
        (p, float(s) / count, part / (2 * np.pi))
        for p, s in zip(positions.T[:count], strengths[:count], strict=True)
        if s > 0
    ]


def lies_in(emitter: mi.Emitter, grid: Grid) -> bool:
    """Return whether a point-like emitter lies in the box of ``grid`` or within a voxel of it."""
    return edges_away(position_of(emitter)[:, None], grid) < 1


def edges_away(positions: np.ndarray, grid: Grid) -> float:
    """Return the minimum distance of ``positions`` (3, n) from the box of ``grid``.

    The unit is the longest edge of a voxel.
    """
    u = np.array(grid.coordinates.point(mi.Point3f(np.float32(positions))), dtype=np.float64)
    nearest = np.clip(u, 0, grid.resolution[:, None]) - u
    world = np.linalg.norm(grid.to_world[:3, :3] @ (nearest / grid.resolution[:, None]), axis=0)
    return float(world.min() / grid.voxel_size.max())
