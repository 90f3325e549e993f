"""Volumetric emission (flames, plasma, glowing gas), which Mitsuba's media do not support.

The emission coefficient j is the isotropic radiance emitted per unit length [W m^-3 sr^-1, or the
scene's unit of radiance per unit of length]. It equals the product sigma_a L_e in eq. 1 of the
paper, but is specified directly, so that media without extinction can be emissive.
"""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.boundary import safe_rcp
from mitsuba_irrcache.grids.fields import ConstantField, Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.grids.occupancy import active_voxels, marked
from mitsuba_irrcache.media.bake import baked_field, volume_error
from mitsuba_irrcache.media.medium import MediumGrid

#: Tolerated deviation from Mitsuba's own values, relative to the maximum.
TOLERANCE = 0.02
#: Tolerance in voxels of the test whether a point is inside a grid: rays end exactly on its faces.
SLACK = 1e-3


class Emission:
    """Emission coefficient: the value of ``field``, and 0 outside of its grid."""

    def __init__(self, field: Field) -> None:
        self.field, self.grid = field, field.grid
        self.channels, self.maximum = field.channels, field.maximum

    def at_world(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Evaluate at the world position ``p``: a Float for one channel, else a Color3f."""
        if self.grid is None:
            return self.field.value
        u = self.grid.coordinates.point(p)
        sides = mi.Point3f([mi.Float(n) for n in self.grid.sides])
        inside = dr.all((u >= -SLACK) & (u <= sides + SLACK))
        return dr.select(inside, self.field.at(u, active & inside), 0)

    def interval(self, ray: mi.Ray3f, near: mi.Float, far: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Clip a ray between ``near`` and ``far`` to the emissive grid; empty if end <= start."""
        if self.grid is None:
            return near, far
        origin = self.grid.coordinates.point(ray.o)
        rcp = safe_rcp(self.grid.coordinates.vector(ray.d))
        sides = mi.Point3f([mi.Float(n) for n in self.grid.sides])
        a, b = -origin * rcp, (sides - origin) * rcp
        enters, leaves = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        return dr.maximum(near, enters), dr.minimum(far, leaves)

    def between(
        self, ray: mi.Ray3f, begin: mi.Float, end: mi.Float, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.PCG32]:
        """Estimate int j dt, unbiased, from one random position; 0 where not ``active``.

        Also returns the advanced random number generator.
        """
        if self.grid is None:
            return dr.select(active, mi.Spectrum(self.field.value) * (end - begin), 0), rng
        place = ray(dr.fma(rng.next_float32(active), end - begin, begin))
        light = mi.Spectrum(self.at_world(place, active)) * (end - begin)
        return dr.select(active, light, 0), rng

    def reaches(self, cells: Macrocells) -> mi.Bool:
        """Whether each macrocell of a medium may contain emission."""
        if self.grid is None or cells.count == 1:
            return dr.full(mi.Bool, True, cells.count)
        own = SimpleNamespace(
            macrocells=Macrocells.build(self.field, None), sigma_t=self.field, boundary=None
        )
        nz, ny, nx = cells.shape
        place = np.linalg.inv(cells.coordinates.matrix) @ np.diag([nx, ny, nz, 1.0])
        grid = Grid(cells.shape, place)
        return marked(grid, active_voxels(own, grid))


def bake_emission(value: object, scale: float) -> Emission | None:
    """Convert the integrator's ``emission`` property times ``scale``; None if it is 0 everywhere.

    The property is a number, a colour, or a ``constvolume`` or ``gridvolume`` in world space.
    Raises IrrcacheError for anything else, and for values that are negative or not finite.
    """
    if not np.isfinite(scale) or scale < 0:
        raise IrrcacheError(
            f"irrcache: emission_scale is {scale:g}; it must be finite and not negative."
        )
    if isinstance(value, mi.Volume):
        field = baked_field(value, "emission of the integrator", scale)
        _verify(value, field, scale)
    else:
        field = ConstantField(_numbers(value, scale), scale)
    return Emission(field) if field.maximum > 0 else None


def place_emission(emission: Emission | None, media: list[MediumGrid]) -> None:
    """Assign the emission to all ``media``; raise IrrcacheError if it overlaps none of them."""
    if emission is None:
        return
    if not media:
        raise IrrcacheError(
            "irrcache: there is emission, but no medium, and only media emit. Put a medium around "
            "it; its sigma_t may be 0."
        )
    if emission.grid is not None and not any(_overlap(emission.grid, m.frame) for m in media):
        lower, upper = _box(emission.grid.to_world)
        raise IrrcacheError(
            f"irrcache: the emission fills {lower} to {upper}, where there is no medium, and only "
            "media emit. Place it by its to_world in world space, or put a medium around it; its "
            "sigma_t may be 0."
        )
    for medium in media:
        medium.emission = emission


def _numbers(value: object, scale: float) -> np.ndarray:
    """Convert a number or colour to one or three values; times ``scale`` they must be finite."""
    try:
        values = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.size not in (1, 3):
        raise IrrcacheError(
            f"irrcache: emission is {value!r}; it must be a number, a colour (rgb), or a "
            'volume of type "constvolume" or "gridvolume".'
        )
    with np.errstate(over="ignore"):
        scaled = np.float32(values * max(scale, 1.0))
    if not np.isfinite(scaled).all() or values.min() < 0:
        raise IrrcacheError(
            f"irrcache: emission is {values}, times emission_scale {scale:g}; it must be finite in "
            "single precision and not negative."
        )
    if values.size == 3 and mi.is_monochromatic:
        values = np.array(mi.luminance(mi.Color3f(values))).ravel()
    return values[:1] if np.ptp(values) == 0 else values


def _verify(volume: mi.Volume, field: Field, scale: float) -> None:
    """Compare the converted values with Mitsuba's own at random points inside the volume."""
    if field.grid is None or not field.maximum > 0:
        return
    rng = mi.PCG32(512)
    u = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    interaction = dr.zeros(mi.Interaction3f, 512)
    interaction.p = Grid((1, 1, 1), field.grid.to_world).world.point(u)
    expected = mi.Spectrum(volume.eval(interaction)) * scale
    deviation = dr.abs(expected - mi.Spectrum(field.at_world(interaction.p)))
    if dr.max(dr.max(deviation))[0] > TOLERANCE * field.maximum:
        raise volume_error("emission of the integrator")


def _box(to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the world bounding box of the unit cube under ``to_world``."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
    world = to_world[:3, :3] @ corners + to_world[:3, 3:]
    return world.min(axis=1), world.max(axis=1)


def _overlap(grid: Grid, frame: np.ndarray) -> bool:
    """Whether the world bounding boxes overlap."""
    (a, b), (c, d) = _box(grid.to_world), _box(frame)
    return bool((np.maximum(a, c) < np.minimum(b, d)).all())
