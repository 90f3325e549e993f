"""Single scattering by quadrature, without any code of irrcache.

    L = int T sigma_s int p L_e T' dw dt

At the points of a fixed quadrature along fixed rays of each pixel, `Emitter.sample_direction` of
Mitsuba gives the direct illumination, for area emitters at points of a lattice that is shifted at
random for every point. Transmittances are exact: between the planes through voxel centres
extinction is a cubic polynomial along a ray.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.validation.limits.cases import ALBEDO, PHASES, PIXELS, Case

#: Two Gauss points of [0, 1], and steps along a ray that each have them.
GAUSS = 0.5 - 3**-0.5 / 2, 0.5 + 3**-0.5 / 2
STEPS = 128
#: Optical depth beyond which contributions are neglected.
DARK = 40.0


class Extinction:
    """A grid over the cube [-1, 1]^3, trilinear between voxel centres and clamped at the border."""

    def __init__(self, values: np.ndarray) -> None:
        self.texture = mi.Texture3f(
            mi.TensorXf(values[..., None]), use_accel=False, wrap_mode=dr.WrapMode.Clamp
        )
        self.sides = mi.Vector3f(*(float(n) for n in values.shape[::-1]))

    def at(self, p: mi.Point3f) -> mi.Float:
        """Return the extinction at world positions."""
        return self.texture.eval(mi.Point3f(0.5 * (p + 1)))[0]

    @dr.syntax
    def transmittance(self, o: mi.Point3f, d: mi.Vector3f, far: mi.Float) -> mi.Float:
        """Return the transmittance from ``o`` along ``d`` to ``far``, or to the border of the
        cube.
        """
        rcp = dr.rcp(dr.select(dr.abs(d) < 1e-7, 1e-7, d))
        far = dr.minimum(far, dr.min((mi.Vector3f(dr.sign(rcp)) - o) * rcp))
        # In these coordinates the centre of voxel i is at i; the distance from plane to plane along
        # each axis, and to the next one.
        u = 0.5 * (o + 1) * self.sides - 0.5
        spacing = dr.abs(2 * rcp / self.sides)
        ahead = dr.select(rcp > 0, dr.floor(u) + 1 - u, u - dr.ceil(u) + 1)
        crossing = ahead * spacing
        t, depth = mi.Float(0), mi.Float(0)
        while (t < far) & (depth < DARK):
            end = dr.minimum(dr.min(crossing), far)
            for x in GAUSS:
                depth += 0.5 * (end - t) * self.at(o + dr.fma(end - t, x, t) * d)
            crossing = dr.select(crossing <= end, crossing + spacing, crossing)
            t = end
        return dr.exp(-depth)


def phase_value(name: str, cosine: mi.Float) -> mi.Float:
    """Return the phase function; ``cosine`` is 1 for forward scattering."""
    phase = PHASES[name]
    if phase["type"] == "hg":
        g = phase["g"]
        base = 1 + g**2 - 2 * g * cosine
        return (1 - g**2) / (4 * dr.pi) / (base * dr.sqrt(base))
    if phase["type"] == "rayleigh":
        return 3 / (16 * dr.pi) * (1 + dr.square(cosine))
    return dr.full(mi.Float, 1 / (4 * dr.pi), dr.width(cosine))


def single(case: Case, rays: int = 3, lights: int = 32, steps: int = STEPS) -> np.ndarray:
    """Return the pixels (y, x): means over ``rays``^2 rays each.

    From every point on a ray ``lights`` points on the emitter are sampled.
    """
    scene = case.scene()
    side = PIXELS * rays
    index = dr.arange(mi.UInt32, side * side)
    film = (mi.Point2f(index % side, index // side) + 0.5) / side
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
    ends = [(s - ray.o) / ray.d for s in (-1.0, 1.0)]
    near = dr.max(dr.minimum(*ends))
    far = dr.min(dr.maximum(*ends))
    radiance = _integral(case, scene, ray.o + near * ray.d, ray.d, far - near, lights, steps)
    pixels = np.array(radiance, dtype=np.float64).reshape(PIXELS, rays, PIXELS, rays)
    return pixels.mean(axis=(1, 3))


def _integral(case, scene, o, d, length, lights, steps):
    """Return the scattered radiance of rays from ``o`` along ``d``."""
    emitter = scene.emitters()[0]
    extinction = Extinction(case.extinction())
    lights = 1 if case.has_direction else lights
    count = dr.width(length) * 2 * steps
    lane = dr.arange(mi.UInt32, count)
    ray, node = lane // (2 * steps), lane % (2 * steps)
    o, d, length = (dr.gather(type(v), v, ray) for v in (o, d, length))
    part = (mi.Float(node // 2) + dr.select(node % 2 == 0, *GAUSS)) / steps
    if case.position is None:
        t, weight = part * length, length / (2 * steps)
    else:  # equiangular: radiance grows like 1 / r^2 next to the emitter
        way = mi.Point3f(*case.position) - o
        middle = dr.dot(way, d)
        q = dr.norm(way - middle * d)
        low, high = dr.atan2(-middle, q), dr.atan2(length - middle, q)
        angle = dr.lerp(low, high, part)
        t = middle + q * dr.tan(angle)
        weight = (high - low) * q / dr.square(dr.cos(angle)) / (2 * steps)
    p = mi.Point3f(o + t * d)
    weight *= ALBEDO * extinction.at(p) * extinction.transmittance(o, d, t)
    dr.eval(p, d, weight)
    total = _light(case.phase, emitter, extinction, p, d, lights)
    return dr.block_sum(weight * total, 2 * steps)


@dr.syntax
def _light(phase: str, emitter, extinction, p, d, lights: int):
    """Return the radiance of ``lights`` emitter samples, scattered at ``p`` into direction -d."""
    a, b = mi.sample_tea_32(dr.arange(mi.UInt32, dr.width(p)), mi.UInt32(1))
    shift = mi.Point2f(mi.Float(a >> 8), mi.Float(b >> 8)) * 2**-24
    at = dr.zeros(mi.Interaction3f, dr.width(p))
    at.p = p
    total, k = dr.zeros(mi.Float, dr.width(p)), mi.UInt32(0)
    while k < dr.opaque(mi.UInt32, lights):
        sample = mi.Float(k) * mi.Point2f(0.7548776662466927, 0.5698402909980532) + shift
        record, light = emitter.sample_direction(at, sample - dr.floor(sample))
        light = light[0] * phase_value(phase, dr.dot(record.d, d))
        passed = extinction.transmittance(p, record.d, dr.select(light > 0, record.dist, 0))
        total += dr.select(light > 0, light * passed, 0) / lights
        k += 1
    return total


#: Independent parts of a Monte Carlo reference, for its standard error.
BATCHES = 16
#: Collisions after which Russian roulette starts, and the survival probability.
CERTAIN, SURVIVE = 6, 0.8


def orders(case: Case, paths: int, seed: int = 0, with_control: bool = True) -> tuple[float, float]:
    """Return the mean of the image for any ``max_depth``, and its standard error.

    It uses delta tracking from the camera with emitter sampling at every collision as in `single`,
    whose result is an optional control variate. Unlike volpath it does not offset rays.
    """
    scene = case.scene()
    extinction = Extinction(case.extinction())
    majorant = float(case.extinction().max())
    exact = single(case, 4, 16).mean() if with_control else 0.0
    found = []
    for i in range(BATCHES):
        first, total = _paths(
            case, scene, extinction, majorant, paths // BATCHES, seed * BATCHES + i
        )
        covariance = np.cov(first, total)
        slope = covariance[0, 1] / max(covariance[0, 0], 1e-300) if with_control else 0.0
        found.append(total.mean() - slope * (first.mean() - exact))
    return float(np.mean(found)), float(np.std(found, ddof=1) / BATCHES**0.5)


def _paths(case, scene, extinction, majorant: float, count: int, seed: int):
    """Return the radiance of paths after their first collision, and in all."""
    rng = mi.PCG32(count, initstate=dr.opaque(mi.UInt64, seed))
    film = mi.Point2f(rng.next_float32(), rng.next_float32())
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
    near = dr.max(dr.minimum(*[(s - ray.o) / ray.d for s in (-1.0, 1.0)]))
    start = mi.Point3f(ray.o + near * ray.d)
    most = 1 << 30 if case.max_depth < 0 else case.max_depth - 1
    emitter, top = scene.emitters()[0], dr.opaque(mi.Float, majorant)
    most = dr.opaque(mi.UInt32, most)
    found = _walk(case.phase, emitter, extinction, top, start, ray.d, rng, most)
    dr.eval(found)
    return [np.array(v, dtype=np.float64) for v in found]


@dr.syntax
def _walk(phase, emitter, extinction, majorant, p, d, rng, most):
    """Return the radiance of paths from ``p``, at the border of the cube, along ``d``."""
    first = dr.zeros(mi.Float, dr.width(p))
    total, weight, collisions = dr.zeros(mi.Float, dr.width(p)), mi.Float(1), mi.UInt32(0)
    d, active = mi.Vector3f(d), dr.full(mi.Bool, True, dr.width(p))
    while active:
        p = mi.Point3f(p - dr.log(1 - rng.next_float32()) / majorant * d)
        active &= dr.all(dr.abs(p) < 1)
        hit = active & (rng.next_float32() * majorant < extinction.at(p))
        a, b = rng.next_float32(), rng.next_float32()
        if hit:
            weight *= ALBEDO
            collisions += 1
            at = dr.zeros(mi.Interaction3f, dr.width(p))
            at.p = p
            record, light = emitter.sample_direction(at, mi.Point2f(a, b))
            light = light[0] * phase_value(phase, dr.dot(record.d, d))
            far = dr.select(light > 0, record.dist, 0)
            passed = extinction.transmittance(p, record.d, far)
            total += dr.select(light > 0, weight * light * passed, 0)
            first = dr.select(collisions == 1, total, first)
            cosine, factor = _scattered(phase, rng.next_float32())
            sine = dr.safe_sqrt(1 - dr.square(cosine))
            turn = 2 * dr.pi * rng.next_float32()
            d = mi.Frame3f(d).to_world(
                mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), cosine)
            )
            weight *= factor
            active = collisions < most
            if collisions > CERTAIN:
                active &= rng.next_float32() < SURVIVE
                weight /= SURVIVE
    return first, total


def _scattered(phase: str, u: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Sample the cosine of a scattering angle; return it with its weight."""
    g = PHASES[phase].get("g", 0.0)
    if not g:
        cosine = 1 - 2 * u
        return cosine, 4 * dr.pi * phase_value(phase, cosine)
    cosine = (1 + g**2 - dr.square((1 - g**2) / (1 - g + 2 * g * u))) / (2 * g)
    return dr.clip(cosine, -1, 1), mi.Float(1)
