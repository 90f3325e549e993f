"""Nodes on surfaces at which irradiance is cached, looked up in a spatial hash table.

The nodes are independent of how surfaces are modelled: they need no parametrisation, and neither
the number of triangles nor the merging of shapes matters. Around a surface point, nodes lie on a
square lattice across the dominant axis of the geometric normal, projected onto the surface along
that axis. Bilinear interpolation between four of them is exact for linear functions on a plane.

Lattices have spacings of ``spacing / 2^level``. The coarsest spacing at a point grows with its
distance from the media, up to a bound that depends on how the point is seen (`SpacingBounds`). A
point uses finer levels until the spacing is small compared to the harmonic mean distance of the
surfaces visible from its nodes (Ward, Rubinstein and Clear, "A ray tracing solution for diffuse
interreflection", 1988), and until the surface is nearly flat between nodes.

A node is identified by a 64-bit key: axis and side, level, two lattice coordinates, and the
interval of the third coordinate in which the surface lies. The position of a node thus depends on
its key only, not on the point for which it was created.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import concatenated, opaque_point, symbolic

#: Node number of keys that are not in the table.
NONE = 0xFFFFFFFF
#: Spacing of the lattice at level 0 over the diagonal of the media's box; distance from the box, in
#: units of that spacing, at 2^k times which level -k begins, for k > 0.
COARSEST, COARSER_BEYOND = 0.25, 2.0
#: Largest spacing over the harmonic mean distance of a node.
SPACING_PER_DISTANCE = 0.25
#: Cosine between the normals of a point and a node below which finer levels are used, and below
#: which the node is not used for the point.
FLAT, SAME_SIDE = 0.97, 0.8
#: Largest distance of a node from the tangent plane, over the spacing.
TANGENT = 0.3
#: Distance of another surface from a node, over the spacing, below which this surface may lie
#: between nodes, as in corners and below objects.
CLEARANCE = 1.5
#: Distance, in units of the spacing at level 0, by multiples of which the origin moves with the
#: camera.
ORIGIN_STEP = 1024.0
#: Largest level: finer lattices would be finer than the rounding of positions.
FINEST_LEVEL = 24
#: Offset of the lattices' origin, so that planes at round coordinates are not on the boundary of
#: two intervals.
SHIFT = np.array([0.2137, 0.3719, 0.4482])
#: Bits of a coordinate, and offsets that make coordinates and levels positive.
BITS, OFFSET, LEVEL_OFFSET = 18, 1 << 17, 32


class SpacingBounds(NamedTuple):
    """Bounds of the spacing of the nodes for a point [scene units]: that of the first level used
    there is at most ``coarsest``, and levels end with the first whose spacing is at most
    ``finest``.
    """

    coarsest: mi.Float
    finest: mi.Float


class _SurfacePoint(NamedTuple):
    """A point on a surface: its normals, and its coordinates across the normals' largest axis."""

    p: mi.Point3f
    geometric: mi.Normal3f
    shading: mi.Normal3f
    axis: mi.UInt32
    side: mi.UInt32
    place: mi.Vector3f
    slope: mi.Vector2f


class _SurfaceCorner(NamedTuple):
    """A node at the corner of a square of nodes around a point.

    Attributes:
        key, number: of the node.
        exists: whether the table has it.
        can_exist: whether its key can express its place.
        weight: for the interpolation at the point, not normalised; 0 if the node does not apply.
        finer: whether interpolation needs a finer level.
        divided: whether another surface may lie between the node and the point.
    """

    key: mi.UInt64
    number: mi.UInt32
    exists: mi.Bool
    can_exist: mi.Bool
    weight: mi.Float
    finer: mi.Bool
    divided: mi.Bool


class SurfaceNodes:
    """A growing set of nodes on surfaces around media that fill the world box ``lower`` to
    ``upper``.
    """

    def __init__(self, lower: np.ndarray, upper: np.ndarray) -> None:
        spacing = COARSEST * float(np.linalg.norm(upper - lower))
        origin = 0.5 * (lower + upper) + SHIFT * spacing
        self.spacing = dr.opaque(mi.Float, spacing)
        self._step = ORIGIN_STEP * spacing
        self._default_origin, self._origin = origin, opaque_point(origin)
        self._lower, self._upper = opaque_point(lower), opaque_point(upper)
        self.count = 0
        self.keys = mi.UInt64(0)
        #: per node: position and harmonic mean distance (0 where there is no surface); shading
        #: normal and distance of the nearest other surface; geometric normal and medium number
        self._places, self._normals = mi.Float([0.0] * 4), mi.Float([0.0] * 4)
        self._geometric = mi.Float([0.0] * 4)
        self._slots, self._mask = mi.UInt32([NONE, NONE]), dr.opaque(mi.UInt32, 1)

    def set_origin_near(self, p: np.ndarray) -> None:
        """Move the origin of the lattices towards a world position (3,), if there are no nodes yet:
        keys can express places of fine lattices near the origin only.
        """
        if not self.count:
            steps = np.round((np.asarray(p) - self._default_origin) / self._step)
            self._origin = opaque_point(self._default_origin + steps * self._step)

    # Lookup

    @symbolic
    def find(
        self,
        p: mi.Point3f,
        normals: tuple[mi.Normal3f, mi.Normal3f],
        bounds: SpacingBounds,
        active: mi.Bool,
    ):
        """Find the nodes between which to interpolate at ``p`` with these ``normals``, geometric
        and shading, with a spacing within ``bounds``.

        Returns the numbers of four nodes; their weights, whose sum is 1, or 0 if a node is missing;
        whether another surface may lie between the nodes; the four keys at the last level visited;
        and whether any of these keys is missing in the table.
        """
        # docs/primer, eq. (5.7)
        point = _SurfacePoint(p, *normals, *_across(normals[0], mi.Vector3f(p - self._origin)))
        level = dr.maximum(self._coarsest_level(p), self._level_of(bounds.coarsest))
        last = self._level_of(bounds.finest)
        numbers = [mi.UInt32(0) for _ in range(4)]
        weights = [mi.Float(0) for _ in range(4)]
        keys = [mi.UInt64(0) for _ in range(4)]
        missing, uncertain, active = mi.Bool(False), mi.Bool(False), mi.Bool(active)
        while dr.hint(active, label="levels of surface nodes"):
            total, incomplete, impossible = mi.Float(0), mi.Bool(False), mi.Bool(False)
            finer, divided = mi.Bool(False), mi.Bool(False)
            corners = [self._corner(point, level, k, active) for k in range(4)]
            for k, corner in enumerate(corners):
                keys[k] = dr.select(active, corner.key, keys[k])
                finer |= corner.finer
                divided |= corner.divided
                total += corner.weight
                incomplete |= active & ~corner.exists
                impossible |= ~corner.can_exist
            # Interpolation at a coarser level than the point requires would be biased.
            finer |= divided | (total == 0)
            ends = active & ~incomplete & (~finer | (level >= last)) & (total > 0)
            uncertain |= ends & divided
            scale = dr.rcp(total)
            for k, corner in enumerate(corners):
                chosen = ends & (corner.weight > 0)
                numbers[k] = dr.select(chosen, corner.number, numbers[k])
                weights[k] = dr.select(ends, corner.weight * scale, weights[k])
            missing |= incomplete & ~impossible
            active &= ~incomplete & finer & (level < last)
            level = dr.select(active, level + 1, level)
        return numbers, weights, uncertain, keys, missing

    def _corner(
        self, point: _SurfacePoint, level: mi.Int32, k: int, active: mi.Bool
    ) -> _SurfaceCorner:
        """Look up the node at corner ``k`` of the square of a ``level`` that contains a point."""
        spacing, place, slope = self._spacing_at(level), point.place, point.slope
        u, v = place.x / spacing, place.y / spacing
        at_u, at_v = dr.floor(u) + (k & 1), dr.floor(v) + (k >> 1)
        height = place.z / spacing + slope.x * (at_u - u) + slope.y * (at_v - v)
        key = _packed(point.axis * 2 + point.side, level, at_u, at_v, dr.floor(height))
        can_exist = dr.maximum(dr.maximum(dr.abs(at_u), dr.abs(at_v)), dr.abs(height)) < OFFSET - 1
        number = self._number_of(key, active & can_exist)
        exists = active & (number != NONE)
        found = dr.gather(mi.Vector4f, self._places, number, exists)
        normal = dr.gather(mi.Vector4f, self._normals, number, exists)
        offset = dr.dot(mi.Vector3f(found.x, found.y, found.z) - point.p, point.geometric)
        cosine = dr.dot(mi.Vector3f(normal.x, normal.y, normal.z), point.shading)
        on_surface = exists & (found.w > 0)
        applies = on_surface & (dr.abs(offset) < TANGENT * spacing) & (cosine > SAME_SIDE)
        weight = (1 - dr.abs(at_u - u)) * (1 - dr.abs(at_v - v))
        return _SurfaceCorner(
            key,
            number,
            exists,
            can_exist,
            weight=dr.select(applies, dr.maximum(weight, 1e-6), 0),
            finer=applies & ((found.w * SPACING_PER_DISTANCE < spacing) | (cosine < FLAT)),
            divided=on_surface & (normal.w < CLEARANCE * spacing),
        )

    def _coarsest_level(self, p: mi.Point3f) -> mi.Int32:
        """Return the level at which the search begins at ``p``, if no bound is finer."""
        away = dr.maximum(dr.maximum(self._lower - p, p - self._upper), 0)
        ratio = dr.norm(away) / (COARSER_BEYOND * self.spacing)
        exponent = mi.Int32(dr.floor(dr.log2(dr.maximum(ratio, 1))))
        return -dr.minimum(exponent, LEVEL_OFFSET - 1)

    def _level_of(self, spacing: mi.Float) -> mi.Int32:
        """Return the first level with at most this ``spacing``."""
        level = dr.ceil(dr.log2(self.spacing / spacing))
        return mi.Int32(dr.clip(level, 1 - LEVEL_OFFSET, FINEST_LEVEL))

    def _spacing_at(self, level: mi.Int32) -> mi.Float:
        power = dr.reinterpret_array(mi.Float, mi.UInt32(127 - level) << 23)
        return self.spacing * power

    @symbolic
    def _number_of(self, key: mi.UInt64, active: mi.Bool):
        """Return the number of the node with this ``key``, NONE where there is none."""
        number, slot = mi.UInt32(NONE), _hash(key) & self._mask
        active = mi.Bool(active)
        while dr.hint(active, label="hash table"):
            candidate = dr.gather(mi.UInt32, self._slots, slot, active)
            used = active & (candidate != NONE)
            same = used & (dr.gather(mi.UInt64, self.keys, candidate, used) == key)
            number = dr.select(same, candidate, number)
            active = used & ~same
            slot = (slot + 1) & self._mask
        return number

    # Growth

    def add_keys(self, keys: Sequence[mi.UInt64]) -> tuple[mi.UInt32, mi.UInt32]:
        """Add those ``keys`` that are not in the table, each once.

        Returns the numbers of the new nodes, and for each the lane of its first occurrence in
        ``keys``. The nodes have to be completed by `place`.
        """
        parts = [self.keys] if self.count else []
        candidates = concatenated([*parts, *keys])
        count = dr.width(candidates)
        size = 1 << max(2 * count - 1, 1).bit_length()
        slots = dr.full(mi.UInt32, NONE, size)
        mask = dr.opaque(mi.UInt32, size - 1)
        lane, slot = dr.arange(mi.UInt32, count), _hash(candidates) & mask
        is_new, active = mi.Bool(False) & (lane == lane), lane == lane
        dr.eval(slots, slot, active, is_new, candidates)
        while True:
            # The lowest lane takes an empty slot, so the result does not depend on the order of
            # execution.
            empty = active & (dr.gather(mi.UInt32, slots, slot, active) == NONE)
            dr.eval(empty)
            dr.scatter_reduce(dr.ReduceOp.Min, slots, lane, slot, empty)
            dr.eval(slots)
            owner = dr.gather(mi.UInt32, slots, slot, active)
            same = active & (dr.gather(mi.UInt64, candidates, owner, active) == candidates)
            is_new |= active & (owner == lane)
            active &= ~same
            slot = dr.select(active, (slot + 1) & mask, slot)
            dr.eval(is_new, active, slot)
            if not dr.any(active)[0]:
                break
        first = dr.opaque(mi.UInt32, self.count)
        is_new |= lane < first
        chosen = dr.compress(is_new)
        # Renumber: lanes become numbers of nodes.
        renumbered = dr.zeros(mi.UInt32, count)
        total = dr.width(chosen)
        dr.scatter(renumbered, dr.arange(mi.UInt32, total), chosen)
        used = slots != NONE
        self._slots = dr.select(used, dr.gather(mi.UInt32, renumbered, slots, used), NONE)
        self._mask, before = mask, self.count
        self.keys = dr.gather(mi.UInt64, candidates, chosen)
        self.count = total
        dr.eval(self._slots, self.keys)
        if total == before:
            return mi.UInt32(), mi.UInt32()
        numbers = dr.arange(mi.UInt32, total - before) + first
        # The keys of the table come first and are all in use.
        place = dr.gather(mi.UInt32, chosen, numbers) - first
        return numbers, place % dr.opaque(mi.UInt32, dr.width(keys[0]))

    def rays(self, numbers: mi.UInt32) -> tuple[mi.Ray3f, mi.Float]:
        """Return rays whose first intersections are the positions of the nodes with these
        ``numbers``, and their lengths.
        """
        key = dr.gather(mi.UInt64, self.keys, numbers)
        coordinate = (1 << BITS) - 1
        w, v, u = (
            mi.Float(mi.Int32(mi.UInt32(key >> (BITS * k)) & coordinate) - OFFSET) for k in range(3)
        )
        rest = mi.UInt32(key >> (3 * BITS))
        level = mi.Int32(rest & 63) - LEVEL_OFFSET
        axis, side = rest >> 7, (rest >> 6) & 1
        spacing = self._spacing_at(level)
        forward = side == 1  # the surface faces the negative direction of the axis
        start = dr.select(forward, w - 0.5, w + 1.5)
        u, v, w = u * spacing, v * spacing, start * spacing
        place = mi.Vector3f(
            dr.select(axis == 0, w, u),
            dr.select(axis == 1, w, dr.select(axis == 0, u, v)),
            dr.select(axis == 2, w, v),
        )
        step = dr.select(forward, mi.Float(1), -1)
        direction = mi.Vector3f(
            dr.select(axis == 0, step, 0),
            dr.select(axis == 1, step, 0),
            dr.select(axis == 2, step, 0),
        )
        return mi.Ray3f(self._origin + place, direction), 2 * spacing

    def place(
        self,
        p: mi.Point3f,
        normals: tuple[mi.Normal3f, mi.Normal3f],
        distance: mi.Float,
        clearance: mi.Float,
        medium: mi.UInt32,
    ) -> None:
        """Complete the nodes that `add_keys` added last.

        ``p`` are their positions, ``normals`` the geometric and shading normals, ``distance`` the
        harmonic mean distances (0 where there is no surface), ``clearance`` the distances of the
        nearest other surface, and ``medium`` the numbers of the media in front of the surface.
        """
        known = self.count - dr.width(p)
        geometric, shading = normals
        new = (
            dr.ravel(mi.Vector4f(p.x, p.y, p.z, distance)),
            dr.ravel(mi.Vector4f(shading.x, shading.y, shading.z, clearance)),
            dr.ravel(mi.Vector4f(geometric.x, geometric.y, geometric.z, mi.Float(medium))),
        )
        old = self._places, self._normals, self._geometric
        joined = [concatenated([a, b]) if known else b for a, b in zip(old, new, strict=True)]
        self._places, self._normals, self._geometric = joined
        dr.eval(joined)

    def positions(
        self, numbers: mi.UInt32, active: mi.Bool = True
    ) -> tuple[mi.Point3f, mi.Normal3f, mi.Normal3f, mi.Float]:
        """Return position, geometric and shading normal, and harmonic mean distance of nodes."""
        found = dr.gather(mi.Vector4f, self._places, numbers, active)
        geometric = dr.gather(mi.Vector4f, self._geometric, numbers, active)
        shading = dr.gather(mi.Vector4f, self._normals, numbers, active)
        return (
            mi.Point3f(found.x, found.y, found.z),
            mi.Normal3f(geometric.x, geometric.y, geometric.z),
            mi.Normal3f(shading.x, shading.y, shading.z),
            found.w,
        )

    def medium_number(self, numbers: mi.UInt32) -> mi.UInt32:
        """Return the number of the medium in front of the surface at nodes, 0 for none."""
        return mi.UInt32(dr.gather(mi.Vector4f, self._geometric, numbers).w)

    def streams(self, numbers: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Return two random words per node, which depend on its key only."""
        key = dr.gather(mi.UInt64, self.keys, numbers)
        return mi.sample_tea_32(mi.UInt32(key), mi.UInt32(key >> 32))


def _across(
    normal: mi.Normal3f, place: mi.Vector3f
) -> tuple[mi.UInt32, mi.UInt32, mi.Vector3f, mi.Vector2f]:
    """Express ``place`` in a frame whose third axis is the dominant axis of ``normal``.

    Returns the number of the axis; 1 where the normal points in its negative direction, else 0; the
    coordinates of ``place``, that along the axis last; and the slopes of the tangent plane.
    """
    size = dr.abs(mi.Vector3f(normal))
    is_x = (size.x >= size.y) & (size.x >= size.z)
    is_y = ~is_x & (size.y >= size.z)
    axis = dr.select(is_x, mi.UInt32(0), dr.select(is_y, mi.UInt32(1), 2))

    def ordered(v: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f(
            dr.select(is_x, v.y, v.x),
            dr.select(is_x | is_y, v.z, v.y),
            dr.select(is_x, v.x, dr.select(is_y, v.y, v.z)),
        )

    normal = ordered(mi.Vector3f(normal))
    slope = mi.Vector2f(-normal.x / normal.z, -normal.y / normal.z)
    return axis, dr.select(normal.z < 0, mi.UInt32(1), 0), ordered(place), slope


def _packed(
    axis_and_side: mi.UInt32, level: mi.Int32, u: mi.Float, v: mi.Float, w: mi.Float
) -> mi.UInt64:
    """Pack a key: 3 bits of axis and side, 6 bits of level, and three coordinates of `BITS`."""
    key = mi.UInt64(axis_and_side) << 6 | mi.UInt64(mi.UInt32(level + LEVEL_OFFSET))
    for x in (u, v, w):
        coordinate = mi.UInt32(mi.Int32(dr.clip(x, 1 - OFFSET, OFFSET - 1)) + OFFSET)
        key = key << BITS | mi.UInt64(coordinate)
    return key


def _hash(key: mi.UInt64) -> mi.UInt32:
    first, second = mi.sample_tea_32(mi.UInt32(key), mi.UInt32(key >> 32), 4)
    return first ^ second
