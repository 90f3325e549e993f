"""Several fields of one grid, packed for ray marching: few, wide loads from little memory.

Ray marching of large volumes is limited by memory bandwidth, not by arithmetic. Values are
therefore stored as 16-bit floats without sign (5 bits of exponent, 11 of mantissa), with dithered
rounding such that the mean over neighbouring voxels is preserved. The fields of a voxel are stored
together, and, if at most four 32-bit words result, with those of its neighbour along x.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.grids.fields import Field, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import Extension, RootField

#: Maximum number of values of a voxel, two per word; numbers of values stored with the neighbour's.
MAX_VALUES, PAIRED_COUNTS = 8, (1, 2, 4)
#: Grids with more voxels are not packed: 32 bits could not address the copy.
MAX_VOXELS = 2**32 // 4
#: Number of mantissa bits of a float32 that are dropped, and the biased float32 exponent that is
#: stored as 0. Values below 2^-30 of the maximum become 0.
DROPPED, ZERO_EXPONENT = 12, 96
#: 2^32 divided by x, x^2 and x^3 where x^4 = x + 1: a low-discrepancy sequence in three dimensions
#: (Roberts, *The unreasonable effectiveness of quasirandom sequences*, 2018).
DITHER_STEPS = (3518319155, 2882110345, 2360945575)
#: Lower bound of a field's maximum, such that its reciprocal is finite.
MIN_SCALE = 1e-37


class Packets:
    """Packed copy of several `GridField` on one ``grid``, at most `MAX_VALUES` per voxel.

    ``planes(index)`` returns the non-negative values at flat voxel indices, one array per value,
    and ``largest`` is the maximum representable value of each. For a grid that exceeds the memory,
    only ``slices`` (first, end) along z are packed; ``index`` then counts from the first of them.
    """

    def __init__(
        self,
        grid: Grid,
        planes: Callable,
        largest: Sequence[float],
        slices: tuple[int, int] | None = None,
    ) -> None:
        self.grid, self.count = grid, len(largest)
        first, end = slices or (0, grid.shape[0])
        voxels = (end - first) * grid.shape[1] * grid.shape[2]
        self._first = None if slices is None else dr.opaque(mi.Int32, first)
        #: whether a word holds a value of a voxel and that of its neighbour along x
        self.paired = self.count in PAIRED_COUNTS
        sides = [int(n) for n in grid.resolution]
        self._last = [dr.opaque(mi.Float, n - 1) for n in sides]
        self._lowest = [dr.opaque(mi.Int32, max(n - 2, 0)) for n in sides]
        steps = zip(sides, (1, sides[0], sides[0] * sides[1]), strict=True)
        self._steps = [dr.opaque(mi.Int32, step if n > 1 else 0) for n, step in steps]
        largest = [max(value, MIN_SCALE) for value in largest]
        self._scales = [dr.opaque(mi.Float, value) for value in largest]
        scales = [dr.opaque(mi.Float, 1 / value) for value in largest]
        index = dr.arange(mi.UInt32, voxels)
        x, y, z = grid.voxel_indices(index)
        z = z if slices is None else z + mi.UInt32(self._first)
        noise = x * DITHER_STEPS[0] + y * DITHER_STEPS[1] + z * DITHER_STEPS[2]

        def numbers(index: mi.UInt32, noise: mi.UInt32) -> list[mi.UInt32]:
            values = zip(planes(index), scales, strict=True)
            return [_encode(value * scale, noise) for value, scale in values]

        here = numbers(index, noise)
        if self.paired:
            step = dr.select(x + 1 < mi.UInt32(grid.sides[0]), mi.UInt32(1), 0)
            right = numbers(index + step, noise + step * DITHER_STEPS[0])
            here = [number for pair in zip(here, right, strict=True) for number in pair]
        words = [low | high << 16 for low, high in zip(here[::2], here[1::2], strict=False)]
        words += here[len(words) * 2 :]
        self.words = 1 << (len(words) - 1).bit_length()
        words += [mi.UInt32(0)] * (self.words - len(words))
        # Allocated by Dr.Jit, because wide loads need an aligned array.
        self.data = dr.empty(mi.UInt32, voxels * self.words)
        dr.scatter(self.data, _load(self.words)(*words), index)
        dr.eval(self.data)

    def at(self, u: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """Interpolate all fields at the voxel coordinates ``u``."""
        corners, weights = [], []
        for c, last, most in zip(u, self._last, self._lowest, strict=True):
            s = clipped(c - 0.5, 0.0, last)
            # A pair starts at the last voxel but one at most.
            corners.append(dr.minimum(mi.Int32(s), most))
            weights.append(s - mi.Float(corners[-1]))
        wx, wy, wz = weights
        nx, ny, _ = self.grid.sides
        if self._first is not None:
            corners[2] -= self._first
        base = (corners[2] * ny + corners[1]) * nx + corners[0]
        dx, dy, dz = self._steps

        def load(place: mi.Int32) -> list[mi.UInt32]:
            words = dr.gather(_load(self.words), self.data, mi.UInt32(place), active)
            return [words] if self.words == 1 else list(words)

        def edge(place: mi.Int32) -> list[mi.Float]:
            """Interpolate along x."""
            low = [half for word in load(place) for half in _decode(word)]
            if self.paired:
                low, high = low[::2], low[1::2]
            else:
                high = [half for word in load(place + dx) for half in _decode(word)]
            return [dr.lerp(a, b, wx) for a, b in zip(low, high, strict=True)][: self.count]

        def face(place: mi.Int32) -> list[mi.Float]:
            """Interpolate along x and y."""
            return [dr.lerp(a, b, wy) for a, b in zip(edge(place), edge(place + dy), strict=True)]

        values = zip(face(base), face(base + dz), self._scales, strict=True)
        return [dr.lerp(near, far, wz) * 2.0**ZERO_EXPONENT * scale for near, far, scale in values]


def _load(words: int) -> type:
    """Return the type that loads this many words at once."""
    return {1: mi.UInt32, 2: mi.Vector2u, 4: mi.Array4u}[words]


def _encode(value: mi.Float, noise: mi.UInt32) -> mi.UInt32:
    """Encode a value, clamped to [0, 1], in 16 bits; ``noise`` dithers the rounding."""
    bits = dr.reinterpret_array(mi.UInt32, dr.clip(value, 0, 1)) + (noise >> (32 - DROPPED))
    # Flush smaller values to 0: a float with exponent 0 is denormal.
    representable = bits >= (ZERO_EXPONENT + 1) << 23
    return dr.select(representable, (bits - (ZERO_EXPONENT << 23)) >> DROPPED, 0)


def _decode(word: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Decode both values of a word, scaled by 2^-`ZERO_EXPONENT`; dropped bits are 0."""
    low = (word & 0xFFFF) << DROPPED
    high = (word >> (16 - DROPPED)) & (0xFFFF << DROPPED)
    return dr.reinterpret_array(mi.Float, low), dr.reinterpret_array(mi.Float, high)


class Lookups:
    """Simultaneous lookups in several fields.

    Fields on the same grid are packed together if they fit (see `Packets`), and their original
    arrays may be released. Other fields and constants are looked up separately. Values of a field
    above its entry in ``limits`` are clamped.
    """

    def __init__(self, fields: list[Field], limits: Sequence[float] | None = None) -> None:
        self.groups: list[PackedGroup] = []
        limits = limits or [dr.inf] * len(fields)
        grids = [f if isinstance(f, GridField) else None for f in fields]
        remaining = [i for i, f in enumerate(grids) if f and f.grid.voxel_count < MAX_VOXELS]
        self._others = {i: f for i, f in enumerate(fields) if i not in remaining}
        while remaining:
            group = [remaining.pop(0)]
            for i in list(remaining):
                candidate = [fields[j] for j in [*group, i]]
                if _on_same_grid(candidate) and sum(f.channels for f in candidate) <= MAX_VALUES:
                    group.append(i)
                    remaining.remove(i)
            self.groups.append(PackedGroup([(i, fields[i], limits[i]) for i in group]))

    def at_world(self, p: mi.Point3f, active: mi.Bool) -> list:
        """Interpolate at world positions."""
        found = [group.at(group.place(p), active) for group in self.groups]
        return self._all(found, p, active)

    def along(self, ray: mi.Ray3f) -> AlongRay:
        """Prepare lookups along a ray."""
        return AlongRay(self, ray)

    def _all(self, found: list[dict], p: mi.Point3f, active: mi.Bool) -> list:
        values = {i: field.at_world(p, active) for i, field in self._others.items()}
        for group in found:
            values |= group
        return [values[i] for i in range(len(values))]


class AlongRay:
    """Lookups along a ``ray``, with origin and direction in the voxel coordinates of each group."""

    def __init__(self, lookups: Lookups, ray: mi.Ray3f) -> None:
        self.ray, self._lookups = ray, lookups
        self._group_rays = [
            (group.place(ray.o), group.grid.coordinates.vector(ray.d)) for group in lookups.groups
        ]

    def at(self, t: mi.Float, active: mi.Bool) -> list:
        """Interpolate at the distance ``t``."""
        groups = zip(self._lookups.groups, self._group_rays, strict=True)
        found = [group.at(dr.fma(d, t, o), active) for group, (o, d) in groups]
        return self._lookups._all(found, self.ray(t), active)


def _base_grid(field: GridField) -> Grid:
    return field.inner if isinstance(field, RootField) else field.grid


def _on_same_grid(fields: list[GridField]) -> bool:
    first = _base_grid(fields[0])
    return all(_base_grid(f).shared(first) is first for f in fields[1:])


class PackedGroup:
    """Fields of one ``grid`` in `Packets`, each with its index in `Lookups` and its upper limit."""

    def __init__(self, fields: list[tuple[int, GridField, float]]) -> None:
        self.grid = _base_grid(fields[0][1])
        #: index, number of channels, and whether square roots are stored
        self.members = [(i, f.channels, isinstance(f, RootField)) for i, f, _ in fields]
        extended = any(root for *_, root in self.members)
        extension = Extension(self.grid) if extended else None
        self._shift = 1 if extended else 0
        largest = []
        for (_, channels, root), (_, field, limit) in zip(self.members, fields, strict=True):
            most = min(field.maximum, limit)
            largest += [most**0.5 if root else most] * channels

        def planes(index: mi.UInt32) -> list[mi.Float]:
            values = []
            for (_, n, root), (_, field, _) in zip(self.members, fields, strict=True):
                voxel = extension.inside(index) if extended and not root else index
                channels = [dr.gather(mi.Float, field.data, voxel * n + c) for c in range(n)]
                values += [c * field.scale for c in channels]
            return values

        self.packets = Packets(extension.grid if extended else self.grid, planes, largest)

    def place(self, p: mi.Point3f) -> mi.Point3f:
        """Convert world positions to voxel coordinates of the packed grid."""
        return self.grid.coordinates.point(p) + self._shift

    def at(self, u: mi.Point3f, active: mi.Bool) -> dict:
        """Interpolate at voxel coordinates; returns the fields by index."""
        values = self.packets.at(u, active)
        found = {}
        for i, channels, root in self.members:
            own, values = values[:channels], values[channels:]
            own = [dr.square(v) for v in own] if root else own
            found[i] = own[0] if channels == 1 else mi.Color3f(own)
        return found
