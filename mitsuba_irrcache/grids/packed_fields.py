"""Several fields of one grid, laid out for rays: a lookup needs few loads of little memory.

What rays read of large volumes waits for memory, not for arithmetic. So values are kept in 16 bits,
floating-point numbers without a sign: 5 bits of exponent and 11 of mantissa, rounded up or down at
random, such that they are right on average over any few neighbours. And what a lookup reads
together lies together: the fields of a voxel, and while there is room in four words, those of the
voxel's neighbour along x.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.grids.fields import Field, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import Extension, RootField

#: Most values of a voxel, two in each word; so many have those of their neighbours with them.
MOST, PAIRED = 8, (1, 2, 4)
#: Larger copies could not be addressed with 32 bits.
LARGEST = 2**32 // 4
#: Bits of a float's mantissa that are left out, and the exponent, as floats keep it, that is 0 in
#: 16 bits. What is below 2^-30 of the largest value is 0.
DROPPED, LEAST = 12, 96
#: 2^32 over x, x^2 and x^3 where x^4 = x + 1: multiples spread evenly over all axes (Roberts,
#: *The unreasonable effectiveness of quasirandom sequences*, 2018).
SPREAD = (3518319155, 2882110345, 2360945575)
#: Smaller largest values count as this one: its reciprocal is a number still.
SMALLEST = 1e-37


class Packets:
    """Fields, at most `MOST` values in all, with values at the voxel centres of ``grid``, trilinear
    between them and clamped at the border: the numbers of a `GridField`, copied.

    ``planes`` gives, for flat indices of voxels, what is kept of them, not negative; of each
    ``largest`` is the largest that is told apart.
    """

    def __init__(self, grid: Grid, planes: Callable, largest: Sequence[float]) -> None:
        self.grid, self.count = grid, len(largest)
        #: whether a word holds a value and that of the voxel's neighbour along x
        self.paired = self.count in PAIRED
        sides = [int(n) for n in grid.resolution]
        self._last = [dr.opaque(mi.Float, n - 1) for n in sides]
        self._lowest = [dr.opaque(mi.Int32, max(n - 2, 0)) for n in sides]
        steps = zip(sides, (1, sides[0], sides[0] * sides[1]), strict=True)
        self._steps = [dr.opaque(mi.Int32, step if n > 1 else 0) for n, step in steps]
        largest = [max(value, SMALLEST) for value in largest]
        self._scales = [dr.opaque(mi.Float, value) for value in largest]
        scales = [dr.opaque(mi.Float, 1 / value) for value in largest]
        index = dr.arange(mi.UInt32, grid.voxel_count)
        x, y, z = grid.places(index)
        noise = x * SPREAD[0] + y * SPREAD[1] + z * SPREAD[2]

        def numbers(index: mi.UInt32, noise: mi.UInt32) -> list[mi.UInt32]:
            values = zip(planes(index), scales, strict=True)
            return [_encoded(value * scale, noise) for value, scale in values]

        here = numbers(index, noise)
        if self.paired:
            step = dr.select(x + 1 < mi.UInt32(grid.sides[0]), mi.UInt32(1), 0)
            right = numbers(index + step, noise + step * SPREAD[0])
            here = [number for pair in zip(here, right, strict=True) for number in pair]
        words = [low | high << 16 for low, high in zip(here[::2], here[1::2], strict=False)]
        words += here[len(words) * 2 :]
        self.words = 1 << (len(words) - 1).bit_length()
        words += [mi.UInt32(0)] * (self.words - len(words))
        # Made by a kernel, never borrowed from elsewhere: wide loads need an aligned array.
        self.data = dr.empty(mi.UInt32, grid.voxel_count * self.words)
        dr.scatter(self.data, _load(self.words)(*words), index)
        dr.eval(self.data)

    def at(self, u: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """The fields at the voxel coordinates ``u``."""
        corners, weights = [], []
        for c, last, most in zip(u, self._last, self._lowest, strict=True):
            s = clipped(c - 0.5, 0.0, last)
            # Of the last voxel nothing but the upper one of two.
            corners.append(dr.minimum(mi.Int32(s), most))
            weights.append(s - mi.Float(corners[-1]))
        wx, wy, wz = weights
        nx, ny, _ = self.grid.sides
        base = (corners[2] * ny + corners[1]) * nx + corners[0]
        dx, dy, dz = self._steps

        def load(place: mi.Int32) -> list[mi.UInt32]:
            words = dr.gather(_load(self.words), self.data, mi.UInt32(place), active)
            return [words] if self.words == 1 else list(words)

        def edge(place: mi.Int32) -> list[mi.Float]:
            """Interpolated along x."""
            low = [half for word in load(place) for half in _decoded(word)]
            if self.paired:
                low, high = low[::2], low[1::2]
            else:
                high = [half for word in load(place + dx) for half in _decoded(word)]
            return [dr.lerp(a, b, wx) for a, b in zip(low, high, strict=True)][: self.count]

        def face(place: mi.Int32) -> list[mi.Float]:
            """Interpolated along x and y."""
            return [dr.lerp(a, b, wy) for a, b in zip(edge(place), edge(place + dy), strict=True)]

        values = zip(face(base), face(base + dz), self._scales, strict=True)
        return [dr.lerp(near, far, wz) * 2.0**LEAST * scale for near, far, scale in values]


def _load(words: int) -> type:
    """So many words that are read together."""
    return {1: mi.UInt32, 2: mi.Vector2u, 4: mi.Array4u}[words]


def _encoded(value: mi.Float, noise: mi.UInt32) -> mi.UInt32:
    """A number in [0, 1], greater ones are 1, in 16 bits, rounded by ``noise``."""
    bits = dr.reinterpret_array(mi.UInt32, dr.clip(value, 0, 1)) + (noise >> (32 - DROPPED))
    # An exponent of 0 has another meaning for floats.
    told = bits >= (LEAST + 1) << 23
    return dr.select(told, (bits - (LEAST << 23)) >> DROPPED, 0)


def _decoded(word: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Both numbers of a word, times 2^-`LEAST`: what is left out are zeros."""
    low = (word & 0xFFFF) << DROPPED
    high = (word >> (16 - DROPPED)) & (0xFFFF << DROPPED)
    return dr.reinterpret_array(mi.Float, low), dr.reinterpret_array(mi.Float, high)


class Lookups:
    """The values of several fields at one place. Those that share their voxels, and fit, are read
    together from a copy, after which they are not needed; others, and constants, by their own.

    Values of a field above its ``limits``, if there are any, count as these.
    """

    def __init__(self, fields: list[Field], limits: Sequence[float] | None = None) -> None:
        self.groups: list[Group] = []
        limits = limits or [dr.inf] * len(fields)
        grids = [f if isinstance(f, GridField) else None for f in fields]
        alone = [i for i, f in enumerate(grids) if f and f.grid.voxel_count < LARGEST]
        self._others = {i: f for i, f in enumerate(fields) if i not in alone}
        while alone:
            group = [alone.pop(0)]
            for i in list(alone):
                candidate = [fields[j] for j in [*group, i]]
                if _together(candidate) and sum(f.channels for f in candidate) <= MOST:
                    group.append(i)
                    alone.remove(i)
            self.groups.append(Group([(i, fields[i], limits[i]) for i in group]))

    def at_world(self, p: mi.Point3f, active: mi.Bool) -> list:
        """The values at world positions."""
        found = [group.at(group.place(p), active) for group in self.groups]
        return self._all(found, p, active)

    def along(self, ray: mi.Ray3f) -> AlongRay:
        """The values along a ray."""
        return AlongRay(self, ray)

    def _all(self, found: list[dict], p: mi.Point3f, active: mi.Bool) -> list:
        values = {i: field.at_world(p, active) for i, field in self._others.items()}
        for group in found:
            values |= group
        return [values[i] for i in range(len(values))]


class AlongRay:
    """`Lookups` at places of a ``ray``, which is straight in the grids' coordinates too."""

    def __init__(self, lookups: Lookups, ray: mi.Ray3f) -> None:
        self.ray, self._lookups = ray, lookups
        self._ways = [
            (group.place(ray.o), group.grid.coordinates.vector(ray.d)) for group in lookups.groups
        ]

    def at(self, t: mi.Float, active: mi.Bool) -> list:
        """The values at the distance ``t``."""
        groups = zip(self._lookups.groups, self._ways, strict=True)
        found = [group.at(dr.fma(d, t, o), active) for group, (o, d) in groups]
        return self._lookups._all(found, self.ray(t), active)


def _inner(field: GridField) -> Grid:
    return field.inner if isinstance(field, RootField) else field.grid


def _together(fields: list[GridField]) -> bool:
    first = _inner(fields[0])
    return all(_inner(f).shared(first) is first for f in fields[1:])


class Group:
    """Fields of one ``grid`` in `Packets`: each has a number, and a limit."""

    def __init__(self, fields: list[tuple[int, GridField, float]]) -> None:
        self.grid = _inner(fields[0][1])
        #: numbers, channels, and whether roots are kept
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
        """Voxel coordinates of world positions in what is kept."""
        return self.grid.coordinates.point(p) + self._shift

    def at(self, u: mi.Point3f, active: mi.Bool) -> dict:
        """The fields, by their numbers, at these coordinates."""
        values = self.packets.at(u, active)
        found = {}
        for i, channels, root in self.members:
            own, values = values[:channels], values[channels:]
            own = [dr.square(v) for v in own] if root else own
            found[i] = own[0] if channels == 1 else mi.Color3f(own)
        return found
