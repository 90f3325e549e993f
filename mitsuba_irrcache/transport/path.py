"""Light transport through surfaces and several media: flights, visibility of emitters, paths.

One path loop serves both sides of the method: from voxel centres it estimates what reaches them,
from surfaces that the camera sees what they send back. Surfaces are what Mitsuba's
``ray_intersect`` says, their scattering and the emitters are Mitsuba's own plugins; media are
tracked on their baked grids, with local majorants and analytic transmittance where nothing varies.

Depths count as in ``volpath``: a vertex of a path is a collision in a medium or a surface that is
not null; crossing a null surface costs nothing. Light from an emitter is counted if it passes fewer
than ``max_depth`` vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import interaction
from mitsuba_irrcache.transport.tracking import free_flight, transmittance

#: Surfaces that a straight line may cross; two that coincide could otherwise hold it for ever.
MOST_CROSSINGS = 1024
#: Roulette spares this much of all paths, as in ``volpath``.
MOST_SURVIVE = 0.95


class Media(Immutable):
    """The media of a scene. Rays know the medium they are in by Mitsuba's pointer; null is none."""

    def __init__(self, grids: Sequence[MediumGrid]) -> None:
        self.grids = tuple(grids)
        self.isotropic = all(grid.phase.is_isotropic for grid in self.grids)

    @property
    def emit(self) -> bool:
        """Whether any of them emits radiance itself."""
        return any(grid.emission is not None for grid in self.grids)

    @classmethod
    def around(cls, medium: MediumGrid) -> Media:
        """The media of its scene for paths that end in ``medium``, whose radiance is known, and in
        no other one: there light scattered into forward peaks counts as scattered.
        """
        before, after = medium.others[: medium.number], medium.others[medium.number :]
        return cls([*before, medium, *after])

    def pointer_of(self, number: mi.UInt32) -> mi.MediumPtr:
        """Mitsuba's medium with this number: 1 for the first one, 0 for none."""
        pointer = dr.zeros(mi.MediumPtr, dr.width(number))
        for i, grid in enumerate(self.grids):
            pointer = dr.select(number == i + 1, grid.pointer, pointer)
        return pointer

    def without(self, medium: MediumGrid) -> Media:
        """All but one."""
        return Media([grid for grid in self.grids if grid is not medium])

    def fly(
        self,
        pointer: mi.MediumPtr,
        ray: mi.Ray3f,
        far: mi.Float,
        weight: mi.Spectrum,
        rng: mi.PCG32,
        active: mi.Bool,
    ) -> tuple[mi.Bool, mi.Float, mi.Spectrum, mi.PCG32, mi.Spectrum]:
        """Free flight up to ``far``: whether the ray collides, where, its weight behind that, the
        albedo included, the generator, and what the media on the way send out, weighted.
        """
        collided, t, emitted = mi.Bool(False), mi.Float(far), mi.Spectrum(0)
        for grid in self.grids:
            hit, near, end = grid.intersect(ray)
            hit &= active & (pointer == grid.pointer)
            near, end = dr.maximum(near, 0), dr.minimum(end, far)
            here, place, weight, rng, light = free_flight(grid, ray, near, end, weight, rng, hit)
            emitted += light
            albedo = mi.Spectrum(grid.albedo.at_world(ray(place), here))
            weight = dr.select(here, weight * albedo, weight)
            t = dr.select(here, place, t)
            collided |= here
        return collided, t, weight, rng, emitted

    def transmittance(
        self, pointer: mi.MediumPtr, ray: mi.Ray3f, far: mi.Float, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.PCG32]:
        """An unbiased estimate of the transmittance up to ``far``."""
        through = mi.Spectrum(1)
        for grid in self.grids:
            hit, near, end = grid.intersect(ray)
            hit &= active & (pointer == grid.pointer)
            near, end = dr.maximum(near, 0), dr.minimum(end, far)
            passed, rng = transmittance(grid, ray, near, end, rng, hit)
            through = dr.select(hit & (near < end), through * mi.Spectrum(passed), through)
        return through, rng


def is_null(flags: mi.UInt32) -> mi.Bool:
    """Whether a BSDF of these flags lets all light pass as if it was not there."""
    return (flags & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.Null)


def medium_after(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, pointer: mi.MediumPtr):
    """The medium that a ray is in behind a surface, where it was in ``pointer`` before."""
    return dr.select(si.is_medium_transition(), si.target_medium(direction), pointer)


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a sample of density ``a`` that might also have come with density ``b``."""
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
):
    """An unbiased estimate of what passes from ``vertex`` to ``target``, through null surfaces (in
    part, where they are so in part) and all media between; the random generator.
    """
    ray = vertex.spawn_ray_to(target)
    through, pointer, active = mi.Spectrum(1), mi.MediumPtr(pointer), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="visibility"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        passed = si.bsdf().eval_null_transmission(si, hit)
        through = dr.select(hit, through * passed, through)
        active &= dr.max(through) > 0
        far = dr.minimum(si.t, ray.maxt)
        passed, rng = media.transmittance(pointer, ray, far, rng, active)
        through = dr.select(active, through * passed, through)
        pointer = dr.select(hit, medium_after(si, ray.d, pointer), pointer)
        ray = si.spawn_ray_to(target)
        crossings += 1
        active &= hit & (dr.max(through) > 0) & (crossings < MOST_CROSSINGS)
    # A line that ends on the way brings nothing.
    return dr.select(crossings < MOST_CROSSINGS, through, 0), rng


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
    """Straight along ``ray``, through null surfaces and ``media``: an unbiased estimate of what
    passes out of the scene, the radiance of these media and of those ``lamps`` that are met on the
    way, and the random generator.
    """
    through, light, escaped = mi.Spectrum(1), mi.Spectrum(0), mi.Bool(False)
    ray, pointer, active = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="out of the scene"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        if dr.hint(media.emit, mode="scalar"):
            *_, rng, glow = media.fly(pointer, ray, si.t, through, rng, active)
            light += dr.select(active, glow, 0)
        passed, rng = media.transmittance(pointer, ray, si.t, rng, active)
        through = dr.select(active, through * passed, through)
        escaped |= active & ~hit
        for lamp in lamps:
            shines = hit & (si.shape.emitter() == lamp)
            light += dr.select(shines, through * si.shape.emitter().eval(si, shines), 0)
        passed = si.bsdf().eval_null_transmission(si, hit)
        through = dr.select(hit, through * passed, through)
        pointer = dr.select(hit, medium_after(si, ray.d, pointer), pointer)
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= hit & (dr.max(through) > 0) & (crossings < MOST_CROSSINGS)
    return dr.select(escaped, through, 0), light, rng


def sample_emitter(
    scene: mi.Scene,
    media: Media,
    vertex: mi.Interaction3f,
    pointer: mi.MediumPtr,
    sample: mi.Point2f,
    rng: mi.PCG32,
    active: mi.Bool,
) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.PCG32]:
    """A sample of the light that reaches ``vertex`` straight from an emitter: where it comes from,
    radiance over density with the transmittance on the way, and the random generator. ``pointer``
    is the medium at the vertex.
    """
    record, light = scene.sample_emitter_direction(vertex, sample, False, active)
    lit = active & (record.pdf > 0) & (dr.max(light) > 0)
    passed, rng = visibility(scene, media, vertex, record.p, pointer, rng, lit)
    return record, dr.select(lit, light * passed, 0), rng


class Start:
    """Where paths begin: a ray, the medium it starts in, and how it came about.

    ``depth`` vertices are behind it. Its direction has density ``pdf`` by a vertex that sampled
    emitters too; none did where ``pdf`` is 0, so that emitters which it meets count in full.
    ``clear``: it is known to meet no matter before the first surface.
    """

    def __init__(
        self,
        ray: mi.Ray3f,
        pointer: mi.MediumPtr,
        depth: int,
        pdf: float,
        clear: bool = False,
    ) -> None:
        self.ray, self.pointer = ray, pointer
        self.depth, self.pdf, self.clear = depth, pdf, clear


class End:
    """Where paths end in a medium whose light is known: the place, the direction in which they got
    there, the medium, and the weight of what is scattered towards them there (with the albedo); 0
    for paths that end elsewhere.
    """

    def __init__(
        self, p: mi.Point3f, direction: mi.Vector3f, pointer: mi.MediumPtr, weight: mi.Spectrum
    ) -> None:
        self.p, self.direction, self.pointer, self.weight = p, direction, pointer, weight


@symbolic
def trace(
    scene: mi.Scene,
    media: Media,
    start: Start,
    max_depth: mi.UInt32,
    rr_depth: mi.UInt32,
    hide_emitters: bool,
    rng: mi.PCG32,
    active: mi.Bool,
    known: Callable | None = None,
):
    """One path per lane: radiance that came straight from emitters or media that shine, radiance
    that was scattered, whether anything was scattered, its `End`, and the random generator.

    ``known``, if given, tells of media whether their light is known: all that a path could still
    find there. Paths end with their first collision in such a medium.
    """
    straight, scattered = mi.Spectrum(0), mi.Spectrum(0)
    throughput, eta = mi.Spectrum(1), mi.Float(1)
    ray, pointer = mi.Ray3f(start.ray), mi.MediumPtr(start.pointer)
    depth, crossings = mi.UInt32(start.depth), mi.UInt32(0)
    pdf = mi.Float(start.pdf)  #: of the direction, 0 where emitters could not be sampled
    last = dr.zeros(mi.Interaction3f)  #: the vertex before
    last.p = ray.o
    clear, interacted = mi.Bool(start.clear), mi.Bool(False)
    place, end_direction, where = mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.MediumPtr(pointer)
    end_throughput = mi.Spectrum(0)  #: the throughput at the end
    active = mi.Bool(active) & (depth < max_depth)
    context = mi.BSDFContext()
    while dr.hint(active, label="paths"):
        # Russian roulette as volpath does it; weights stay near one.
        survival = dr.minimum(dr.max(throughput) * dr.square(eta), MOST_SURVIVE)
        survival = dr.select(depth > rr_depth, survival, 1)
        active &= (rng.next_float32(active) < survival) & (dr.max(throughput) > 0)
        throughput = dr.select(active, throughput / survival, throughput)

        si = scene.ray_intersect(ray, active)
        collided, t, throughput, rng, light = media.fly(
            pointer, ray, si.t, throughput, rng, active & ~clear
        )
        first = depth == start.depth
        straight += dr.select(first, light, 0)
        scattered += dr.select(first, 0, light)
        clear = mi.Bool(False)
        surface = active & ~collided
        interacted |= collided
        if dr.hint(known is not None, mode="scalar"):
            ends = collided & known(pointer)
            place = dr.select(ends, ray(t), place)
            end_direction = dr.select(ends, ray.d, end_direction)
            where = dr.select(ends, pointer, where)
            end_throughput = dr.select(ends, throughput, end_throughput)
            collided &= ~ends

        # Emitters that are met by chance, weighted against sampling them from the last vertex.
        emitter = si.emitter(scene, surface)
        glows = surface & (emitter != None)  # noqa: E711
        skipped = mi.Bool(False)
        if dr.hint(hide_emitters, mode="scalar"):
            unseen = glows & (depth == 0)
            glows &= ~unseen
            # As in volpath: hidden emitters are transparent where they stand in no medium.
            skipped = unseen & si.is_valid() & (pointer == None)  # noqa: E711
        record = mi.DirectionSample3f(scene, si, last)
        sampled = glows & (pdf > 0)
        density = scene.pdf_emitter_direction(last, record, sampled)
        share = dr.select(sampled, power_heuristic(pdf, density), 1)
        light = dr.select(glows, throughput * emitter.eval(si, glows) * share, 0)
        straight += dr.select(first, light, 0)
        scattered += dr.select(first, 0, light)
        surface &= si.is_valid()

        # The vertex, and emitters that are sampled from it.
        scatters = surface & ~skipped
        bsdf = si.bsdf()
        smooth = scatters & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        vertex = dr.zeros(mi.Interaction3f)
        vertex.p = dr.select(collided, ray(t), si.p)
        vertex.n = dr.select(collided, 0, si.n)
        vertex.time, vertex.wavelengths = ray.time, ray.wavelengths
        lit = (collided | smooth) & (depth + 1 < max_depth)
        sample = mi.Point2f(rng.next_float32(lit), rng.next_float32(lit))
        record, light = scene.sample_emitter_direction(vertex, sample, False, lit)
        lit &= (record.pdf > 0) & (dr.max(light) > 0)
        value, density = bsdf.eval_pdf(context, si, si.to_local(record.d), lit & smooth)
        value = dr.select(collided, mi.Spectrum(dr.inv_four_pi), value)
        density = dr.select(collided, dr.inv_four_pi, density)
        if dr.hint(not media.isotropic, mode="scalar"):
            collision, phase = interaction(ray(t), ray.d), pointer.phase_function()
            value, density = _phase_value(
                phase, collision, record.d, lit & collided, value, density
            )
        lit &= dr.max(value) > 0
        beyond = dr.select(surface, medium_after(si, record.d, pointer), pointer)
        passed, rng = visibility(scene, media, vertex, record.p, beyond, rng, lit)
        share = power_heuristic(record.pdf, dr.select(record.delta, 0, density))
        scattered += dr.select(lit, throughput * value * light * passed * share, 0)

        # Onwards.
        choice = rng.next_float32(active)
        sample = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
        bounce, value = bsdf.sample(context, si, choice, sample, scatters)
        throughput = dr.select(scatters, throughput * value, throughput)
        eta = dr.select(scatters, eta * bounce.eta, eta)
        turned = scatters & ~mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Null)
        delta = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta)
        pdf = dr.select(turned, dr.select(delta, 0, bounce.pdf), pdf)
        pdf = dr.select(collided, dr.inv_four_pi, pdf)
        direction = mi.warp.square_to_uniform_sphere(sample)
        if dr.hint(not media.isotropic, mode="scalar"):
            direction, value, density = phase.sample(
                mi.PhaseFunctionContext(), collision, choice, sample, collided
            )
            throughput = dr.select(collided, throughput * value, throughput)
            pdf = dr.select(collided, density, pdf)
        outwards = dr.select(skipped, ray.d, si.to_world(bounce.wo))
        onwards = si.spawn_ray(outwards)
        pointer = dr.select(scatters, medium_after(si, outwards, pointer), pointer)
        ray.o = dr.select(collided, vertex.p, onwards.o)
        ray.d = dr.select(collided, direction, onwards.d)
        turned |= collided
        last = dr.select(turned, vertex, last)
        depth = dr.select(turned, depth + 1, depth)
        interacted |= turned
        crossings += 1
        active &= (collided | surface) & (depth < max_depth) & (crossings < MOST_CROSSINGS)
    return straight, scattered, interacted, End(place, end_direction, where, end_throughput), rng


def _phase_value(
    phase: mi.PhaseFunctionPtr,
    collision: mi.MediumInteraction3f,
    towards: mi.Vector3f,
    active: mi.Bool,
    value: mi.Spectrum,
    density: mi.Float,
) -> tuple[mi.Spectrum, mi.Float]:
    """Value and density of scattering ``towards`` a direction; those given where not ``active``."""
    own, pdf = phase.eval_pdf(mi.PhaseFunctionContext(), collision, towards, active)
    return dr.select(active, own, value), dr.select(active, pdf, density)
