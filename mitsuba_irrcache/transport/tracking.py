"""Free-flight sampling and transmittance of a medium.

`optical_depth` is deterministic and exact. `free_flight` and `transmittance` are unbiased
null-collision estimators (Woodcock et al. 1965; Novak et al. 2014) with the majorants of the
macrocells. Functions return the random number generator, because recorded loops do not update the
caller's copy.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.grids.boundary import safe_rcp
from mitsuba_irrcache.media.medium import MediumGrid

#: Abscissae of two-point Gauss-Legendre quadrature over [0, 1]: exact for cubic polynomials.
GAUSS_POINTS = (0.5 - 0.28867513, 0.5 + 0.28867513)
#: Optical depth whose transmittance underflows to 0 in single precision.
OPAQUE = 104.0
#: Transmittance below which ratio tracking applies Russian roulette.
ROULETTE_BELOW = 0.1


def max_channel(value: mi.Float | mi.Color3f) -> mi.Float:
    """Return the largest channel."""
    return value if isinstance(value, mi.Float) else dr.max(value)


@symbolic
def free_flight(
    medium: MediumGrid,
    ray: mi.Ray3f,
    near: mi.Float,
    far: mi.Float,
    weight: mi.Spectrum,
    rng: mi.PCG32,
    active: mi.Bool,
):
    """Sample a collision between ``near`` and ``far`` by delta tracking (Woodcock et al. 1965).

    ``weight`` is the path throughput. Returns whether the ray collides, the distance, the
    throughput after it, the random number generator, and the radiance of the medium's emission
    times the throughput, an unbiased estimate of ``weight`` int T j dt.

    Grey extinction leaves the throughput unchanged. With coloured extinction, collisions are
    accepted with a probability that depends on the current throughput, which compensates for the
    difference in each channel and stays bounded (spectral tracking, Kutz et al. 2017).
    """
    # docs/primer, eq. (3.3)
    walk = medium.macrocells.walk(ray)
    t = mi.Float(near)
    cell = walk.cell(t)
    active = mi.Bool(active) & (near < far)
    collided = mi.Bool(False)
    grey = medium.sigma_t.channels == 1
    weight, emitted = mi.Spectrum(weight), mi.Spectrum(0)
    emission_near, emission_far = near, far
    if dr.hint(medium.emission is not None, mode="scalar"):
        emission_near, emission_far = medium.emission.interval(ray, near, far)
    while dr.hint(active, label="free flight"):
        majorant = walk.majorant(cell, active)
        cell_exit, following = walk.exit(cell, t)
        candidate = t - dr.log(1 - rng.next_float32(active)) / majorant
        exits_cell = ~(candidate < dr.minimum(cell_exit, far))
        tentative = active & ~exits_cell
        sigma_t = medium.sigma_t.at_world(ray(candidate), tentative)
        choice = rng.next_float32(active)
        if dr.hint(medium.emission is not None, mode="scalar"):
            begin = dr.maximum(t, emission_near)
            end = dr.minimum(dr.select(exits_cell, cell_exit, candidate), emission_far)
            radiance, rng = medium.emission.between(ray, begin, end, rng, active & (begin < end))
            emitted += weight * radiance
        if dr.hint(grey, mode="scalar"):
            collides = tentative & (choice * majorant < sigma_t)
        else:
            real = sigma_t / majorant
            total = dr.sum(weight)
            probability = dr.select(total > 0, dr.dot(weight, real) / total, 0)
            collides = tentative & (choice < probability)
            accepted = dr.select(collides, real / probability, (1 - real) / (1 - probability))
            weight = dr.select(tentative, weight * accepted, weight)
        collided |= collides
        t = dr.select(exits_cell, cell_exit, candidate)
        cell = dr.select(exits_cell, following, cell)
        active &= ~collides & (t < far)
    return collided, t, weight, rng, emitted


@symbolic
def optical_depth(
    medium: MediumGrid,
    ray: mi.Ray3f,
    near: mi.Float,
    far: mi.Float,
    active: mi.Bool,
    most: float = OPAQUE,
):
    """Integrate sigma_t from ``near`` to ``far``, exactly up to rounding, for each channel.

    Integration stops once all channels exceed ``most``; the result is then only a lower bound.
    Between planes through the voxel centres, trilinear extinction is a cubic polynomial of the
    distance, which two Gauss points integrate exactly, whatever the optical depth of a voxel.
    Empty macrocells are skipped.
    """
    depth = medium.sigma_t.at_world(ray.o, False) * 0
    active = mi.Bool(active) & (near < far)
    if dr.hint(medium.homogeneous, mode="scalar"):
        depth += medium.sigma_t.value * dr.select(active, far - near, 0)
    else:
        grid = medium.sigma_t.grid
        # Coordinates in which voxel centres, and hence the planes, are at integers.
        origin = mi.Vector3f(grid.coordinates.point(ray.o)) - 0.5
        direction = grid.coordinates.vector(ray.d)
        rcp = safe_rcp(direction)
        forward = rcp > 0
        last = mi.Vector3f(*(mi.Float(n) for n in grid.sides)) - 1
        walk = medium.macrocells.walk(ray)
        # Minimum step: rounding must not prevent progress.
        min_step = dr.fma(dr.abs(near) + dr.abs(far), 3e-7, 1e-30)
        t = mi.Float(near)
        while dr.hint(active, label="optical depth"):
            middle = t + 4 * min_step
            cell = walk.cell(middle)
            empty = walk.majorant(cell, active) == 0
            wall, _ = walk.exit(cell, middle)
            place = dr.fma(direction, middle, origin)
            # Values are clamped beyond the outermost centres: the next plane is the first of these.
            plane = dr.select(forward, dr.floor(place) + 1, dr.ceil(place) - 1)
            plane = dr.select(forward, dr.maximum(plane, 0), dr.minimum(plane, last))
            beyond = dr.select(forward, plane > last, plane < 0)
            crossing = dr.min(dr.select(beyond, dr.inf, (plane - origin) * rcp))
            end = dr.minimum(dr.select(empty, wall, crossing), far)
            end = dr.minimum(dr.maximum(end, t + min_step), far)
            length = 0.5 * (end - t)
            reads = active & ~empty
            for point in GAUSS_POINTS:
                sigma_t = medium.sigma_t.at_world(ray(dr.lerp(t, end, point)), reads)
                depth += dr.select(reads, sigma_t * length, 0)
            t = end
            thinnest = dr.min(depth) if not isinstance(depth, mi.Float) else depth
            active &= (t < far) & (thinnest < most)
    return depth


def medium_transmittance(
    medium: MediumGrid, ray: mi.Ray3f, distance: mi.Float, active: mi.Bool
) -> mi.Float | mi.Color3f:
    """Compute the transmittance of ``medium`` along ``ray`` up to ``distance``, without noise."""
    hit, near, far = medium.intersect(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, distance)
    return dr.exp(-optical_depth(medium, ray, near, far, active & hit))


@symbolic
def transmittance(
    medium: MediumGrid, ray: mi.Ray3f, near: mi.Float, far: mi.Float, rng: mi.PCG32, active: mi.Bool
):
    """Estimate T = exp(-int sigma_t dt) from ``near`` to ``far``, unbiased.

    Analytic for homogeneous media; otherwise residual ratio tracking (Novak et al. 2014) with the
    minorant of each macrocell as control, so that every factor lies in [0, 1].
    """
    # docs/primer, eq. (3.4)
    if dr.hint(medium.homogeneous, mode="scalar"):
        length = dr.maximum(far - near, 0)
        optical_depth = medium.sigma_t.value * length
        # Avoid 0 * infinity for a distant emitter behind a medium without extinction.
        result = dr.exp(-dr.select(medium.sigma_t.value > 0, optical_depth, 0))
    else:
        walk = medium.macrocells.walk(ray)
        t = mi.Float(near)
        cell = walk.cell(t)
        active = mi.Bool(active) & (near < far)
        result = mi.Float(1) if medium.sigma_t.channels == 1 else mi.Color3f(1)
        while dr.hint(active, label="ratio tracking"):
            control = walk.minorant(cell, active)
            residual = walk.majorant(cell, active) - control
            wall, following = walk.exit(cell, t)
            end = dr.minimum(wall, far)
            candidate = t - dr.log(1 - rng.next_float32(active)) / residual
            leaves = ~(candidate < end)
            tentative = active & ~leaves
            sigma_t = medium.sigma_t.at_world(ray(candidate), tentative)
            stop = dr.select(leaves, end, candidate)
            factor = dr.exp(-control * (stop - t))
            null_probability = dr.clip(1 - (sigma_t - control) / residual, 0, 1)
            result = dr.select(active, result * factor, result)
            result = dr.select(tentative, result * null_probability, result)
            t = dr.select(leaves, wall, candidate)
            cell = dr.select(leaves, following, cell)
            active &= t < far
            # Russian roulette: a small transmittance is not worth many lookups.
            largest = max_channel(result)
            faint = active & (largest < ROULETTE_BELOW)
            survives = rng.next_float32(active) * ROULETTE_BELOW < largest
            result = dr.select(
                faint, dr.select(survives, result * (ROULETTE_BELOW / largest), 0), result
            )
            active &= ~faint | survives
    return result, rng
