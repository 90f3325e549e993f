"""Direct irradiance of area emitters of simple shapes.

Without a medium and other surfaces the irradiance is E(p) = L Omega(p), in closed form
(`lights/solid_angle`). It varies by an order of magnitude within a voxel next to the emitter, and
is zero behind it, so it is not interpolated. Only two smooth factors are interpolated:

- the mean transmittance of the medium between p and points on the emitter, as an optical depth, or
  as that depth divided by the length of the line to the closest point;
- the mean visibility of these points past other surfaces, weighted by that transmittance.

Both are ratios of sums over the same points, weighted by the solid angle that each point
represents, so they have no variance where transmittance and visibility of all points are equal.
They are also defined behind a flat emitter, and continuous across its plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis, order_of_direct_light
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.direct_light import POINTS, DirectLight, mean_over, shift_at, spread
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker, random_stream
from mitsuba_irrcache.core.spectrum import channel_mean
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.grids.root_field import ExtendedField
from mitsuba_irrcache.lights.emitters import EmitterKind, EmittersByKind
from mitsuba_irrcache.lights.solid_angle import SolidAngle
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.occluders import bounding_sphere, may_meet
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.transport.path import Media, visibility
from mitsuba_irrcache.transport.tracking import GAUSS_POINTS, medium_transmittance

#: Number of points on an emitter: in total over all voxels, and minimum and maximum per voxel.
SAMPLES, FEWEST_SAMPLES, MOST_SAMPLES = 1 << 24, 32, 512
#: Samples per voxel of the cache for each point on an emitter (above the minimum of points). The
#: means over these points are the only part of the cache that further samples do not refine, so
#: their number limits the accuracy that a cache reaches.
CACHE_SAMPLES_PER_POINT = 4
#: Largest mean bias of the optical depths due to the number of points; most of it is corrected.
LARGEST_BIAS = 5e-4
#: Number of points on an emitter over which a lookup averages the part of the phase function that
#: the moments do not represent; the second number for phase functions with a forward peak.
PHASE_SAMPLES, PEAK_SAMPLES = 4, 16
#: Weight [sr] added to each point, so that their sum is positive in the plane of a flat emitter.
SMALL_ANGLE = 1e-6
#: Number of positions at which the error of interpolated optical depths is measured.
TESTS = 2048
#: Number of positions on an emitter at which it is tested whether it lies in the medium.
POSITIONS = 64
#: Ratio of an emitter's radius to its distance from the farthest position in a medium above which
#: it counts as wide: a forward peak then selects a few of the directions over which transmittances
#: are averaged. For squares at distance 3 from the centre of a cube of half-edge 1, the RMSE of
#: images is smaller with edges above 4.5.
WIDE = 0.7
#: Maximum number of emitters treated in this way, maximum number of their values at all voxels, and
#: number of values per voxel and emitter without its moments. The irradiance of further emitters is
#: interpolated.
MOST_LIGHTS, MOST_VALUES, VALUES = 8, 14 << 24, 14

#: Difference of the shares of a channel below which irradiances have the same colour.
SAME_COLOUR = 1e-3
#: Lines from a position to an emitter whose lengths in the medium divide optical depths: that to
#: the closest point, those to several points, or none. With "each", transmittances of the mean
#: extinction are averaged over points instead (docs/primer, eq. (2.10)).
CLOSEST, SEVERAL, NONE, EACH = LINES = ("closest", "several", "none", "each")
#: Relative error of the others below which "each" is not tried, and weight of its own error.
SMALL_ERROR, NOISE_WEIGHT = 1e-3, 2
#: Number of points per lookup with "each", and largest number of Newton steps for its extinction.
LOOKUP_POINTS, NEWTON_STEPS = 16, 12
#: Error of the optical depth at which Newton steps end.
NEWTON_TOLERANCE = 1e-4


class AreaLight(DirectLight):
    """The irradiance of an area emitter at the voxels of a grid, and its factors for lookups."""

    def __init__(
        self,
        scene: mi.Scene,
        emitter: mi.Emitter,
        medium: MediumGrid,
        grid: Grid,
        voxels: mi.UInt32,
        classes: VoxelClasses | None = None,
        samples: int = 0,
    ) -> None:
        """Compute the factors.

        ``classes`` is None if there is no surface among the voxels; ``samples`` is the number of
        samples per voxel of the cache, from which the number of points on the emitter follows.
        """
        #: number of points on the emitter, from which its factors at a voxel are computed
        self.points_per_voxel = 0
        self._fewest = max(FEWEST_SAMPLES, samples // CACHE_SAMPLES_PER_POINT)
        self._solid_angle, self._radiance = SolidAngle.of(emitter), _radiance(emitter)
        # An emitter does not keep its shape alive, which Mitsuba accesses as long as it exists.
        self._shape = emitter.get_shape()
        self._edges = classes.cut_cells if classes is not None else None
        samples = PEAK_SAMPLES if medium.phase.forward else PHASE_SAMPLES
        self._phase_samples = dr.opaque(mi.UInt32, samples)
        self._lines = CLOSEST
        #: points that represent the emitter for mean lengths
        self._places = _places_on(self._shape)
        self._lookup_points = dr.opaque(mi.UInt32, LOOKUP_POINTS)
        self._largest_extinction = dr.opaque(mi.Float, medium.sigma_t.maximum)
        super().__init__(scene, emitter, medium, grid, voxels, classes)
        self.maximum = 2 * dr.pi * max(float(c[0]) for c in self._radiance)
        self.is_wide = bool(medium.phase.forward) and _is_wide(self._shape, medium, grid)

    # docs/primer, eq. (2.9)

    def unobstructed(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Spectrum:
        return self._radiance * dr.select(active, self._solid_angle.at(p), 0)

    def past_others(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        passed = self._others.at_world(p, active)
        if self._edges is None:
            return passed
        return self._edges.corrected(self._others, p, passed, mi.Bool(active))

    def length(self, p: mi.Point3f) -> mi.Float:
        """Return the length in the medium of the line to the closest point of the emitter, the mean
        length of lines to several points, or 1.

        The optical depth divided by a length is smooth next to the emitter and to the face through
        which its radiance enters. Where lines to different points leave through different faces,
        the mean length or the optical depth itself may be smoother. `_extinction` chooses the
        alternative with the smallest error.
        """
        if self._lines == NONE:
            return dr.full(mi.Float, 1, dr.width(p))
        if self._lines == CLOSEST:
            return self._length_to(p, self._solid_angle.closest(p))
        return self._mean_length(p)

    @symbolic
    def _mean_length(self, p: mi.Point3f):
        """Return the mean length in the medium of the lines from ``p`` to several points."""
        total, i, count = mi.Float(0), mi.UInt32(0), dr.opaque(mi.UInt32, dr.width(self._places))
        while dr.hint(i < count, label="points on an emitter"):
            total += self._length_to(p, dr.gather(mi.Point3f, self._places, i))
            i += 1
        return total / mi.Float(count)

    def _length_to(self, p: mi.Point3f, place: mi.Point3f) -> mi.Float:
        """Return the length in the medium of the line to a ``place`` on the emitter."""
        offset = place - p
        distance = dr.norm(offset)
        direction = dr.select(distance > 0, offset / distance, mi.Vector3f(0, 0, 1))
        return self._length_within(p, direction, distance)

    def _length_within(self, p: mi.Point3f, direction: mi.Vector3f, distance: mi.Float) -> mi.Float:
        """Return the length in the medium of a line from ``p``."""
        hit, near, far = self._medium.intersect(mi.Ray3f(p, direction))
        near, far = dr.maximum(near, 0), dr.minimum(far, distance)
        return dr.maximum(dr.select(hit, far - near, 0), 0)

    def _extinction(
        self, scene: mi.Scene, depth: mi.Float | mi.Color3f, classes: VoxelClasses | None
    ) -> GridField:
        """Create the field as in the base class, with the `length` that has the smaller error."""
        if _is_inside(self._shape, self._medium):
            return super()._extinction(scene, depth, classes)
        fields, errors = {}, {}
        for self._lines in LINES:
            if self._lines == EACH and min(errors.values()) < SMALL_ERROR:
                break
            fields[self._lines] = self.extinction = super()._extinction(scene, depth, classes)
            # The average over points has noise, which the others do not have.
            weight = NOISE_WEIGHT if self._lines == EACH else 1
            errors[self._lines] = weight * self._depth_error(scene)
        self._lines = min(errors, key=errors.get)
        return fields[self._lines]

    def _mean_extinction(
        self, depth: mi.Float | mi.Color3f, sigma_t: mi.Float | mi.Color3f
    ) -> mi.Float | mi.Color3f:
        if self._lines != EACH:
            mean = super()._mean_extinction(depth, sigma_t)
            if self._solid_angle.is_flat:
                return mean
            # Lookups outside of an opaque shape interpolate with voxels whose centre is inside.
            is_inside = self._solid_angle.at(self._centres) <= 0
            return dr.select(is_inside, sigma_t, mean)
        count = dr.opaque(mi.UInt32, self.points_per_voxel)
        rng = self._stream_of_voxels()
        shift = mi.Vector2f(rng.next_float32(), rng.next_float32())
        return self._solve_for_extinction(self._centres, depth, sigma_t, count, shift)

    @symbolic
    def _solve_for_extinction(
        self,
        p: mi.Point3f,
        depth: mi.Float | mi.Color3f,
        sigma_t: mi.Float | mi.Color3f,
        count: mi.UInt32,
        shift: mi.Vector2f,
    ):
        """Find the extinction s of a homogeneous medium that has the optical ``depth``, by Newton's
        method for the logarithm of the mean transmittance, from ``sigma_t``.

        That logarithm is a convex function of s, so that s increases after the first step, or is
        halved while the transmittance underflows. Where few lines cross the medium, the equation is
        ill-conditioned: s is at most the largest extinction of the medium.
        """
        shares, s, i = self._solid_angle.shares(p), sigma_t + dr.zeros_like(depth), mi.UInt32(0)
        most, is_far = self._largest_extinction, mi.Bool(True)
        while dr.hint(is_far & (i < NEWTON_STEPS), label="Newton steps"):
            passed, slope, total = self._transmittance_of(s, p, shares, count, shift)
            excess = dr.log(dr.maximum(passed / total, 1e-30)) + depth
            step = dr.select(slope > 0, excess * passed / dr.maximum(slope, 1e-30), 0)
            s = dr.select(passed > 1e-30 * total, dr.clip(s + step, 0, most), 0.5 * s)
            is_far = _any_channel(dr.abs(excess) > NEWTON_TOLERANCE)
            i += 1
        return s

    @symbolic
    def _transmittance_of(
        self,
        extinction: mi.Float | mi.Color3f,
        p: mi.Point3f,
        shares: list[mi.Float],
        count: mi.UInt32,
        shift: mi.Vector2f,
    ):
        """Sum over ``count`` points of the emitter: transmittance of a constant ``extinction``
        times the solid angle W that a point represents; the same times the length in the medium; W.
        """
        vertex = dr.zeros(mi.Interaction3f, dr.width(p))
        vertex.p = p
        passed, slope = dr.zeros_like(extinction), dr.zeros_like(extinction)
        total, k = mi.Float(0), mi.UInt32(0)
        while dr.hint(k < count, label="points on an emitter"):
            _, direction, distance, weight = self._sample(vertex, shares, k, shift)
            length = self._length_within(p, direction, distance)
            share = weight * dr.exp(-extinction * length)
            passed += share
            slope += share * length
            total += weight
            k += 1
        return passed, slope, total

    def depth_of(
        self, mean: mi.Float | mi.Color3f, p: mi.Point3f, shift: mi.Vector2f | None = None
    ) -> mi.Float | mi.Color3f:
        """Return the optical depth that follows from ``mean``, as `DirectLight.depth_of`."""
        if self._lines != EACH:
            return super().depth_of(mean, p)
        shift = shift_at(p) if shift is None else shift
        return self._depth_to_points(mean, p, self._lookup_points, shift)

    def depth_along(
        self, ray: mi.Ray3f, ends: tuple[mi.Float, mi.Float], means: tuple
    ) -> Callable[[mi.Float], mi.Float | mi.Color3f]:
        """Return the optical depth along segments as `DirectLight.depth_along`.

        It is a parabola if depths are averages over points.
        """
        depth_at = super().depth_along(ray, ends, means)
        if self._lines != EACH:
            return depth_at
        first, middle, last = _at_three_places(depth_at, 0 * means[0])
        slope, curvature = 4 * middle - 3 * first - last, 2 * (first + last) - 4 * middle
        return lambda u: dr.maximum(first + u * (slope + u * curvature), 0)

    def _depth_to_points(
        self, mean: mi.Float | mi.Color3f, p: mi.Point3f, count: mi.UInt32, shift: mi.Vector2f
    ) -> mi.Float | mi.Color3f:
        """Return minus the logarithm of the mean transmittance of lines to ``count`` points."""
        # docs/primer, eq. (2.10)
        shares = self._solid_angle.shares(p)
        passed, _, total = self._transmittance_of(mean, p, shares, count, shift)
        return -dr.log(dr.maximum(passed / dr.maximum(total, 1e-30), 1e-30))

    def _depth_error(self, scene: mi.Scene) -> float:
        """Estimate the relative error of the radiance that is scattered once, due to interpolated
        optical depths.

        It is evaluated at random positions in random voxels. These are weighted by the extinction:
        interpolation errs most where radiance enters dense matter, which scatters most of it.
        """
        p, stream = self._test_positions()
        count = dr.opaque(mi.UInt32, MOST_SAMPLES)
        transmitted, _, weight, *_ = self._sums(scene, p, count, stream)
        exact = dr.mean(transmitted) / dr.maximum(weight, 1e-20)
        scale = dr.select(self._medium.contains(p), self._solid_angle.at(p), 0)
        scale *= channel_mean(self._medium.sigma_t.at_world(p))
        if self._lines == EACH:  # without the noise of few points
            depth = self._depth_to_points(self.extinction.at_world(p), p, count, shift_at(p))
        else:
            depth = self.depth(p)
        error = dr.abs(dr.mean(mi.Spectrum(dr.exp(-depth))) - exact)
        total, reference = dr.sum(scale * error), dr.sum(scale * exact)
        return float(total[0]) / max(float(reference[0]), 1e-30)

    def _test_positions(self) -> tuple[mi.Point3f, mi.PCG32]:
        """Return random positions in random voxels, and a random stream for each."""
        rng = np.random.default_rng(TESTS)
        number = mi.UInt32(rng.integers(dr.width(self._voxels), size=TESTS).astype(np.uint32))
        voxel = dr.gather(mi.UInt32, self._voxels, number)
        offset = mi.Vector3f(np.float32(rng.random((3, TESTS))))
        p = self._grid.world.point(mi.Point3f(*self._grid.voxel_indices(voxel)) + offset)
        stream = random_stream(mi.sample_tea_32(voxel, hashed_seed((TESTS, 1))[0]))
        return p, stream

    def _attenuation(
        self, scene: mi.Scene, p: mi.Point3f
    ) -> tuple[mi.Float | mi.Color3f, mi.Spectrum]:
        count = self.points_per_voxel = self._sample_count(scene)
        rng = self._stream_of_voxels()
        sums = self._sums(scene, p, dr.opaque(mi.UInt32, count), rng, self.order)
        transmitted, visible, _, _, _, angular = sums
        passed = dr.select(transmitted > 0, visible / transmitted, 0)
        mean, bias = _mean_and_bias(*sums)
        depth = -dr.log(dr.maximum(mean, 1e-30)) - bias
        depth = depth[0] if self._medium.sigma_t.channels == 1 else mi.Color3f(depth)
        seen = visible if self._is_coloured else mi.Spectrum(dr.mean(visible))
        share = dr.select(seen > 0, 1 / dr.select(seen > 0, seen, 1), 0)
        self._angular_means = [share * mi.Spectrum(total) for total in angular]
        dr.eval(depth, passed, self._angular_means)
        return depth, passed

    def _stream_of_voxels(self) -> mi.PCG32:
        """Return the random stream of each voxel, which shifts its points on the emitter."""
        words = mi.sample_tea_32(self._voxels, hashed_seed((self.points_per_voxel, 0))[0])
        return random_stream(words)

    def _sample_count(self, scene: mi.Scene) -> int:
        """Return the number of points on the emitter per voxel.

        It is `SAMPLES` over the number of voxels, or, if the transmittance varies over the emitter,
        the larger number that `LARGEST_BIAS` requires; at least `_fewest`, which grows with the
        samples of the cache.
        """
        most = max(MOST_SAMPLES, self._fewest)
        permitted = np.clip(SAMPLES // dr.width(self._voxels), self._fewest, most)
        p, stream = self._test_positions()
        count = dr.opaque(mi.UInt32, FEWEST_SAMPLES)
        mean, bias = _mean_and_bias(*self._sums(scene, p, count, stream))
        weight = self._solid_angle.at(p) * mean
        weight = dr.select(self._medium.contains(p), dr.mean(weight), 0)
        total, relative = dr.sum(weight), dr.sum(weight * dr.mean(bias))
        dr.eval(total, relative)
        bias = float(relative[0]) / max(float(total[0]), 1e-30)
        required = FEWEST_SAMPLES * np.sqrt(bias / LARGEST_BIAS)
        return int(np.clip(np.ceil(required), permitted, most))

    def angular_means(self) -> list[mi.Spectrum]:
        return self._angular_means

    @property
    def _is_coloured(self) -> bool:
        """Whether media may attenuate the emitter's channels differently."""
        media = self._medium, *self._medium.others
        return any(medium.sigma_t.channels > 1 for medium in media)

    @property
    def has_one_direction(self) -> bool:
        return False

    def mean_residual(
        self,
        basis: AngularBasis,
        p: mi.Point3f,
        direction: mi.Vector3f,
        peak_depth: mi.Float | mi.Color3f | None = None,
    ) -> mi.Float | mi.Color3f:
        """Average `AngularBasis.residual_gain` over the radiance from the emitter.

        `Aureole.correction` is included if ``peak_depth``, the optical depth of the forward peak
        between emitter and camera, is given. The points on the emitter differ between lookups, so
        that the error of sharp phase functions is noise. They are weighted by the transmittance of
        the mean extinction along the line to each.
        """
        if self._lines == EACH:
            mean = channel_mean(self.extinction.at_world(p))
        else:
            length = self._length_to(p, self._solid_angle.closest(p))
            mean = mean_over(length, channel_mean(self.depth(p)), 0)
        count, shift = self._phase_samples, shift_at(p)
        return self._mean_residual(basis, p, direction, mean, count, shift, peak_depth)

    @symbolic
    def _mean_residual(
        self,
        basis: AngularBasis,
        p: mi.Point3f,
        direction: mi.Vector3f,
        sigma_t: mi.Float,
        count: mi.UInt32,
        shift: mi.Vector2f,
        peak_depth: mi.Float | mi.Color3f | None,
    ):
        """Average as `mean_residual`, over ``count`` points with mean extinction ``sigma_t``."""
        vertex = dr.zeros(mi.Interaction3f, dr.width(p))
        vertex.p = p
        coloured = isinstance(peak_depth, mi.Color3f)
        total = mi.Color3f(0) if dr.hint(coloured, mode="scalar") else mi.Float(0)
        shares, sum_of_weights, k = self._solid_angle.shares(p), mi.Float(0), mi.UInt32(0)
        while dr.hint(k < count, label="phase function over an emitter"):
            _, towards, distance, weight = self._sample(vertex, shares, k, shift)
            weight *= dr.exp(-sigma_t * self._length_within(p, towards, distance))
            rest = basis.residual_gain(p, direction, towards)
            if dr.hint(peak_depth is not None, mode="scalar"):
                cosine = dr.dot(direction, towards)
                rest = rest + basis.phase.aureole.correction(cosine, peak_depth)
            total += dr.select(weight > 0, weight * rest, 0)
            sum_of_weights += weight
            k += 1
        return dr.select(sum_of_weights > 0, total / sum_of_weights, 0)

    @symbolic
    def _sums(
        self, scene: mi.Scene, p: mi.Point3f, count: mi.UInt32, rng: mi.PCG32, order: int = 0
    ):
        """Sum over ``count`` points of the emitter; W is the solid angle that a point represents.

        Returns six sums: W times the transmittance T of the medium; W times T times the visibility
        V past surfaces and other media; W; the first and the third sum over every other point; and
        the list of the sums of W T V, averaged over the channels unless media are coloured, times
        each spherical harmonic of the direction to the point, from degree 1 to ``order``.
        """
        vertex = dr.zeros(mi.Interaction3f, dr.width(p))
        vertex.p = p
        shift = mi.Vector2f(rng.next_float32(), rng.next_float32())
        transmitted, visible, total = mi.Spectrum(0), mi.Spectrum(0), mi.Float(0)
        odd, odd_total = mi.Spectrum(0), mi.Float(0)
        coloured = self._is_coloured
        kind = mi.Spectrum if coloured else mi.Float
        angular = [kind(0) for _ in range(order * (order + 2))]
        others = Media.around(self._medium).without(self._medium)
        shares, k = self._solid_angle.shares(p), mi.UInt32(0)
        while dr.hint(k < count, label="points on an emitter"):
            target, direction, distance, weight = self._sample(vertex, shares, k, shift)
            seen = weight > 0
            ray = mi.Ray3f(p, direction)
            passed = medium_transmittance(self._medium, ray, distance, seen)
            passed = dr.select(seen, weight * mi.Spectrum(passed), 0)
            past, rng = visibility(scene, others, vertex, target, self._medium.pointer, rng, seen)
            transmitted += passed
            visible += dr.select(seen, passed * past, 0)
            total += weight
            is_odd = (k & 1) == 1
            odd += dr.select(is_odd, passed, 0)
            odd_total += dr.select(is_odd, weight, 0)
            if dr.hint(order > 0, mode="scalar"):
                share = passed * past
                if dr.hint(not coloured, mode="scalar"):
                    share = dr.mean(share)
                angular = _with_harmonics(angular, direction, dr.select(seen, share, 0), order)
            k += 1
        return transmitted, visible, total, odd, odd_total, angular

    def _sample(
        self, vertex: mi.Interaction3f, shares: list[mi.Float], k: mi.UInt32, shift: mi.Vector2f
    ) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Float]:
        """Sample a point on the emitter, approximately uniformly by solid angle.

        ``shares`` is the result of `SolidAngle.shares`. Returns the point, its direction and
        distance, and the solid angle that it represents, up to a constant factor; 0 if it is not
        seen, from inside of a closed shape. Flat emitters are sampled from both sides, so that the
        factors are continuous across their plane.
        """
        sample = mi.Point2f(kronecker(k, 2, (shift.x, shift.y)))
        if self._solid_angle.kind == "sphere":
            record = self._shape.sample_direction(vertex, sample)
            seen = (record.pdf > 0) & (dr.dot(record.n, record.d) < 0)
            weight = dr.select(seen, dr.rcp(record.pdf) + SMALL_ANGLE, 0)
            return record.p, record.d, record.dist, weight
        direction, distance, angle = self._solid_angle.sample(vertex.p, shares, sample)
        weight = dr.select(sum(shares) > 0, angle + SMALL_ANGLE, 0)
        return vertex.p + distance * direction, direction, distance, weight

    def _field_of_extinction(
        self, mean: mi.Float | mi.Color3f, classes: VoxelClasses | None
    ) -> ExtendedField:
        """Create the field of the optical depth divided by `length`.

        It is extrapolated beyond the outermost voxel centres, because it varies within a voxel next
        to faces that the emitter irradiates at grazing angles.
        """
        field = super()._field_of_extinction(mean, classes)
        known = marked(self._grid, self._voxels)
        return ExtendedField(self._grid, field.data, field.channels, known)

    def _field_of_others(self, passed: mi.Spectrum, classes: VoxelClasses | None) -> ExtendedField:
        """Create the field of visibility, interpolated linearly: shadow edges have no bias."""
        channels = list(passed)
        if all(dr.all(c == channels[0])[0] for c in channels[1:]):
            channels = channels[:1]
        values = spread(self._grid, self._voxels, channels, classes)
        return ExtendedField(self._grid, values, len(channels))

    def _mean_unobstructed(self) -> mi.Spectrum:
        return self._mean(self._grid, self._voxels, POINTS)


def area_lights_of(
    scene: mi.Scene,
    medium: MediumGrid,
    grid: Grid,
    voxels: mi.UInt32,
    classes: VoxelClasses | None = None,
    samples: int = 0,
) -> list[AreaLight]:
    """Return the direct light of the brightest area emitters of simple shapes.

    ``samples`` is the number of samples per voxel of the cache.
    """
    if medium.is_isolated or not dr.width(voxels):
        return []
    lights = [
        emitter
        for emitter in EmittersByKind(scene.emitters()).of(EmitterKind.AREA)
        if SolidAngle.of(emitter) is not None
    ]
    lights.sort(key=_power, reverse=True)
    order = order_of_direct_light(medium.phase)
    channels = max(m.sigma_t.channels for m in (medium, *medium.others))
    values = (VALUES + channels * order * (order + 2)) * dr.width(voxels)
    count = min(MOST_LIGHTS, MOST_VALUES // values)
    return [AreaLight(scene, e, medium, grid, voxels, classes, samples) for e in lights[:count]]


def _is_wide(shape: mi.Shape, medium: MediumGrid, grid: Grid) -> bool:
    """Return whether an emitter with this shape is wide as seen from all positions in a medium."""
    if may_meet(shape, grid, np.zeros(3), grid.resolution):
        return False
    centre, extent = bounding_sphere(medium.frame)
    ends = np.array([shape.bbox().min, shape.bbox().max], dtype=np.float64)
    radius = 0.5 * float(np.linalg.norm(ends[1] - ends[0]))
    return radius > WIDE * (float(np.linalg.norm(ends.mean(axis=0) - centre)) + extent)


def _mean_and_bias(
    transmitted: mi.Spectrum,
    visible: mi.Spectrum,
    weight: mi.Float,
    odd: mi.Spectrum,
    odd_weight: mi.Float,
    angular: list[mi.Float | mi.Spectrum],
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Return the mean transmittance T from the results of `AreaLight._sums`, and the bias of
    -log(T).

    The bias is half the relative variance of the mean. The variance of a mean over n points of a
    lattice is proportional to n^-2, so that the mean over one half of the points differs from that
    over all by a square of three times the variance of the latter.
    """
    mean = dr.select(weight > 0, transmitted / weight, 1)
    half = dr.select(odd_weight > 0, odd / odd_weight, mean)
    return mean, dr.square(dr.select(mean > 0, (half - mean) / mean, 0)) / 6


def moments_of(
    lights: Sequence[DirectLight], basis: AngularBasis, grid: Grid, voxels: mi.UInt32
) -> AngularField | None:
    """Create the field of the moments of the radiance from all ``lights`` with extent, relative to
    their irradiance at the ``voxels``; return None without such lights.

    The field has one channel if all irradiances have the same colour.
    """
    lights = [light for light in lights if not light.has_one_direction]
    if not lights:
        return None
    means = [[mi.Spectrum(1), *light.angular_means()] for light in lights]
    irradiances = [light.irradiance for light in lights]
    if _have_same_colour(irradiances):
        irradiances = [mi.Spectrum(dr.mean(irradiance)) for irradiance in irradiances]
        channels = 1
    else:
        channels = dr.size_v(mi.Spectrum)
    rows = []
    for own in zip(*means, strict=True):
        total = sum(e * mean for e, mean in zip(irradiances, own, strict=True))
        rows += [spread(grid, voxels, [total[c]], None) for c in range(channels)]
    return AngularField(basis, grid, rows[:channels], rows[channels:])


def _have_same_colour(irradiances: list[mi.Spectrum]) -> bool:
    """Return whether the channels of all ``irradiances`` have the same ratios everywhere."""
    colour, largest = sum(irradiances[0]), mi.Float(0)
    colour = [dr.sum(channel) / dr.sum(colour) for channel in irradiances[0]]
    for irradiance in irradiances:
        total = sum(irradiance)
        for share, channel in zip(colour, irradiance, strict=True):
            difference = dr.abs(channel - share * total)
            largest = dr.maximum(largest, dr.select(total > 0, difference / total, 0))
    return bool(dr.max(largest)[0] < SAME_COLOUR)


def _with_harmonics(
    sums: list[mi.Float | mi.Spectrum],
    direction: mi.Vector3f,
    weight: mi.Float | mi.Spectrum,
    order: int,
) -> list[mi.Float | mi.Spectrum]:
    """Return ``sums`` plus the spherical harmonics of ``direction``, degrees 1 to ``order``, times
    ``weight``.
    """
    harmonics = dr.sh_eval(direction, order)[1:]
    return [dr.fma(weight, y, total) for y, total in zip(harmonics, sums, strict=True)]


def _any_channel(mask: mi.Bool | mi.Color3f) -> mi.Bool:
    """Return whether a condition holds for any channel of a value that may have one."""
    return mask if isinstance(mask, mi.Bool) else mask[0] | mask[1] | mask[2]


def _is_inside(shape: mi.Shape, medium: MediumGrid) -> bool:
    """Return whether any of `POSITIONS` points of a shape lies in the medium."""
    rng = np.random.default_rng(POSITIONS)
    sample = mi.Point2f(np.float32(rng.random((2, POSITIONS))))
    return bool(dr.any(medium.contains(shape.sample_position(0.0, sample).p)))


def _places_on(shape: mi.Shape) -> mi.Point3f:
    """Return four points of a shape, those of a product rule for a rectangle."""
    places = shape.sample_position(0.0, mi.Point2f(*dr.meshgrid(*2 * [mi.Float(GAUSS_POINTS)]))).p
    dr.eval(places)
    return places


@symbolic
def _at_three_places(
    function: Callable[[mi.Float], mi.Float | mi.Color3f], zero: mi.Float | mi.Color3f
):
    """Evaluate a function that returns values of the type of ``zero`` at 0, 0.5 and 1."""
    first, middle, last = zero, zero, zero
    i, count = mi.UInt32(0), dr.opaque(mi.UInt32, 3)
    while dr.hint(i < count, label="three places"):
        value = function(0.5 * mi.Float(i))
        first = dr.select(i == 0, value, first)
        middle = dr.select(i == 1, value, middle)
        last = dr.select(i == 2, value, last)
        i += 1
    return first, middle, last


def _radiance(emitter: mi.Emitter) -> mi.Spectrum:
    """Return the radiance of an emitter whose radiance is uniform."""
    record = emitter.get_shape().sample_position(0.0, mi.Point2f(0.5))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.n, si.uv, si.wi = record.p, record.n, record.uv, mi.Vector3f(0, 0, 1)
    return mi.Spectrum([dr.opaque(mi.Float, float(c[0])) for c in emitter.eval(si)])


def _power(emitter: mi.Emitter) -> float:
    """Return the radiant power of an emitter over pi, summed over the channels."""
    area = float(np.ravel(emitter.get_shape().surface_area())[0])
    return area * sum(float(c[0]) for c in _radiance(emitter))
