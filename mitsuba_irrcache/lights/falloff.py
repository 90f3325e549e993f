"""Lamps nearby: where they are, places that keep away from them, and how their light falls off."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import kronecker_points
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import point_lights, position_of

#: A lamp is not nearer to what the cache knows than this part of a voxel's shortest edge: less than
#: the half edge that lies between voxel centres and a lamp beside a box.
LEAST = 0.25
#: Lamps farther from the voxels than so many of their edges, or larger than that in radius, light
#: these as smoothly as the voxels can tell: to 0.3 % between them.
REACH, LARGEST = 16.0, 8.0
#: Points that stand for a lamp, and for all lamps, at most.
MOST_POINTS = 8
#: Positions from which the strength of a point-like light is told.
POSITIONS = 1024
#: Nearest that anything comes to a lamp, in edges of a voxel.
NEAREST = 1e-3
#: Steps between both ends of a segment, over the distance to a lamp, below which its light is
#: linear along the segment.
SHORT = 0.05
#: Points along each axis of a voxel over which its light is averaged, if a lamp is at most so many
#: edges from its middle; elsewhere two.
FINEST, CLOSE = 24, 1.5


class VoxelSamplePoints:
    """Where the light in the voxels of ``grid`` is computed: at their centres, but for those that a
    lamp is in.

    A lamp beside a medium may be in the corner of a voxel's box that the medium does not fill. At
    its centre there is no end to the light, and lookups in the medium would read some of it.
    """

    def __init__(self, scene: mi.Scene, grid: Grid) -> None:
        self.grid = grid
        lamps = [position_of(e) for e in point_lights(scene)]
        self._lamps = [mi.Point3f([dr.opaque(mi.Float, float(v)) for v in p]) for p in lamps]
        self._least = dr.opaque(mi.Float, LEAST * float(grid.voxel_size.min()))

    def of(self, voxel: mi.UInt32) -> mi.Point3f:
        """World positions for the voxels of these flat indices."""
        p = self.grid.centers(voxel)
        for lamp in self._lamps:
            way = p - lamp
            distance = dr.norm(way)
            away = dr.select(distance > 0, way / distance, mi.Vector3f(0, 0, 1))
            p = dr.select(distance < self._least, lamp + self._least * away, p)
        return p


class InverseSquareFactor:
    """How light falls off with the distance from lamps nearby, relative to what it is far away.

        W = 1 + sum_k w_k REACH^2 h^2 / r_k^2,    sum_k w_k = 1,

    h being the longest edge of a voxel. A cache is read as W times what is interpolated of Phi / W,
    which is smooth where Phi falls off like 1/r^2: next to a lamp it is the transmittance of the
    way from there.
    """

    # docs/primer, eq. (2.4)

    def __init__(
        self, places: VoxelSamplePoints, points: list[tuple[np.ndarray, float, float]]
    ) -> None:
        """``points`` are positions, strengths (irradiance times squared distance, in any unit) and
        squared radii.
        """
        self.places, edge = places, float(places.grid.voxel_size.max())
        total = sum(strength for _, strength, _ in points)
        self._points = [
            (
                mi.Point3f([dr.opaque(mi.Float, float(v)) for v in position]),
                dr.opaque(mi.Float, strength / total * (REACH * edge) ** 2),
                dr.opaque(mi.Float, max(squared, (NEAREST * edge) ** 2)),
            )
            for position, strength, squared in points
        ]

    @classmethod
    def of(
        cls, scene: mi.Scene, grid: Grid, others: Sequence[mi.Emitter] = ()
    ) -> InverseSquareFactor | None:
        """The falloff of lamps near the voxels of ``grid``, except ``others``; None without any."""
        lights = [e for e in point_lights(scene) if e not in others]
        points = [p for e in lights for p in _of_point(e, grid)]
        points += [p for s in scene.shapes() if s.is_emitter() for p in _of_area(s, grid)]
        points.sort(key=lambda point: -point[1])
        points = points[:MOST_POINTS]
        return cls(VoxelSamplePoints(scene, grid), points) if points else None

    def at(self, p: mi.Point3f) -> mi.Float:
        """W at a world position."""
        result = mi.Float(1)
        for position, strength, squared in self._points:
            result += strength / (dr.squared_norm(p - position) + squared)
        return result

    def of_voxels(self, voxel: mi.UInt32) -> mi.Float:
        """W where the light in voxels is computed."""
        return self.at(self.places.of(voxel))

    def maximum(self, voxel: mi.UInt32) -> float:
        """The largest W of these voxels."""
        return float(dr.max(self.of_voxels(voxel))[0])

    def along(self, ray: mi.Ray3f) -> list[tuple]:
        """What `means` has to know of a ray."""
        found = []
        for position, strength, squared in self._points:
            way = position - ray.o
            nearest = dr.dot(way, ray.d)
            distance = dr.sqrt(dr.squared_norm(way - nearest * ray.d) + squared)
            found.append((nearest, distance, strength))
        return found

    def means(self, along: list[tuple], a: mi.Float, b: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Means of W between the distances ``a`` and ``b`` along a ray, with weights that fall, and
        that rise linearly: 2 int_0^1 (1 - u | u) W du.
        """
        near, far = mi.Float(1), mi.Float(1)
        length = b - a
        for nearest, q, strength in along:
            x, y = a - nearest, b - nearest
            low, high = dr.fma(x, x, q * q), dr.fma(y, y, q * q)
            angle = dr.atan2(q * length, dr.fma(x, y, q * q)) / q  # int dx / (x^2 + q^2)
            ratio = 0.5 * dr.log(high / low)  # int x dx / (x^2 + q^2)
            scale = 2 / dr.square(length)
            # Both are differences: of a short segment, taken at its thirds instead.
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
        """The mean of W over voxels, over W where their light is computed."""
        grid, total, k = self.places.grid, mi.Float(0), mi.UInt32(0)
        corner = mi.Point3f(*grid.places(voxel))
        near = mi.Bool(False)
        for position, _, _ in self._points:
            way = grid.coordinates.point(position) - corner - 0.5
            near |= dr.max(dr.abs(mi.Vector3f(way))) < CLOSE
        points = dr.select(near, mi.UInt32(FINEST), 2)
        count = points * points * points
        # Over a cube of edge d that is not near, 1/r^2 is 1/r^2 (1 + d^2 / 12 r^2) on average; over
        # one that a lamp is in the middle of, 7.6 / d^2.
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
    """A point-like light, if it is near."""
    position = position_of(emitter)
    if _edges_away(position[:, None], grid) > REACH:
        return []
    rng = np.random.default_rng(1)
    p = grid.world.point(mi.Point3f(rng.random((3, POSITIONS)) * grid.resolution[:, None]))
    at = dr.zeros(mi.Interaction3f, POSITIONS)
    at.p = p
    record, light = emitter.sample_direction(at, mi.Point2f(0.5))
    strength = float(dr.max(dr.mean(light) * dr.square(record.dist))[0])
    return [(position, strength, 0.0)] if strength > 0 else []


def _of_area(shape: mi.Shape, grid: Grid) -> list[tuple[np.ndarray, float, float]]:
    """Points that stand for the parts of an area light, if it is small and near."""
    sample = mi.Point2f(np.float32(kronecker_points(np.arange(MOST_POINTS) + 0.5, 2)))
    found = shape.sample_position(0.0, sample)
    area, edge = float(dr.max(shape.surface_area())[0]), float(grid.voxel_size.max())
    positions = np.array(found.p, dtype=np.float64)
    if np.sqrt(area / np.pi) > LARGEST * edge or _edges_away(positions, grid) > REACH:
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


def _edges_away(positions: np.ndarray, grid: Grid) -> float:
    """How far the nearest of ``positions`` (3, n) is from the box of ``grid``, in its longest
    edges.
    """
    u = np.array(grid.coordinates.point(mi.Point3f(np.float32(positions))), dtype=np.float64)
    nearest = np.clip(u, 0, grid.resolution[:, None]) - u
    world = np.linalg.norm(grid.to_world[:3, :3] @ (nearest / grid.resolution[:, None]), axis=0)
    return float(world.min() / grid.voxel_size.max())
