"""A participating medium on grids: extinction, albedo, extent, and majorants."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.core.jit import opaque_point
from mitsuba_irrcache.grids.boundary import Boundary, intersect_slabs
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.media.emission import Emission
from mitsuba_irrcache.media.phase import ISOTROPIC, Phase


class MediumContext(Immutable):
    """Relation of a medium to the rest of its scene.

    Attributes:
        pointer: Mitsuba's medium, which identifies the medium of a ray. None if rays are not traced
            through the scene's shapes, because the scene has only an isotropic medium in its
            boundary.
        number: index in the scene's list of media.
        others: the other media of the scene in the order of that list, before delta-M scaling.
        is_isolated: whether the scene contains nothing but emitters, this medium and its boundary.
        has_exact_boundary: whether the medium fills its boundary exactly; otherwise the boundary
            is a larger shape that encloses the medium.
        refracts: whether the boundary refracts radiance (a dielectric, not a null interface).
        detail: how much the incident radiance varies with position and direction; SHARP if
            unknown.
        holds_emitters: whether emitting shapes are in the medium or touch it.
        object_sizes: second largest sides of the bounding boxes of surfaces, where these boxes lie
            within that of the medium [scene units].
    """

    def __init__(
        self,
        pointer: mi.MediumPtr | None = None,
        number: int = 0,
        others: tuple[MediumGrid, ...] = (),
        *,
        is_isolated: bool = True,
        has_exact_boundary: bool = True,
        refracts: bool = False,
        detail: Detail = Detail.SHARP,
        holds_emitters: bool = False,
        object_sizes: tuple[float, ...] = (),
    ) -> None:
        self.pointer, self.number, self.others = pointer, number, others
        self.is_isolated, self.has_exact_boundary = is_isolated, has_exact_boundary
        self.refracts, self.detail = refracts, detail
        self.holds_emitters, self.object_sizes = holds_emitters, object_sizes

    def among(self, others: tuple[MediumGrid, ...]) -> MediumContext:
        """Return a copy with these ``others``."""
        return MediumContext(**self.attributes() | {"others": others})


#: The context of a medium that fills its boundary, without any shapes.
ALONE = MediumContext()


class Unscaled(Immutable):
    """The medium from which delta-M scaling derived another one (see `delta_m`).

    Attributes:
        medium: the medium before scaling.
        exponent: for each channel of the albedo, the ratio sigma_t / sigma_t' of the extinction
            before and after scaling: (transmittance of the scaled medium)^exponent is the fraction
            of the radiance that is not scattered at all, not even into the forward peak. None if
            the ratio varies in space.
    """

    def __init__(self, medium: MediumGrid, exponent: np.ndarray | None) -> None:
        self.medium, self.exponent = medium, exponent


class MediumGrid(Immutable):
    """``sigma_t`` [1/scene unit] and ``albedo`` inside ``boundary`` and the world box ``bbox``.

    Attributes:
        bbox: lower and upper corner; None: unbounded.
        emission: emission coefficient of the medium; None if it does not emit.
        phase: phase function, the same everywhere.
        name: unique among the media of a scene.
        context: relation of the medium to the rest of its scene.
        unscaled: the medium before delta-M scaling; None if it is not scaled.
        macrocells: local majorants of ``sigma_t``.
    """

    def __init__(
        self,
        sigma_t: Field,
        albedo: Field,
        boundary: Boundary,
        bbox: tuple[np.ndarray, np.ndarray] | None = None,
        *,
        emission: Emission | None = None,
        phase: Phase = ISOTROPIC,
        name: str = "",
        context: MediumContext = ALONE,
        unscaled: Unscaled | None = None,
        macrocells: Macrocells | None = None,
    ) -> None:
        self.sigma_t, self.albedo, self.boundary, self.bbox = sigma_t, albedo, boundary, bbox
        self.emission, self.phase = emission, phase
        self.name, self.context, self.unscaled = name, context, unscaled
        self.macrocells = macrocells or Macrocells.build(sigma_t, boundary)
        if bbox is not None:
            corners = [opaque_point(p) for p in bbox]
            self._clip = mi.BoundingBox3f(*corners)

    def replaced(self, **changes: object) -> MediumGrid:
        """Return a copy with these attributes; macrocells follow from a changed extinction."""
        attributes = self.attributes()
        if "sigma_t" in changes or "boundary" in changes:
            del attributes["macrocells"]
        return MediumGrid(**attributes | changes)

    # Attributes of the context and of delta-M scaling

    @property
    def pointer(self) -> mi.MediumPtr | None:
        return self.context.pointer

    @property
    def number(self) -> int:
        return self.context.number

    @property
    def others(self) -> tuple[MediumGrid, ...]:
        return self.context.others

    @property
    def is_isolated(self) -> bool:
        return self.context.is_isolated

    @property
    def has_exact_boundary(self) -> bool:
        return self.context.has_exact_boundary

    @property
    def holds_emitters(self) -> bool:
        return self.context.holds_emitters

    @property
    def object_sizes(self) -> tuple[float, ...]:
        """See `MediumContext.object_sizes`."""
        return self.context.object_sizes

    @property
    def refracts(self) -> bool:
        return self.context.refracts

    @property
    def detail(self) -> Detail:
        """How much the incident radiance varies with position and direction."""
        return self.context.detail

    @property
    def is_traced(self) -> bool:
        """Whether rays in the medium are traced through the scene's shapes."""
        return self.pointer is not None

    @property
    def original(self) -> MediumGrid | None:
        """The medium before delta-M scaling; None if it is not scaled."""
        return self.unscaled.medium if self.unscaled is not None else None

    @property
    def unscattered_exponent(self) -> np.ndarray | None:
        """See `Unscaled.exponent`; None if the medium is not scaled."""
        return self.unscaled.exponent if self.unscaled is not None else None

    # Geometry

    @property
    def frame(self) -> np.ndarray:
        """Matrix (4, 4) from the unit cube to a box around the medium, the extent of its cache.

        The smaller of the boundary's box and ``bbox``.
        """
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
        """Shortest voxel edge of the extinction [scene units]; infinite if it is constant."""
        return dr.inf if self.homogeneous else float(self.sigma_t.grid.voxel_size.min())

    @property
    def clips(self) -> Callable[[mi.Point3f], mi.Bool] | None:
        """Function that returns whether world positions lie within ``bbox``; None if unbounded."""
        return None if self.bbox is None else self._clip.contains

    def contains(self, p: mi.Point3f) -> mi.Bool:
        """Return whether world positions lie within the boundary and ``bbox``: in the medium, if
        its boundary is exact.
        """
        inside = self.boundary.surrounds(p)
        return inside if self.bbox is None else inside & self._clip.contains(p)

    def overlaps(self, other: MediumGrid) -> bool:
        """Return whether the boxes around both media may overlap, by their extents along the
        world's axes.
        """
        (low, high), (least, most) = (
            (
                m[:3, 3] + np.minimum(m[:3, :3], 0).sum(axis=1),
                m[:3, 3] + np.maximum(m[:3, :3], 0).sum(axis=1),
            )
            for m in (self.frame, other.frame)
        )
        return bool((low < most).all() and (least < high).all())

    def fills(self, grid: Grid) -> bool:
        """Return whether the medium fills the whole box covered by ``grid``."""
        box = self.boundary.frame
        if self.bbox is not None:
            box = axis_aligned(*self.bbox)
            corners = product(*zip(*self.bbox, strict=True))
            inside = all(self.boundary.contains(np.array(corner)) for corner in corners)
            is_whole = inside and self.has_exact_boundary
        else:
            is_whole = self.boundary.kind == "box" and self.has_exact_boundary
        same = np.abs(box - grid.to_world).max() <= 1e-6 * grid.side_lengths.max()
        return is_whole and bool(same)

    def intersect(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return whether the line of a ray intersects the medium, and its distances of entry and
        exit.
        """
        hit, near, far = self.boundary.intersect(ray)
        if self.bbox is not None:
            # Mitsuba's box accepts the rays of the first variant only that was used in the process.
            first, last = intersect_slabs(self._clip.min, self._clip.max, ray.o, ray.d)
            near, far = dr.maximum(near, first), dr.minimum(far, last)
        return hit & (near < far), near, far


def axis_aligned(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return ``to_world`` of the unit cube for an axis-aligned world box."""
    frame = np.diag([*(upper - lower), 1.0])
    frame[:3, 3] = lower
    return frame
