"""Irradiance cached on the surfaces that a camera sees, and on the surfaces visible from these.

Nodes (`SurfaceNodes`) are created where camera rays hit diffuse surfaces, and then where rays from
these nodes do. Each node gathers the radiance of all directions along cosine-distributed rays:
in-scattered radiance of the media by ray marching, emission, and radiance reflected by other
surfaces, which is linear in the irradiance of their nodes. The irradiances are therefore the
solution of E = E_0 + H E, found by iteration (Goral et al., "Modeling the interaction of light
between diffuse surfaces", 1984). Emitters that cast sharp shadows are excluded: they are sampled
where camera rays end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, concatenated, symbolic
from mitsuba_irrcache.core.sequences import kronecker, random_stream, unit_floats
from mitsuba_irrcache.lights.narrow_sources import SourceTable
from mitsuba_irrcache.render.film import ViewExtent
from mitsuba_irrcache.render.surface_paths import SurfacePaths
from mitsuba_irrcache.render.surface_vertices import facing, lambertian
from mitsuba_irrcache.scene.medium_probe import probe
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, is_null

#: Number of rays by which a node measures the distances of its surroundings; by which a node that
#: camera rays need samples its irradiance; by which other nodes do.
DISTANCE_RAYS, GATHERED, GATHERED_INDIRECT = 32, 128, 32
#: Rays by which a node gathers what forward peaks scatter, per narrow source up to a number of
#: sources, and the mean cosine of the angle between them for a source without extent.
AROUND_SOURCES, MOST_AROUND, MEAN_COSINE = 32, 8, 0.85
#: Nodes of a view up to which all rays are used: more nodes are close to each other, so that their
#: errors average out within a pixel.
FINE_NODES = 1 << 15
#: Number of nodes from which on no further ones are created.
MOST_NODES = 1 << 18
#: Number of rounds in which nodes are created: the first where camera rays end, others where rays
#: from the nodes of the round before end. Paths continue where there are none.
GENERATIONS = 4
#: Gather rays of a launch, at most.
LANES = 1 << 21
#: Smallest cosine between the normal of a node's surface and the axis along which it was found.
MIN_SLOPE = 0.3
#: Relative change of the irradiances at which the iteration ends, and the most iterations.
CONVERGED, MOST_ITERATIONS = 1e-4, 500
#: Number of parts of the rays of each node whose solutions are compared, and the relative change at
#: which their iteration ends. Each part is about as well distributed as all rays.
PARTS, PARTS_CONVERGED = 8, 1e-2
#: Estimated standard error of the mean irradiance on the surfaces in view, relative to it, above
#: which a warning is logged; and the same if emitters are sampled, whose direct irradiance, most of
#: it, is not part of this.
LARGE_NOISE, LARGE_INDIRECT_NOISE = 0.01, 0.03
#: Standard error that more rays aim at if it exceeds LARGE_NOISE, by at most MOST_MORE times their
#: number, and MOST_RAYS in all.
AIMED_NOISE, MOST_MORE, MOST_RAYS = 0.007, 16, 1 << 23


class SurfaceIrradiance:
    """The cached irradiance on the surfaces of a scene."""

    def __init__(
        self,
        paths: SurfacePaths,
        seed: int,
        refinement: int = 1,
        groups: Sequence[tuple[int, int, int]] = (),
    ) -> None:
        """Gather radiance along ``refinement`` times the usual numbers of rays.

        ``groups`` are those of the nodes that ``paths`` have already: the first of consecutive
        nodes, the end, and the usual number of rays.
        """
        self.paths, self.nodes, self.seed = paths, paths.nodes, seed
        self._refinement = refinement
        self._seed = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        self._channels = range(dr.size_v(mi.Spectrum))
        self._groups = list(groups)
        self._exchange: list[Exchange] = []
        self._gathered = 0  # groups
        self._view: ViewExtent | None = None  # the last one

    def renewed(self, paths: SurfacePaths, refinement: int = 1) -> SurfaceIrradiance:
        """Return the same nodes, with irradiance gathered again along ``paths``."""
        return SurfaceIrradiance(paths, self.seed, refinement, self._groups)

    def has_space_for(self, view: ViewExtent) -> bool:
        """Return whether nodes for ``view`` can be added, or were computed last."""
        return self.nodes.count < MOST_NODES or view == self._view

    def prepare(
        self, scene: mi.Scene, view: ViewExtent, ray: mi.Ray3f, pointer: mi.MediumPtr
    ) -> None:
        """Create the nodes that camera rays of a ``view`` need, and compute their irradiance."""
        self._view = view
        self.paths.bound_spacing(view)
        rng = random_stream(mi.sample_tea_32(dr.arange(mi.UInt32, dr.width(ray)), self._seed))
        place, found, _ = self.paths.walk(scene, ray, pointer, rng, mi.Bool(True))
        self._cover(scene, place, found)
        if self._gathered == len(self._groups):
            return
        first, end, _ = self._groups[self._gathered]
        self._complete(scene)
        error = self._standard_error(first, end)
        factor = self._more_rays(error)
        if factor > 1:
            self._refinement *= factor
            self._exchange, self._gathered = [], 0
            self._complete(scene)
            error = self._standard_error(first, end)
        self._warn_of_noise(error)

    def _complete(self, scene: mi.Scene) -> None:
        """Gather radiance at all nodes that have none, and compute the irradiance of all."""
        for first, end, rays in self._groups[self._gathered :]:
            self._gather(scene, first, end, self._refinement * rays)
        self._gathered = len(self._groups)
        self._solve()

    # Placement

    def _cover(self, scene: mi.Scene, place: tuple, active: mi.Bool) -> None:
        """Create all nodes for interpolation at ``place`` (a result of `SurfacePaths.walk`), and
        then those for the positions that rays from these nodes hit.
        """
        first = seen = self.nodes.count
        dr.eval(place, active)  # otherwise each lookup below evaluates one array by itself
        for generation in range(GENERATIONS):
            found = []
            while self.nodes.count < MOST_NODES:
                index = dr.compress(active)
                if not dr.width(index):
                    break
                p, normals, medium, travelled = place
                p, medium = dr.gather(mi.Point3f, p, index), dr.gather(mi.UInt32, medium, index)
                normals = tuple(dr.gather(mi.Normal3f, n, index) for n in normals)
                travelled = dr.gather(mi.Float, travelled, index)
                place = p, normals, medium, travelled
                bounds = self.paths.spacing_bounds(p, travelled, from_node=generation > 0)
                *_, keys, active = self.nodes.find(p, normals, bounds, mi.Bool(True))
                dr.eval(place, keys, active)
                missing = dr.compress(active)
                if not dr.width(missing):
                    break
                keys = [dr.gather(mi.UInt64, key, missing) for key in keys]
                new, origin = self.nodes.add_keys(keys)
                if dr.width(new):
                    origin = dr.gather(mi.UInt32, missing, origin)
                    found.append(self._place(scene, new, dr.gather(mi.UInt32, medium, origin)))
            if not generation:
                seen = self.nodes.count
            if not found:
                break
            place, active = (_joined(parts) for parts in zip(*found, strict=True))
        rays = GATHERED if seen - first <= FINE_NODES else GATHERED_INDIRECT
        groups = (first, seen, rays), (seen, self.nodes.count, GATHERED_INDIRECT)
        self._groups += [group for group in groups if group[0] < group[1]]

    def _place(self, scene: mi.Scene, numbers: mi.UInt32, medium: mi.UInt32) -> tuple:
        """Place new nodes on surfaces. ``medium`` is the number of the one in front of the points
        for which they are created, which other media may separate from the nodes.

        Returns the points that further rays from the nodes hit, and whether they hit any.
        """
        ray, length = self.nodes.rays(numbers)
        p, normals, valid, several = _first_surface(scene, ray, length)
        medium = self._medium_before(scene, p, normals[0], medium)
        dr.eval(p, normals, valid, several, medium)
        count = dr.width(numbers)
        lane, k = Divisor(DISTANCE_RAYS).split(dr.arange(mi.UInt32, count * DISTANCE_RAYS))
        start, rng = self._ray_from(scene, p, normals, numbers, (lane, k), DISTANCE_RAYS)
        pointer = self.paths.media.pointer_of(dr.gather(mi.UInt32, medium, lane))
        active = dr.gather(mi.Bool, valid, lane)
        other, found, (nearest, surface) = self.paths.walk(scene, start, pointer, rng, active)
        closeness = dr.select(active & (nearest > 0), dr.rcp(nearest), 0)
        dr.eval(other, found, closeness, surface)
        mean = dr.block_sum(closeness, DISTANCE_RAYS) / DISTANCE_RAYS
        distance = dr.select(valid, dr.rcp(dr.maximum(mean, 1e-18)), 0)
        clearance = dr.block_reduce(dr.ReduceOp.Min, surface, DISTANCE_RAYS)
        # The surface of a node that might be on either of two is known at finer levels only.
        clearance = dr.select(several, 0, clearance)
        self.nodes.place(p, normals, distance, clearance, medium)
        return other, found

    def _medium_before(
        self, scene: mi.Scene, p: mi.Point3f, normal: mi.Normal3f, nearby: mi.UInt32
    ) -> mi.UInt32:
        """Return the number of the medium in front of surfaces at ``p``; ``nearby`` is that of a
        point nearby.

        It is the medium of that point if no other one has ``p`` in its boundary: rays can miss a
        boundary that nearly coincides with a wall.
        """
        vertex = dr.zeros(mi.Interaction3f, dr.width(p))
        vertex.p, vertex.n = p, normal
        ray = vertex.spawn_ray(mi.Vector3f(normal))
        found = self.paths.media.number_of(probe(scene, ray.o, ray.d))
        around, kept, unknown = mi.UInt32(0), mi.Bool(False), mi.Bool(False)
        for number, grid in enumerate(self.paths.media.grids, 1):
            within = grid.contains(ray.o)
            around += dr.select(within, mi.UInt32(1), 0)
            own = within & (nearby == number)
            kept |= own & grid.has_exact_boundary
            # The extent of some media is known from their data only.
            unknown |= own & (not grid.has_exact_boundary)
        found = dr.select(kept & (around == 1) | unknown & (found == 0), nearby, found)
        return dr.select(around == 0, 0, found)

    def _ray_from(
        self,
        scene: mi.Scene,
        p: mi.Point3f,
        normals: tuple[mi.Normal3f, mi.Normal3f],
        numbers: mi.UInt32,
        ray: tuple[mi.UInt32, mi.UInt32],
        count: int,
    ) -> tuple[mi.Ray3f, mi.PCG32]:
        """Sample cosine-distributed rays from nodes.

        ``ray`` is (lane of the node, number of the ray out of ``count``). Rays of consecutive
        numbers, ``count`` / PARTS at a time, are distributed like all rays.
        """
        lane, k = ray
        part, k = Divisor(count // PARTS).split(k)
        k = k * PARTS + part
        words = mi.sample_tea_32(
            dr.gather(mi.UInt32, self.nodes.streams(numbers)[0], lane), self._seed
        )
        shift = unit_floats(words)
        share = dr.opaque(mi.Float, 1 / count)  # one kernel for all numbers of rays
        u = (mi.Float(k) * share + shift[0] * share, kronecker(k, 1, [shift[1]])[0])
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*u))
        geometric, shading = (dr.gather(mi.Normal3f, n, lane) for n in normals)
        vertex = dr.zeros(mi.Interaction3f, dr.width(lane))
        vertex.p, vertex.n = dr.gather(mi.Point3f, p, lane), geometric
        rng = random_stream(mi.sample_tea_32(words[0] ^ k, words[1]))
        return vertex.spawn_ray(mi.Frame3f(shading).to_world(local)), rng

    # Irradiance

    def _gather(self, scene: mi.Scene, first: int, end: int, rays: int) -> None:
        """Gather radiance along ``rays`` rays from each of the nodes ``first`` to ``end``."""
        per_launch = LANES // rays
        for begin in range(first, end, per_launch):
            count = min(per_launch, end - begin)
            numbers = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, begin)
            p, *normals, distance = self.nodes.positions(numbers)
            medium = self.nodes.medium_number(numbers)
            dr.eval(p, normals, distance, medium)
            lane, k = Divisor(rays).split(dr.arange(mi.UInt32, count * rays))
            ray, rng = self._ray_from(scene, p, normals, numbers, (lane, k), rays)
            pointer = self.paths.media.pointer_of(dr.gather(mi.UInt32, medium, lane))
            active = dr.gather(mi.Float, distance, lane) > 0
            emitted, radiance, _, other, factor = self.paths.follow(
                scene, ray, pointer, rng, active
            )
            weight = dr.opaque(mi.Float, dr.pi / rays)
            radiance, factor = (emitted + radiance) * weight, factor * weight
            dr.eval(radiance, other, factor)  # in one launch
            parts = [dr.block_sum(c, rays // PARTS) for c in list(radiance)]
            own = [dr.block_sum(c, PARTS) for c in parts]
            place = p, normals, medium, distance
            peak = self.paths.peak
            parts_around = 0 if peak is None else min(peak.narrow.count, MOST_AROUND)
            for number in range(parts_around):
                around = self._gather_around(scene, numbers, place, number, parts_around)
                own = [a + b for a, b in zip(own, around, strict=True)]
            mean = PARTS / len(parts) * sum(parts)
            dr.eval(own, mean)
            self._exchange.append(Exchange(rays, own, other, list(factor), mean))

    def _gather_around(
        self, scene: mi.Scene, numbers: mi.UInt32, place: tuple, part: int, parts: int
    ) -> list[mi.Float]:
        """Return a ``part`` of the irradiance at nodes due to radiance of narrow sources that
        truncated forward peaks scatter, of as many ``parts`` as there are sources or fewer.

        Rays are distributed around the directions of the sources like the Henyey-Greenstein phase
        function, the more broadly the larger a source. Each finds the radiance of all sources, so
        that its density is the mean of those around each (balance heuristic, Veach and Guibas
        1995).
        """
        # docs/primer, eq. (5.12)
        p, (geometric, shading), medium, distance = place
        sources = self.paths.peak.narrow
        lane, k = Divisor(AROUND_SOURCES).split(
            dr.arange(mi.UInt32, dr.width(numbers) * AROUND_SOURCES)
        )
        k += dr.opaque(mi.UInt32, part * AROUND_SOURCES)
        words = mi.sample_tea_32(
            dr.gather(mi.UInt32, self.nodes.streams(numbers)[1], lane), self._seed
        )
        shift = unit_floats(words)
        share = dr.opaque(mi.Float, 1 / (AROUND_SOURCES * parts))
        count = dr.opaque(mi.UInt32, sources.count)
        vertex = dr.zeros(mi.Interaction3f, dr.width(lane))
        vertex.p = dr.gather(mi.Point3f, p, lane)
        vertex.n = dr.gather(mi.Normal3f, geometric, lane)
        chosen_by = (mi.Float(k) + shift[0]) * share * mi.Float(count)
        number = dr.minimum(mi.UInt32(chosen_by), count - 1)
        u = dr.minimum(chosen_by - mi.Float(number), 1), kronecker(k, 1, [shift[1]])[0]
        towards, cosine = sources.seen_from(vertex.p, number)
        local = _henyey_greenstein(_mean_cosine(cosine), mi.Point2f(*u))
        ray = vertex.spawn_ray(mi.Frame3f(towards).to_world(local))
        normal = dr.gather(mi.Normal3f, shading, lane)
        density = _mean_density(sources, count, vertex.p, ray.d)
        weight = dr.maximum(dr.dot(normal, ray.d), 0) * share / density
        above = (weight > 0) & (dr.dot(vertex.n, ray.d) > 0)
        active = above & (dr.gather(mi.Float, distance, lane) > 0)
        pointer = self.paths.media.pointer_of(dr.gather(mi.UInt32, medium, lane))
        rng = random_stream(mi.sample_tea_32(words[0] ^ k, words[1]))
        radiance = self.paths.scattered_forward(scene, ray, pointer, rng, active)
        found = dr.select(active, radiance * weight, 0)
        dr.eval(found)
        return [dr.block_sum(c, AROUND_SOURCES) for c in list(found)]

    def _solve(self) -> None:
        """Solve E = E_0 + H E by iteration."""
        # docs/primer, eq. (5.8)
        total = [concatenated([part.own[c] for part in self._exchange]) for c in self._channels]

        def following(total: list[mi.Float]) -> list[mi.Float]:
            parts = [part.gathered(total) for part in self._exchange]
            return [concatenated([part[c] for part in parts]) for c in self._channels]

        self.paths.irradiance = _fixed_point(following, total, CONVERGED)

    def _more_rays(self, error: float) -> int:
        """Return by what factor, a power of two, there should be more rays for a standard
        ``error``.
        """
        if not error > LARGE_NOISE:
            return 1
        rays = self._refinement * sum((end - first) * n for first, end, n in self._groups)
        wanted = np.ceil(np.log2((error / AIMED_NOISE) ** 2))
        affordable = np.floor(np.log2(max(MOST_RAYS / rays, 1)))
        return 1 << int(min(wanted, affordable, np.log2(MOST_MORE)))

    def _warn_of_noise(self, error: float) -> None:
        """Log a warning if the mean irradiance in view has a large standard ``error``."""
        is_indirect = self.paths.emitters.count[0] > 0
        if error > (LARGE_INDIRECT_NOISE if is_indirect else LARGE_NOISE):
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: the irradiance on surfaces has noise of about {error:.1%} of its mean, "
                "and several times as much in small regions: few of the rays that sample it find "
                "the light, for example through a small window. Raise cache_spp, which multiplies "
                "their number, or render with volpath.",
            )

    def _standard_error(self, first: int, end: int) -> float:
        """Estimate the standard error of the mean irradiance of the nodes from ``first`` to
        ``end``, relative to it, from solutions with parts of the rays.
        """
        channels = len(self._channels)
        mean = sum(self.paths.irradiance) * (1 / channels)

        def following(total: list[mi.Float]) -> list[mi.Float]:
            return [concatenated([part.parts_gathered(*total) for part in self._exchange])]

        (total,) = _fixed_point(following, [dr.repeat(mean, PARTS)], PARTS_CONVERGED)
        lane = dr.arange(mi.UInt32, (end - first) * PARTS) + dr.opaque(mi.UInt32, first * PARTS)
        _, part = Divisor(PARTS).split(lane)
        sums = dr.zeros(mi.Float, PARTS)
        dr.scatter_add(sums, dr.gather(mi.Float, total, lane), part)
        found = np.array(sums, dtype=np.float64)
        return float(found.std(ddof=1) / np.sqrt(PARTS) / max(found.mean(), 1e-300))


class Exchange:
    """Rows of E = E_0 + H E for consecutive nodes: ``own`` is E_0, and ``factors`` are those of the
    irradiance of the ``other`` nodes that their rays hit, ``rays`` per node. ``parts`` are E_0 by
    PARTS of the rays, the mean of the channels.
    """

    def __init__(
        self,
        rays: int,
        own: list[mi.Float],
        other: mi.UInt32,
        factors: list[mi.Float],
        parts: mi.Float,
    ) -> None:
        self.rays, self.own, self.other, self.factors = rays, own, other, factors
        self.parts = parts

    def gathered(self, total: list[mi.Float]) -> list[mi.Float]:
        """Return the irradiance per channel, given the irradiance ``total`` of all nodes."""
        received = [
            factor * dr.gather(mi.Float, values, self.other)
            for factor, values in zip(self.factors, total, strict=True)
        ]
        dr.eval(received)
        return [a + dr.block_sum(b, self.rays) for a, b in zip(self.own, received, strict=True)]

    def parts_gathered(self, total: mi.Float) -> mi.Float:
        """Return the irradiance by each of PARTS of the rays, given that of all nodes by the same
        parts: the mean of the channels.
        """
        rays = self.rays // PARTS
        part, _ = Divisor(rays).split(dr.arange(mi.UInt32, dr.width(self.other)))
        _, part = Divisor(PARTS).split(part)
        factor = sum(self.factors) * (PARTS / len(self.factors))
        received = factor * dr.gather(mi.Float, total, self.other * PARTS + part)
        dr.eval(received)
        return self.parts + dr.block_sum(received, rays)


def _fixed_point(
    following: Callable[[list[mi.Float]], list[mi.Float]], total: list[mi.Float], converged: float
) -> list[mi.Float]:
    """Iterate ``following`` from ``total`` until the relative change is at most ``converged``."""
    for _ in range(MOST_ITERATIONS):
        before, total = total, following(total)
        change = sum(dr.sum(dr.abs(a - b)) for a, b in zip(total, before, strict=True))
        scale = sum(dr.sum(a) for a in total)
        dr.eval(total, change, scale)
        if not change[0] > converged * scale[0]:
            break
    return total


def _mean_cosine(cosine: mi.Float) -> mi.Float:
    """Return the mean cosine of the angle between rays and the direction of a source, given the
    ``cosine`` of its angular radius (`Source.seen_from`).
    """
    radius = dr.sqrt(dr.maximum(1 - dr.square(dr.minimum(cosine, 1)), 0))
    return MEAN_COSINE * dr.select(cosine > 1, 0.1, dr.maximum(1 - radius, 0.1))


def _henyey_greenstein(g: mi.Float, u: mi.Point2f) -> mi.Vector3f:
    """Sample a direction around the z axis with the mean cosine ``g`` > 0."""
    ratio = (1 - dr.square(g)) / dr.fma(2 * g, u.x, 1 - g)
    cosine = dr.clip((1 + dr.square(g) - dr.square(ratio)) / (2 * g), -1, 1)
    sine = dr.sqrt(1 - dr.square(cosine))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
    return mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine)


@symbolic
def _mean_density(sources: SourceTable, count: mi.UInt32, p: mi.Point3f, direction: mi.Vector3f):
    """Return the density [1/sr] of rays around ``count`` sources, as many around each."""
    total, number = mi.Float(0), mi.UInt32(0)
    while dr.hint(number < count, label="sources"):
        towards, cosine = sources.seen_from(p, number)
        g = _mean_cosine(cosine)
        base = dr.maximum(1 + dr.square(g) - 2 * g * dr.dot(direction, towards), 1e-12)
        total += dr.inv_four_pi * (1 - dr.square(g)) / (base * dr.sqrt(base))
        number += 1
    return total / mi.Float(count)


def _joined(parts: Sequence) -> object:
    """Concatenate arrays, or tuples of them."""
    first = parts[0]
    if isinstance(first, tuple):
        return tuple(_joined(each) for each in zip(*parts, strict=True))
    if isinstance(first, (mi.Point3f, mi.Normal3f)):
        return type(first)(*(concatenated([part[k] for part in parts]) for k in range(3)))
    return concatenated(list(parts))


@symbolic
def _first_surface(scene: mi.Scene, ray: mi.Ray3f, length: mi.Float):
    """Find the first surface along ``ray`` that is neither null nor black on the side of the ray.

    Returns its position, its geometric and shading normal, and whether it is diffuse; and whether
    there are further ones up to ``length``, to which a node with this ray might belong as well.
    """
    ray, remaining = mi.Ray3f(ray), mi.Float(length)
    position, geometric, shading = mi.Point3f(0), mi.Normal3f(0), mi.Normal3f(0)
    found, met, several = mi.Bool(False), mi.Bool(False), mi.Bool(False)
    active, crossings = mi.Bool(True), mi.UInt32(0)
    while dr.hint(active, label="place nodes"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid() & (si.t <= remaining)
        remaining -= si.t
        null = is_null(si.bsdf().flags())
        diffuse, value = lambertian(si, active & ~null)
        # Surfaces like the back of a one-sided one reflect nothing, so that they need no nodes.
        black = diffuse & ~(dr.max(value) > 0)
        several |= met & active & ~null & ~black
        diffuse &= ~black & ~met
        normals = facing(si, ray.d)
        steep = dr.abs(dr.dot(normals[0], ray.d)) < MIN_SLOPE
        position = dr.select(diffuse, si.p, position)
        geometric = dr.select(diffuse, normals[0], geometric)
        shading = dr.select(diffuse, normals[1], shading)
        found |= diffuse & ~steep
        met |= active & ~null & ~black
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= ~several & (crossings < MOST_CROSSINGS)
    return position, (geometric, shading), found, several
