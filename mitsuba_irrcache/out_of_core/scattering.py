"""All orders of scattering in volumes in files.

A coarse copy of the medium, which fits into memory, is solved for all orders by multigrid. The
scattered irradiance of the copy, interpolated, and the uncollided irradiance of the whole volume
are the source of a sweep of the whole volume. This is a source iteration phi <- A phi + b
(docs/primer, eq. 4.9) whose initial error is that of the coarse grid. Further iterations follow
while the irradiance changes by more than `NEGLIGIBLE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.out_of_core.brick_file import EDGE, BrickFile
from mitsuba_irrcache.out_of_core.slab_sweep import SlabSweep
from mitsuba_irrcache.out_of_core.slabs import even_slabs
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium, CacheSettings
from mitsuba_irrcache.pipeline.defaults import choose_solver
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.solvers.discrete_ordinates.antidiffusion import Antidiffusion
from mitsuba_irrcache.solvers.discrete_ordinates.layout import voxel_and_channel

#: Largest number of voxels along a side of the coarse copy.
COARSE = 128
#: Largest number of passes over the whole volume; root mean square of the relative change of the
#: irradiance, weighted by collisions, below which no other pass follows.
MOST_PASSES, NEGLIGIBLE = 3, 0.01

Progress = Callable[[int, int], None]


def coarse_medium(medium: MediumGrid) -> MediumGrid:
    """Create the coarse copy of a medium whose extinction is in a file.

    Its values are means over blocks of voxels; those of the albedo are weighted by extinction.
    """
    sigma_t, albedo = medium.sigma_t, medium.albedo
    shape = sigma_t.grid.shape
    factor = -(-max(shape) // COARSE)
    sides = [-(-n // factor) for n in shape]
    starts = [np.arange(m) * n // m for n, m in zip(shape, sides, strict=True)]
    counts = [np.diff([*s, n]) for s, n in zip(starts, shape, strict=True)]
    size = counts[0][:, None, None] * counts[1][:, None] * counts[2]
    sums = np.zeros((2, *sides), np.float64)
    for z, (first, count) in enumerate(zip(starts[0], counts[0], strict=True)):
        values = sigma_t.file.read(first, first + count)
        sums[0, z] = _block_sums(values, starts)
        if isinstance(albedo, MappedField):
            sums[1, z] = _block_sums(values * albedo.file.read(first, first + count), starts)
    grid = Grid(tuple(sides), sigma_t.grid.to_world)
    extinction = mi.Float((sums[0] / size).astype(np.float32).ravel())
    changes = {"sigma_t": GridField(grid, extinction, 1, sigma_t.factor)}
    if isinstance(albedo, MappedField):
        mean = sums[1] / np.where(sums[0] > 0, sums[0], 1)
        changes["albedo"] = GridField(grid, mi.Float(mean.astype(np.float32).ravel()), 1)
    return medium.replaced(**changes)


def _block_sums(values: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    rows = np.add.reduceat(values.sum(axis=0, dtype=np.float64), starts[1], axis=0)
    return np.add.reduceat(rows, starts[2], axis=1)


class ScatteredIrradiance:
    """Scattered irradiance in ``medium``, the only one of a scene.

    It is computed from the ``uncollided`` irradiance in a file; both are in units of ``colour``
    (channels of the image).

    ``ordinates`` are directions, weights and offsets of the passes over the whole volume.
    """

    def __init__(
        self,
        sweep: SlabSweep,
        medium: MediumGrid,
        uncollided: BrickFile,
        colour: np.ndarray,
        ordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
    ) -> None:
        self._sweep, self._medium, self._uncollided = sweep, medium, uncollided
        self._colour, self._ordinates = colour, ordinates
        self._channels = uncollided.channels
        self._grid: Grid = medium.sigma_t.grid
        self._initial: GridField | None = None

    def solve(
        self, scene: mi.Scene, description: SceneDescription, settings: CacheSettings
    ) -> None:
        """Solve for all orders on the coarse grid, with these settings of a cache."""
        coarse = coarse_medium(self._medium)
        settings = replace(settings, resolution=max(coarse.sigma_t.grid.shape))
        solver = choose_solver(scene, coarse, "sweep", -1, settings.resolution)
        part = CachedMedium(scene, description, coarse, settings, solver, "")
        part.start(scene)
        part.refine(scene, 0, False, None)
        found = np.array(part.cache.scattered)
        if self._channels == 1 and found.shape[3] > 1:
            brightest = int(np.argmax(self._colour))
            found = found[..., brightest : brightest + 1] / self._colour[brightest]
        data = mi.Float(np.ascontiguousarray(found, np.float32).ravel())
        self._initial = GridField(part.cache.grid, data, self._channels)

    def find(self, progress: Progress) -> BrickFile:
        """Return the file of the scattered irradiance, after one or more passes."""
        before: BrickFile | None = None
        for number in range(MOST_PASSES):
            source = self._source(f"source-{number}", before)
            name = f"scattered-{number}"
            after = self._sweep.scattered(name, self._ordinates, source, progress)
            source.close()
            change = self._change(before, after)
            if before is not None:
                before.close()
            before = after
            mi.Log(
                mi.LogLevel.Info,
                f"irrcache: pass {number + 1} over the whole volume has changed the irradiance by "
                f"{change:.2%}",
            )
            if change <= NEGLIGIBLE:
                break
        else:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: the last of {MOST_PASSES} passes over the whole volume still changed "
                f"the irradiance by {change:.1%}",
            )
        return before

    def _source(self, name: str, before: BrickFile | None) -> BrickFile:
        """Return the scattered radiance per optical depth, in a working file."""
        file = self._sweep.file(name, channels=self._channels)
        slices, ny, nx = self._grid.shape
        for lower, upper in self._boxes():
            # Antidiffusive fluxes need two slices more on either side.
            first, last = max(lower[0] - 2, 0), min(upper[0] + 2, slices)
            box = [first, 0, 0], [last, ny, nx]
            scattered = self._scattered(*box, before)
            irradiance = self._uncollided.read(*box).reshape(scattered.shape) + scattered
            source = irradiance * self._albedo(*box) * np.float32(1 / (4 * np.pi))
            source = self._antidiffused(source, self._sweep.extinction(*box))
            file.write(lower, source[lower[0] - first : upper[0] - first])
        if isinstance(self._medium.albedo, MappedField):
            self._medium.albedo.file.require_unchanged()  # before anything is computed from it
        return file

    def _antidiffused(self, source: np.ndarray, sigma_t: np.ndarray) -> np.ndarray:
        """Compensate the numerical diffusion of a source (z, y, x, channel) in a box."""
        *shape, channels = source.shape
        size = self._grid.voxel_size * np.array(shape[::-1])
        box = Grid(tuple(shape), np.diag([*size, 1.0]))
        extinction = mi.Float(np.ascontiguousarray(sigma_t, np.float32).ravel())
        every = dr.arange(mi.UInt32, box.voxel_count)
        values = mi.Float(np.ascontiguousarray(source, np.float32).ravel())
        place, channel = voxel_and_channel(box.voxel_count, channels)
        compensation = Antidiffusion(box, extinction, every, lambda voxel: voxel)
        found = compensation.applied(values, place, channels, channel)
        return np.array(found).reshape(source.shape)

    def _boxes(self) -> Iterator[tuple[list[int], list[int]]]:
        """Yield the lower and upper corner (z, y, x) of boxes of slices that fill whole bricks."""
        slices, ny, nx = self._grid.shape
        for first, last in even_slabs(slices, EDGE):
            yield [first, 0, 0], [last, ny, nx]

    def _albedo(self, lower: list[int], upper: list[int]) -> np.ndarray:
        """Return the albedo in a box of whole slices; one value if it is constant."""
        albedo = self._medium.albedo
        if isinstance(albedo, MappedField):
            values = albedo.file.read(lower[0], upper[0]) * np.float32(albedo.factor)
            return values[..., None]
        if isinstance(albedo, ConstantField):
            return np.array(albedo.value, np.float32).ravel()
        return self._evaluated(albedo, lower, upper)

    def _scattered(self, lower: list[int], upper: list[int], known: BrickFile | None) -> np.ndarray:
        if known is None:
            return self._evaluated(self._initial, lower, upper)
        return known.read(lower, upper).reshape(*_shape(lower, upper), self._channels)

    def _evaluated(self, field: GridField, lower: list[int], upper: list[int]) -> np.ndarray:
        """Return a field at the centres of the voxels of a box: (z, y, x, channel)."""
        shape = _shape(lower, upper)
        box = Grid(tuple(shape), np.eye(4))
        at = box.voxel_indices(dr.arange(mi.UInt32, box.voxel_count))
        first = [dr.opaque(mi.Float, n) for n in lower[::-1]]
        place = mi.Point3f(*(mi.Float(a) + b for a, b in zip(at, first, strict=True))) + 0.5
        value = field.at_world(self._grid.world.point(place))
        channels = [value] if field.channels == 1 else list(value)
        return np.stack([np.array(c) for c in channels], axis=-1).reshape(*shape, -1)

    def _change(self, before: BrickFile | None, after: BrickFile) -> float:
        """Return the root mean square of the change over that of the irradiance.

        Both are weighted by extinction.
        """
        change = total = 0.0
        for box in self._boxes():
            new = self._scattered(*box, after)
            weight = self._sweep.extinction(*box)[..., None].astype(np.float32)
            difference = new - self._scattered(*box, before)
            whole = new + self._uncollided.read(*box).reshape(new.shape)
            change += float((weight * np.square(difference)).sum(dtype=np.float64))
            total += float((weight * np.square(whole)).sum(dtype=np.float64))
        return (change / max(total, 1e-300)) ** 0.5


def add(first: BrickFile, second: BrickFile, total: BrickFile) -> BrickFile:
    """Write the sums of two files to a third one, return it, and close the two.

    They do not change, so that this may be done again after an interruption.
    """
    slices, ny, nx = total.shape
    for begin, end in even_slabs(slices, EDGE):
        box = (begin, 0, 0), (end, ny, nx)
        total.write(box[0], first.read(*box) + second.read(*box))
    first.close()
    second.close()
    return total


def _shape(lower: list[int], upper: list[int]) -> list[int]:
    return [b - a for a, b in zip(lower, upper, strict=True)]
