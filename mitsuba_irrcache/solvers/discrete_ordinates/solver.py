"""The solver ``sweep``: discrete ordinates along long characteristics, all voxels at once.

A batch consists of passes; a pass is a transport sweep of one ordinate set along tracks through all
voxels (`tracks`). For all orders of scattering (``max_depth`` -1) the first pass of a batch solves
by source iteration with multigrid and Anderson acceleration (`multigrid`). Every other pass sweeps
the resulting source along different ordinates, so that the mean of the passes has little angular
noise, and improves the source for the passes that follow. For ``max_depth`` D >= 3 the first pass
makes D - 2 sweeps, which give orders 0 to D - 3, the source of the last order; each of the other
passes sweeps this source once. For single scattering (``max_depth`` 2) there is one pass.

Emission of the medium and small or point-like emitters are sampled voxel by voxel
(`direct_emission`, `direct_light`).

Batches have independent random numbers, so the standard error of their mean follows from the
variance of their results, although the voxels and orders of scattering of a batch are correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.statistics import ORDER_GROUPS, totals_of_pairs
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.occupancy import occupied_box
from mitsuba_irrcache.lights.falloff import VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.media_shares import media_in, media_within, why_shared
from mitsuba_irrcache.solvers.base import Progress
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import merged
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import SurfaceBoundary
from mitsuba_irrcache.solvers.discrete_ordinates.crossings import SurfaceVoxels
from mitsuba_irrcache.solvers.discrete_ordinates.cut_voxel_light import CutVoxelLight
from mitsuba_irrcache.solvers.discrete_ordinates.direct_emission import (
    EmissionPoints,
    emission_irradiance,
)
from mitsuba_irrcache.solvers.discrete_ordinates.direct_light import (
    EmitterSampling,
    split_by_solid_angle,
)
from mitsuba_irrcache.solvers.discrete_ordinates.incident import (
    FEW_SAMPLES,
    DistantIllumination,
    samples_in_isolated_media,
)
from mitsuba_irrcache.solvers.discrete_ordinates.layout import interleaved_channels
from mitsuba_irrcache.solvers.discrete_ordinates.mixture import MediaMixture, SingleMedium
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import (
    BoundaryOrdinateSet,
    OrdinateSet,
    boundary_ordinate_sets,
)
from mitsuba_irrcache.solvers.discrete_ordinates.refracted_light import (
    is_needed,
    refracted_irradiance,
)
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks, means_at_faces

#: Minimum and maximum number of ordinates of a batch (opposite ones count as two). One even set of
#: 32 has half the noise of two sets of 16, and one of 64 has 0.8 times the noise of two of 32.
SMALLEST_BATCH, LARGEST_BATCH = 32, 256
#: The same for a pass in multiple scattering, where a batch has several passes: all orders but
#: the last are solved for with one such set.
DIRECTIONS_OF_PASS = 16
#: Number of unknowns of a channel (voxels times moments) above which channels are swept one by one,
#: because sweeping them together takes several times the memory.
MOST_SWEPT_TOGETHER = 1 << 24
#: Variance of the mean of two passes, over what their difference suggests: their ordinates
#: complement each other. (Measured under windows in the ground; with four passes it is .7.)
VARIANCE_OF_TWO = 0.3
#: Relative change of the irradiance below which further orders of scattering are omitted, about the
#: resolution of single precision; number of orders between two tests of it.
NEGLIGIBLE, CHECKED_ORDERS = 1e-7, 8


def swept_together(extinctions: int, voxels: int, moments: int) -> bool:
    """Return whether all channels of a cache with this number of channels of the extinction, of
    ``voxels`` and of angular ``moments`` (0: the irradiance alone) are swept at once.
    """
    unknowns = voxels * max(1, moments)
    return extinctions == 1 and unknowns <= MOST_SWEPT_TOGETHER


def batch_of(samples: int, multiple: int) -> int:
    """Return the number of ordinates of a batch for a cache of ``samples`` ordinates.

    It is all of them, or an equal part if they exceed `LARGEST_BATCH`, rounded up to a multiple of
    ``multiple``. Batches should be large, because each one solves for all orders anew.
    """
    batches = -(-samples // LARGEST_BATCH)
    return -(-samples // (batches * multiple)) * multiple


class Sweep:
    """Fills the ``cache`` of ``medium`` by discrete ordinates (S_N) along long characteristics,
    with source iteration, multigrid and Anderson acceleration.
    """

    #: ordinates of a pass in multiple scattering
    directions = DIRECTIONS_OF_PASS

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        cache: IrradianceCache,
        seed: int,
        rr_depth: int = 5,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        """``rr_depth`` applies to paths between surfaces; ``pause`` is called after each launch."""
        self.cache, self.seed = cache, seed
        #: squared noise of each batch, see `direction_noise`
        self._squared_noise: list[float] = []
        sampling = FEW_SAMPLES, True
        if medium.is_isolated:
            sampling = samples_in_isolated_media(cache.max_depth, not cache.moments)
        self._illumination = DistantIllumination(
            scene, medium.emission is not None, *sampling, is_isotropic=not cache.moments
        )
        if not cache.active_count:
            return
        self._medium = medium
        # The tracks come first: `occupied_box` evaluates the coordinates of all voxels, which the
        # sample points would otherwise share and store.
        self._surfaces = _surfaces_among(scene, cache, medium if medium.refracts else None)
        box = occupied_box(cache.grid, cache.active)
        #: whether boundaries that are not in closed form, or of other media, divide voxels
        self._is_shared = not medium.is_isolated and not medium.refracts
        self._is_shared &= why_shared(scene, medium, cache.grid, box) is not None
        self._prepare_tracks(scene, pause)
        self._sample_points = VoxelSamplePoints(scene, cache.grid).of(cache.active)
        if medium.refracts:
            self._sample_points = medium.boundary.drawn_inside(self._sample_points)
            dr.eval(self._sample_points)
        #: mean of the inverse-square factor over a voxel, divided by its value at the sample point:
        #: the source of multiple scattering near an emitter is a mean over the voxel
        self._inverse_square_mean = mi.Float(1)
        if cache.falloff is not None and cache.max_depth != 2:
            self._inverse_square_mean = cache.falloff.spread(cache.active)
            dr.eval(self._inverse_square_mean)
        #: direct lights of the cache, evaluated in closed form, by the identity of their irradiance
        self._closed_form_lights = {id(light.irradiance): light for light in cache.direct_lights}
        #: the same lights in voxels that surfaces cut; None without any
        self._cut_voxel_light: CutVoxelLight | None = None
        #: results of sampling voxel by voxel in a batch: from each point-like emitter and from area
        #: emitters, and from emission. Each is a list of the irradiance, and its moments unless
        #: they follow from the direction
        self._direct: list[list[mi.Spectrum]] = []
        self._emission: list[list[mi.Spectrum]] = []
        self._emission_points: EmissionPoints | None = None
        if medium.emission is not None and medium.emission.grid is not None:
            self._emission_points = EmissionPoints(medium.emission)
        #: for each channel, the sum of the variances of what is sampled voxel by voxel in a batch;
        #: None: nothing
        self._own_spreads: list[mi.Float | None] = [None] * cache.channels
        #: irradiance of suns that are direct lights of the cache
        self._sun_irradiance: list[mi.Spectrum] = []
        #: factors of the channels of a batch's results
        self._colour = np.ones(cache.channels)
        self._boundary: SurfaceBoundary | None = None
        self._emitter_sampling: EmitterSampling | None = None
        #: irradiance from each point-like emitter, among surfaces
        self._from_points: list[mi.Spectrum] = []
        if medium.is_isolated:
            known = cache.direct_lights
            points = self._illumination.point_irradiance(medium, self._sample_points, known)
            self._direct = [[self._with_means_at_faces(irradiance)] for irradiance in points]
            self._sun_irradiance = [d.irradiance for d in known if d.distant]
        else:
            self._prepare_surroundings(scene, rr_depth)

    def _prepare_surroundings(self, scene: mi.Scene, rr_depth: int) -> None:
        """Create the objects that trace rays among surfaces and other media."""
        medium, cache = self._medium, self.cache
        box = occupied_box(cache.grid, cache.active)
        known = [light.emitter for light in cache.direct_lights]
        small, large = (
            [emitter for emitter in emitters if emitter not in known]
            for emitters in split_by_solid_angle(scene, cache.grid, *box)
        )
        within = media_in(medium, cache.grid) if self._is_shared else ()
        self._boundary = SurfaceBoundary(
            scene, medium, large, rr_depth, cache.directional, self._surfaces, within
        )
        # Moments of the radiance in cut voxels are those at the centre.
        if self._surfaces is not None and known and cache.max_depth != 2 and not cache.moments:
            lights, surfaces = cache.direct_lights, self._surfaces
            self._cut_voxel_light = CutVoxelLight(lights, medium, surfaces, cache.active)
            self._boundary.cut_voxel_light = self._cut_voxel_light
        # Crossing glass is a vertex of a path: this source would not fit a limited max_depth.
        isotropic, all_orders = medium.phase.is_isotropic, cache.max_depth < 0
        if medium.refracts and isotropic and all_orders and is_needed(scene):
            self._boundary.carries_refracted = False
        emitters = small, self._illumination.point_lights
        self._emitter_sampling = EmitterSampling(
            scene, medium, *emitters, self._sample_points, cache.directional, self._is_shared
        )
        points = self._emitter_sampling.from_points
        self._from_points = [self._with_means_at_faces(irradiance) for irradiance in points]

    def _with_means_at_faces(self, irradiance: mi.Spectrum) -> mi.Spectrum:
        """Replace values at centres by means where uncollided irradiance along tracks is a mean,
        except for direct lights, which are subtracted before values are interpolated.
        """
        if id(irradiance) in self._closed_form_lights:
            return irradiance
        layers = self._tracks[0].layers
        return means_at_faces(irradiance, self.cache.grid, self.cache.active, layers)

    def _prepare_tracks(self, scene: mi.Scene, pause: Callable[[], None]) -> None:
        """Create the tracks for each channel of the extinction, and resample extinction and albedo
        for multiple scattering.
        """
        medium, cache, grid = self._medium, self.cache, self.cache.grid
        if medium.refracts:
            # Tracks end at the glass, so the extinction of voxels that it cuts must not be reduced.
            medium = medium.replaced(boundary=Boundary("box", medium.boundary.to_world))
        border = cache.interpolation.border
        is_dense = border is not None
        box = occupied_box(grid, cache.active)
        voxels = SingleMedium(medium)
        if self._is_shared:
            voxels = MediaMixture(scene, media_within(medium, grid, box))
        detail = voxels.extinction_grid(grid, is_dense)
        extinction = voxels.extinction(detail, grid)
        # The extinction of blocks of the medium's voxels, or of rotated voxels, may extend beyond
        # the active voxels.
        data = medium.sigma_t.grid
        sparse = data is not None and detail.shape == data.shape and medium.fills(grid)
        sparse &= not self._is_shared
        # With further orders, the sum of uncollided and scattered irradiance does not depend on it.
        has_dense_faces = is_dense and border.is_at_faces and cache.max_depth == 2
        rest = *box, detail, cache.active, sparse, pause, self._surfaces, has_dense_faces
        self._tracks = [Tracks(grid, sigma_t, *rest) for sigma_t in extinction]
        self._levels: dict[tuple[int, ...], MultigridLevel] = {}
        # Single scattering does not need the albedo here: lookups multiply by it.
        self._sigma_t = self._albedo = [mi.Float(0)]
        if cache.max_depth != 2 or self._surfaces is not None:
            if detail is not grid:
                extinction = voxels.extinction(grid, grid)
            self._sigma_t = self._at_active(extinction)
            self._albedo = voxels.albedo(grid, cache.active)
            if self._surfaces is not None:
                # Without this, corrections from coarser grids would leave small irradiance within
                # objects, and lookups next to them would not replace it by that of neighbours.
                enclosed = dr.gather(mi.Bool, cache.voxel_classes.enclosed, cache.active)
                self._albedo = [dr.select(enclosed, 0, albedo) for albedo in self._albedo]
                dr.eval(self._albedo)

    @property
    def direction_noise(self) -> float:
        """See `Solver.direction_noise`; the mean over the batches so far."""
        count = len(self._squared_noise)
        return float(np.sqrt(sum(self._squared_noise)) / max(count, 1))

    def use(self, scene: mi.Scene | None) -> None:
        """Set the scene in which rays are traced, see `Solver.use`."""
        if self.cache.active_count:
            for part in (self._surfaces, self._boundary, self._emitter_sampling):
                if part is not None:
                    part.scene = scene

    def refine(self, samples: int, progress: Progress | None = None) -> None:
        """Add ``samples`` ordinates per voxel, a multiple of the cache's batch.

        If ``progress`` raises, complete batches remain in the cache.
        """
        cache = self.cache
        if not cache.active_count:
            cache.note_samples(self.seed, samples)
            return
        first, count = cache.streams.get(self.seed, 0) // cache.batch, samples // cache.batch
        for number in range(first, first + count):
            batch = self._batch(number)
            cache.add(self.seed, cache.batch, [batch], self._own_spreads)
            if progress is not None:
                dr.sync_thread()
                done = (number - first + 1) * cache.batch
                progress(done * cache.active_count, samples * cache.active_count)

    # A batch

    def _batch(self, number: int) -> tuple:
        """Compute a batch in the form that `IrradianceCache.add` takes.

        It has the irradiance of both order groups in all channels at the active voxels, and the
        moments if any.
        """
        cache, seed = self.cache, (self.seed, number)
        self._own_spreads = [None] * cache.channels
        if self._medium.emission is not None:
            arguments = self._medium, self._emission_points, self._sample_points, cache.batch // 2
            self._emission = [
                self._mean_of_two(
                    seed, lambda own: emission_irradiance(*arguments, own, cache.directional)
                )
            ]
        sets, grey, colour = self._ordinate_sets(seed)
        found = []
        for channels in self._channel_groups(grey):
            found += self._solve(sets(channels), channels)
        values: list[list] = [[] for _ in range(len(ORDER_GROUPS) + cache.moments)]
        # Channels with the same factor share one array.
        factors = {factor: dr.opaque(mi.Float, factor) for factor in map(float, colour)}
        for c in range(cache.channels):
            factor = factors[float(colour[c])]
            for own, part in zip(values, found[min(c, len(found) - 1)], strict=True):
                own.append(part if part is None else part * factor)
        dr.eval(values)
        irradiance, moments = values[: len(ORDER_GROUPS)], values[len(ORDER_GROUPS) :]
        parts = [tuple(chain(*irradiance)), (None,) * cache.channels]
        return (*parts, tuple(chain(*moments))) if moments else tuple(parts)

    def _ordinate_sets(self, seed: tuple[int, int]) -> tuple[Callable, bool, np.ndarray]:
        """Create the ordinate sets of all passes of a batch.

        Returns a function from the channels that are swept together to the sets; whether the
        results of all channels are equal up to a factor; and these factors (channels).
        """
        cache, rng = self.cache, np.random.default_rng(seed)
        pairs, passes = cache.batch // 2, 1
        if cache.max_depth != 2:  # one pass more, which solves for the source of the others
            pairs, passes = self.directions // 2, cache.batch // self.directions + 1
        grey_media = max(len(self._tracks), len(self._albedo)) == 1
        if self._boundary is None:
            first = self._first_pairs(pairs)
            ordinates, colour = self._illumination.factored_ordinates(
                passes - bool(first), pairs, cache.channels, rng, first
            )
            self._colour = colour
            suns = self._illumination.sun_pairs(pairs) if self._sun_irradiance else 0

            def sets(channels: Sequence[int]) -> list[OrdinateSet]:
                return [OrdinateSet(each, channels, suns) for each in ordinates]

            return sets, grey_media and ordinates[0].incoming.shape[-1] == 1, colour
        surroundings = self._boundary, self._illumination, self._tracks[0]
        sets, spectra = boundary_ordinate_sets(*surroundings, passes, pairs, rng, seed)
        sampling = self._emitter_sampling
        direct = [[irradiance] for irradiance in self._from_points]
        if sampling.has_area_emitters:
            direct.append(self._mean_of_two(seed, sampling.from_area_emitters))
        self._direct = self._with_closed_form_lights(direct)
        if not self._boundary.carries_refracted:
            arguments = self._boundary, cache.grid, cache.active
            self._direct.append(
                self._mean_of_two(seed, lambda own: [refracted_irradiance(*arguments, own)])
            )
        grey = grey_media and is_grey([*spectra, *chain(*self._direct, *self._emission)])
        return sets, grey, np.ones(cache.channels)

    def _mean_of_two(
        self, seed: tuple[int, int], estimate: Callable[[tuple[int, int]], list[mi.Spectrum]]
    ) -> list[mi.Spectrum]:
        """Return the mean of two independent estimates, given a seed, of an irradiance at each
        voxel (with moments), and add its variance to that of the batch.

        Errors that differ between neighbours bias the interpolation of the cache unless their
        variance is known (`cache/conservative`).
        """
        cache_seed, number = seed
        first, second = (estimate((cache_seed, 2 * number + half)) for half in (0, 1))
        variances = [dr.square(0.5 * (a - b)) for a, b in zip(first[0], second[0], strict=True)]
        self._own_spreads = totals_of_pairs(self._own_spreads, variances)
        mean = [0.5 * (a + b) for a, b in zip(first, second, strict=True)]
        dr.eval(mean, self._own_spreads)
        return mean

    def _first_pairs(self, pairs: int) -> int:
        """Return the number of pairs of ordinates of the first pass, which computes all orders but
        the last; 0 if there are no such orders. Other passes have ``pairs``.

        If there are few orders, the first pass has more ordinates, as many as fit into about the
        time of the other passes, because these do not reduce its noise.
        """
        max_depth = self.cache.max_depth
        if max_depth < 0:
            return pairs
        if max_depth == 2:
            return 0
        return max(pairs, self.cache.batch // 2 // (max_depth - 2))

    def _channel_groups(self, grey: bool) -> list[tuple[int, ...]]:
        """Return groups of channels that are swept together; only the first channel if ``grey``."""
        channels = range(1 if grey else self.cache.channels)
        voxels, moments = self.cache.grid.voxel_count, self.cache.moments
        if swept_together(len(self._tracks), voxels, moments):
            return [tuple(channels)]
        return [(c,) for c in channels]

    def _solve(
        self,
        sets: list[OrdinateSet] | list[BoundaryOrdinateSet],
        channels: tuple[int, ...],
    ) -> list[tuple]:
        """Return for each channel the irradiance at the active voxels: uncollided, and scattered
        (None for single scattering), followed by the moments, if any.
        """
        if self.cache.max_depth == 2:
            tracks = self._tracks_of(channels)
            return [(found, None) for found in self._uncollided(tracks, sets, channels)[1]]
        level = self._level(channels)
        swept, uncollided = self._uncollided(level.tracks, sets[1:], channels)
        total = self._swept(level, sets, channels)
        # Both order groups use the same ordinates: in their sum the uncollided part along tracks
        # cancels (but for suns evaluated in closed form), so it has no noise in a constant
        # environment.
        scattered = [
            dr.maximum(dr.gather(mi.Float, total, place) - along_tracks, 0)
            for place, along_tracks in zip(self._interleaved_places(channels), swept, strict=True)
        ]
        dr.eval(scattered)
        return list(zip(uncollided, scattered, strict=True))

    # Tracks and levels

    def _level(self, channels: tuple[int, ...]) -> MultigridLevel:
        """Return the finest level for these channels, created at the first call."""
        if channels not in self._levels:
            sigma_t, albedo = self._sigma_t, self._albedo
            self._levels[channels] = self._new_level(
                sigma_t[min(channels[0], len(sigma_t) - 1)],
                interleaved_channels([albedo[min(c, len(albedo) - 1)] for c in channels]),
                self._tracks_of(channels),
            )
        return self._levels[channels]

    def _tracks_of(self, channels: tuple[int, ...]) -> Tracks:
        """Return the tracks with the extinction of these channels."""
        return self._tracks[min(channels[0], len(self._tracks) - 1)]

    def _new_level(self, sigma_t: mi.Float, albedo: mi.Float, tracks: Tracks) -> MultigridLevel:
        # Among surfaces, levels have to be coarsened along all axes (`boundary_condition`).
        return MultigridLevel(sigma_t, albedo, tracks, all_axes=not self._medium.is_isolated)

    # Uncollided irradiance

    def _uncollided(
        self,
        tracks: Tracks,
        sets: list[OrdinateSet] | list[BoundaryOrdinateSet],
        channels: tuple[int, ...],
    ) -> tuple[list[mi.Float], list[mi.Float]]:
        """Compute the uncollided irradiance in each channel.

        Returns the part along tracks, the mean of all passes; and the total, including emitters
        that are sampled voxel by voxel.
        """
        (arguments, *suns), share = sets[0].uncollided(sets), dr.opaque(mi.Float, 1 / len(sets))
        interpolated = swept = self._mean_irradiance(tracks, arguments, share, len(channels))
        if self._sun_irradiance and self.cache.max_depth != 2:  # it is scattered, too
            from_suns = self._mean_irradiance(tracks, suns[0], share, len(channels))
            swept = [a + b for a, b in zip(swept, from_suns, strict=True)]
        if self._surfaces is not None:
            interpolated = swept = self._with_cut_voxels(interpolated, sets, share, channels)
        emitters = *self._direct, *self._emission
        return swept, [
            along_tracks + sum(irradiance[c] for irradiance, *_ in emitters) + self._from_suns(c)
            for c, along_tracks in zip(channels, interpolated, strict=True)
        ]

    def _with_cut_voxels(
        self,
        irradiance: list[mi.Float],
        sets: list[BoundaryOrdinateSet],
        share: mi.Float,
        channels: tuple[int, ...],
    ) -> list[mi.Float]:
        """Replace the uncollided irradiance in voxels that surfaces cut by that of collisions."""
        level = self._level(channels)
        collided = sum(each.uncollided_collisions(level) for each in sets) * share
        is_cut = self._surfaces.is_cut_at(self.cache.active)
        places = self._interleaved_places(channels)
        found = [
            dr.select(is_cut, dr.gather(mi.Float, collided, place), own)
            for place, own in zip(places, irradiance, strict=True)
        ]
        dr.eval(found)
        return found

    def _mean_irradiance(
        self, tracks: Tracks, arguments: tuple, share: mi.Float, channels: int
    ) -> list[mi.Float]:
        """Return `Tracks.uncollided` times ``share`` per channel; channels may share an array."""
        count = self.cache.active_count
        if not len(arguments[0]):
            return [dr.zeros(mi.Float, count)] * channels
        values = tracks.uncollided(*arguments) * share
        if dr.width(values) == count:
            return [values] * channels
        place = dr.arange(mi.UInt32, count)
        starts = (dr.opaque(mi.UInt32, c * count) for c in range(channels))
        return [dr.gather(mi.Float, values, place + start) for start in starts]

    def _from_suns(self, channel: int) -> mi.Float | int:
        """Return the irradiance of suns among the direct lights over the channel's factor."""
        if not self._colour[channel] > 0:
            channel = int(self._colour.argmax())
        colour = dr.opaque(mi.Float, 1 / float(self._colour[channel]))
        return sum(irradiance[channel] * colour for irradiance in self._sun_irradiance)

    # Multiple scattering

    def _swept(
        self,
        level: MultigridLevel,
        sets: list[OrdinateSet] | list[BoundaryOrdinateSet],
        channels: tuple[int, ...],
    ) -> mi.Float:
        """Return the irradiance of all orders along tracks at the active voxels, the mean of all
        passes but the first, with interleaved channels.
        """
        first, *sets = sets
        phi, total = self._irradiance_of_collisions(level, first, channels, len(sets)), mi.Float(0)
        used, share = mi.Float(0), dr.opaque(mi.Float, 1 / len(sets))
        scatters = self._boundary is not None and len(sets) > 1
        squares = mi.Float(0)
        for number, each in enumerate(sets, 1):
            irradiance, again = each.sweep(level, phi)
            total, used = total + irradiance, used + phi
            if scatters:
                squares += dr.square(self._irradiance_of(irradiance))
            dr.eval(total, used, squares)
            if self.cache.max_depth < 0:
                # The sweep is another estimate of all orders: the mean of both has less noise.
                again = each.corrected(level, phi, self._add_sampled(again, channels))
                phi = dr.lerp(phi, again, dr.opaque(mi.Float, 1 / (number + 1)))
                dr.eval(phi)
        if scatters:
            self._note_noise(self._irradiance_of(total), squares, len(sets), channels)
        if self.cache.max_depth >= 0:
            return total * share
        # Earlier passes used a noisier phi than the final one. Without this correction the noise of
        # the first pass would have three times the weight of the others'.
        change = phi - used * share
        if self._surfaces is None:
            ordinates = merged([each.scattering for each in sets])
            change = level.propagated_change(change, ordinates, len(sets))
        else:  # coarser levels have no surfaces among the voxels
            change, _ = sets[0].exchanged(level, change)
        return dr.fma(total, share, change)

    def _irradiance_of(self, values: mi.Float) -> mi.Float:
        """Return the irradiance in ``values`` that the solver computes."""
        return values

    @property
    def _noise_of_scattering(self) -> float:
        """Ratio of the squared noise of scattered radiance to that of the irradiance."""
        return 1.0

    def _note_noise(
        self, total: mi.Float, squares: mi.Float, passes: int, channels: tuple[int, ...]
    ) -> None:
        """Estimate the noise of a batch by the scatter of its passes, given their sum and the sum
        of their squares.
        """
        count = dr.opaque(mi.Float, passes)
        variance = dr.maximum(squares - dr.square(total) / count, 0) / (count * (count - 1))
        scale = self._noise_of_scattering * (VARIANCE_OF_TWO if passes == 2 else 1.0)
        variance *= dr.opaque(mi.Float, scale)
        sampled = sum(
            dr.mean(self._irradiance_of(sum(self._sampled(c), mi.Float(0)))) for c in channels
        )
        values = dr.mean(variance), dr.mean(total) / count, sampled / len(channels)
        dr.eval(values)
        variance, mean, sampled = (float(v[0]) for v in values)
        self._squared_noise.append(variance / max(mean + sampled, 1e-30) ** 2)

    def _irradiance_of_collisions(
        self,
        level: MultigridLevel,
        first: OrdinateSet | BoundaryOrdinateSet,
        channels: tuple[int, ...],
        passes: int,
    ) -> mi.Float:
        """Return the mean irradiance of collisions of all orders but the last, computed with the
        set ``first``. ``passes`` is the number of passes that follow.
        """
        phi = self._add_sampled(first.collisions(level, None), channels)
        if self.cache.max_depth < 0:
            return first.solve(level, phi, passes)
        for order in range(self.cache.max_depth - 3):
            before, phi = phi, self._add_sampled(first.collisions(level, phi), channels)
            # Omit further orders once they are negligible, whatever max_depth is.
            if order % CHECKED_ORDERS == CHECKED_ORDERS - 1 and _change(before, phi) < NEGLIGIBLE:
                break
        return phi

    def _add_sampled(self, phi: mi.Float, channels: tuple[int, ...]) -> mi.Float:
        """Return ``phi`` plus the irradiance of emitters that are sampled voxel by voxel."""
        sampled = [sum(self._sampled(c)) for c in channels]
        if self._direct or self._emission:
            phi = phi + interleaved_channels(sampled)
            dr.eval(phi)
        return phi

    def _sampled(self, channel: int) -> list[mi.Float]:
        """Return the irradiance from each emitter that is sampled voxel by voxel, as means over the
        active voxels.
        """
        known = {key: light.means for key, light in self._closed_form_lights.items()}
        if self._cut_voxel_light is not None:
            known |= self._cut_voxel_light.means
        direct = [
            known[id(irradiance)][channel]
            if id(irradiance) in known
            else irradiance[channel] * self._inverse_square_mean
            for irradiance, *_ in self._direct
        ]
        return direct + [irradiance[channel] for irradiance, *_ in self._emission]

    def _with_closed_form_lights(self, direct: list[list[mi.Spectrum]]) -> list[list[mi.Spectrum]]:
        """Replace and complete ``direct`` by the irradiance of the cache's direct lights.

        ``direct`` is the irradiance of each point-like emitter, followed by that of other emitters.
        """
        known = {id(d.emitter): [d.irradiance] for d in self.cache.direct_lights}
        lights = self._illumination.point_lights
        replaced = [known.pop(id(e), d) for e, d in zip(lights, direct, strict=False)]
        return replaced + direct[len(lights) :] + list(known.values())

    # Arrays

    def _at_active(self, fields: list[mi.Float]) -> list[mi.Float]:
        """Return the values of ``fields`` at the active voxels."""
        found = [dr.gather(mi.Float, field, self.cache.active) for field in fields]
        dr.eval(found)
        return found

    def _interleaved_places(self, channels: Sequence[int]) -> list[mi.UInt32]:
        """Return the indices of each channel's values in an array with interleaved channels."""
        place = dr.arange(mi.UInt32, self.cache.active_count) * len(channels)
        return [place + c for c in range(len(channels))]


def _surfaces_among(
    scene: mi.Scene, cache: IrradianceCache, medium: MediumGrid | None
) -> SurfaceVoxels | None:
    """Return the voxels near surfaces; None without surfaces in the box of the active voxels.

    ``medium`` is given if its boundary refracts.
    """
    if cache.voxel_classes is None:
        return None
    box = occupied_box(cache.grid, cache.active)
    surfaces = SurfaceVoxels(scene, cache.grid, *box, medium, cache.active)
    return surfaces if surfaces.count else None


def _change(before: mi.Float, after: mi.Float) -> float:
    """Return the mean absolute change, relative to the mean."""
    change, scale = dr.sum(dr.abs(after - before)), dr.sum(dr.abs(after))
    dr.eval(change, scale)
    return float(change[0]) / max(float(scale[0]), 1e-30)


def is_grey(spectra: Sequence[mi.Spectrum]) -> bool:
    """Return whether all channels of each spectrum are the same."""
    same = [dr.all(c == spectrum[0]) for spectrum in spectra for c in list(spectrum)[1:]]
    dr.eval(same)
    return all(s[0] for s in same)
