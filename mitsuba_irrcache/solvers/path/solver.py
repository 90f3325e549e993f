"""The solver ``path``: unbiased Monte Carlo path tracing from the voxel centres to the emitters.

With isotropic scattering the irradiance at x is a sum over scattering orders (paper, section 3):

    Phi(x) = sum_k E[beta_k D(x_k)],   x_0 = x,  beta_0 = 1,  beta_k = beta_(k-1) albedo(x_k)

where x_k follows from x_(k-1) by a uniform direction and a free flight, and D(x) = int_S2 L_e T dw
is the irradiance at x directly from the emitters. Order 0 is the *uncollided* part of the
cache, the others the *scattered* one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.statistics import BATCH, ORDER_GROUPS
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import kronecker, random_stream
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import occupied_box
from mitsuba_irrcache.lights.emitters import is_never_sampled
from mitsuba_irrcache.lights.falloff import VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.occluders import hole_in
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.solvers.base import Preview, Progress, Solver, SolverTask, register
from mitsuba_irrcache.solvers.grid_size import SizeAmongSurfaces, SizeRule
from mitsuba_irrcache.solvers.path import estimator as volume_path
from mitsuba_irrcache.transport.path import Media, with_valid_direction
from mitsuba_irrcache.transport.path_tracer import PathTracer
from mitsuba_irrcache.transport.tracking import free_flight, transmittance

#: Number of paths in one kernel launch: enough to occupy any machine, few enough to bound memory
#: (about 100 bytes per path).
LANES = 1 << 21

#: Default number of samples of all voxels together: without surfaces, among surfaces, where each
#: sample is more expensive, and behind glass, where paths hit emitters by chance (with 2^22 the
#: error of jade under an environment map was 2.4 %). Minimum and maximum number of samples per
#: voxel.
PATHS, PATHS_AMONG_SURFACES, PATHS_BEHIND_GLASS = 2**24, 2**22, 2**23
FEWEST_SAMPLES, MOST_SAMPLES = 16, 256
#: Cost of a path in paths of ``volpath`` through the image, some of which miss the medium: measured
#: 0.8 in a foggy room, 0.9 to 2.4 behind glass, about 4 in a dense mesh.
PATH_COST = 1.5


@register
class PathSolver(Solver):
    """Traces paths from the voxel centres, in any scene."""

    name = "path"
    #: last, since it supports all scenes
    precedence = 100
    #: The noise of smaller voxels would exceed the error of larger ones, and the work grows with
    #: their number; among surfaces the number of paths does not depend on the number of voxels.
    size_rule = SizeRule(
        target_error=1.0,
        fewest=16,
        most_by_contrast=32,
        most_by_border=32,
        refines_dense_data=False,
        most=128,
        among_surfaces=SizeAmongSurfaces(32, 64, target_error=0.25),
    )
    has_preview = True

    @classmethod
    def why_not(
        cls, scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
    ) -> str | None:
        return None

    @classmethod
    def why(cls, medium: MediumGrid) -> str:
        return "it supports all scenes"

    @classmethod
    def default_samples(cls, medium: MediumGrid, max_depth: int, active_count: int) -> int:
        paths = PATHS_AMONG_SURFACES if medium.is_traced else PATHS
        paths = PATHS_BEHIND_GLASS if medium.refracts else paths
        return int(np.clip(paths // max(active_count, 1), FEWEST_SAMPLES, MOST_SAMPLES))

    @classmethod
    def batch_size(
        cls, medium: MediumGrid, max_depth: int, samples: int, basis: AngularBasis | None
    ) -> int:
        return BATCH

    @classmethod
    def numbers_per_voxel(
        cls, medium: MediumGrid, max_depth: int, moments: int, voxels: int, channels: int
    ) -> int:
        # Sums are in float64.
        return channels * (3 * 2 + 3) + 5 + channels * moments * 3

    @classmethod
    def cost(cls, medium: MediumGrid, active_count: int, samples: int) -> float:
        return active_count * samples * PATH_COST

    @classmethod
    def voxel_classes(
        cls, scene: mi.Scene, media: Media, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> VoxelClasses | None:
        if not medium.is_traced:
            return None
        return VoxelClasses(scene, media, medium, grid, by_centre=True)

    @classmethod
    def knows_direct_lights(
        cls, scene: mi.Scene, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> bool:
        """Return whether straight lines within the boundary of ``medium`` stay in it up to a
        surface.
        """
        if medium.is_isolated or not dr.width(active):
            return medium.is_isolated
        if not medium.has_exact_boundary or medium.others or medium.refracts:
            return False
        return hole_in(scene, medium, grid, occupied_box(grid, active)) is None

    @classmethod
    def batches_at_once(cls, cache: IrradianceCache) -> int:
        return max(1, _lanes(cache) // (BATCH * max(_block(cache), 1)))

    def __init__(self, task: SolverTask) -> None:
        self._task = task

    def refine(self, samples: int, progress: Progress | None = None) -> None:
        task = self._task
        cache, seed = task.cache, task.seed
        dark = not task.description.emitters and task.medium.emission is None
        if not cache.active_count or _orders(cache) < 1 or dark:
            cache.note_samples(seed, samples)
            return
        estimator = _Estimator(task)
        total, done = cache.active_count * samples, 0
        if total > 16 * LANES:
            seconds = estimator.seconds(total)
            mi.Log(mi.LogLevel.Info, f"irrcache: {total:.3g} paths, about {seconds:.0f} s")
        block, batches_at_once = _block(cache), self.batches_at_once(cache)
        remaining = samples // BATCH
        while remaining:
            count = min(batches_at_once, remaining)
            first = cache.streams.get(seed, 0) // BATCH
            blocks = []
            for voxels in _blocks(cache.active_count, block):
                if blocks and progress is not None:
                    progress(done, total)
                blocks.append(estimator.batches(voxels, first, count))
                done += dr.width(voxels) * BATCH * count
            cache.add(seed, BATCH * count, blocks)
            if progress is not None:
                progress(done, total)
            remaining -= count

    def preview(self) -> Opening:
        return Opening(self._task)


def _orders(cache: IrradianceCache) -> int:
    """Return the number of scattering orders in the cache; the largest integer for all."""
    return cache.max_depth - 1 if cache.max_depth >= 0 else 0xFFFFFFFF


def _blocks(count: int, width: int) -> Iterator[mi.UInt32]:
    """Yield the numbers 0 .. ``count`` - 1 in arrays of ``width``; the last one may be shorter."""
    for start in range(0, count, width):
        yield dr.arange(mi.UInt32, min(width, count - start)) + dr.opaque(mi.UInt32, start)


def _lanes(cache: IrradianceCache) -> int:
    """Return the paths per kernel launch: fewer if moments of the radiance are stored as well."""
    return LANES // 8 if cache.moments else LANES


def _block(cache: IrradianceCache) -> int:
    """Return the voxels of one kernel launch."""
    return min(cache.active_count, _lanes(cache) // BATCH)


def _statistics(totals: list, size: int, count: int, channels: int) -> tuple:
    """Compute the statistics of each voxel from sums over batches of ``size`` samples.

    Each voxel has ``count`` consecutive batches. Returns sums of batch means for each order group
    and channel; squared deviations of the irradiance from its mean for each channel; and
    sums of batch means of the moments, if any.
    """
    means = [total / size for total in totals]
    n = dr.opaque(type(means[0]), count)
    both = [means[c] + means[channels + c] for c in range(channels)]
    squares = [dr.square(b) for b in both]
    dr.eval(means, both, squares)  # by one kernel, also where a sum over one batch is part of it
    spreads = [
        dr.maximum(dr.block_sum(s, count) - dr.square(dr.block_sum(b, count)) / n, 0)
        for s, b in zip(squares, both, strict=True)
    ]
    sums = [dr.block_sum(mean, count) for mean in means]
    totals, moments = tuple(sums[: 2 * channels]), tuple(sums[2 * channels :])
    return (totals, tuple(spreads), *([moments] if moments else []))


class Opening(Preview):
    """The first two batches of a stream, which suffice for a standard error, filled in small steps.

    When they are complete they equal the first two batches of `PathSolver.refine`.
    """

    def __init__(self, task: SolverTask) -> None:
        self.cache, self.seed = task.cache, task.seed
        self.size = 0  #: samples of each batch so far
        self._estimator = _Estimator(task)
        # In blocks of voxels, for each order group and channel: the sums of both batches.
        self._totals: list[list] = []

    def grow(self, size: int, progress: Progress | None = None) -> None:
        """Add samples until there are ``size`` in each batch, at most `BATCH`."""
        more, active = size - self.size, self.cache.active_count
        totals, done = [], 0
        for i, voxels in enumerate(_blocks(active, min(active, _lanes(self.cache) // (2 * BATCH)))):
            sums = self._estimator.sums(voxels, 0, 2, self.size, more)
            if self._totals:
                sums = [old + new for old, new in zip(self._totals[i], sums, strict=True)]
            dr.eval(sums)
            dr.sync_thread()
            totals.append(sums)
            done += dr.width(voxels) * 2 * more
            if progress is not None:
                progress(done, active * 2 * more)
        self._totals, self.size = totals, size

    def fill(self, cache: IrradianceCache) -> None:
        """Store both batches in an empty ``cache`` with batches of this size."""
        blocks = [_statistics(sums, self.size, 2, cache.channels) for sums in self._totals]
        cache.add(self.seed, 2 * self.size, blocks)


class _Estimator:
    """Estimates batches, with one kernel for all passes: parameters that differ are opaque."""

    def __init__(self, task: SolverTask) -> None:
        scene, medium, cache = task.scene, task.medium, task.cache
        orders = _orders(cache)
        self.scene, self.media, self.medium, self.cache = (
            scene,
            task.description.media,
            medium,
            cache,
        )
        self.sample_points = VoxelSamplePoints(scene, cache.grid)
        # Direct lights are not sampled from the voxels.
        self._excluded = [mi.EmitterPtr(light.emitter) for light in cache.direct_lights]
        numbers = [
            i
            for i, emitter in enumerate(scene.emitters())
            if all(light.emitter != emitter for light in cache.direct_lights)
            and not is_never_sampled(emitter)
        ]
        self._sampled = None
        if self._excluded:
            self._sampled = dr.gather(mi.EmitterPtr, scene.emitters_dr(), mi.UInt32(numbers))
        # Emission of the medium is estimated along the flight to the next collision.
        self.multiple = orders > 1 or medium.emission is not None
        self.orders, self.seed, self.rr_depth = (
            dr.opaque(mi.UInt32, n) for n in (orders, task.seed, task.rr_depth)
        )

    def batches(self, voxels: mi.UInt32, first: int, count: int) -> tuple:
        """Estimate ``count`` batches, starting with batch ``first``.

        ``voxels`` are indices into the list of active voxels. Returns for each voxel the sums of
        the batch means of every order group and channel and their spread for every channel
        (float64), and the sums for every moment and channel (float32).
        """
        result = _statistics(
            self.sums(voxels, first, count, 0, BATCH), BATCH, count, self.cache.channels
        )
        dr.eval(result)
        dr.sync_thread()
        return result

    def sums(self, voxels: mi.UInt32, first: int, count: int, start: int, size: int) -> list:
        """Sum samples ``start`` to ``start + size`` of batches ``first`` to ``first + count`` for
        every order group and channel; the batches of a voxel are consecutive.

        Float64 sums of float32 values are exact (unless these span a factor of 2^25), so they do
        not depend on how samples are divided into passes.
        """
        cache = self.cache
        per_batch, per_voxel = (dr.opaque(mi.UInt32, n) for n in (size, size * count))
        lane = dr.arange(mi.UInt32, dr.width(voxels) * count * size)
        row = lane // per_batch
        batch = row % dr.opaque(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
        within = lane - row * per_batch + dr.opaque(mi.UInt32, start)
        number = dr.gather(mi.UInt32, voxels, lane // per_voxel)
        voxel = dr.gather(mi.UInt32, cache.active, number)
        values = list(self._sample(self.sample_points.of(voxel), batch, within, voxel))
        for light in cache.direct_lights:
            values[0] += dr.gather(mi.Spectrum, light.irradiance, number)
        double = dr.float64_array_t(mi.Float)
        # Values that are zero throughout come as a literal without a width.
        none = dr.zeros(mi.Float, dr.width(lane))
        kinds = [double] * len(ORDER_GROUPS) + [mi.Float] * cache.moments
        values = [
            kind(v[c] + none)
            for kind, v in zip(kinds, values, strict=True)
            for c in range(cache.channels)
        ]
        dr.eval(values)
        return [dr.block_sum(value, size) for value in values]

    def _sample(
        self, position: mi.Point3f, batch: mi.UInt32, within: mi.UInt32, voxel: mi.UInt32
    ) -> Sequence[mi.Spectrum]:
        """Compute one sample per lane of both order groups and of the moments."""
        rng, spread = _random_numbers(batch, within, voxel, self.seed)
        if not self.medium.is_traced:
            return self._estimate(position, spread, rng)
        number = dr.gather(mi.UInt32, self.cache.voxel_classes.medium_number, voxel)
        pointer = self.media.pointer_of(number)
        max_depth = dr.select(self.orders < 0xFFFFFFFF, self.orders + 1, self.orders)
        tracer = PathTracer(self.scene, self.media, max_depth, self.rr_depth)
        where = tracer, position, pointer
        return volume_path.estimate(self.cache.directional, *where, spread, rng, self._excluded)

    @symbolic
    def _estimate(self, position: mi.Point3f, spread: list[mi.Float], rng: mi.PCG32):
        """Compute one sample of both order groups per lane in an isolated medium.

        ``spread`` are four uniform numbers for the directions.
        """
        # docs/primer, eq. (3.1)
        scene, medium, orders, rr_depth = self.scene, self.medium, self.orders, self.rr_depth
        always = mi.Bool(True)
        uncollided, rng = direct_light(
            scene, medium, position, mi.Point2f(spread[0], spread[1]), rng, always, self._sampled
        )
        scattered, emits = mi.Spectrum(0), medium.emission is not None
        further = 1 if emits else 0  # flights beyond the last collision
        if dr.hint(self.multiple, mode="scalar"):
            weight = mi.Spectrum(1)
            direction = mi.warp.square_to_uniform_sphere(mi.Point2f(spread[2], spread[3]))
            order = mi.UInt32(1)
            active = order - further < orders
            while dr.hint(active, label="scattering orders"):
                ray = mi.Ray3f(position, direction)
                hit, near, far = medium.intersect(ray)
                near = dr.maximum(near, 0)
                collided, t, weight, rng, light = free_flight(
                    medium, ray, near, far, weight, rng, active & hit
                )
                if dr.hint(emits, mode="scalar"):
                    uncollided += dr.select(order == 1, 4 * dr.pi * light, 0)
                    scattered += dr.select(order == 1, 0, 4 * dr.pi * light)
                    active &= order < orders
                active &= collided
                position = dr.select(active, ray(t), position)
                weight *= medium.albedo.at_world(position, active)
                active &= dr.max(weight) > 0
                # Russian roulette, as volpath does it.
                survival = dr.select(order > rr_depth, dr.minimum(dr.max(weight), 0.95), 1)
                active &= rng.next_float32(active) < survival
                weight /= survival
                sample = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
                light, rng = direct_light(scene, medium, position, sample, rng, active)
                scattered += dr.select(active, weight * light, 0)
                sample = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
                direction = mi.warp.square_to_uniform_sphere(sample)
                order += 1
                active &= order - further < orders
        return uncollided, scattered

    def seconds(self, samples: int) -> float:
        """Predict the duration [s] of ``samples`` from one batch at voxels all over the medium."""
        count = self.cache.active_count
        voxels = dr.arange(mi.UInt32, min(count, _lanes(self.cache) // 256))
        voxels = voxels * dr.opaque(mi.UInt32, max(1, count // dr.width(voxels)))
        dr.eval(voxels)
        self.batches(voxels, 0, 1)  # compiles the kernel
        started = perf_counter()
        self.batches(voxels, 0, 1)
        return (perf_counter() - started) * samples / (dr.width(voxels) * BATCH)


def _random_numbers(
    batch: mi.UInt32, within: mi.UInt32, voxel: mi.UInt32, seed: mi.UInt32
) -> tuple[mi.PCG32, list[mi.Float]]:
    """Return the random stream of a sample, and its point of a 4D low-discrepancy set."""
    first, second = mi.sample_tea_32(voxel, mi.sample_tea_32(seed, batch)[0])
    rng = random_stream((first, second), mi.UInt64(within) + 1)
    # A batch shares one random shift of a low-discrepancy set; each point alone is uniform.
    shifts = random_stream((second, first), 0)
    return rng, kronecker(within, 4, [shifts.next_float32() for _ in range(4)])


def direct_light(
    scene: mi.Scene,
    medium: MediumGrid,
    position: mi.Point3f,
    sample: mi.Point2f,
    rng: mi.PCG32,
    active: mi.Bool,
    emitters: mi.EmitterPtr | None = None,
) -> tuple[mi.Spectrum, mi.PCG32]:
    """Sample D(x) = int_S2 L_e T dw, by emitter sampling and ratio tracking, for all emitters of
    the scene or the given ``emitters``.
    """
    interaction = dr.zeros(mi.Interaction3f)
    interaction.p = position
    if emitters is None:
        record, radiance = scene.sample_emitter_direction(interaction, sample, False, active)
    else:
        count = dr.width(emitters)
        if not count:
            return mi.Spectrum(0), rng
        scaled = sample.x * count
        number = dr.minimum(mi.UInt32(scaled), count - 1)
        emitter = dr.gather(mi.EmitterPtr, emitters, number, active)
        sample = mi.Point2f(scaled - mi.Float(number), sample.y)
        record, radiance = emitter.sample_direction(interaction, sample, active)
        radiance = radiance * count
    record = with_valid_direction(record)
    contributes = active & (record.pdf > 0) & (dr.max(radiance) > 0)
    ray = mi.Ray3f(position, record.d)
    hit, near, far = medium.intersect(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, record.dist)
    through, rng = transmittance(medium, ray, near, far, rng, contributes & hit)
    through = dr.select(hit & (near < far), through, 1)
    return dr.select(contributes, radiance * through, 0), rng
