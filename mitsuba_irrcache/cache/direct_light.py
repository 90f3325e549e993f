"""Direct irradiance of emitters without extent (spot lights, points, suns).

The irradiance of such an emitter at a position p is E(p) exp(-tau(p)). E is the unobstructed
irradiance, known in closed form from the emitter; tau is the optical depth of the straight line to
the emitter, the mean extinction along it times its length in the medium. The length is known in
closed form from the boundary; only the mean extinction is interpolated between the voxels of the
cache. It remains smooth if a beam is narrower than a voxel, and if the medium is so dense that the
irradiance decays within a fraction of a voxel.

The cache stores the irradiance at the voxel centres (for spot lights, the mean of E over the voxel
times exp(-tau) at its centre), and higher orders of scattering start from means over the voxels.
Camera rays exclude these values and evaluate E(p) exp(-tau(p)) instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, Scattering, order_of_direct_light
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.conservative import unbiased
from mitsuba_irrcache.cache.peak_depths import peak_depth
from mitsuba_irrcache.core.fast_math import absorptance, clipped, maximum, minimum
from mitsuba_irrcache.core.jit import concatenated, symbolic
from mitsuba_irrcache.core.sequences import random_stream
from mitsuba_irrcache.core.spectrum import channel_mean, scatter_channels
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.lights.emitters import (
    POINT_LIKE,
    SPOT_LIKE,
    EmitterKind,
    EmittersByKind,
    are_distant,
    illuminating,
    kind_of,
    position_of,
    spot_lights,
)
from mitsuba_irrcache.lights.falloff import VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.transport.path import Media, visibility
from mitsuba_irrcache.transport.tracking import optical_depth

#: Numbers of points along each axis of a voxel over which E and exp(-tau) are averaged.
POINTS, DEPTH_POINTS = 8, 3
#: Step of the finite differences at the ends of a segment, over the length of the segment.
TANGENT = 1 / 64
#: Maximum number of voxels for which optical depths are computed without a pause, some tenths of a
#: second on two processor cores.
LARGEST_PART = 1 << 18


class DirectLight:
    """The irradiance of ``emitter`` at the ``voxels`` (flat indices) of ``grid`` in ``medium``."""

    def __init__(
        self,
        scene: mi.Scene,
        emitter: mi.Emitter,
        medium: MediumGrid,
        grid: Grid,
        voxels: mi.UInt32,
        classes: VoxelClasses | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        """Compute mean extinctions and irradiance.

        ``classes`` is None if there are no surfaces and other media among the voxels. ``pause`` is
        called between kernel launches and may raise an exception.
        """
        #: whether moments alone represent its radiance, and what a forward peak scatters of it
        #: counts as unscattered
        self.is_wide = False
        #: order of `angular_means`
        self.order = order_of_direct_light(medium.phase)
        self._kind = kind_of(emitter)
        self.emitter, self._medium = emitter, medium
        self.distant = self._kind is EmitterKind.SUN
        self._sample_points, self._pause = VoxelSamplePoints(scene, grid), pause
        p = self._sample_points.of(voxels)
        self._grid, self._voxels, self._centres = grid, voxels, p
        depth, self._passed = self._attenuation(scene, p)
        #: field of the mean extinction along the line to the emitter
        self.extinction = self._extinction(scene, depth, classes)
        #: optical depth of the truncated forward peak over that of the medium, in each channel; if
        #: that ratio varies in space, the field of the peak's mean extinction; None without a peak
        self._peak_ratio = self._peak_extinction = None
        if medium.unscattered_exponent is not None:
            ratio = [dr.opaque(mi.Float, float(e - 1)) for e in medium.unscattered_exponent]
            self._peak_ratio = ratio[0] if len(ratio) == 1 else mi.Color3f(ratio)
        elif medium.original is not None:
            self._peak_extinction = self._extinction_of_peak(classes)
        # field of the transmittance of surfaces and other media; None without any
        self._others = self._field_of_others(self._passed, classes) if medium.is_traced else None
        self._means: mi.Spectrum | None = None
        # E at the voxel centres; for a spot light, whose beam may be narrower than a voxel, the
        # means of E over the voxels
        self._unobstructed = self.unobstructed(p)
        if self._kind in SPOT_LIKE:
            self._unobstructed = self._mean(grid, voxels, POINTS)
        #: irradiance, from E as above
        self.irradiance = self._passed * self._unobstructed
        self.irradiance *= mi.Spectrum(dr.exp(-self.depth(p)))
        dr.eval(self.irradiance)
        #: maximum of E for a sun, where it is uniform; 0 for other emitters
        self.maximum = 0.0
        if self.distant:
            self.maximum = float(dr.max(dr.max(self._unobstructed))[0])

    @property
    def means(self) -> mi.Spectrum:
        """Means of the irradiance over the voxels, the source of higher orders of scattering."""
        if self._means is None:
            mean = self._mean_transmittance(self._grid, self._voxels)
            self._means = self._passed * self._mean_unobstructed() * mean
            dr.eval(self._means)
        return self._means

    @property
    def has_one_direction(self) -> bool:
        """Whether its radiance comes from a single direction at each position."""
        return True

    def unobstructed(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Spectrum:
        """Evaluate the unobstructed irradiance E at world positions."""
        _, light = self._sample_emitter(p, active)
        return dr.select(active, light, 0)

    def depth(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Return the optical depth of the medium between world positions and the emitter."""
        return self.depth_of(self.extinction.at_world(p, active), p)

    def depth_of(
        self, mean: mi.Float | mi.Color3f, p: mi.Point3f, shift: mi.Vector2f | None = None
    ) -> mi.Float | mi.Color3f:
        """Return the optical depth that follows from the ``mean`` extinction at world positions.

        ``shift`` moves the points on an emitter with extent that represent it; positions with the
        same shift have the same points. By default it is a hash of the position.
        """
        # docs/primer, eq. (2.5)
        return mean * self.length(p)

    def depth_along(
        self, ray: mi.Ray3f, ends: tuple[mi.Float, mi.Float], means: tuple
    ) -> Callable[[mi.Float], mi.Float | mi.Color3f]:
        """Return the optical depth between places on segments of rays and the emitter, as a
        function of the place, a fraction of the segment.

        ``ends`` are distances along the rays, ``means`` the mean extinctions there.
        """
        shift = shift_at(ray(ends[0]))
        return lambda u: self.depth_of(dr.lerp(*means, u), ray(dr.lerp(*ends, u)), shift)

    def peak_depth(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Return the optical depth of scattering into the truncated forward peak between world
        positions and the emitter.
        """
        if self._peak_extinction is None:
            return self.depth(p, active) * self._peak_ratio
        return self._peak_extinction.at_world(p, active) * self.length(p)

    def length(self, p: mi.Point3f) -> mi.Float:
        """Return the length in the medium of the line from world positions to the emitter."""
        _, near, far = self._line(p)
        return dr.maximum(far - near, 0)

    def angular_means(self) -> list[mi.Spectrum]:
        """Return the mean spherical harmonics of the directions to the emitter, weighted by its
        irradiance at the voxels, from degree 1 on: ``order`` (order + 2) values.
        """
        return [mi.Spectrum(y) for y in dr.sh_eval(self.towards(self._centres), self.order)[1:]]

    def towards(self, p: mi.Point3f) -> mi.Vector3f:
        """Return the direction from world positions to an emitter without extent."""
        return self._sample_emitter(p)[0].d

    def _sample_emitter(
        self, p: mi.Point3f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Return the direction from world positions to an emitter without extent, and its
        unobstructed irradiance.
        """
        at = dr.zeros(mi.Interaction3f, dr.width(p))
        at.p = p
        return self.emitter.sample_direction(at, mi.Point2f(0.5), active)

    def past_others(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Return the transmittance of surfaces and other media between world positions and the
        emitter.
        """
        return mi.Float(1) if self._others is None else self._others.at_world(p, active)

    def _attenuation(
        self, scene: mi.Scene, p: mi.Point3f
    ) -> tuple[mi.Float | mi.Color3f, mi.Spectrum]:
        """Return the optical depth of the medium, and the transmittance of surfaces and other
        media, between ``p`` and the emitter.
        """
        depth = self._depths()
        passed = mi.Spectrum(1)
        if self._medium.is_traced:
            position = [dr.opaque(mi.Float, float(v)) for v in position_of(self.emitter)]
            passed = _past_others(scene, self._medium, p, mi.Point3f(position))
            dr.eval(passed)
        return depth, passed

    def _depths(self) -> mi.Float | mi.Color3f:
        """Return the optical depths between the sample points of the voxels and the emitter."""
        count = dr.width(self._voxels)
        if count <= LARGEST_PART:
            return self._depths_at(self._centres)
        parts = []
        for start in range(0, count, LARGEST_PART):
            self._pause()
            index = dr.arange(mi.UInt32, min(LARGEST_PART, count - start))
            index += dr.opaque(mi.UInt32, start)
            voxels = dr.gather(mi.UInt32, self._voxels, index)
            parts.append(self._depths_at(self._sample_points.of(voxels)))
            dr.eval(parts[-1])
            dr.sync_thread()  # launches only queue kernels, which nothing interrupts
        if isinstance(parts[0], mi.Float):
            return concatenated(parts)
        return mi.Color3f([concatenated(channel) for channel in zip(*parts, strict=True)])

    def _depths_at(self, p: mi.Point3f) -> mi.Float | mi.Color3f:
        """Return the optical depths between world positions and the emitter."""
        ray, near, far = self._line(p)
        return optical_depth(self._medium, ray, near, far, near < far, dr.inf)

    def _extinction(
        self, scene: mi.Scene, depth: mi.Float | mi.Color3f, classes: VoxelClasses | None
    ) -> GridField:
        """Create the field of the mean extinction, given optical depths at the voxels."""
        sigma_t = self._medium.sigma_t.at_world(self._centres)
        return self._field_of_extinction(self._mean_extinction(depth, sigma_t), classes)

    def _mean_extinction(
        self, depth: mi.Float | mi.Color3f, sigma_t: mi.Float | mi.Color3f
    ) -> mi.Float | mi.Color3f:
        """Return mean extinctions at the voxels, the inverse of `depth_of`; ``sigma_t`` where no
        line to the emitter crosses the medium.
        """
        return mean_over(self.length(self._centres), depth, sigma_t)

    def _extinction_of_peak(self, classes: VoxelClasses | None) -> GridField:
        """Create the field of the mean extinction of the forward peak over `length`."""
        ray, near, far = DirectLight._line(self, self._centres)
        depth = peak_depth(self._medium, ray, near, far, near < far)
        mean = mean_over(self.length(self._centres), depth, 0)
        return _on_grid(self._grid, self._voxels, mean, classes)

    def _field_of_extinction(
        self, mean: mi.Float | mi.Color3f, classes: VoxelClasses | None
    ) -> GridField:
        """Create a field from the mean extinction at the voxels."""
        return _on_grid(self._grid, self._voxels, mean, classes)

    def _field_of_others(self, passed: mi.Spectrum, classes: VoxelClasses | None) -> GridField:
        """Create the field of the transmittance of surfaces and other media."""
        return _root_field(self._grid, self._voxels, passed, classes)

    def _line(self, p: mi.Point3f) -> tuple[mi.Ray3f, mi.Float, mi.Float]:
        """Return rays from world positions to the emitter, and the distances at which they enter
        and leave the medium (entry >= exit: they miss it).
        """
        record, _ = self._sample_emitter(p)
        ray = mi.Ray3f(p, record.d)
        hit, near, far = self._medium.intersect(ray)
        near = dr.maximum(near, 0)
        if not are_distant(self.emitter):
            far = dr.minimum(far, record.dist)
        return ray, near, dr.select(hit, far, near)

    def _mean_unobstructed(self) -> mi.Spectrum:
        """Compute means of E over the voxels."""
        if self._kind is EmitterKind.POINT:
            return self._mean(self._grid, self._voxels, POINTS)
        return self._unobstructed

    def _mean_transmittance(self, grid: Grid, voxel: mi.UInt32) -> mi.Spectrum:
        """Compute means of exp(-tau) over the part of voxels that is in the medium."""
        passed, count = self._sum_transmittance(grid, voxel, DEPTH_POINTS)
        centre = mi.Spectrum(dr.exp(-self.depth(self._centres)))
        return dr.select(count > 0, passed / dr.maximum(count, 1), centre)

    @symbolic
    def _mean(self, grid: Grid, voxel: mi.UInt32, points: int):
        """Compute means of E over ``points``^3 points in each voxel."""
        corner, total, k = mi.Point3f(*grid.voxel_indices(voxel)), mi.Spectrum(0), mi.UInt32(0)
        n = dr.opaque(mi.UInt32, points)
        while dr.hint(k < n * n * n, label="points in a voxel"):
            place = mi.Point3f(k % n, (k // n) % n, k // (n * n)) + 0.5
            total += self.unobstructed(grid.world.point(corner + place / mi.Float(n)))
            k += 1
        return total / mi.Float(n * n * n)

    @symbolic
    def _sum_transmittance(self, grid: Grid, voxel: mi.UInt32, points: int):
        """Sum exp(-tau) over the points in voxels that are in the medium, and count them."""
        corner, total, k = mi.Point3f(*grid.voxel_indices(voxel)), mi.Spectrum(0), mi.UInt32(0)
        n, count = dr.opaque(mi.UInt32, points), mi.Float(0)
        while dr.hint(k < n * n * n, label="points in a voxel"):
            place = mi.Point3f(k % n, (k // n) % n, k // (n * n)) + 0.5
            p = grid.world.point(corner + place / mi.Float(n))
            inside = self._medium.contains(p)
            total += dr.select(inside, mi.Spectrum(dr.exp(-self.depth(p, inside))), 0)
            count += dr.select(inside, mi.Float(1), 0)
            k += 1
        return total, count


def direct_lights_of(
    scene: mi.Scene,
    medium: MediumGrid,
    grid: Grid,
    voxels: mi.UInt32,
    dense: bool,
    classes: VoxelClasses | None = None,
    pause: Callable[[], None] = lambda: None,
) -> list[DirectLight]:
    """Return the direct light of all spot lights of a scene.

    Point lights and suns are included if the voxels are optically ``dense`` and the scene has no
    surfaces. ``voxels`` are flat indices; ``classes`` is None without surfaces and other media;
    ``pause`` as in `DirectLight`.
    """
    if not dr.width(voxels):
        return []
    emitters = spot_lights(scene)
    if dense and medium.is_isolated:
        emitters = EmittersByKind(illuminating(scene)).of(EmitterKind.SUN, *POINT_LIKE)
    where = medium, grid, voxels, classes
    return [DirectLight(scene, emitter, *where, pause) for emitter in emitters]


def mean_over(
    length: mi.Float, depth: mi.Float | mi.Color3f, otherwise: mi.Float | mi.Color3f | int
) -> mi.Float | mi.Color3f:
    """Return the mean extinction of an optical ``depth``; ``otherwise`` where the length is 0."""
    return dr.select(length > 0, depth / dr.select(length > 0, length, 1), otherwise)


def shift_at(p: mi.Point3f) -> mi.Vector2f:
    """Return random numbers in [0, 1) that are a hash of world positions."""
    first, second = (dr.reinterpret_array(mi.UInt32, v) for v in (p.x + p.y, p.z))
    rng = random_stream(mi.sample_tea_32(first, second))
    return mi.Vector2f(rng.next_float32(), rng.next_float32())


def _on_grid(
    grid: Grid, voxels: mi.UInt32, values: mi.Float | mi.Color3f, classes: VoxelClasses | None
) -> GridField:
    """Create a field from values at the ``voxels``."""
    channels = [values] if isinstance(values, mi.Float) else list(values)
    known = dr.zeros(mi.Bool, grid.voxel_count)
    dr.scatter(known, mi.Bool(True), voxels)
    values, count = spread(grid, voxels, channels, classes), len(channels)
    return GridField(grid, unbiased(grid, values, known, count), count)


def _root_field(
    grid: Grid, voxels: mi.UInt32, values: mi.Spectrum, classes: VoxelClasses | None
) -> RootField:
    """Create a field whose square roots are interpolated, with one channel if all are equal."""
    channels = [dr.sqrt(c) for c in values]
    if all(dr.all(c == channels[0])[0] for c in channels[1:]):
        channels = channels[:1]
    separated, count = None if classes is None else classes.separated, len(channels)
    field = RootField(grid, spread(grid, voxels, channels, classes), count, separated=separated)
    field.data = dr.minimum(field.data, 1)  # it is a transmittance, also where extrapolated
    return field


def spread(
    grid: Grid, voxels: mi.UInt32, channels: list[mi.Float], classes: VoxelClasses | None
) -> mi.Float:
    """Return an array over all voxels of the grid with these values at ``voxels``.

    Other voxels are 0, except that with ``classes`` voxels inside of surfaces are extrapolated
    (`VoxelClasses.filled`). Channels are interleaved.
    """
    values = dr.zeros(mi.Float, grid.voxel_count * len(channels))
    scatter_channels(values, channels, voxels)
    dr.eval(values)
    return values if classes is None else classes.filled(values, len(channels))


def _past_others(
    scene: mi.Scene, medium: MediumGrid, p: mi.Point3f, target: mi.Point3f
) -> mi.Spectrum:
    """Estimate the transmittance of surfaces and other media between ``p`` and ``target``."""
    others = Media.around(medium).without(medium)
    vertex = dr.zeros(mi.Interaction3f, dr.width(p))
    vertex.p = p
    rng = mi.PCG32(dr.width(p))
    passed, _ = visibility(scene, others, vertex, target, medium.pointer, rng, mi.Bool(True))
    return passed


class RaySegment(NamedTuple):
    """A segment of camera rays; all but the rays are pairs of values at both ends.

    Attributes:
        ray: the rays.
        ends: distances along the rays.
        extinctions: extinction.
        means: mean extinction on the line to the emitter.
        weights: weights of the source, the result of `quadrature.segment`.
        albedos: albedo.
    """

    ray: mi.Ray3f
    ends: tuple[mi.Float, mi.Float]
    extinctions: tuple
    means: tuple
    weights: tuple
    albedos: tuple


class DirectLightAlongRays:
    """Direct light of an emitter, evaluated along camera rays."""

    def __init__(
        self,
        light: DirectLight,
        basis: AngularBasis | None = None,
        moments: AngularField | None = None,
        peak_factor: float = 1.0,
    ) -> None:
        """``basis`` is None for isotropic scattering. For anisotropic scattering, ``moments`` are
        those of the radiance from all emitters with extent (see `area_light.moments_of`).
        ``peak_factor`` multiplies optical depths of the forward peak.
        """
        self.light, self._basis, self._moments = light, basis, moments
        self._peak_factor = dr.opaque(mi.Float, peak_factor)

    def _gain(
        self,
        p: mi.Point3f,
        direction: mi.Vector3f,
        with_peak: bool,
        peak_depth: mi.Float | mi.Color3f | None = None,
    ) -> mi.Float | mi.Color3f:
        """Average `AngularBasis.gain` over the radiance from the emitter.

        ``with_peak`` and ``peak_depth`` are as in `AngularField.factor`.
        """
        # docs/primer, eq. (2.12)
        light, basis = self.light, self._basis
        if light.has_one_direction:
            gain = basis.gain(p, direction, light.towards(p), with_peak)
            if peak_depth is None or not basis.phase.forward:
                return gain
            depth, cosine = self._bend(p, direction, peak_depth)
            return maximum(gain + basis.phase.aureole.correction(cosine, depth), 0.0)
        view = direction, basis.basis(direction)
        smooth = self._moments.factor(p, *view, mi.Bool(True), with_peak)
        if light.is_wide or not basis.has_residual(with_peak):
            return smooth
        if peak_depth is not None and basis.phase.forward:
            peak_depth = light.peak_depth(p) + peak_depth
        return maximum(smooth + light.mean_residual(basis, p, direction, peak_depth), 0.0)

    def _bend(
        self, p: mi.Point3f, direction: mi.Vector3f, peak_depth: mi.Float | mi.Color3f
    ) -> tuple[mi.Float | mi.Color3f, mi.Float]:
        """Return the optical depth of the forward peak along the path from an emitter without
        extent via ``p`` to the camera, and the cosine of the angle of scattering.
        """
        depth = (self.light.peak_depth(p) + peak_depth) * self._peak_factor
        return depth, dr.dot(direction, self.light.towards(p))

    def at_with_change(
        self,
        p: mi.Point3f,
        active: mi.Bool,
        direction: mi.Vector3f | None,
        peak_depth: mi.Float | mi.Color3f,
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Evaluate `at` with the forward peak, for an emitter without extent; and that value plus
        the derivative of the `aureole.Aureole` correction, see `gradients/source_weights`.
        """
        value = self.at(p, active, direction, with_peak=True, peak_depth=peak_depth)
        if self._basis is None or not self._basis.phase.forward:
            return value, value
        depth, cosine = self._bend(p, direction, peak_depth)
        phase = self._basis.phase
        change = phase.aureole_of_changes.correction(cosine, depth)
        change -= phase.aureole.correction(cosine, depth)
        return value, value + self._irradiance(p, active, change)

    def _irradiance(
        self, p: mi.Point3f, active: mi.Bool, gain: mi.Float | mi.Color3f | None
    ) -> mi.Spectrum:
        """Return the irradiance at world positions, times ``gain`` unless it is None."""
        light = self.light
        passed = dr.exp(-light.depth(p, active)) * light.past_others(p, active)
        if gain is not None:
            passed = passed * gain
        return mi.Spectrum(passed) * light.unobstructed(p, active)

    def at(
        self,
        p: mi.Point3f,
        active: mi.Bool,
        direction: mi.Vector3f | None = None,
        with_peak: bool = False,
        peak_depth: mi.Float | mi.Color3f | None = None,
    ) -> mi.Spectrum:
        """Evaluate the irradiance at world positions.

        For anisotropic scattering it is multiplied by 4 pi times the phase function for scattering
        towards the camera along ``direction``, averaged over the emitter; ``with_peak`` and
        ``peak_depth`` are as in `AngularField.factor`.
        """
        gain = None
        if self._basis is not None:
            gain = self._gain(p, direction, with_peak, peak_depth)
        return self._irradiance(p, active, gain)

    def mean_extinction(self, p: mi.Point3f, active: mi.Bool) -> mi.Float | mi.Color3f:
        """Return the mean extinction between world positions and the emitter."""
        return self.light.extinction.at_world(p, active)

    def scattered(
        self,
        segment: RaySegment,
        scattering: Scattering = Scattering.ALL,
        peak_depth: mi.Float | mi.Color3f | None = None,
    ) -> mi.Spectrum:
        """Integrate the radiance scattered towards the camera along a segment.

        ``scattering`` selects the part of it, ``peak_depth`` is as in `AngularField.factor`.
        """
        ray, (a, b), extinctions, _, weights, _ = segment
        near, far = (extinction * (b - a) for extinction in extinctions)
        total = self._integral(segment, self._parts(ray, a, b, 0.5 * (near + far)))
        # Scale to the absorptance that the quadrature rule computes.
        absorbed = absorptance(0.5 * (near + far))
        rule = dr.select(absorbed > 0, (weights[0] + weights[1]) / absorbed, 1)
        if self._basis is not None:
            p = ray(0.5 * (a + b))
            with_peak = scattering is not Scattering.WITHOUT_PEAK
            gain = self._gain(p, ray.d, with_peak, peak_depth)
            if scattering is Scattering.PEAK:
                gain = gain - self._gain(p, ray.d, with_peak=False)
            total *= gain
        return total * mi.Spectrum(rule) * dr.inv_four_pi

    @symbolic
    def _integral(self, segment: RaySegment, inner: list[mi.Float]):
        """Integrate the radiance that isotropic scattering would add, without quadrature weights.

        The segment is divided into parts at the ``inner`` places. In a part with constant
        extinction c and optical depth C, along which the optical depth to the emitter changes
        linearly from s0 to s0 + S,
        int c e^-(c u + s) du = e^-s0 C (1 - e^-(C + S)) / (C + S), for any optical depth.
        """
        # docs/primer, eq. (2.6)
        ray, (a, b), extinctions, means, _, albedo = segment
        light = self.light
        near, far = (extinction * (b - a) for extinction in extinctions)
        depth_at = light.depth_along(ray, (a, b), means)
        total, u, passed = mi.Spectrum(0), mi.Float(0), 0 * near
        depth, i, count = depth_at(u), mi.UInt32(0), dr.opaque(mi.UInt32, len(inner) + 1)
        # One copy of the code: it is most of the code of the ray march.
        while dr.hint(i < count, label="parts of a segment"):
            end = mi.Float(1)
            for number, place in enumerate(inner):
                end = dr.select(i == number, place, end)
            middle = 0.5 * (u + end)
            depth_end, depth_middle = depth_at(end), depth_at(middle)
            passed_end = dr.fma(near, end * (1 - 0.5 * end), far * (0.5 * end * end))
            within = passed_end - passed
            both = within + depth_end - depth
            # A parabola exceeds its chord by 4 u (1 - u) sag; weight this with e^-x u.
            sag = depth_middle - 0.5 * (depth + depth_end)
            sag = sag * 4 / (6 + dr.abs(both))
            exponent = maximum(-both, 0.0) - passed - depth - sag
            part = within * dr.exp(exponent) * _mean_decay(dr.abs(both))
            p = ray(dr.lerp(a, b, middle))
            part = mi.Spectrum(part * light.past_others(p) * dr.lerp(*albedo, middle))
            total += part * light.unobstructed(p)
            u, depth, passed = end, depth_end, passed_end
            i += 1
        return total

    def _parts(
        self, ray: mi.Ray3f, a: mi.Float, b: mi.Float, depth: mi.Float | mi.Color3f
    ) -> list[mi.Float]:
        """Divide a segment of optical ``depth`` into four parts.

        Three parts of equal absorptance, one of which is divided at the kink (see `_kink`). Returns
        the inner ends of the parts as fractions of the segment.
        """
        depth = channel_mean(depth)
        absorbed, thin = absorptance(depth), depth < 1e-3
        thirds = [
            dr.select(thin, k, -dr.log(1 - k * absorbed) / dr.select(thin, 1, depth))
            for k in (1 / 3, 2 / 3)
        ]
        first, second = thirds
        kink = self._kink(ray, a, b)
        return [minimum(kink, first), clipped(kink, first, second), maximum(kink, second)]

    def _kink(self, ray: mi.Ray3f, a: mi.Float, b: mi.Float) -> mi.Float:
        """Locate the kink of `DirectLight.length` between the distances ``a`` and ``b``.

        In a box that length is piecewise linear; at a kink the line to the emitter leaves through
        another face of the box. The kink is where the tangents at both ends intersect. Returns its
        position as a fraction of the segment, 0.5 without a kink.
        """
        at = [a, dr.lerp(a, b, TANGENT), dr.lerp(b, a, TANGENT), b]
        first, second, third, last = (self.light.length(ray(t)) for t in at)
        rise, fall = (second - first) * (1 / TANGENT), (last - third) * (1 / TANGENT)
        bend = rise - fall
        kink = (last - fall - first) / dr.select(bend != 0, bend, 1)
        return dr.select((bend != 0) & (kink > 0) & (kink < 1), kink, 0.5)


def _mean_decay(depth: mi.Float | mi.Color3f) -> mi.Float | mi.Color3f:
    """Return the mean of e^-x for x in [0, depth]."""
    depth = maximum(depth, 1e-20)
    return absorptance(depth) / depth
