"""Path tracing through surfaces and several media: distance sampling, visibility, paths.

The same path loop serves both sides of the method: from voxel centres it estimates the irradiance,
from surfaces seen by the camera it estimates the reflected radiance. Surfaces, BSDFs and emitters
are Mitsuba's; media are sampled on their grids, with local majorants and analytic transmittance for
homogeneous ones.

Depth has the meaning it has in ``volpath``: every collision in a medium and every surface that is
not null is a vertex of the path; null surfaces are free. An emitter contributes if fewer than
``max_depth`` vertices precede it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import interaction
from mitsuba_irrcache.transport.tracking import free_flight, medium_transmittance, transmittance

#: Maximum number of surface crossings of a path; coincident surfaces could otherwise loop forever.
MOST_CROSSINGS = 1024
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

        Returns whether the ray collides, the distance, the path throughput behind the collision
        including the albedo, the random number generator, and the weighted emission along the
        segment.
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


def is_null(flags: mi.UInt32) -> mi.Bool:
    """Whether a BSDF with these flags is an ideal null interface."""
    return (flags & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.Null)


def transmits(flags: mi.UInt32) -> mi.Bool:
    """Whether a BSDF with these flags lets radiance through, refracted, scattered or straight."""
    return (flags & int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)) != 0


def flags_of(shape: mi.Shape) -> int:
    """Return the flags of the BSDF of a shape, 0 without one."""
    return int(shape.bsdf().flags()) if shape.bsdf() is not None else 0


def refracts(shape: mi.Shape) -> bool:
    """Whether radiance passes a shape other than straight, or is reflected by it as well."""
    flags = flags_of(shape)
    return bool(transmits(flags)) and not is_null(flags)


def is_surface(shape: mi.Shape) -> bool:
    """Whether a shape is more than the boundary of a medium: it scatters, emits or measures."""
    return not is_null(flags_of(shape)) or shape.is_emitter() or shape.is_sensor()


def is_solid(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a surface is more than the boundary of a medium: it scatters or emits."""
    return ~is_null(si.bsdf().flags()) | (si.shape.emitter() != None)  # noqa: E711


def medium_after(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, pointer: mi.MediumPtr):
    """Return the medium behind a surface for a ray that is in the medium ``pointer`` before it."""
    return dr.select(si.is_medium_transition(), si.target_medium(direction), pointer)


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return the weight of a sample with density ``a`` and alternative density ``b``.

    Power heuristic of multiple importance sampling (Veach and Guibas 1995).
    """
    # docs/primer, eq. (3.2)
    a, b = dr.square(a), dr.square(b)
    return dr.select(a > 0, a / (a + b), 0)


@symbolic
def visibility(
    scene: mi.Scene,
    media: Media,
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
):
    """Follow ``ray`` straight through null surfaces and ``media`` until it leaves the scene.

    Returns unbiased estimates of the transmittance (0 if a surface blocks the ray) and of the
    radiance from emissive media and those ``lamps`` that the ray hits, and the random number
    generator.
    """
    attenuation, radiance, escaped = mi.Spectrum(1), mi.Spectrum(0), mi.Bool(False)
    ray, pointer, active = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="out of the scene"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        if dr.hint(media.is_emissive, mode="scalar"):
            *_, rng, emitted = media.sample_distance(pointer, ray, si.t, attenuation, rng, active)
            radiance += dr.select(active, emitted, 0)
        factor, rng = media.transmittance(pointer, ray, si.t, rng, active)
        attenuation = dr.select(active, attenuation * factor, attenuation)
        escaped |= active & ~hit
        for lamp in lamps:
            hit_lamp = hit & (si.shape.emitter() == lamp)
            radiance += dr.select(hit_lamp, attenuation * si.shape.emitter().eval(si, hit_lamp), 0)
        factor = si.bsdf().eval_null_transmission(si, hit)
        attenuation = dr.select(hit, attenuation * factor, attenuation)
        pointer = dr.select(hit, medium_after(si, ray.d, pointer), pointer)
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= hit & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)
    return dr.select(escaped, attenuation, 0), radiance, rng


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
    active_em = active & (record.pdf > 0) & (dr.max(radiance) > 0)
    attenuation, rng = visibility(scene, media, vertex, record.p, pointer, rng, active_em)
    return record, dr.select(active_em, radiance * attenuation, 0), rng


class PathStart:
    """Initial state of paths: a ray, its medium, and how it was sampled.

    ``depth`` is the number of preceding vertices. ``pdf`` is the density of the ray's direction if
    emitters were also sampled at the previous vertex; 0 if not, so that emitters hit by the ray
    count fully. ``clear`` states that there is no medium before the first surface. The radiance of
    the emitters ``excluded`` is not added if the ray hits them before any other vertex.
    """

    def __init__(
        self,
        ray: mi.Ray3f,
        pointer: mi.MediumPtr,
        depth: int,
        pdf: float,
        clear: bool = False,
        excluded: Sequence[mi.EmitterPtr] = (),
    ) -> None:
        self.ray, self.pointer = ray, pointer
        self.depth, self.pdf, self.clear = depth, pdf, clear
        self.excluded = tuple(excluded)


class PathEnd:
    """Final state of paths that end in a medium whose radiance is known.

    Position, direction and medium of the collision, and the path throughput ``weight`` including
    the albedo; 0 for paths that end elsewhere.
    """

    def __init__(
        self, p: mi.Point3f, direction: mi.Vector3f, pointer: mi.MediumPtr, weight: mi.Spectrum
    ) -> None:
        self.p, self.direction, self.pointer, self.weight = p, direction, pointer, weight


@symbolic
def trace(
    scene: mi.Scene,
    media: Media,
    start: PathStart,
    max_depth: mi.UInt32,
    rr_depth: mi.UInt32,
    hide_emitters: bool,
    rng: mi.PCG32,
    active: mi.Bool,
    known: Callable | None = None,
):
    """Trace one path per lane.

    Returns the radiance received directly from emitters and emissive media, the scattered radiance,
    whether any interaction occurred, the path's `PathEnd`, and the random number generator.

    ``known`` is an optional predicate that selects media whose radiance is known; paths end with
    their first collision in such a medium.
    """
    direct, scattered = mi.Spectrum(0), mi.Spectrum(0)
    throughput, eta = mi.Spectrum(1), mi.Float(1)
    ray, pointer = mi.Ray3f(start.ray), mi.MediumPtr(start.pointer)
    depth, crossings = mi.UInt32(start.depth), mi.UInt32(0)
    pdf = mi.Float(start.pdf)  #: density of the current direction, 0 if emitters were not sampled
    last = dr.zeros(mi.Interaction3f)  #: previous vertex
    last.p = ray.o
    clear, interacted = mi.Bool(start.clear), mi.Bool(False)
    end_position, end_direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    end_medium = mi.MediumPtr(pointer)
    end_throughput = mi.Spectrum(0)  #: throughput at the end
    active = mi.Bool(active) & (depth < max_depth)
    context = mi.BSDFContext()
    while dr.hint(active, label="paths"):
        # Apply Russian roulette as volpath does; it bounds the variation of the throughput.
        survival = dr.minimum(dr.max(throughput) * dr.square(eta), MAX_SURVIVAL)
        survival = dr.select(depth > rr_depth, survival, 1)
        active &= (rng.next_float32(active) < survival) & (dr.max(throughput) > 0)
        throughput = dr.select(active, throughput / survival, throughput)

        si = scene.ray_intersect(ray, active)
        collided, t, throughput, rng, emitted = media.sample_distance(
            pointer, ray, si.t, throughput, rng, active & ~clear
        )
        first = depth == start.depth
        direct += dr.select(first, emitted, 0)
        scattered += dr.select(first, 0, emitted)
        clear = mi.Bool(False)
        surface = active & ~collided
        interacted |= collided
        if dr.hint(known is not None, mode="scalar"):
            is_end = collided & known(pointer)
            end_position = dr.select(is_end, ray(t), end_position)
            end_direction = dr.select(is_end, ray.d, end_direction)
            end_medium = dr.select(is_end, pointer, end_medium)
            end_throughput = dr.select(is_end, throughput, end_throughput)
            collided &= ~is_end

        # Add emission of emitters hit by the ray, with multiple importance sampling.
        emitter = si.emitter(scene, surface)
        hit_emitter = surface & (emitter != None)  # noqa: E711
        skipped = mi.Bool(False)
        if dr.hint(hide_emitters, mode="scalar"):
            hidden = hit_emitter & (depth == 0)
            hit_emitter &= ~hidden
            # As in volpath, hidden emitters are transparent if they are outside of all media.
            skipped = hidden & si.is_valid() & (pointer == None)  # noqa: E711
        record = mi.DirectionSample3f(scene, si, last)
        sampled = hit_emitter & (pdf > 0)
        density = scene.pdf_emitter_direction(last, record, sampled)
        mis_weight = dr.select(sampled, power_heuristic(pdf, density), 1)
        emitted = dr.select(hit_emitter, throughput * emitter.eval(si, hit_emitter) * mis_weight, 0)
        for excluded in start.excluded:
            emitted = dr.select(first & (emitter == excluded), 0, emitted)
        direct += dr.select(first, emitted, 0)
        scattered += dr.select(first, 0, emitted)
        surface &= si.is_valid()

        # Construct the next vertex and sample an emitter from it.
        scatters = surface & ~skipped
        bsdf = si.bsdf()
        smooth = scatters & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        vertex = dr.zeros(mi.Interaction3f)
        vertex.p = dr.select(collided, ray(t), si.p)
        vertex.n = dr.select(collided, 0, si.n)
        vertex.time, vertex.wavelengths = ray.time, ray.wavelengths
        active_em = (collided | smooth) & (depth + 1 < max_depth)
        sample = mi.Point2f(rng.next_float32(active_em), rng.next_float32(active_em))
        record, emitted = scene.sample_emitter_direction(vertex, sample, False, active_em)
        active_em &= (record.pdf > 0) & (dr.max(emitted) > 0)
        value, density = bsdf.eval_pdf(context, si, si.to_local(record.d), active_em & smooth)
        value = dr.select(collided, mi.Spectrum(dr.inv_four_pi), value)
        density = dr.select(collided, dr.inv_four_pi, density)
        if dr.hint(not media.isotropic, mode="scalar"):
            collision, phase = interaction(ray(t), ray.d), pointer.phase_function()
            value, density = _phase_value(
                phase, collision, record.d, active_em & collided, value, density
            )
        active_em &= dr.max(value) > 0
        medium_em = dr.select(surface, medium_after(si, record.d, pointer), pointer)
        attenuation, rng = visibility(scene, media, vertex, record.p, medium_em, rng, active_em)
        mis_weight = power_heuristic(record.pdf, dr.select(record.delta, 0, density))
        scattered += dr.select(
            active_em, throughput * value * emitted * attenuation * mis_weight, 0
        )

        # Sample the BSDF or the phase function and continue the path.
        choice = rng.next_float32(active)
        sample = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
        towards, value, scale, is_vertex, density = sample_bsdf(si, choice, sample, scatters)
        throughput = dr.select(scatters, throughput * value, throughput)
        eta = dr.select(scatters, eta * scale, eta)
        pdf = dr.select(is_vertex, density, pdf)
        pdf = dr.select(collided, dr.inv_four_pi, pdf)
        direction = mi.warp.square_to_uniform_sphere(sample)
        if dr.hint(not media.isotropic, mode="scalar"):
            direction, value, density = phase.sample(
                mi.PhaseFunctionContext(), collision, choice, sample, collided
            )
            throughput = dr.select(collided, throughput * value, throughput)
            pdf = dr.select(collided, density, pdf)
        next_direction = dr.select(skipped, ray.d, towards)
        next_ray = si.spawn_ray(next_direction)
        pointer = dr.select(scatters, medium_after(si, next_direction, pointer), pointer)
        ray.o = dr.select(collided, vertex.p, next_ray.o)
        ray.d = dr.select(collided, direction, next_ray.d)
        is_vertex |= collided
        last = dr.select(is_vertex, vertex, last)
        depth = dr.select(is_vertex, depth + 1, depth)
        interacted |= is_vertex
        crossings += 1
        active &= (collided | surface) & (depth < max_depth) & (crossings < MOST_CROSSINGS)
    end = PathEnd(end_position, end_direction, end_medium, end_throughput)
    return direct, scattered, interacted, end, rng


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


def _phase_value(
    phase: mi.PhaseFunctionPtr,
    collision: mi.MediumInteraction3f,
    towards: mi.Vector3f,
    active: mi.Bool,
    value: mi.Spectrum,
    density: mi.Float,
) -> tuple[mi.Spectrum, mi.Float]:
    """Evaluate the phase function and its density ``towards`` a direction where ``active``.

    Elsewhere ``value`` and ``density`` are returned unchanged.
    """
    own, pdf = phase.eval_pdf(mi.PhaseFunctionContext(), collision, towards, active)
    return dr.select(active, own, value), dr.select(active, pdf, density)
