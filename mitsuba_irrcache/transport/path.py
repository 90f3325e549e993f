"""Steps of paths through surfaces and several media: free flights, visibility, scattering.

Surfaces, BSDFs and emitters are Mitsuba's; media are sampled on their grids, with local majorants
and analytic transmittance for homogeneous ones. The loop over vertices is in `path_tracer`.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.lights.emitters import are_distant
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import free_flight, medium_transmittance, transmittance

#: Maximum number of surface crossings of a path; coincident surfaces could otherwise loop forever.
MOST_CROSSINGS = 1024
#: Lobes of BSDFs that reflect, without diffuse ones.
REFLECTION = int(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.GlossyReflection)
#: Distance at which shadow rays to suns and environments end, over the diameter of the scene that
#: Mitsuba has measured.
FAR = 1e4
#: Maximum survival probability of Russian roulette, as in ``volpath``.
MAX_SURVIVAL = 0.95


class Media(Immutable):
    """Media of a scene. Mitsuba's pointer identifies the medium of a ray; null is no medium."""

    def __init__(self, grids: Sequence[MediumGrid]) -> None:
        self.grids = tuple(grids)
        self.isotropic = all(grid.phase.is_isotropic for grid in self.grids)

    @property
    def is_emissive(self) -> bool:
        """Whether any medium has volumetric emission."""
        return any(grid.emission is not None for grid in self.grids)

    @classmethod
    def around(cls, medium: MediumGrid) -> Media:
        """Return the media of the scene for paths that end in ``medium``, whose radiance is cached.

        Delta-M scaling applies to ``medium`` only; the other media are unscaled.
        """
        before, after = medium.others[: medium.number], medium.others[medium.number :]
        return cls([*before, medium, *after])

    def pointer_of(self, number: mi.UInt32) -> mi.MediumPtr:
        """Return Mitsuba's medium with this number: 1 for the first one, 0 for none."""
        pointer = dr.zeros(mi.MediumPtr, dr.width(number))
        for i, grid in enumerate(self.grids):
            pointer = dr.select(number == i + 1, grid.pointer, pointer)
        return pointer

    def number_of(self, pointer: mi.MediumPtr) -> mi.UInt32:
        """Return the number of Mitsuba's medium, the inverse of `pointer_of`."""
        number = mi.UInt32(0)
        for i, grid in enumerate(self.grids):
            number = dr.select(pointer == grid.pointer, i + 1, number)
        return number

    def original(self) -> Media:
        """Return the media before delta-M scaling."""
        return Media([grid.original or grid for grid in self.grids])

    def without(self, medium: MediumGrid) -> Media:
        """Return all media except one."""
        return Media([grid for grid in self.grids if grid is not medium])

    def sample_distance(
        self,
        pointer: mi.MediumPtr,
        ray: mi.Ray3f,
        far: mi.Float,
        weight: mi.Spectrum,
        rng: mi.PCG32,
        active: mi.Bool,
    ) -> tuple[mi.Bool, mi.Float, mi.Spectrum, mi.PCG32, mi.Spectrum]:
        """Sample a free-flight distance up to ``far``.

        Returns whether the ray collides, the distance, the path throughput after the collision
        including the albedo, the random number generator, and the emission along the segment times
        the throughput.
        """
        collided, t, emitted = mi.Bool(False), mi.Float(far), mi.Spectrum(0)
        for grid in self.grids:
            hit, near, end = grid.intersect(ray)
            hit &= active & (pointer == grid.pointer)
            near, end = dr.maximum(near, 0), dr.minimum(end, far)
            collided_here, distance, weight, rng, emission = free_flight(
                grid, ray, near, end, weight, rng, hit
            )
            emitted += emission
            albedo = mi.Spectrum(grid.albedo.at_world(ray(distance), collided_here))
            weight = dr.select(collided_here, weight * albedo, weight)
            t = dr.select(collided_here, distance, t)
            collided |= collided_here
        return collided, t, weight, rng, emitted

    def transmittance(
        self, pointer: mi.MediumPtr, ray: mi.Ray3f, far: mi.Float, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.PCG32]:
        """Estimate the transmittance up to ``far``, unbiased; also return the generator."""
        attenuation = mi.Spectrum(1)
        for grid in self.grids:
            hit, near, end = grid.intersect(ray)
            hit &= active & (pointer == grid.pointer)
            near, end = dr.maximum(near, 0), dr.minimum(end, far)
            factor, rng = transmittance(grid, ray, near, end, rng, hit)
            attenuation = dr.select(
                hit & (near < end), attenuation * mi.Spectrum(factor), attenuation
            )
        return attenuation, rng

    def exact_transmittance(
        self, pointer: mi.MediumPtr, ray: mi.Ray3f, far: mi.Float, active: mi.Bool
    ) -> mi.Spectrum:
        """Compute the transmittance up to ``far`` without noise."""
        attenuation = mi.Spectrum(1)
        for grid in self.grids:
            inside = active & (pointer == grid.pointer)
            factor = mi.Spectrum(medium_transmittance(grid, ray, far, inside))
            attenuation = dr.select(inside, attenuation * factor, attenuation)
        return attenuation


class PartlyOriginalMedia:
    """Media whose extinction is that before delta-M scaling in the lanes ``is_original`` only."""

    def __init__(self, scaled: Media, original: Media, is_original: mi.Bool) -> None:
        self._scaled, self._original, self._is_original = scaled, original, is_original

    def transmittance(
        self, pointer: mi.MediumPtr, ray: mi.Ray3f, far: mi.Float, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.PCG32]:
        """Estimate the transmittance as `Media.transmittance`."""
        own, where = self._is_original, (pointer, ray, far)
        scaled, rng = self._scaled.transmittance(*where, rng, active & ~own)
        original, rng = self._original.transmittance(*where, rng, active & own)
        return dr.select(own, original, scaled), rng

    def exact_transmittance(
        self, pointer: mi.MediumPtr, ray: mi.Ray3f, far: mi.Float, active: mi.Bool
    ) -> mi.Spectrum:
        """Compute the transmittance as `Media.exact_transmittance`."""
        own, where = self._is_original, (pointer, ray, far)
        scaled = self._scaled.exact_transmittance(*where, active & ~own)
        return dr.select(own, self._original.exact_transmittance(*where, active & own), scaled)


def is_null(flags: mi.UInt32) -> mi.Bool:
    """Return whether a BSDF with these flags is an ideal null interface."""
    return (flags & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.Null)


def transmits(flags: mi.UInt32) -> mi.Bool:
    """Return whether a BSDF with these flags lets radiance through, refracted, scattered or
    straight.
    """
    return (flags & int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)) != 0


def flags_of(shape: mi.Shape) -> int:
    """Return the flags of the BSDF of a shape, 0 without one."""
    return int(shape.bsdf().flags()) if shape.bsdf() is not None else 0


def refracts(shape: mi.Shape) -> bool:
    """Return whether radiance passes a shape, and is deflected or partly reflected by it."""
    flags = flags_of(shape)
    return bool(transmits(flags)) and not is_null(flags)


def is_surface(shape: mi.Shape) -> bool:
    """Return whether a shape is more than a medium boundary.

    It is if it scatters, emits or is a sensor.
    """
    return not is_null(flags_of(shape)) or shape.is_emitter() or shape.is_sensor()


def is_solid(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Return whether hit surfaces are more than the boundary of a medium: they scatter or emit."""
    return ~is_null(si.bsdf().flags()) | (si.shape.emitter() != None)  # noqa: E711


def medium_after(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, pointer: mi.MediumPtr):
    """Return the medium behind a surface for a ray that is in the medium ``pointer`` before it."""
    return dr.select(si.is_medium_transition(), si.target_medium(direction), pointer)


def straight_through(
    si: mi.SurfaceInteraction3f,
    ray: mi.Ray3f,
    pointer: mi.MediumPtr,
    attenuation: mi.Spectrum,
    hit: mi.Bool,
) -> tuple[mi.Ray3f, mi.MediumPtr, mi.Spectrum]:
    """Return the rays behind the surfaces that they ``hit``, their media, and the ``attenuation``
    with what the surfaces let through straight.
    """
    factor = si.bsdf().eval_null_transmission(si, hit)
    attenuation = dr.select(hit, attenuation * factor, attenuation)
    pointer = dr.select(hit, medium_after(si, ray.d, pointer), pointer)
    return si.spawn_ray(ray.d), pointer, attenuation


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return the weight of a sample with density ``a`` and alternative density ``b``.

    Power heuristic of multiple importance sampling (Veach and Guibas 1995).
    """
    # docs/primer, eq. (3.2)
    a = dr.square(a)
    b = dr.select(b > 0, dr.square(b), 0)  # a black environment map has no density: 0 / 0
    return dr.select(a > 0, a / (a + b), 0)


@symbolic
def emitter_behind(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool):
    """Return the emitter of the first surface on ``ray`` that is not null; None where there is
    none.
    """
    ray, active = mi.Ray3f(ray), mi.Bool(active)
    found, crossings = dr.zeros(mi.EmitterPtr, dr.width(active)), mi.UInt32(0)
    while dr.hint(active, label="emitter behind"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        null = is_null(si.bsdf().flags())
        found = dr.select(hit & ~null, si.emitter(scene, hit), found)
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= hit & null & (crossings < MOST_CROSSINGS)
    return found


@symbolic
def unobstructed(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool):
    """Return whether no surface but null ones lies on ``ray`` up to its end."""
    ray, clear, active = mi.Ray3f(ray), mi.Bool(active), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="unobstructed"):
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


@symbolic
def visibility(
    scene: mi.Scene,
    media: Media | PartlyOriginalMedia,
    vertex: mi.Interaction3f,
    target: mi.Point3f,
    pointer: mi.MediumPtr,
    rng: mi.PCG32,
    active: mi.Bool,
    exact: bool = False,
):
    """Estimate the transmittance from ``vertex`` to ``target``, unbiased or, if ``exact``, without
    noise.

    The line crosses all media and null surfaces, also partially transmitting ones. Also returns the
    random number generator.
    """
    ray = vertex.spawn_ray_to(target)
    attenuation, pointer, active = mi.Spectrum(1), mi.MediumPtr(pointer), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="visibility"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        factor = si.bsdf().eval_null_transmission(si, hit)
        attenuation = dr.select(hit, attenuation * factor, attenuation)
        active &= dr.max(attenuation) > 0
        far = dr.minimum(si.t, ray.maxt)
        if dr.hint(exact, mode="scalar"):
            factor = media.exact_transmittance(pointer, ray, far, active)
        else:
            factor, rng = media.transmittance(pointer, ray, far, rng, active)
        attenuation = dr.select(active, attenuation * factor, attenuation)
        pointer = dr.select(hit, medium_after(si, ray.d, pointer), pointer)
        ray = si.spawn_ray_to(target)
        crossings += 1
        active &= hit & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)
    # A line that exceeds the maximum number of crossings does not contribute.
    return dr.select(crossings < MOST_CROSSINGS, attenuation, 0), rng


@symbolic
def trace_to_infinity(
    scene: mi.Scene,
    media: Media,
    ray: mi.Ray3f,
    pointer: mi.MediumPtr,
    lamps: Sequence[mi.EmitterPtr],
    rng: mi.PCG32,
    active: mi.Bool,
    clear: mi.Bool = False,
):
    """Follow ``ray`` straight through null surfaces and ``media`` until it leaves the scene.

    ``clear`` states that there is no medium before the first surface. Returns unbiased estimates of
    the transmittance (0 if a surface blocks the ray) and of the radiance from emissive media and
    those ``lamps`` that the ray hits, and the random number generator.
    """
    attenuation, radiance, escaped = mi.Spectrum(1), mi.Spectrum(0), mi.Bool(False)
    ray, pointer, active = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(active)
    crossings, clear = mi.UInt32(0), mi.Bool(clear)
    while dr.hint(active, label="out of the scene"):
        si = scene.ray_intersect(ray, active)
        hit, within = active & si.is_valid(), active & ~clear
        if dr.hint(media.is_emissive, mode="scalar"):
            *_, rng, emitted = media.sample_distance(pointer, ray, si.t, attenuation, rng, within)
            radiance += dr.select(within, emitted, 0)
        factor, rng = media.transmittance(pointer, ray, si.t, rng, within)
        attenuation = dr.select(within, attenuation * factor, attenuation)
        clear = mi.Bool(False)
        escaped |= active & ~hit
        for lamp in lamps:
            hit_lamp = hit & (si.shape.emitter() == lamp)
            radiance += dr.select(hit_lamp, attenuation * si.shape.emitter().eval(si, hit_lamp), 0)
        ray, pointer, attenuation = straight_through(si, ray, pointer, attenuation, hit)
        crossings += 1
        active &= hit & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)
    return dr.select(escaped, attenuation, 0), radiance, rng


def distance_to(record: mi.DirectionSample3f) -> mi.Float:
    """Return the distance of a sampled emitter: beyond all shapes for suns and environments, where
    Mitsuba's follows from the bounding box of the scene, which may be too small (`core/bounds`).
    """
    return dr.select(are_distant(record.emitter), FAR * record.dist, record.dist)


def position_on(record: mi.DirectionSample3f, vertex: mi.Interaction3f) -> mi.Point3f:
    """Return where a shadow ray from ``vertex`` to a sampled emitter ends, see `distance_to`."""
    beyond = vertex.p + FAR * record.dist * record.d
    return dr.select(are_distant(record.emitter), beyond, record.p)


def with_valid_direction(record: mi.DirectionSample3f) -> mi.DirectionSample3f:
    """Return a sample of an emitter with any direction where there is none: in Mitsuba that from a
    black environment map is not a number, and remains so when it is multiplied by 0.
    """
    record.d = dr.select(record.pdf > 0, record.d, mi.Vector3f(0, 0, 1))
    return record


def illuminates(
    scene: mi.Scene,
    vertex: mi.Interaction3f,
    record: mi.DirectionSample3f,
    radiance: mi.Spectrum,
    rng: mi.PCG32,
    active: mi.Bool,
) -> tuple[mi.Bool, mi.PCG32]:
    """Return whether a sample of an emitter has ``radiance`` that no surface blocks on the way to
    ``vertex``, and the random number generator. Surfaces that let light pass straight do not block.
    """
    sampled = active & (record.pdf > 0) & (dr.max(radiance) > 0)
    target = position_on(with_valid_direction(record), vertex)
    none = dr.zeros(mi.MediumPtr, dr.width(vertex.p))
    passed, rng = visibility(scene, Media([]), vertex, target, none, rng, sampled, exact=True)
    return sampled & (dr.max(passed) > 0), rng


def sample_emitter(
    scene: mi.Scene,
    media: Media,
    vertex: mi.Interaction3f,
    pointer: mi.MediumPtr,
    sample: mi.Point2f,
    rng: mi.PCG32,
    active: mi.Bool,
) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.PCG32]:
    """Sample the radiance of an emitter at ``vertex``, which lies in the medium ``pointer``.

    Returns the direction sample, radiance over density times the transmittance, and the random
    number generator.
    """
    record, radiance = scene.sample_emitter_direction(vertex, sample, False, active)
    record = with_valid_direction(record)
    active_em = active & (record.pdf > 0) & (dr.max(radiance) > 0)
    target = position_on(record, vertex)
    attenuation, rng = visibility(scene, media, vertex, target, pointer, rng, active_em)
    return record, dr.select(active_em, radiance * attenuation, 0), rng


def sample_bsdf(
    si: mi.SurfaceInteraction3f,
    choice: mi.Float,
    sample: mi.Point2f,
    active: mi.Bool,
    lobes: int | None = None,
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float, mi.Bool, mi.Float]:
    """Sample a direction from the BSDF at ``si``, from all its lobes or those with these flags.

    Returns the direction in the world, the BSDF over its density, the factor of the relative
    refractive index, whether the path has a vertex here (not where it passes a null interface), and
    the density [1/sr], 0 for mirrors and smooth refraction.
    """
    context = mi.BSDFContext()
    if lobes is not None:
        context.type_mask = lobes
    found, value = si.bsdf().sample(context, si, choice, sample, active)
    is_vertex = active & ~mi.has_flag(found.sampled_type, mi.BSDFFlags.Null)
    delta = mi.has_flag(found.sampled_type, mi.BSDFFlags.Delta)
    density = dr.select(delta, 0, found.pdf)
    return si.to_world(found.wo), value, found.eta, is_vertex, density
