"""A scalar volume with its placement in the world: what readers return and importers consume."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError


@dataclass(frozen=True)
class VolumeData:
    """A regular grid of scalar values, placed in the world.

    Attributes:
        values: shape ``(z, y, x)``, any real dtype; values at voxel centres.
        spacing: distance between voxel centres along x, y, z in world units (mm for medical data).
        origin: world position of the centre of voxel ``(0, 0, 0)``.
        direction: 3x3, columns are the world directions of the grid's x, y and z axes.
        unit: the unit of the values, e.g. ``"HU"``; empty if it is unknown.
        length_unit: the unit of ``spacing`` and ``origin``, e.g. ``"mm"``; empty if it is unknown.
        source: description of the origin of the values, for summaries and messages.

    Raises:
        IrrcacheError: a shape, spacing, origin or direction that does not define a grid.
    """

    values: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: np.ndarray = field(default_factory=lambda: np.eye(3))
    unit: str = ""
    length_unit: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", np.asarray(self.direction, dtype=np.float64))
        object.__setattr__(self, "spacing", tuple(float(s) for s in self.spacing))
        object.__setattr__(self, "origin", tuple(float(o) for o in self.origin))
        if self.values.ndim != 3 or self.values.size == 0:
            raise IrrcacheError(
                f"volume {self.source!r} has shape {self.values.shape}; "
                "give a non-empty array (z, y, x)"
            )
        _check_placement(self)

    @property
    def size(self) -> tuple[int, int, int]:
        """Return the voxel counts along x, y, z."""
        z, y, x = self.values.shape
        return x, y, z

    @property
    def physical_size(self) -> tuple[float, float, float]:
        """Return the edge lengths of the grid, outer half voxels included, along x, y, z."""
        x, y, z = (n * s for n, s in zip(self.size, self.spacing, strict=True))
        return x, y, z

    @property
    def index_to_world(self) -> np.ndarray:
        """Return the 4x4 matrix from continuous index ``(x, y, z)`` to world position.

        Integer indices are voxel centres.
        """
        matrix = np.eye(4)
        matrix[:3, :3] = self.direction * np.asarray(self.spacing)
        matrix[:3, 3] = self.origin
        return matrix

    @property
    def to_world(self) -> np.ndarray:
        """Return the 4x4 matrix from the unit cube to the world, as in ``gridvolume``.

        Voxel centres lie at ``(i + 0.5) / n``, so the cube begins half a voxel before the first.
        """
        unit_to_index = np.diag([*self.size, 1.0])
        unit_to_index[:3, 3] = -0.5
        return self.index_to_world @ unit_to_index


def _check_placement(volume: VolumeData) -> None:
    """Raise an error for a placement that is not an invertible affine map."""
    if len(volume.spacing) != 3 or not all(np.isfinite(s) and s > 0 for s in volume.spacing):
        raise IrrcacheError(
            f"volume {volume.source!r} has voxel spacing {volume.spacing}; "
            "give three positive lengths (x, y, z)"
        )
    if len(volume.origin) != 3 or not np.all(np.isfinite(volume.origin)):
        raise IrrcacheError(
            f"volume {volume.source!r} has origin {volume.origin}; give three finite coordinates"
        )
    direction = volume.direction
    if direction.shape != (3, 3) or not np.all(np.isfinite(direction)):
        raise IrrcacheError(
            f"volume {volume.source!r} has direction {direction.tolist()}; give a finite 3x3 matrix"
        )
    if abs(np.linalg.det(direction)) < 1e-6:
        raise IrrcacheError(
            f"volume {volume.source!r} has a singular direction {direction.tolist()}; "
            "give three independent axes"
        )
