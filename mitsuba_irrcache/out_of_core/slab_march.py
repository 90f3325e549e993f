"""Ray marching of volumes in files, through slabs across z from front to back.

Radiance and transmittance are passed on from slab to slab. Every step of a ray is made in the slab
in which it ends. First the rays that run upwards cross the slabs in ascending order, then the
others in descending order. Slabs that no ray crosses are not read.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.conservative import conserving
from mitsuba_irrcache.grids.fields import ConstantField, Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.packed_fields import AlongRay, Lookups, PackedGroup, Packets
from mitsuba_irrcache.grids.root_field import Extension, extrapolated
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.out_of_core.brick_file import BrickFile
from mitsuba_irrcache.out_of_core.slabs import Slab, even_slabs
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.render.raymarch import MarchedPart, Projection

#: Number of slices on either side of a slab on which lookups in it depend: by interpolation, by
#: `conserving`, and by the extrapolation beyond the border.
HALO = 4
#: Memory per voxel of a slab while it is packed, for each value of the voxel [bytes].
BYTES = 40
#: Largest and smallest number of slices of a slab; thinner slabs would consist mostly of halo.
MOST_SLICES, FEWEST_SLICES = 128, 8


class MappedIrradiance:
    """The irradiance in a file, with the interface that `Projection` needs.

    It is the product of the ``values`` and, if these have one channel, of ``colour`` (channels).
    """

    def __init__(self, values: BrickFile, colour: np.ndarray, grid: Grid) -> None:
        self._values, self.inner = values, grid
        self.extension = Extension(grid)
        self.grid = self.extension.grid
        self._factors = [dr.opaque(mi.Float, float(factor)) for factor in colour]
        if values.channels == 1 and np.ptp(colour) == 0:
            self._factors = self._factors[:1]
        self.channels = len(self._factors)
        #: an upper bound, set by `measure`
        self.maximum = 0.0

    def measure(self, slabs: Sequence[Slab]) -> None:
        """Compute the ``maximum``, slab by slab."""
        largest = 0.0
        for slab in slabs:
            window = _Window(self.inner, slab)
            roots = self.roots(window)
            first, voxels = window.first_voxel * self.channels, window.voxels * self.channels
            place = dr.arange(mi.UInt32, voxels) + dr.opaque(mi.UInt32, first)
            largest = max(largest, float(dr.max(dr.gather(mi.Float, roots, place))[0]))
        self.maximum = largest**2

    def roots(self, window: _Window) -> mi.Float:
        """Return the square roots in the extended grid of a window, see `IrradianceCache.field`."""
        (_, ny, nx), sub = self.inner.shape, window.grid
        values = mi.Float(self._values.read((window.lower, 0, 0), (window.upper, ny, nx)).ravel())
        place = dr.arange(mi.UInt32, sub.voxel_count * self.channels)
        if self._values.channels == self.channels > 1:
            channel = place % self.channels
        else:
            place, channel = place // self.channels, place % self.channels
        factor = self._factors[0]
        for c in range(1, self.channels):
            factor = dr.select(channel == c, self._factors[c], factor)
        roots = dr.sqrt(dr.gather(mi.Float, values, place) * factor)
        known = dr.opaque(mi.Bool, True, sub.voxel_count)
        return extrapolated(
            window.extension, conserving(sub, roots, known, self.channels), self.channels
        )


class _Window:
    """The slices of the extended grid that lookups in a slab read.

    Their values follow from the slices of the grid itself from ``lower`` up to ``upper``.
    """

    def __init__(self, grid: Grid, slab: Slab) -> None:
        slices = grid.shape[0]
        #: slices of the extended grid
        self.first, self.end = max(slab[0] - 1, 0), min(slab[1] + 1, slices + 2)
        self.lower, self.upper = max(0, self.first - HALO), min(slices, self.end + HALO - 1)
        self.grid = Grid((self.upper - self.lower, *grid.shape[1:]), np.eye(4))
        self.extension = Extension(self.grid)
        layer = self.extension.grid.shape[1] * self.extension.grid.shape[2]
        #: index of the first voxel of the window in the extended grid, and its number of voxels
        self.first_voxel = (self.first - self.lower) * layer
        self.voxels = (self.end - self.first) * layer


class _WindowGroup(PackedGroup):
    """The fields in a window of a volume, packed as `PackedGroup` packs them."""

    def __init__(
        self,
        grid: Grid,
        window: _Window,
        fields: list[tuple[int, MappedField | MappedIrradiance, float]],
    ) -> None:
        self.grid, self._shift = grid, 1
        self.members = [(i, f.channels, isinstance(f, MappedIrradiance)) for i, f, _ in fields]
        arrays, largest = [], []
        for _, field, limit in fields:
            most = min(field.maximum, limit)
            if isinstance(field, MappedIrradiance):
                arrays.append(field.roots(window))
                largest += [most**0.5] * field.channels
            else:
                arrays.append(field.values(window.lower, window.upper))
                largest.append(most)

        def planes(index: mi.UInt32) -> list[mi.Float]:
            place, values = index + dr.opaque(mi.UInt32, window.first_voxel), []
            for (_, field, _), array in zip(fields, arrays, strict=True):
                n = field.channels
                if isinstance(field, MappedIrradiance):
                    values += [dr.gather(mi.Float, array, place * n + c) for c in range(n)]
                else:
                    values.append(dr.gather(mi.Float, array, window.extension.inside(place)))
            return values

        extended = Extension(grid).grid
        self.packets = Packets(extended, planes, largest, (window.first, window.end))


class _SlabLookups(Lookups):
    """Lookups in the current window, see `enter`."""

    def __init__(self, grid: Grid, fields: list, limits: Sequence[float]) -> None:
        self._grid = grid
        members = list(enumerate(zip(fields, limits, strict=True)))
        self._mapped = [(i, f, limit) for i, (f, limit) in members if _is_mapped(f)]
        self._others = {i: f for i, (f, _) in members if isinstance(f, ConstantField)}
        rest = [(i, f, limit) for i, (f, limit) in members if not _is_mapped(f)]
        self._in_memory = [PackedGroup([m]) for m in rest if m[0] not in self._others]
        self.groups: list[PackedGroup] = []

    def enter(self, slab: Slab) -> None:
        """Read the window of a slab, and make it the current one."""
        self.groups = []  # frees the memory of the one before
        window = _Window(self._grid, slab)
        self.groups = [_WindowGroup(self._grid, window, self._mapped), *self._in_memory]


def _is_mapped(field: Field | MappedField | MappedIrradiance) -> bool:
    return isinstance(field, (MappedField, MappedIrradiance))


class _Slab(MarchedPart):
    """The part of rays in a slab, which ends at ``bound`` on the z axis.

    Rays run along z if ``ascending``, otherwise against it.
    """

    def __init__(self, state: tuple | None, bound: float, ascending: bool) -> None:
        super().__init__(state)
        self._bound, self._ascending = dr.opaque(mi.Float, bound), ascending

    def holds(self, fields: AlongRay, t: mi.Float) -> mi.Bool:
        origin, direction = fields._group_rays[0]
        z = dr.fma(direction.z, t, origin.z)
        return z < self._bound if self._ascending else z >= self._bound


class SlabProjection(Projection):
    """Ray marching of a medium whose fields stay in files, within about ``memory`` bytes.

    These are the extinction, the irradiance, and the albedo unless it is constant.
    """

    def __init__(
        self,
        medium: MediumGrid,
        irradiance: MappedIrradiance,
        quadrature: str,
        step: float,
        memory: int,
    ) -> None:
        grid = irradiance.inner
        (slices, ny, nx), values = irradiance.grid.shape, 2 + irradiance.channels
        thickness = int(memory // (BYTES * values * ny * nx)) - 2 * HALO - 2
        thickness = int(np.clip(thickness, FEWEST_SLICES, MOST_SLICES))
        #: slabs of the extended grid
        self._slabs = list(even_slabs(slices, thickness))
        irradiance.measure(self._slabs)

        def lookups(fields: list, limits: Sequence[float]) -> Lookups:
            return _SlabLookups(grid, fields, limits)

        super().__init__(medium, irradiance, quadrature, step, lookups=lookups)
        self._grid = grid

    def march(
        self,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        background: mi.Spectrum,
        offset: mi.Float,
        active: mi.Bool,
    ) -> tuple:
        """March as `Projection.march`, slab by slab."""
        active = mi.Bool(active) & (near < far)
        dr.eval(ray, near, far, background, offset, active)
        upwards = self._grid.coordinates.vector(ray.d).z >= 0
        radiance, transmittance = mi.Spectrum(0), mi.Spectrum(1)
        for ascending in (True, False):
            chosen = active & (upwards == ascending)
            if not dr.any(chosen)[0]:
                continue
            rays = ray, near, far, background, offset, chosen
            found = self._march_one_way(rays, ascending)
            radiance, transmittance = (
                dr.select(chosen, new, old)
                for new, old in zip(found, (radiance, transmittance), strict=True)
            )
            dr.eval(radiance, transmittance)
        return radiance, transmittance, [], mi.Spectrum(0)

    def _march_one_way(self, rays: tuple, ascending: bool) -> tuple:
        """Return radiance and transmittance of rays that all run upwards, or all downwards."""
        ray, near, *_, active = rays
        entry = (self._grid.coordinates.point(ray(near)).z + 1) * mi.Float(1 if ascending else -1)
        entry = abs(float(dr.min(dr.select(active, entry, dr.inf))[0]))
        slabs = self._slabs if ascending else self._slabs[::-1]
        state, found = None, None
        for number, slab in enumerate(slabs):
            is_last = number == len(slabs) - 1
            # Rays that enter in a slab are at least a rounding error beyond its first face.
            is_before = slab[1] < entry - 1 if ascending else slab[0] > entry + 1
            if is_before and not is_last:
                continue
            bound = slab[1] if ascending else slab[0]
            if is_last:  # with all that lies beyond the grid
                bound = np.inf if ascending else -np.inf
            self.lookups.enter(slab)
            part = _Slab(state, bound, ascending)
            scattered, transmittance, *_ = super().march(*rays, part)
            dr.eval(scattered, transmittance, part.state)
            state, found = part.state, (scattered, transmittance)
            if not dr.any(state.active)[0]:
                break
        self.lookups.groups = []
        return found
