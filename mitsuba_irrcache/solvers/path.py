"""The solver ``path``: unbiased Monte Carlo path tracing from the voxel centres to the lights.

With isotropic scattering the irradiance at x is a sum over scattering orders (paper, section 3):

    Phi(x) = sum_k E[beta_k D(x_k)],   x_0 = x,  beta_0 = 1,  beta_k = beta_(k-1) albedo(x_k)

where x_k follows from x_(k-1) by a uniform direction and a free flight, and D(x) = int_S2 L_e T dw
is the light that reaches x straight from the emitters. Order 0 is the *uncollided* layer of the
cache, the others the *scattered* one.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache import BATCH, IrradianceCache
from mitsuba_irrcache.medium import MediumGrid
from mitsuba_irrcache.tracking import free_flight, transmittance

#: Paths in one kernel launch: enough to fill any machine, few enough to bound memory (about 100
#: bytes each).
LANES = 1 << 21

#: called with (samples done, samples in all), both in voxels times samples
Progress = Callable[[int, int], None]


def refine(
    scene: mi.Scene,
    medium: MediumGrid,
    cache: IrradianceCache,
    samples: int,
    seed: int,
    rr_depth: int,
    progress: Progress | None = None,
) -> None:
    """Adds ``samples`` per voxel (a multiple of ``BATCH``) of the random stream ``seed`` to
    ``cache``.

    The stream goes on where an earlier call with the same seed stopped. Passes end early without
    losing anything if ``progress`` raises: what was added stays valid.
    """
    orders = cache.max_depth - 1 if cache.max_depth >= 0 else 0xFFFFFFFF
    if not cache.active_count or orders < 1 or not scene.emitters():
        cache.note_samples(seed, samples)
        return
    block = min(cache.active_count, LANES // BATCH)
    batches_at_once = max(1, LANES // (BATCH * block))
    total = cache.active_count * samples
    done = 0
    started = perf_counter()
    remaining = samples // BATCH
    while remaining:
        count = min(batches_at_once, remaining)
        first = cache.streams.get(seed, 0) // BATCH
        layers = []
        for start in range(0, cache.active_count, block):
            layers.append(
                _batches(scene, medium, cache, start, block, first, count, orders, seed, rr_depth)
            )
            done += min(block, cache.active_count - start) * BATCH * count
            if progress is not None:
                progress(done, total)
        cache.add(seed, BATCH * count, layers)
        remaining -= count
    rate = done / max(perf_counter() - started, 1e-9)
    mi.Log(mi.LogLevel.Info, f"irrcache: path solver, {done} samples, {rate:.3g} per second")


def _batches(
    scene: mi.Scene,
    medium: MediumGrid,
    cache: IrradianceCache,
    start: int,
    block: int,
    first: int,
    count: int,
    orders: int,
    seed: int,
    rr_depth: int,
) -> tuple:
    """Sums and sums of squares of batch means of ``count`` batches, for the voxels ``start`` ... of
    the active list.
    """
    width = min(block, cache.active_count - start)
    lane = dr.arange(mi.UInt32, width * count * BATCH)
    within = lane % BATCH
    batch = (lane // BATCH) % dr.opaque(mi.UInt32, count)
    voxel = dr.gather(
        mi.UInt32,
        cache.active,
        lane // dr.opaque(mi.UInt32, BATCH * count) + dr.opaque(mi.UInt32, start),
    )
    layers = _estimate(
        scene,
        medium,
        cache.grid.centers(voxel),
        batch + dr.opaque(mi.UInt32, first),
        within,
        voxel,
        dr.opaque(mi.UInt32, seed),
        dr.opaque(mi.UInt32, orders),
        dr.opaque(mi.UInt32, rr_depth),
        orders > 1,
    )
    result = []
    for value in layers:
        for channel in range(cache.channels):
            # A layer that is zero throughout comes as a literal without a width.
            samples = value[channel] + dr.zeros(mi.Float, dr.width(lane))
            mean = dr.block_sum(samples, BATCH) / BATCH
            result.append((dr.block_sum(mean, count), dr.block_sum(dr.square(mean), count)))
    dr.eval(result)
    return tuple(result)


@dr.syntax
def _estimate(
    scene: mi.Scene,
    medium: MediumGrid,
    position: mi.Point3f,
    batch: mi.UInt32,
    within: mi.UInt32,
    voxel: mi.UInt32,
    seed: mi.UInt32,
    orders: mi.UInt32,
    rr_depth: mi.UInt32,
    multiple: bool,
):
    """One sample of both layers per lane; the samples ``within`` a batch are spread evenly over
    directions.
    """
    shift_a, shift_b = mi.sample_tea_32(voxel, mi.sample_tea_32(seed, batch)[0])
    rng = mi.PCG32(
        initstate=mi.UInt64(shift_a) << 32 | mi.UInt64(shift_b), initseq=mi.UInt64(within) + 1
    )
    # A batch shares one random shift of a low-discrepancy set; each point alone is uniform.
    shifts = mi.PCG32(initstate=mi.UInt64(shift_b) << 32 | mi.UInt64(shift_a), initseq=mi.UInt64(0))
    spread = [_fraction(shifts.next_float32() + _kronecker(within, axis)) for axis in range(4)]
    always = mi.Bool(True)
    uncollided, rng = direct_light(
        scene, medium, position, mi.Point2f(spread[0], spread[1]), rng, always
    )
    scattered = mi.Spectrum(0)
    if dr.hint(multiple, mode="scalar"):
        weight = mi.Spectrum(1)
        direction = mi.warp.square_to_uniform_sphere(mi.Point2f(spread[2], spread[3]))
        order = mi.UInt32(1)
        active = order < orders
        while dr.hint(active, label="scattering orders"):
            ray = mi.Ray3f(position, direction)
            hit, near, far = medium.intersect(ray)
            near = dr.maximum(near, 0)
            collided, t, weight, rng = free_flight(
                medium, ray, near, far, weight, rng, active & hit
            )
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
            active &= order < orders
    return uncollided, scattered


def direct_light(
    scene: mi.Scene,
    medium: MediumGrid,
    position: mi.Point3f,
    sample: mi.Point2f,
    rng: mi.PCG32,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.PCG32]:
    """One sample of D(x) = int_S2 L_e T dw by emitter sampling and ratio tracking."""
    interaction = dr.zeros(mi.Interaction3f)
    interaction.p = position
    record, radiance = scene.sample_emitter_direction(interaction, sample, False, active)
    lit = active & (record.pdf > 0) & (dr.max(radiance) > 0)
    ray = mi.Ray3f(position, record.d)
    hit, near, far = medium.intersect(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, record.dist)
    through, rng = transmittance(medium, ray, near, far, rng, lit & hit)
    through = dr.select(hit & (near < far), through, 1)
    return dr.select(lit, radiance * through, 0), rng


def _kronecker(index: mi.UInt32, axis: int) -> mi.Float:
    """Point ``index`` of the four-dimensional Kronecker sequence of the generalised golden
    ratio.
    """
    golden = 1.1673039782614187  # root of x^5 = x + 1
    return mi.Float(index) * (golden ** -(axis + 1) % 1.0)


def _fraction(x: mi.Float) -> mi.Float:
    return x - dr.floor(x)
