"""A grid of Hounsfield units onto which solids are painted with edges one voxel wide."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mitsuba_irrcache.volumes.phantom.distance import Bounds, Solid
from mitsuba_irrcache.volumes.phantom.texture import texture


@dataclass(frozen=True)
class Tissue:
    """Mean attenuation in HU and the amplitude in HU of the texture around it."""

    mean: float
    grain: float = 0.0


@dataclass(frozen=True)
class Region:
    """A box of a canvas: index slices (z, y, x) and the open grid of its voxel centres in mm."""

    slices: tuple[slice, slice, slice]
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.z.size, self.y.size, self.x.size


class Canvas:
    """A grid over the box from ``lower`` to ``upper`` (x, y, z in mm), first filled with air.

    ``values`` is a float32 array ``(z, y, x)`` in HU at voxel centres. ``edge`` is the width in mm
    of a painted surface: the mean voxel spacing.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        lower: Sequence[float],
        upper: Sequence[float],
        air: Tissue,
    ) -> None:
        counts = shape[::-1]
        self.axes = [
            (low + (np.arange(n) + 0.5) * ((high - low) / n)).astype(np.float32)
            for low, high, n in zip(lower, upper, counts, strict=True)
        ]
        self.edge = float(np.mean(np.subtract(upper, lower) / counts))
        self.values = np.full(shape, air.mean, dtype=np.float32)
        self._texture = texture(self.axes, lower, upper)

    def region(self, bounds: Bounds, margin: float = 0.0) -> Region:
        """Return the voxels whose centres lie within ``bounds`` widened by ``margin`` mm."""
        lower, upper = np.subtract(bounds[0], margin), np.add(bounds[1], margin)
        return self._region(
            [
                slice(*np.searchsorted(axis, [low, high]))
                for axis, low, high in zip(self.axes, lower, upper, strict=True)
            ][::-1]
        )

    def _region(self, slices: Sequence[slice]) -> Region:
        x, y, z = (axis[part] for axis, part in zip(self.axes, slices[::-1], strict=True))
        return Region(tuple(slices), x[None, None, :], y[None, :, None], z[:, None, None])

    def union(
        self, solids: Iterable[Solid], region: Region | None = None
    ) -> tuple[Region, np.ndarray]:
        """Return the signed distance in mm to the union of ``solids``, where they are.

        If a ``region`` is given, the distance is restricted to it. Each solid is evaluated in its
        own bounding box only, and the distance is clamped at ``edge``, beyond which nothing is
        painted.
        """
        solids = list(solids)
        if region is None:
            lower = np.min([solid.bounds()[0] for solid in solids], axis=0)
            upper = np.max([solid.bounds()[1] for solid in solids], axis=0)
            region = self.region((lower, upper), self.edge)
        distance = np.full(region.shape, self.edge, dtype=np.float32)
        for solid in solids:
            box = self.region(solid.bounds(), self.edge).slices
            box = [_intersection(a, b) for a, b in zip(box, region.slices, strict=True)]
            part = self._region(box)
            target = distance[
                tuple(
                    slice(inner.start - outer.start, inner.stop - outer.start)
                    for inner, outer in zip(box, region.slices, strict=True)
                )
            ]
            np.minimum(target, solid.distance(part.x, part.y, part.z, self.edge), out=target)
        return region, distance

    def paint(
        self, region: Region, distance: np.ndarray, tissue: Tissue, softness: float = 1.0
    ) -> None:
        """Paint ``tissue`` where ``distance`` <= 0, blended over ``softness`` times ``edge``."""
        edge = softness * self.edge
        touched = distance < edge / 2
        coverage = np.minimum(0.5 - distance[touched] / edge, 1)
        colour = tissue.mean + tissue.grain * self._texture[region.slices][touched]
        values = self.values[region.slices]
        before = values[touched]
        values[touched] = before + coverage * (colour - before)

    def paint_solids(self, solids: Iterable[Solid], tissue: Tissue) -> None:
        """Paint the union of ``solids`` with ``tissue``."""
        self.paint(*self.union(solids), tissue)

    def paint_shell(
        self, solids: Iterable[Solid], shell: Tissue, core: Tissue, thickness: float
    ) -> None:
        """Paint the union of ``solids`` with ``core`` under a ``shell`` of ``thickness`` mm."""
        region, distance = self.union(solids)
        self.paint(region, distance, shell)
        self.paint(region, distance + np.float32(thickness), core)


def _intersection(first: slice, second: slice) -> slice:
    start = max(first.start, second.start)
    return slice(start, max(start, min(first.stop, second.stop)))
