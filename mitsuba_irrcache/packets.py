"""Several fields of one grid, laid out so that a lookup needs few wide loads.

A load of two or four neighbouring floats costs little more than that of one. So what a lookup reads
together lies together: the fields of a voxel, and while there is room in four floats, the voxel's
neighbours along x and y too.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from .grid import Extension, Field, Grid, GridField, RootField, stencil

#: Floats in one load.
WIDTH = 4
#: Larger copies could not be addressed with 32 bits.
LARGEST = 2**31 // WIDTH


class Packets:
    """Fields, at most `WIDTH` words in all, with values at the voxel centres of ``grid``, trilinear
    between them and clamped at the border: the numbers of a `GridField`, copied.

    ``planes`` gives, for flat indices of voxels, what is kept of them, and ``decode`` makes the
    values of it. The copy takes `WIDTH` floats per voxel.
    """

    def __init__(self, grid: Grid, planes: Callable, decode: Callable | None = None) -> None:
        self.grid, self._decode = grid, decode
        nx, ny, _ = (mi.UInt32(n) for n in grid.sides)
        index = dr.arange(mi.UInt32, grid.voxel_count)
        x, y, _ = grid.places(index)
        here = planes(index)
        values = list(here)
        # 4: along x and y, 2: along x, 1: none
        self.neighbours = 2 if len(here) == 2 else WIDTH // len(here)
        if self.neighbours > 1:
            right = index + dr.select(x + 1 < nx, mi.UInt32(1), 0)
            values += planes(right)
            if self.neighbours == 4:
                above = dr.select(y + 1 < ny, nx, 0)
                values += [*planes(index + above), *planes(right + above)]
        values += [mi.Float(0)] * (WIDTH - len(values))
        # Made by a kernel, never borrowed from elsewhere: wide loads need an aligned array.
        self.data = dr.empty(mi.Float, grid.voxel_count * WIDTH)
        dr.scatter(self.data, mi.Vector4f(*values), index)
        dr.eval(self.data)

    def at(self, u: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """The fields at the voxel coordinates ``u``."""
        nx, ny, _ = self.grid.sides
        corners, weights, more = zip(
            *(stencil(c, n) for c, n in zip(u, self.grid.sides, strict=True)), strict=True
        )
        base = (corners[2] * ny + corners[1]) * nx + corners[0]
        dx, dy, dz = (
            dr.select(m, mi.Int32(s), 0) for m, s in zip(more, (1, nx, nx * ny), strict=True)
        )
        wx, wy, wz = weights

        def load(place: mi.Int32) -> list[mi.Float]:
            values = list(dr.gather(mi.Vector4f, self.data, mi.UInt32(place), active))
            return self._decode(values) if self._decode else values

        def edge(place: mi.Int32) -> list[mi.Float]:
            """Interpolated along x."""
            low = load(place)
            low, high = (low[:2], low[2:]) if self.neighbours == 2 else (low, load(place + dx))
            return [dr.lerp(a, b, wx) for a, b in zip(low, high, strict=True)]

        def face(place: mi.Int32) -> list[mi.Float]:
            """Interpolated along x and y."""
            if self.neighbours == 4:
                a, b, c, d = load(place)
                return [dr.lerp(dr.lerp(a, b, wx), dr.lerp(c, d, wx), wy)]
            low, high = edge(place), edge(place + dy)
            return [dr.lerp(a, b, wy) for a, b in zip(low, high, strict=True)]

        near, far = face(base), face(base + dz)
        return [dr.lerp(a, b, wz) for a, b in zip(near, far, strict=True)]


class Lookups:
    """The values of several fields at one place. Those that share their voxels, and fit, are read
    together from a copy; others, and constants, by their own.
    """

    def __init__(self, fields: list[Field]) -> None:
        self.fields = fields
        self.groups: list[Group] = []
        grids = [f if isinstance(f, GridField) else None for f in fields]
        alone = [i for i, f in enumerate(grids) if f and f.grid.voxel_count < LARGEST]
        while alone:
            group = [alone.pop(0)]
            for i in list(alone):
                candidate = [fields[j] for j in [*group, i]]
                if _together(candidate) and Group.words(candidate) <= WIDTH:
                    group.append(i)
                    alone.remove(i)
            if Group.words([fields[i] for i in group]) <= WIDTH:
                self.groups.append(Group(fields, group))

    def at_world(self, p: mi.Point3f, active: mi.Bool) -> list:
        found: dict = {}
        for group in self.groups:
            found |= group.at_world(p, active)
        return [
            found[i] if i in found else f.at_world(p, active) for i, f in enumerate(self.fields)
        ]


def _inner(field: GridField) -> Grid:
    return field.inner if isinstance(field, RootField) else field.grid


def _together(fields: list[GridField]) -> bool:
    first = _inner(fields[0])
    return all(_inner(f).shared(first) is first for f in fields[1:])


class Group:
    """Fields of one grid in `Packets`."""

    @staticmethod
    def words(fields: list[GridField]) -> int:
        """Floats per voxel; three channels below 1 beside others take two."""
        total = sum(f.channels for f in fields)
        fractions = [f for f in fields if _is_fraction(f)]
        return total - len(fractions) if total > WIDTH else total

    def __init__(self, fields: list[Field], members: list[int]) -> None:
        self.members = [(i, fields[i]) for i in members]
        used = [f for _, f in self.members]
        self.grid = _inner(used[0])
        extended = any(isinstance(f, RootField) for f in used)
        extension = Extension(self.grid) if extended else None
        self.shift = 1 if extended else 0
        halved = sum(f.channels for f in used) > WIDTH
        self.halved = [halved and _is_fraction(f) for f in used]

        def planes(index: mi.UInt32) -> list[mi.Float]:
            values = []
            for field, half in zip(used, self.halved, strict=True):
                own = extended and not isinstance(field, RootField)
                voxel = dr.gather(mi.UInt32, extension.inside, index) if own else index
                n = field.channels
                channels = [dr.gather(mi.Float, field.data, voxel * n + c) for c in range(n)]
                channels = [c * field.scale for c in channels]
                values += _halves(channels) if half else channels
            return values

        self.packets = Packets(
            extension.grid if extended else self.grid, planes, self._decode if halved else None
        )

    def _decode(self, words: list[mi.Float]) -> list[mi.Float]:
        values = []
        for (_, field), half in zip(self.members, self.halved, strict=True):
            n = 2 if half else field.channels
            own, words = words[:n], words[n:]
            values += _fractions(own) if half else own
        return values

    def at_world(self, p: mi.Point3f, active: mi.Bool) -> dict:
        values = self.packets.at(self.grid.coordinates.point(p) + self.shift, active)
        found = {}
        for i, field in self.members:
            own, values = values[: field.channels], values[field.channels :]
            if isinstance(field, RootField):
                own = [dr.square(v) for v in own]
            found[i] = own[0] if field.channels == 1 else mi.Color3f(own)
        return found


def _is_fraction(field: GridField) -> bool:
    return field.channels == 3 and not isinstance(field, RootField) and field.maximum <= 1.0001


def _halves(channels: list[mi.Float]) -> list[mi.Float]:
    """Three numbers in [0, 1] as two words, each to 16 bits: right to 8e-6."""
    a, b, c = (mi.UInt32(dr.clip(v, 0, 1) * 65535 + 0.5) for v in channels)
    return [dr.reinterpret_array(mi.Float, w) for w in (a | (b << 16), c)]


def _fractions(words: list[mi.Float]) -> list[mi.Float]:
    """The inverse of `_halves`."""
    first, second = (dr.reinterpret_array(mi.UInt32, w) for w in words)
    return [mi.Float(mi.Int32(v)) * (1 / 65535) for v in (first & 0xFFFF, first >> 16, second)]
