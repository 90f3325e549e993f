"""A first pass over the file of a volume: bounds of its values, invalid values, and a digest."""

from __future__ import annotations

import hashlib
from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Affine, Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.out_of_core.volume_files import VolumeFile


class MappedField:
    """A field of grey values at the voxel centres of ``grid``, which stay in a file.

    ``scale`` multiplies every value, as in `GridField`; ``digest`` is that of the values. Raises
    IrrcacheError for values that are negative or not finite.
    """

    channels = 1

    def __init__(self, file: VolumeFile, grid: Grid, scale: float, what: str) -> None:
        self.file, self.grid, self.factor = file, grid, scale
        self.scale = dr.opaque(mi.Float, scale)
        #: voxels along an edge of a macrocell
        self._cell = max(4, -(-max(grid.shape) // 64))
        least, largest, self.digest = self._survey(what)
        self.maximum = float(largest.max()) * scale
        self.largest = float(np.float32(largest.max()) * np.float32(scale))
        self._ends = least, largest

    def macrocells(self) -> Macrocells:
        """Create the macrocells of an extinction, see `Macrocells.build`."""
        least, largest = (mi.Float(bounds.ravel()) for bounds in self._ends)
        shrink = np.diag([1 / self._cell] * 3 + [1.0])
        least, largest = least * self.scale * (1 - 1e-6), largest * self.scale * (1 + 1e-6)
        dr.eval(least, largest)
        coordinates = Affine(shrink @ self.grid.coordinates.matrix)
        return Macrocells(largest, least, self._ends[0].shape, coordinates)

    def values(self, first: int, last: int) -> mi.Float:
        """Return the scaled values of slices ``first`` to ``last - 1``, x fastest."""
        return mi.Float(self.file.read(first, last).ravel()) * self.scale

    def _survey(self, what: str) -> tuple[np.ndarray, np.ndarray, str]:
        """Return the minimum and maximum over each macrocell, extended by one voxel, and the
        SHA-256 of all values.
        """
        size, slices = self._cell, self.grid.shape[0]
        found, sha = [], hashlib.sha256()
        for first in range(0, slices, size):
            lower, upper = max(first - 1, 0), min(first + size + 1, slices)
            values = self.file.read(lower, upper)
            sha.update(values[first - lower : first - lower + size].data)
            ends = values.min(axis=0), values.max(axis=0)
            if not (ends[0].min() >= 0 and np.isfinite(ends[1]).all()):
                _refuse(values, lower, what)
            found.append([_windows(end, size, np_reduce) for end, np_reduce in zip(
                ends, (np.minimum, np.maximum), strict=True
            )])  # fmt: skip
        self.file.require_unchanged()
        least, largest = (np.stack(bounds) for bounds in zip(*found, strict=True))
        return least, largest, sha.hexdigest()


def _windows(values: np.ndarray, size: int, smaller: np.ufunc) -> np.ndarray:
    """Reduce a slice to windows of ``size`` + 2 values along both axes."""
    for axis in range(2):
        side = values.shape[axis]
        starts = np.arange(0, side, size)
        indices = [np.clip(starts + k, 0, side - 1) for k in range(-1, size + 1)]
        values = reduce(smaller, (np.take(values, i, axis=axis) for i in indices))
    return values


def _refuse(values: np.ndarray, first: int, what: str) -> None:
    """Raise IrrcacheError that names the first invalid value of these slices."""
    z, y, x = (int(i) for i in np.argwhere(~((values >= 0) & np.isfinite(values)))[0])
    raise IrrcacheError(
        f"irrcache: the {what} has values that are negative or not finite, the first at voxel "
        f"(z, y, x) = ({z + first}, {y}, {x}): {values[z, y, x]:g}. Clean the data first "
        "(numpy.nan_to_num, numpy.clip)."
    )
