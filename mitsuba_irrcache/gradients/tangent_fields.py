"""Fields of changes for forward mode: where reverse mode adds derivatives to fields, forward mode
reads changes of these fields at the same positions, and adds up the products.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.parameters import ALBEDO, EMISSION, SIGMA_T
from mitsuba_irrcache.gradients.scattering import Components
from mitsuba_irrcache.grids.fields import ConstantField, Field
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


@dataclass(eq=False)
class MediumChanges:
    """Changes of a medium and of its fluence along a change of the parameters.

    Attributes:
        fields: changes of the fields of the medium as it is rendered, by role.
        g: change of the mean cosine of the phase function.
        collisions: changes of what camera rays that collide in the voxels read; None for none.
        original: change of the extinction before delta-M scaling, which attenuates narrow sources
            behind the medium; None for none.
    """

    fields: dict[str, Field]
    g: float = 0.0
    collisions: ChangesOfVoxels | None = None
    original: Field | None = None

    @property
    def sigma_t(self) -> Field | None:
        """The change of the extinction."""
        return self.fields.get(SIGMA_T)

    def without_scattering(self) -> MediumChanges:
        """Return the changes for rays into which the medium scatters nothing."""
        own = {role: field for role, field in self.fields.items() if role != ALBEDO}
        return MediumChanges(own)

    def attenuation(self) -> MediumChanges:
        """Return the changes for radiance that the medium only attenuates."""
        return MediumChanges({SIGMA_T: self.sigma_t} if self.sigma_t is not None else {})

    def readers(self, width: int) -> CameraReaders:
        """Return sums for ``width`` rays, 0 at first, of the products with these changes."""
        zero = mi.Spectrum(dr.zeros(mi.Float, width))
        readers = CameraReaders()
        for role in (SIGMA_T, ALBEDO, EMISSION):
            if role in self.fields:
                setattr(readers, role, FieldReader(mi.Spectrum(zero), self.fields[role]))
        if self.collisions is not None:
            readers.collisions = VoxelReader(mi.Spectrum(zero), self.collisions)
        if self.original is not None:
            readers.unscattered = FieldReader(mi.Spectrum(zero), self.original)
        if self.g:
            readers.g = FieldReader(mi.Spectrum(zero), ConstantField(np.array([self.g])))
        return readers


class AttachedParameters:
    """The parameters ``keys`` of emitters and BSDFs in Dr.Jit's graph, and ``changes`` of all
    parameters, by key.
    """

    def __init__(
        self, params: mi.SceneParameters, keys: Sequence[str], changes: Mapping[str, object]
    ) -> None:
        self._params, self._keys, self._changes = params, keys, changes
        self._pairs: list[tuple] = []

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Evaluate emitters and BSDFs with variables that nothing else in the graph depends on.

        Dr.Jit would propagate to all that does. Plugins copy tensors themselves.
        """
        with dr.resume_grad():
            # Copies: Mitsuba returns references to variables of plugins.
            values = [(key, self._params[key]) for key in self._keys]
            kept = {key: type(value)(value) for key, value in values}
        try:
            for key, value in kept.items():
                variable = value
                if not dr.is_tensor_v(value):
                    with dr.resume_grad():
                        variable = type(value)(dr.detach(value))
                        dr.enable_grad(variable)
                        self._params[key] = variable
                self._pairs.append((variable, self._changes[key]))
            yield
        finally:
            with dr.resume_grad():
                for key, value in kept.items():
                    if not dr.is_tensor_v(value):
                        self._params[key] = value
            self._pairs = []

    def change_of(self, value: mi.Spectrum) -> mi.Spectrum:
        """Return the change of a ``value`` that depends on the parameters."""
        if not dr.grad_enabled(value):
            return mi.Spectrum(0)
        self._set(1)
        found = mi.Spectrum(dr.forward_to(value, flags=dr.ADFlag.ClearNone))
        dr.eval(found)
        # Plugins keep variables that depend on the parameters, such as the padded texels of a
        # texture, in which the gradients of further evaluations would add up.
        self._set(-1)
        dr.forward_to(value, flags=dr.ADFlag.ClearNone)
        self._set(1)
        return found

    def _set(self, sign: int) -> None:
        for parameter, change in self._pairs:
            dr.set_grad(parameter, change * sign)


class SceneChanges(NamedTuple):
    """Changes of the ``media`` of a scene, and of its emitters and BSDFs."""

    media: list[MediumChanges]
    attached: AttachedParameters


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

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to read."""
        return all(reader is None for reader in vars(self).values())
