"""Surfaces that rays hit: their normals, whether they are diffuse."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Largest relative difference of f in three directions for which a BSDF counts as Lambertian.
LAMBERTIAN = 1e-4


def vertex_at(si: mi.SurfaceInteraction3f) -> mi.Interaction3f:
    """Return the interaction from which emitters are sampled."""
    vertex = dr.zeros(mi.Interaction3f)
    vertex.p, vertex.n = si.p, si.n
    vertex.time, vertex.wavelengths = si.time, si.wavelengths
    return vertex


def facing(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> tuple[mi.Normal3f, mi.Normal3f]:
    """Return geometric and shading normal on the side that a ray in ``direction`` hits."""
    geometric, shading = si.n, si.sh_frame.n
    geometric = dr.select(dr.dot(geometric, direction) < 0, geometric, -geometric)
    shading = dr.select(dr.dot(shading, direction) < 0, shading, -shading)
    return mi.Normal3f(geometric), mi.Normal3f(shading)


def lambertian(si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Bool, mi.Spectrum]:
    """Return whether the BSDF is Lambertian, and its value f = reflectance / pi.

    This is decided by flags and, because the normals of bump maps differ from those of the surface,
    by values of the BSDF.
    """
    bsdf, context = si.bsdf(), mi.BSDFContext()
    flags = bsdf.flags() & int(mi.BSDFFlags.All)
    active = active & (flags == int(mi.BSDFFlags.DiffuseReflection))
    side = dr.select(si.wi.z < 0, mi.Float(-1), 1)
    value = bsdf.eval(context, si, mi.Vector3f(0, 0, side), active)
    for x, y in ((0.6, 0.0), (-0.3, 0.51961524)):
        other = bsdf.eval(context, si, mi.Vector3f(x, y, 0.8 * side), active) / 0.8
        active = active & (dr.max(dr.abs(other - value)) <= LAMBERTIAN * dr.max(value))
    return active, value
