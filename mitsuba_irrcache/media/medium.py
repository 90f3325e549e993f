"""A participating medium on grids: extinction, albedo, extent, and majorants."""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.media.phase import Phase


class MediumGrid:
    """A medium with ``sigma_t`` [1/scene unit] and ``albedo`` inside ``boundary`` and ``bbox``.

    ``bbox`` is a world box, or None if the medium is not clipped.
    """

    def __init__(
        self,
        sigma_t: Field,
        albedo: Field,
        boundary: Boundary,
        bbox: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self.sigma_t = sigma_t
        self.albedo = albedo
        self.boundary = boundary
        self.bbox = bbox
        #: volumetric emission, or None (see `emission`)
        self.emission: object | None = None
        #: whether ``boundary`` is the exact shape of the medium, not a bounding shape
        self.has_exact_boundary = True
        #: None for isotropic scattering
        self.phase: Phase | None = None
        #: exponent that converts the transmittance of the truncated medium to the original one
        #: (see `delta_m`)
        self.unscattered_exponent = 1.0
        self._with_peak: MediumGrid | None = None
        #: identifier of the medium
        self.name = ""
        #: pointer to Mitsuba's medium, and the other objects of the scene; None if the medium is
        #: isolated and isotropic
        self.pointer: mi.MediumPtr | None = None
        self.surroundings: object | None = None
        #: whether the scene has no other medium, no surface and no area emitter
        self.is_isolated = True
        self.macrocells = Macrocells.build(sigma_t, boundary)
        if bbox is not None:
            corners = [mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in p)) for p in bbox]
            self._clip = mi.BoundingBox3f(*corners)

    @property
    def frame(self) -> np.ndarray:
        """``to_world`` of the smallest known unit cube around the medium: extent of its cache."""
        frames = [self.boundary.frame]
        if self.bbox is not None:
            frames.append(axis_aligned(*self.bbox))
        return min(frames, key=lambda m: abs(np.linalg.det(m[:3, :3])))

    @property
    def channels(self) -> int:
        """3 for coloured extinction or albedo, else 1."""
        return max(self.sigma_t.channels, self.albedo.channels)

    @property
    def homogeneous(self) -> bool:
        return self.sigma_t.grid is None

    @property
    def shortest_edge(self) -> float:
        """Shortest edge of an extinction voxel [scene units]; infinite for a homogeneous medium."""
        return dr.inf if self.homogeneous else float(self.sigma_t.grid.voxel_size.min())

    @property
    def with_peak(self) -> MediumGrid:
        """The medium before truncation of its forward peak."""
        return self._with_peak or self

    def store_untruncated(self) -> None:
        """Store a copy of the untruncated medium."""
        self._with_peak = copy(self)

    def contains(self, p: mi.Point3f) -> mi.Bool:
        """Whether points lie in the medium."""
        inside = self.boundary.surrounds(p)
        return inside if self.bbox is None else inside & self._clip.contains(p)

    def fills(self, grid: Grid) -> bool:
        """Whether the medium fills the whole box covered by ``grid``."""
        same = np.abs(self.boundary.frame - grid.to_world).max() <= 1e-6 * grid.side_lengths.max()
        return self.boundary.kind == "box" and self.bbox is None and bool(same)

    def intersect(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Whether the line of a ray intersects the medium, and its distances of entry and exit."""
        hit, near, far = self.boundary.intersect(ray)
        if self.bbox is not None:
            _, box_near, box_far = self._clip.ray_intersect(ray)
            near, far = dr.maximum(near, box_near), dr.minimum(far, box_far)
        return hit & (near < far), near, far


def axis_aligned(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return ``to_world`` of the unit cube for an axis-aligned world box."""
    frame = np.diag([*(upper - lower), 1.0])
    frame[:3, 3] = lower
    return frame
