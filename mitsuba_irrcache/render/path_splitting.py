"""Splitting of paths at glass: both the reflected and the transmitted path are followed.

Choosing one of them at random would add noise, although paths that end in ray-marched media have
none. Paths are split at their first vertices, as long as there is free storage in which the
reflected path waits until the transmitted one has ended.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.transport.path import REFLECTION, medium_after, sample_bsdf

#: Maximum number of reflected paths that wait, per lane.
PLACES = 2
#: Lobes that transmit, without diffuse ones.
TRANSMISSION = int(
    mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.Null
)
#: Throughput of either path below which one of both is chosen at random instead.
NEGLIGIBLE = 2e-3


def no_waiting(ray: mi.Ray3f, pointer: mi.MediumPtr) -> list[list]:
    """Return empty storage for waiting paths.

    Each place holds whether it is in use, and the path's ray, medium, throughput, relative
    refractive index, last vertex, and density of its direction.
    """
    last = dr.zeros(mi.Interaction3f)
    last.p = ray.o
    path = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Spectrum(0), mi.Float(1), last, mi.Float(0)
    return [[mi.Bool(False), *path] for _ in range(PLACES)]


def split(
    waiting: list[list],
    si: mi.SurfaceInteraction3f,
    state: tuple,
    samples: tuple[mi.Float, mi.Point2f],
    active: mi.Bool,
) -> tuple[list[list], list]:
    """Sample the BSDF as `sample_bsdf`, and split paths at surfaces that both reflect and transmit,
    without a diffuse lobe.

    ``state`` is the medium, throughput, relative refractive index and vertex of a path. Returns the
    updated ``waiting`` and the result of `sample_bsdf`, for split paths that of the transmitted
    part.
    """
    found = sample_bsdf(si, *samples, active)
    pointer, throughput, eta, vertex = state
    flags = si.bsdf().flags()
    both = active & ((flags & REFLECTION) != 0) & ((flags & TRANSMISSION) != 0)
    both &= (flags & int(mi.BSDFFlags.Diffuse)) == 0
    transmitted = _lobe(si, samples, both, TRANSMISSION)
    direction, f, scale, _, pdf = _lobe(si, samples, both, REFLECTION)
    f = throughput * f
    # At total reflection the transmittance is 0 but for rounding, which differs between backends.
    both &= (dr.max(throughput * transmitted[1]) > NEGLIGIBLE) & (dr.max(f) > NEGLIGIBLE)
    reflected = si.spawn_ray(direction), medium_after(si, direction, pointer), f, eta * scale
    placed, result = mi.Bool(False), []
    for taken, *path in waiting:
        here = both & ~placed & ~taken
        new = *reflected, vertex, pdf
        path = [dr.select(here, a, b) for a, b in zip(new, path, strict=True)]
        result.append([taken | here, *path])
        placed |= here
    return result, [dr.select(placed, a, b) for a, b in zip(transmitted, found, strict=True)]


def _lobe(
    si: mi.SurfaceInteraction3f,
    samples: tuple[mi.Float, mi.Point2f],
    active: mi.Bool,
    lobes: int,
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float, mi.Bool, mi.Float]:
    """Sample the ``lobes`` `REFLECTION` or `TRANSMISSION` as `sample_bsdf`, but return the density
    of all lobes: emitters are sampled for all lobes, and the weights of multiple importance
    sampling have to sum to 1.
    """
    direction, f, scale, is_vertex, density = sample_bsdf(si, *samples, active, lobes)
    wo = si.to_local(direction)
    # Some BSDFs, such as "mask", sample lobes that were not asked for.
    reflects = wo.z * si.wi.z > 0
    f = dr.select(reflects if lobes == REFLECTION else ~reflects, f, 0)
    glossy = active & (density > 0)
    density = dr.select(glossy, si.bsdf().pdf(mi.BSDFContext(), si, wo, glossy), 0)
    return direction, f, scale, is_vertex, density


def resumed(waiting: list[list], state: list, active: mi.Bool) -> tuple[list[list], list, mi.Bool]:
    """Replace paths that are not ``active`` any more by waiting ones.

    ``state`` is the ray, medium, throughput, relative refractive index, last vertex and density.
    Returns the updated ``waiting``, the state, and the mask of lanes with a resumed path.
    """
    new, result = mi.Bool(False), []
    for taken, *path in waiting:
        here = taken & ~active & ~new
        state = [dr.select(here, a, b) for a, b in zip(path, state, strict=True)]
        result.append([taken & ~here, *path])
        new |= here
    return result, state, new
