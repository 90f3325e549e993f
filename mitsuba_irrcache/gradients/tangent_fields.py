"""Fields of changes for forward mode: where reverse mode adds derivatives to fields, forward mode
reads changes of these fields at the same positions, and adds up the products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.scattering import Components
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.grid import Grid


@dataclass
class FieldReader:
    """The transpose of `GridSplat` and `ConstantSplat`.

    Attributes:
        total: sum of the products, by channel of the radiance.
        field: the changes.
    """

    total: mi.Spectrum
    field: Field

    @property
    def channels(self) -> int:
        """Number of channels that are kept apart."""
        return dr.size_v(mi.Spectrum)

    def add(self, p: mi.Point3f, values: Sequence[mi.Float], active: mi.Bool) -> None:
        """Multiply one value for each channel by the change of the field at world positions."""
        change = mi.Spectrum(self.field.at_world(p, active)) * mi.Spectrum(*values)
        self.total += dr.select(active, change, 0)


class ChangesOfVoxels:
    """Changes of ``channels``, each a list of components with one value per voxel of ``grid``."""

    def __init__(self, grid: Grid, channels: list[Components]) -> None:
        self.grid, self.components = grid, len(channels[0])
        self.data = interleaved([values for own in channels for values in own], grid.voxel_count)
        dr.eval(self.data)

    def read(self, p: mi.Point3f, number: int, active: mi.Bool) -> mi.Float:
        """Return component ``number``, counted over all channels, in the voxel around ``p``."""
        at = [
            dr.clip(mi.Int32(dr.floor(clipped(x, -1.0, mi.Float(n)))), 0, n - 1)
            for x, n in zip(self.grid.coordinates.point(p), self.grid.sides, strict=True)
        ]
        count = dr.width(self.data) // self.grid.voxel_count
        return dr.gather(mi.Float, self.data, self.grid.index(*at) * count + number, active)


@dataclass
class VoxelReader:
    """The transpose of `VoxelSums`; attributes as those of `FieldReader`."""

    total: mi.Spectrum
    field: ChangesOfVoxels

    def add(self, p: mi.Point3f, values: Sequence[mi.Float], active: mi.Bool) -> None:
        """Multiply the components of each channel by their changes in the voxels around ``p``."""
        for number, value in enumerate(values):
            change = dr.select(active, value * self.field.read(p, number, active), 0)
            self.total[number // self.field.components] += change


@dataclass
class CameraReaders:
    """Products that the replay of camera rays adds up; attributes as those of `CameraSplats`."""

    sigma_t: FieldReader | None = None
    albedo: FieldReader | None = None
    collisions: VoxelReader | None = None
    emission: FieldReader | None = None
    unscattered: FieldReader | None = None
    g: FieldReader | None = None

    def total(self) -> mi.Spectrum:
        """Return the sum of all products."""
        found = vars(self).values()
        return sum((reader.total for reader in found if reader is not None), mi.Spectrum(0))
