"""Transmittance and free flights through a medium.

`optical_depth` is deterministic and exact. `free_flight` and `transmittance` are unbiased estimates
by null-collision tracking: tentative collisions are drawn with the majorant of the macrocell at
hand. Functions return the random generator they advanced, since a recorded loop does not update its
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
#: Optical depth whose transmittance is 0 in single precision: nothing behind it matters.
OPAQUE = 104.0
#: Ratio tracking continues below this transmittance by Russian roulette only.
ROULETTE_BELOW = 0.1


def brightest(value: mi.Float | mi.Color3f) -> mi.Float:
    """The largest channel."""
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
    """Delta tracking from ``near`` to ``far``: whether the ray collides, where, the weight carried
    on, the generator, and the radiance that the medium itself has added, an unbiased estimate of
    int T j dt times the weight.

    With grey extinction the weight is unchanged. With coloured extinction a collision is accepted
    with the probability that the current weights give it, and the weights make up for each
    channel's difference (spectral tracking, Kutz et al. 2017), so that they stay bounded.
    """
    # docs/primer, eq. (3.3)
    walk = medium.macrocells.walk(ray)
    t = mi.Float(near)
    cell = walk.cell(t)
    active = mi.Bool(active) & (near < far)
    collided = mi.Bool(False)
    grey = medium.sigma_t.channels == 1
    weight, emitted = mi.Spectrum(weight), mi.Spectrum(0)
    shines_from, shines_to = near, far
    if dr.hint(medium.emission is not None, mode="scalar"):
        shines_from, shines_to = medium.emission.interval(ray, near, far)
    while dr.hint(active, label="free flight"):
        majorant = walk.majorant(cell, active)
        wall, following = walk.exit(cell, t)
        candidate = t - dr.log(1 - rng.next_float32(active)) / majorant
        leaves = ~(candidate < dr.minimum(wall, far))
        tentative = active & ~leaves
        sigma_t = medium.sigma_t.at_world(ray(candidate), tentative)
        choice = rng.next_float32(active)
        if dr.hint(medium.emission is not None, mode="scalar"):
            begin = dr.maximum(t, shines_from)
            end = dr.minimum(dr.select(leaves, wall, candidate), shines_to)
            light, rng = medium.emission.between(ray, begin, end, rng, active & (begin < end))
            emitted += weight * light
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
        t = dr.select(leaves, wall, candidate)
        cell = dr.select(leaves, following, cell)
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
    """Integral of sigma_t along ``ray`` from ``near`` to ``far``, exact up to rounding, for each
    channel of the extinction; beyond ``most`` in all channels only a lower bound.

    Between the planes through the voxel centres extinction is trilinear, so it is a cubic
    polynomial of the distance along the ray: two Gauss points between two planes integrate it
    exactly, whatever the optical depth of a voxel. Macrocells without extinction are skipped.
    """
    depth = medium.sigma_t.at_world(ray.o, False) * 0
    active = mi.Bool(active) & (near < far)
    if dr.hint(medium.homogeneous, mode="scalar"):
        depth += medium.sigma_t.value * dr.select(active, far - near, 0)
    else:
        grid = medium.sigma_t.grid
        # Coordinates in which the centre of voxel i is at i: these are the planes.
        origin = mi.Vector3f(grid.coordinates.point(ray.o)) - 0.5
        direction = grid.coordinates.vector(ray.d)
        rcp = safe_rcp(direction)
        forward = rcp > 0
        last = mi.Vector3f(*(mi.Float(n) for n in grid.sides)) - 1
        walk = medium.macrocells.walk(ray)
        # A step that rounding makes shorter than this would not advance at all.
        least = dr.fma(dr.abs(near) + dr.abs(far), 3e-7, 1e-30)
        t = mi.Float(near)
        while dr.hint(active, label="optical depth"):
            middle = t + 4 * least
            cell = walk.cell(middle)
            empty = walk.majorant(cell, active) == 0
            wall, _ = walk.exit(cell, middle)
            place = dr.fma(direction, middle, origin)
            # Outside of the outermost centres values are clamped: there is no plane until these.
            plane = dr.select(forward, dr.floor(place) + 1, dr.ceil(place) - 1)
            plane = dr.select(forward, dr.maximum(plane, 0), dr.minimum(plane, last))
            beyond = dr.select(forward, plane > last, plane < 0)
            crossing = dr.min(dr.select(beyond, dr.inf, (plane - origin) * rcp))
            end = dr.minimum(dr.select(empty, wall, crossing), far)
            end = dr.minimum(dr.maximum(end, t + least), far)
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
    """Transmittance of ``medium`` along ``ray`` up to ``distance``, without noise."""
    hit, near, far = medium.intersect(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, distance)
    return dr.exp(-optical_depth(medium, ray, near, far, active & hit))


@symbolic
def transmittance(
    medium: MediumGrid, ray: mi.Ray3f, near: mi.Float, far: mi.Float, rng: mi.PCG32, active: mi.Bool
):
    """An unbiased estimate of T = exp(-int sigma_t dt) from ``near`` to ``far``.

    Analytic for a homogeneous medium; otherwise residual ratio tracking (Novak et al. 2014) with
    each macrocell's smallest extinction as control, so every factor lies in [0, 1].
    """
    # docs/primer, eq. (3.4)
    if dr.hint(medium.homogeneous, mode="scalar"):
        length = dr.maximum(far - near, 0)
        optical_depth = medium.sigma_t.value * length
        # 0 * infinity: an emitter infinitely far away, seen through nothing.
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
            kept = dr.clip(1 - (sigma_t - control) / residual, 0, 1)
            result = dr.select(active, result * factor, result)
            result = dr.select(tentative, result * kept, result)
            t = dr.select(leaves, wall, candidate)
            cell = dr.select(leaves, following, cell)
            active &= t < far
            # Russian roulette: what is nearly dark is not worth many lookups.
            largest = brightest(result)
            faint = active & (largest < ROULETTE_BELOW)
            survives = rng.next_float32(active) * ROULETTE_BELOW < largest
            result = dr.select(
                faint, dr.select(survives, result * (ROULETTE_BELOW / largest), 0), result
            )
            active &= ~faint | survives
    return result, rng
