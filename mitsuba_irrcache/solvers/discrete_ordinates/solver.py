"""The solver ``sweep``: light is carried along lines that all voxels share, all voxels at once.

See `tracks` for the lines, `incident` for where they point, `multigrid` for light that is
scattered more than once, `direct_emission` for light of the medium itself, which is followed voxel
by voxel. A batch is a chain of its own, with random numbers of its own: batches are independent of
each other, so their scatter is the error of their mean, whatever the voxels and orders of
scattering in a batch share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import LAYERS, IrradianceCache
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import SurfaceBoundary
from mitsuba_irrcache.solvers.discrete_ordinates.direct_emission import emitted_light
from mitsuba_irrcache.solvers.discrete_ordinates.direct_light import Lamps, is_lamp, split
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.solvers.discrete_ordinates.layout import interleaved_channels
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import (
    BoundaryOrdinateSet,
    OrdinateSet,
    arriving,
    merged,
)
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import (
    albedo_of_collisions,
    baked,
    detail_of,
)
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Directions per voxel of a batch, pairs of opposite ones, at least and at most. Spread evenly
#: together, 32 leave half the noise of two sets of 16, and 64 four fifths of that of two of 32.
BATCH, LARGEST_BATCH = 32, 256
#: Directions of a pass, of which a batch is made where light is scattered more than once: the
#: orders before the last are solved for with one such set.
DIRECTIONS = 16
#: Voxels of a cache whose channels are swept one by one, if there are more: together they take
#: several times the memory.
TOGETHER = 1 << 24
#: An order of scattering that changes the light by less is one too many, as single precision has
#: it; looked at every so many orders.
NO_LIGHT, CHECKED = 1e-7, 8

#: called with (samples done, samples in all), both in voxels times directions
Progress = Callable[[int, int], None]


def takes(emitter: mi.Emitter) -> bool:
    """Whether the light of an emitter can be swept: it comes from far away, or from a point, or
    from an area that shines in all directions.
    """
    flags = mi.EmitterFlags.Infinite, mi.EmitterFlags.DeltaDirection, mi.EmitterFlags.DeltaPosition
    surface = mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
    return is_lamp(emitter) if surface else any(mi.has_flag(emitter.flags(), f) for f in flags)


def swept_together(medium: MediumGrid, voxels: int) -> bool:
    """Whether the channels of light in a cache of so many ``voxels`` go the same ways at once."""
    return medium.phase is None and medium.sigma_t.channels == 1 and voxels <= TOGETHER


def batch_of(samples: int, least: int) -> int:
    """The directions of a batch of a cache of so many: all of them, or equal parts if there are too
    many, in multiples of ``least``. Each batch solves for all orders anew.
    """
    batches = -(-samples // LARGEST_BATCH)
    return -(-samples // (batches * least)) * least


class Sweep:
    """Fills ``cache``, which lies over ``medium``."""

    #: of a pass, where light is scattered more than once
    directions = DIRECTIONS

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        cache: IrradianceCache,
        seed: int,
        rr_depth: int = 5,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        """``rr_depth`` is that of paths between surfaces."""
        self.cache, self.seed = cache, seed
        self._sky = DistantIllumination(scene, medium.emission is not None)
        if not cache.active_count:
            return
        grid = cache.grid
        detail = detail_of(medium, grid)
        extinction = baked(medium, medium.sigma_t, detail)
        box = occupied_box(grid, cache.active)
        # Blocks of the medium's voxels, and voxels that lie askew to these, reach farther.
        data = medium.sigma_t.grid
        sparse = data is not None and detail.shape == data.shape and medium.fills(grid)
        rest = *box, detail, cache.active, sparse, pause
        self._lattices = [Tracks(grid, s, *rest) for s in extinction]
        # For single scattering the albedo does not matter here.
        self._levels: dict[tuple[int, ...], MultigridLevel] = {}
        self._sigma_t = self._albedo = [mi.Float(0)]
        if cache.max_depth != 2:
            sigma_t = extinction if detail is grid else baked(medium, medium.sigma_t, grid)
            self._sigma_t = self._at_active(sigma_t)
            self._albedo = albedo_of_collisions(medium, grid, cache.active)
        self._medium, self._places = medium, VoxelSamplePoints(scene, grid).of(cache.active)
        # What is scattered near a lamp is what a voxel gets on average, not in its middle.
        self._spread = mi.Float(1)
        if cache.falloff is not None and cache.max_depth != 2:
            self._spread = cache.falloff.spread(cache.active)
            dr.eval(self._spread)
        # Light that does not come along lines, of a batch: irradiance, and the moments, if they
        # are not known from the direction.
        self._direct: list[list[mi.Spectrum]] = []
        self._emitted: list[list[mi.Spectrum]] = []
        #: irradiance of suns that camera rays do not interpolate
        self._suns: list[mi.Spectrum] = []
        #: what all channels of the light are in units of the first one's
        self._colour = np.ones(cache.channels)
        self._around: SurfaceBoundary | None = None
        if medium.is_isolated:
            near = self._sky.near_light(medium, self._places, cache.direct_lights)
            self._direct = [[e] for e in near]
            self._suns = [d.irradiance for d in cache.direct_lights if d.distant]
            return
        small, large = split(scene, grid, *box)
        self._around = SurfaceBoundary(scene, medium, large, rr_depth, cache.directional)
        lights = small, self._sky.near
        self._lamps = Lamps(scene, medium, *lights, self._places, cache.directional)

    def refine(self, samples: int, progress: Progress | None = None) -> None:
        """Adds ``samples`` directions per voxel, a multiple of the cache's batch.

        If ``progress`` raises, batches that are complete stay in the cache.
        """
        cache = self.cache
        if not cache.active_count:
            cache.note_samples(self.seed, samples)
            return
        first, count = cache.streams.get(self.seed, 0) // cache.batch, samples // cache.batch
        for number in range(first, first + count):
            cache.add(self.seed, cache.batch, [self._batch(number)])
            if progress is not None:
                dr.sync_thread()
                done = (number - first + 1) * cache.batch
                progress(done * cache.active_count, samples * cache.active_count)

    def _batch(self, number: int) -> tuple:
        """Irradiance of both layers in all channels at the active voxels, and the moments if there
        are any, as `IrradianceCache.add` wants it.
        """
        cache = self.cache
        pairs, passes = cache.batch // 2, 1
        if cache.max_depth != 2:  # one pass more tells what is scattered again
            pairs, passes = self.directions // 2, cache.batch // self.directions + 1
        rng = np.random.default_rng((self.seed, number))
        if self._medium.emission is not None:
            seed = self.seed, number
            shines = self._medium, self._places, cache.batch
            self._emitted = [emitted_light(*shines, seed, cache.directional)]
        media = max(len(self._lattices), len(self._albedo))
        if self._around is None:
            first = self._first_pairs(pairs)
            rows, colour = self._sky.tables(passes - bool(first), pairs, cache.channels, rng, first)
            # Channels that differ by a factor only are one.
            grey = media == 1 and rows[0][1].shape[-1] == 1

            self._colour = colour
            of_suns = self._sky.sun_rows(pairs) if self._suns else 0

            def passes_of(channels: Sequence[int]) -> list[OrdinateSet]:
                return [OrdinateSet(row, channels, of_suns) for row in rows]
        else:
            seed = self.seed, number
            lattice, colour = self._lattices[0], np.ones(cache.channels)
            passes_of, kinds = arriving(self._around, self._sky, lattice, passes, pairs, rng, seed)
            self._direct = self._with_direct_lights(self._lamps.light(seed))
            grey = media == 1 and is_grey([*kinds, *chain(*self._direct, *self._emitted)])
        found = []
        for channels in self._together(grey):
            found += self._solved(passes_of(channels), channels)
        layers: list[list] = [[] for _ in range(len(LAYERS) + cache.moments)]
        # Channels with one factor in common are one array.
        factors = {factor: dr.opaque(mi.Float, factor) for factor in map(float, colour)}
        for c in range(cache.channels):
            factor = factors[float(colour[c])]
            for layer, phi in zip(layers, found[min(c, len(found) - 1)], strict=True):
                layer.append(phi if phi is None else phi * factor)
        dr.eval(layers)
        light, moments = layers[: len(LAYERS)], layers[len(LAYERS) :]
        parts = [tuple(chain(*light)), (None,) * cache.channels]
        return (*parts, tuple(chain(*moments))) if moments else tuple(parts)

    def _first_pairs(self, pairs: int) -> int:
        """Pairs of directions of the pass by which the orders before the last are known, where
        others have so many ``pairs``; 0 where there are none.

        Few orders are found one by one with more directions, in about the time of all passes:
        their noise is not made good by those that follow.
        """
        orders = self.cache.max_depth - 2
        if orders <= 0:
            return pairs if orders else 0
        return max(pairs, self.cache.batch // 2 // orders)

    def _together(self, grey: bool) -> list[tuple[int, ...]]:
        """The channels that are swept at once, of all or of the first one."""
        channels = range(1 if grey else self.cache.channels)
        if swept_together(self._medium, self.cache.grid.voxel_count):
            return [tuple(channels)]
        return [(c,) for c in channels]

    def _level(self, channels: tuple[int, ...]) -> MultigridLevel:
        """The finest level, made when it is first asked for."""
        if channels not in self._levels:
            sigma_t, albedo = self._sigma_t, self._albedo
            self._levels[channels] = self._new_level(
                sigma_t[min(channels[0], len(sigma_t) - 1)],
                interleaved_channels([albedo[min(c, len(albedo) - 1)] for c in channels]),
                self._lattice(channels),
            )
        return self._levels[channels]

    def _lattice(self, channels: tuple[int, ...]) -> Tracks:
        """The lines of these channels of the medium."""
        return self._lattices[min(channels[0], len(self._lattices) - 1)]

    def _new_level(self, *arguments: object) -> MultigridLevel:
        return MultigridLevel(
            *arguments, evenly=not self._medium.is_isolated
        )  # as `boundary_condition` takes for granted

    def _solved(
        self,
        passes: list[OrdinateSet] | list[BoundaryOrdinateSet],
        channels: tuple[int, ...],
    ) -> list[tuple]:
        """For each channel the irradiance at the active voxels: straight from the emitters, and
        scattered, if wanted; then moments, if there are any.
        """
        if self.cache.max_depth == 2:
            lattice = self._lattice(channels)
            return [(phi, None) for phi in self._uncollided(lattice, passes, channels)[1]]
        level = self._level(channels)
        swept, uncollided = self._uncollided(level.lattice, passes[1:], channels)
        received = self._received(level, passes, channels)
        # Both layers with the same directions: under a white sky the sum has no noise.
        scattered = [
            dr.maximum(dr.gather(mi.Float, received, place) - phi, 0)
            for place, phi in zip(self._places_of(channels), swept, strict=True)
        ]
        dr.eval(scattered)
        return list(zip(uncollided, scattered, strict=True))

    def _received(
        self,
        level: MultigridLevel,
        passes: list[OrdinateSet] | list[BoundaryOrdinateSet],
        channels: tuple[int, ...],
    ) -> mi.Float:
        """Light of all orders wanted along lines at the active voxels, on average over all passes
        but the first one, of all channels next to each other.
        """
        first, *passes = passes
        phi, total = self._collided(level, first, channels, len(passes)), mi.Float(0)
        used, share = mi.Float(0), dr.opaque(mi.Float, 1 / len(passes))
        for known, each in enumerate(passes, 1):
            received, again = each.scatter(level, phi)
            total, used = total + received, used + phi
            dr.eval(total, used)
            if self.cache.max_depth < 0:
                # Of all orders there is now another estimate: on average they have less noise.
                again = each.corrected(level, phi, self._with_near_light(again, channels))
                phi = dr.lerp(phi, again, dr.opaque(mi.Float, 1 / (known + 1)))
                dr.eval(phi)
        if self.cache.max_depth >= 0:
            return total * share
        # What first passes sent on is not as well known as it is now. Else their noise would count
        # three times as much as that of others.
        rows = merged([each.between for each in passes])
        return dr.fma(total, share, level.passed_on(phi - used * share, rows, len(passes)))

    def _at_active(self, fields: list[mi.Float]) -> list[mi.Float]:
        """The values at the active voxels."""
        found = [dr.gather(mi.Float, field, self.cache.active) for field in fields]
        dr.eval(found)
        return found

    def _places_of(self, channels: Sequence[int]) -> list[mi.UInt32]:
        """Where each channel's values are in an array that has those of all next to each other."""
        place = dr.arange(mi.UInt32, self.cache.active_count) * len(channels)
        return [place + c for c in range(len(channels))]

    def _apart(self, values: mi.Float, channels: int) -> list[mi.Float]:
        """The values at the active voxels of each of so many channels, which may be alike."""
        count = self.cache.active_count
        if dr.width(values) == count:
            return [values] * channels
        place = dr.arange(mi.UInt32, count)
        starts = (dr.opaque(mi.UInt32, c * count) for c in range(channels))
        return [dr.gather(mi.Float, values, place + start) for start in starts]

    def _uncollided(
        self,
        lattice: Tracks,
        passes: list[OrdinateSet] | list[BoundaryOrdinateSet],
        channels: tuple[int, ...],
    ) -> tuple[list[mi.Float], list[mi.Float]]:
        """Irradiance straight from emitters along lines, on average over passes, in each channel;
        and that from all emitters.
        """
        (rows, *suns), share = passes[0].straight(passes), dr.opaque(mi.Float, 1 / len(passes))
        interpolated = swept = self._carried(lattice, rows, share, len(channels))
        if self._suns and self.cache.max_depth != 2:  # from them light is scattered further
            of_suns = self._carried(lattice, suns[0], share, len(channels))
            swept = [a + b for a, b in zip(swept, of_suns, strict=True)]
        emitters = *self._direct, *self._emitted
        return swept, [
            phi + sum(irradiance[c] for irradiance, *_ in emitters) + self._of_suns(c)
            for c, phi in zip(channels, interpolated, strict=True)
        ]

    def _carried(
        self, lattice: Tracks, rows: tuple, share: mi.Float, channels: int
    ) -> list[mi.Float]:
        """Irradiance along ``rows`` at the active voxels, in each channel."""
        if not len(rows[0]):
            return [dr.zeros(mi.Float, self.cache.active_count)] * channels
        return self._apart(lattice.uncollided(*rows) * share, channels)

    def _of_suns(self, channel: int) -> mi.Float | int:
        """Irradiance of suns that is not interpolated, over the colour of the light."""
        if not self._colour[channel] > 0:
            channel = int(self._colour.argmax())
        colour = dr.opaque(mi.Float, 1 / float(self._colour[channel]))
        return sum(irradiance[channel] * colour for irradiance in self._suns)

    def _collided(
        self,
        level: MultigridLevel,
        first: OrdinateSet | BoundaryOrdinateSet,
        channels: tuple[int, ...],
        passes: int,
    ) -> mi.Float:
        """Mean irradiance of collisions, of all orders but the last, which so many further
        ``passes`` make use of.
        """
        _, phi = first.scatter(level, None)
        phi = self._with_near_light(phi, channels)
        if self.cache.max_depth < 0:
            return first.solve(level, phi, passes)
        for order in range(self.cache.max_depth - 3):
            before, phi = phi, self._with_near_light(first.scatter(level, phi)[1], channels)
            # However many are asked for: once there is no light in them, they need no sweeps.
            if order % CHECKED == CHECKED - 1 and _changed_by(before, phi) < NO_LIGHT:
                break
        return phi

    def _with_near_light(self, phi: mi.Float, channels: tuple[int, ...]) -> mi.Float:
        near = [sum(self._near_light(c)) for c in channels]
        if self._direct or self._emitted:
            phi = phi + interleaved_channels(near)
            dr.eval(phi)
        return phi

    def _with_direct_lights(self, direct: list[list[mi.Spectrum]]) -> list[list[mi.Spectrum]]:
        """Irradiance of each point-like light, and of others behind these; that of `DirectLight`s
        as they know it.
        """
        known = {id(d.emitter): [d.irradiance] for d in self.cache.direct_lights}
        lights = self._sky.near
        replaced = [known.get(id(e), d) for e, d in zip(lights, direct, strict=False)]
        return replaced + direct[len(lights) :]

    def _near_light(self, channel: int) -> list[mi.Float]:
        """Light at the active voxels that does not come along lines, on average over each."""
        lights = {id(d.irradiance): d for d in self.cache.direct_lights}
        near = [
            lights[id(irradiance)].means[channel]
            if id(irradiance) in lights
            else irradiance[channel] * self._spread
            for irradiance, *_ in self._direct
        ]
        return near + [irradiance[channel] for irradiance, *_ in self._emitted]


def _changed_by(before: mi.Float, after: mi.Float) -> float:
    """The mean change of light, relative to its mean."""
    change, scale = dr.sum(dr.abs(after - before)), dr.sum(dr.abs(after))
    dr.eval(change, scale)
    return float(change[0]) / max(float(scale[0]), 1e-30)


def is_grey(spectra: Sequence[mi.Spectrum]) -> bool:
    """Whether all channels are the same."""
    same = [dr.all(c == spectrum[0]) for spectrum in spectra for c in list(spectrum)[1:]]
    dr.eval(same)
    return all(s[0] for s in same)


def occupied_box(grid: Grid, active: mi.UInt32) -> tuple[np.ndarray, np.ndarray]:
    """The least box of voxels (x, y, z; lower end, upper end) that holds all ``active`` ones."""
    ends = [(dr.min(p), dr.max(p)) for p in grid.places(active)]
    dr.eval(ends)
    return np.array([int(e[0][0]) for e in ends]), np.array([int(e[1][0]) + 1 for e in ends])
