"""Surfaces that rays hit: the first one that is not null, its normals, whether it is diffuse."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.transport.path import (
    MOST_CROSSINGS,
    Media,
    PartlyOriginalMedia,
    is_null,
    medium_after,
)

#: Largest relative difference of f in three directions for which a BSDF counts as Lambertian.
LAMBERTIAN = 1e-4


@symbolic
def first_opaque(
    scene: mi.Scene,
    media: Media | PartlyOriginalMedia,
    ray: mi.Ray3f,
    pointer: mi.MediumPtr,
    rng: mi.PCG32,
    active: mi.Bool,
    exact: bool,
):
    """Find the first surface along ``ray`` that emits or lets nothing through, invalid where there
    is none.

    Surfaces that partly transmit are passed like null ones, as by `transport.path.visibility`: the
    densities of a sampled emitter then count both ways to find it. Returns the surface with the
    transmittance of what lies before it, without noise if ``exact``, and the random generator.
    """
    ray, pointer, active = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(active)
    end, attenuation = dr.zeros(mi.SurfaceInteraction3f), mi.Spectrum(1)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="first opaque surface"):
        si = scene.ray_intersect(ray, active)
        if dr.hint(exact, mode="scalar"):
            factor = media.exact_transmittance(pointer, ray, si.t, active)
        else:
            factor, rng = media.transmittance(pointer, ray, si.t, rng, active)
        attenuation = dr.select(active, attenuation * factor, attenuation)
        hit = active & si.is_valid()
        factor = si.bsdf().eval_null_transmission(si, hit)
        null = hit & (si.emitter(scene, hit) == None) & (dr.max(factor) > 0)  # noqa: E711
        end = dr.select(active & ~null, si, end)
        attenuation = dr.select(null, attenuation * factor, attenuation)
        pointer = dr.select(null, medium_after(si, ray.d, pointer), pointer)
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= null & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)
    # A line that exceeds the maximum number of crossings does not contribute.
    return end, dr.select(crossings < MOST_CROSSINGS, attenuation, 0), rng


@symbolic
def unobstructed(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool):
    """Return whether no surface but null ones lies on ``ray`` up to its end."""
    ray, clear, active = mi.Ray3f(ray), mi.Bool(active), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="visible nodes"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        null = is_null(si.bsdf().flags())
        clear &= ~(hit & ~null)
        remaining = ray.maxt - si.t
        ray = si.spawn_ray(ray.d)
        ray.maxt = remaining
        crossings += 1
        active &= hit & null & (crossings < MOST_CROSSINGS)
    return clear


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
