"""Flat glossy surfaces that reflect a sun into a medium, by a narrow beam.

The ordinates of the solver ``sweep`` are the same for all voxels: a beam that is narrower than the
angles between them is missed by all voxels, or counts several times in all.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.lights.emitters import EmitterKind, illuminating, kind_of
from mitsuba_irrcache.lights.narrow_sources import Source, sources_of
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.consistency import described
from mitsuba_irrcache.transport.path import flags_of, is_surface

#: Solid angle [sr] of reflected beams below which ordinates do not resolve them. Fog over a floor
#: of roughness 0.05, 0.1 and 0.2 under a sun has errors of 25, 2 and 0.4 % with 64 directions.
NARROW = 0.2
#: Least reflectance of a lobe that matters.
LEAST_REFLECTANCE = 0.1
#: Number of points that are sampled on a surface, and of samples of a BSDF; largest angle [rad]
#: between normals of a flat part, and least share of the points in it.
POINTS, SAMPLES, FLAT, FLAT_SHARE = 256, 1024, 0.02, 0.1
#: Cosine of the angle of incidence at which BSDFs are sampled.
COSINE = 0.7

_REFLECTION = int(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.GlossyReflection)


def narrow_beam(scene: mi.Scene, medium: MediumGrid) -> str | None:
    """Return a description of a surface that reflects a sun, or a bright spot of an environment,
    into ``medium`` by a beam narrower than `NARROW`; None without any.
    """
    far = any(
        kind_of(e).is_environment or kind_of(e) is EmitterKind.SUN for e in illuminating(scene)
    )
    glossy = [s for s in scene.shapes() if is_surface(s) and flags_of(s) & _REFLECTION]
    if not far or not glossy:
        return None
    suns = [source for source in sources_of(scene)[0] if source.far]
    for shape in glossy if suns else ():
        lobe = _lobe(shape.bsdf())
        if lobe is None:
            continue
        for points, normal in _flat_parts(shape):
            for sun in suns:
                # A mirror reflects only sources that have an extent.
                width = lobe + (sun.solid_angle if sun.is_spot else 0.0)
                if 0 < width < NARROW and _meets(points, normal, sun, medium):
                    return (
                        f"{described(shape)} reflects a sun into a beam of {width:.2g} sr, "
                        "narrower than the angles between directions"
                    )
    return None


def _lobe(bsdf: mi.BSDF) -> float | None:
    """Return the solid angle [sr] of the reflection of a BSDF without diffuse lobes, 0 for mirrors;
    None if it reflects little.
    """
    rng = np.random.default_rng(SAMPLES)
    u = np.float32(rng.random((5, SAMPLES)))
    si = dr.zeros(mi.SurfaceInteraction3f, SAMPLES)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.n, si.uv = mi.Normal3f(0, 0, 1), mi.Point2f(u[:2])
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = mi.Vector3f(float(np.sqrt(1 - COSINE**2)), 0, COSINE)
    context = mi.BSDFContext()
    context.type_mask = _REFLECTION
    found, weight = bsdf.sample(context, si, mi.Float(u[2]), mi.Point2f(u[3:]), True)
    reflected = (found.wo.z > 0) & mi.has_flag(found.sampled_type, mi.BSDFFlags.Reflection)
    weight = np.array(dr.select(reflected, dr.max(weight), 0), dtype=np.float64)
    is_delta = np.array(mi.has_flag(found.sampled_type, mi.BSDFFlags.Delta))
    density = np.where(is_delta, np.inf, np.array(found.pdf, dtype=np.float64))
    weight, density = (np.broadcast_to(x, SAMPLES) for x in (weight, density))
    if not weight.mean() > LEAST_REFLECTANCE:
        return None
    # The mean density of samples of a uniform lobe is the reciprocal of its solid angle.
    own = weight > 0
    return float(1 / np.median(density[own]))


def _flat_parts(shape: mi.Shape) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield points (n, 3) of the flat parts of a shape, and the normal (3) of each part."""
    sample = mi.Point2f(np.float32(np.random.default_rng(POINTS).random((2, POINTS))))
    try:
        found = shape.sample_position(0.0, sample)
    except RuntimeError:
        return  # shapes without sampling, such as instances
    points, normals = (np.array(x, dtype=np.float64).T for x in (found.p, found.n))
    left = np.isfinite(points).all(axis=1)
    while left.any():
        normal = normals[np.argmax(left)]
        own = left & (normals @ normal > np.cos(FLAT))
        own |= left & (np.arange(len(left)) == np.argmax(left))
        left &= ~own
        if own.sum() >= FLAT_SHARE * POINTS:
            yield points[own], normal


def _meets(points: np.ndarray, normal: np.ndarray, sun: Source, medium: MediumGrid) -> bool:
    """Return whether rays towards ``medium``, reflected at ``points``, come from a ``sun``."""
    towards = np.array(sun.place, dtype=np.float64).reshape(-1)
    reflected = 2 * (towards @ normal) * normal - towards
    frame = medium.frame
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
    corners = (frame[:3, :3] @ corners + frame[:3, 3:]).T
    centre = corners.mean(axis=0)
    radius = np.linalg.norm(corners - centre, axis=1).max()
    offset = centre - points
    along = offset @ reflected
    distance = np.sqrt(np.maximum((offset**2).sum(axis=1) - along**2, 0))
    return bool(((distance < radius) & (along > 0)).any())
