"""Convert the integrator's property ``emission`` to the emission coefficient of media."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.fields import (
    ConstantField,
    Field,
    error_of_texture_units,
    positions_between_voxels,
)
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.bake import baked_field, volume_error
from mitsuba_irrcache.media.emission import Emission

#: Tolerated deviation of converted values from those that Mitsuba evaluates, over their maximum.
TOLERANCE = 0.02


def bake_emission(value: object, scale: float) -> Emission | None:
    """Convert the integrator's ``emission``, times ``scale``; return None if it is 0 everywhere.

    ``value`` is a number, a colour, or a ``constvolume`` or ``gridvolume`` in world space. Raises
    IrrcacheError for anything else, and for values that are negative or not finite.
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


def _numbers(value: object, scale: float) -> np.ndarray:
    """Return one value, or the three of a colour; raise IrrcacheError if they overflow float32
    when multiplied by ``scale``.
    """
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
    """Compare converted values with those that Mitsuba evaluates inside of the volume, anywhere and
    between voxels that differ.
    """
    if field.grid is None or not field.maximum > 0:
        return
    rng = mi.PCG32(512)
    u = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    anywhere = Grid((1, 1, 1), field.grid.to_world).world.point(u)
    for p in (anywhere, positions_between_voxels(field, 512)):
        if p is None:
            continue
        interaction = dr.zeros(mi.Interaction3f, 512)
        interaction.p = p
        theirs = mi.Spectrum(volume.eval(interaction)) * scale
        apart = dr.abs(theirs - mi.Spectrum(field.at_world(p)))
        apart -= error_of_texture_units(field, p)
        if dr.max(dr.max(apart))[0] > TOLERANCE * field.maximum:
            raise volume_error("emission of the integrator")
