"""Transport sweeps along long characteristics: parallel tracks that all voxels of a grid share.

For one ordinate, tracks lie on the lattice of the voxels of a slice across the ordinate's dominant
axis, shifted by a random fraction of a voxel, and advance slice by slice. All tracks of an ordinate
pass to the next voxel at the same slices, so in every slice each voxel has exactly one track. A
voxel and ordinate cost one step, whatever the size of the grid, and no two tracks ever write to the
same voxel. A track that leaves through a side continues as a new one that enters through the
opposite side, and begins at the exact point of entry, between two slices.

Along a track the extinction is interpolated bilinearly in every slice and linearly from slice to
slice; the source is that of the track's voxel. On a grid that is coarser or finer than the
medium's, the values across the tracks are still those of the medium, and each half of a slice has
its own mean. If they were first resampled to the grid and then interpolated again, objects would
become wider and shadows darker: on a CT head at twice its resolution, by 1 % of the irradiance in
the air and 5 % in the skin.

An ordinate and its opposite are swept together along the same tracks: these are two independent
chains of arithmetic, and odd parts of the integrand over directions cancel.

Long characteristics: Askew, *A characteristics formulation of the neutron transport equation in
complicated geometries*, AEEW-M 1108, 1972. The kernel is in `kernel`, the extinction as it reads it
in `extinction`, the record of a pair of ordinates in `track_layout`, and their table in
`track_table`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.crossings import SurfaceVoxels
from mitsuba_irrcache.solvers.discrete_ordinates.empty_space import EmptySpace
from mitsuba_irrcache.solvers.discrete_ordinates.extinction import Extinction
from mitsuba_irrcache.solvers.discrete_ordinates.kernel import (
    SweptMedium,
    SweptVolume,
    add_copies,
    sweep_tracks,
)
from mitsuba_irrcache.solvers.discrete_ordinates.layout import (
    block_and_index,
    flat_index,
    slicewise,
    strides_of,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_layout import TrackLayout, against_axis_last
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup, TrackTable

#: Factor of second differences that converts means over cross sections of voxels to values at their
#: centres: a mean over a unit square smooths with variance 1/12 along both axes, whose effect is
#: half of that times the second derivative (Taylor expansion).
SECOND_DIFFERENCE = 1 / 24
#: Number of layers of voxels at each face of a grid whose means are computed instead of values at
#: their centres, where the medium is dense there: those to which `cache/border` fits a profile.
LAYERS = 3
#: Number of voxels up to which one launch sweeps all ordinates, each into a copy of the volume. The
#: copies are added in a fixed order, because atomic sums are not reproducible.
SMALL_GRID = 40**3
#: Factor of that number with surfaces among the voxels, for which Dr.Jit traces a launch longer.
LARGER_WITH_SURFACES = 4
#: Maximum number of voxels of all copies together: 64 MB with a source.
MAX_COPIED_VOXELS = 1 << 22


class Tracks:
    """Tracks through the voxels of ``grid`` between ``lower`` and ``upper`` (x, y, z).

    ``sigma_t`` is the extinction [1/scene unit] at all voxels of ``extinction_grid``, a grid over
    the same box (None: the same grid). Results are computed at the voxels ``active`` (flat indices;
    None: all). ``sparse`` states that the extinction is 0 in all other voxels, so that sweeps may
    skip empty space. ``pause`` is called after every launch (see `CacheBuilder.pause`).
    ``surfaces`` are the voxels near surfaces, None without any. ``has_dense_faces`` states that
    uncollided irradiance is computed as means over the voxels in `LAYERS` at the grid's faces.
    """

    def __init__(
        self,
        grid: Grid,
        sigma_t: mi.Float,
        lower: np.ndarray,
        upper: np.ndarray,
        extinction_grid: Grid | None = None,
        active: mi.UInt32 | None = None,
        sparse: bool = False,
        pause: Callable[[], None] = lambda: None,
        surfaces: SurfaceVoxels | None = None,
        has_dense_faces: bool = False,
    ) -> None:
        self.surfaces = surfaces
        #: number of layers of voxels at the faces in which uncollided irradiance is a mean
        self.layers = LAYERS if has_dense_faces else 0
        self.grid, self.extinction_grid = grid, extinction_grid or grid
        self.pause = pause
        self.lower, self.size = np.array(lower), np.array(upper) - np.array(lower)
        self._count = max(int(np.prod(np.delete(self.size, axis))) for axis in range(3))
        self._indices = dr.arange(mi.UInt32, self._count)
        dr.eval(self._indices)
        #: whether one launch sweeps many ordinates
        small = SMALL_GRID * (1 if surfaces is None else LARGER_WITH_SURFACES)
        self.one_launch = grid.voxel_count <= small
        self._extinction = Extinction(grid, self.extinction_grid, sigma_t)
        self.active = dr.arange(mi.UInt32, grid.voxel_count) if active is None else active
        self.active_count = dr.width(self.active)
        self.all_active = self.active_count == grid.voxel_count
        self._active_index: mi.UInt32 | None = None
        self.sparse, self._empty = sparse, None
        if sparse and not self.one_launch:
            needed = self.active
            if surfaces is not None:
                needed = concatenated([needed, surfaces.voxels])
            self._empty = EmptySpace.find(grid, needed, lower, upper)
        first_extinction = [0, 0, 0]
        if self.one_launch:
            sizes = [np.prod(self._extinction.layout.sides(axis)) for axis in range(3)]
            first_extinction = np.cumsum([0, *sizes[:2]]).tolist()
            self._all_corners: dict[int, mi.UInt32] = {}  # of all axes
        self._layout = TrackLayout(
            self._extinction.layout,
            (self.lower, self.size),
            self._empty.strides if self._empty else (0, 0, 0),
            first_extinction,
        )

    def active_index(self, voxels: mi.UInt32) -> mi.UInt32:
        """Return the indices of voxels among the active ones; ``active_count`` for others."""
        if self.all_active:
            return voxels
        if self._active_index is None:
            self._active_index = dr.opaque(mi.UInt32, self.active_count, self.grid.voxel_count)
            dr.scatter(self._active_index, dr.arange(mi.UInt32, self.active_count), self.active)
            dr.eval(self._active_index)
        return dr.gather(mi.UInt32, self._active_index, voxels)

    def table(
        self,
        directions: np.ndarray,
        incoming: np.ndarray,
        weights: np.ndarray,
        offsets: np.ndarray,
        by_slice: bool = False,
    ) -> TrackTable:
        """Create the table of pairs of opposite ordinates that kernels read.

        Args:
            directions: (n, 3), directions of propagation, world space, unit length.
            incoming: (n, 2) or (n, 2, channels), irradiance that enters the box along an ordinate
                and along its opposite: radiance times solid angle.
            weights: (n), ordinate weights for radiance that voxels emit or scatter [sr].
            offsets: (n, 2), in [0, 1), random shifts of the tracks.
            by_slice: whether the swept volume is laid out by the slices of each dominant axis.
        """
        incoming = incoming if incoming.ndim == 3 else incoming[..., None]
        record, axis, forward = self._layout.record(directions, weights, offsets, by_slice)
        return TrackTable(record, against_axis_last(incoming, forward), axis, forward)

    def uncollided(
        self,
        directions: np.ndarray,
        incoming: np.ndarray,
        offsets: np.ndarray,
        boundary_source: Callable | None = None,
    ) -> mi.Float:
        """Compute the uncollided irradiance at the centres of the active voxels, or means over them
        at dense faces.

        The radiance that enters along pairs of ordinates is ``incoming``, as in `table`, or the
        `BoundarySource` that ``boundary_source(table)`` returns. The result has the values of one
        channel after the other.
        """
        table = self.table(directions, incoming, np.zeros(len(incoming)), offsets, by_slice=True)
        table.boundary_source = boundary_source(table) if boundary_source is not None else None
        box = self.lower, self.lower + self.size
        channels = (table if table.boundary_source is None else table.boundary_source).channels
        active = self.active_count
        total = dr.opaque(mi.Float, 0, active * channels)
        for axis, pairs in table.by_axis:
            volume = dr.opaque(mi.Float, 0, self.grid.voxel_count * channels)
            self._sweep_axis(volume, False, table, axis, pairs)
            for c in range(channels):
                where = SweptBox(self.grid, *box, axis), self.active, c, channels
                cut = None if self.surfaces is None else self.surfaces.is_cut
                values = values_at_centres(volume, *where, cut=cut, layers=self.layers)
                index = dr.arange(mi.UInt32, active)
                index = index + dr.opaque(mi.UInt32, active * c) if c else index
                # In place: a sum would be a second array.
                dr.scatter_add(total, values, index)
            dr.eval(total)
            del volume, values  # before the next axis has its own
        return total

    def sweep(self, volume: mi.Float, table: TrackTable) -> None:
        """Sweep radiance that voxels emit or scatter, and that enters from outside.

        ``volume`` has four values per voxel: its source S (radiance per optical depth), and three
        sums, Phi, V and W of eq. (4.7): its irradiance; the loss, the integral of L - S over
        optical depth and directions; and the integral of 1. V and W are divided by the length of
        the track in a slice. S + V / W is the mean radiance *of collisions*: scattering it
        conserves energy exactly in every voxel. With several channels, a voxel has these four
        values for each channel in turn.
        """
        if self.one_launch:
            self._sweep_copies(volume, True, table, table.order)
            return
        for axis, pairs in table.by_axis:
            self._sweep_axis(volume, True, table, axis, pairs)

    def sweep_separately(
        self,
        table: TrackTable,
        source: Callable[[PairGroup], mi.Float] | None = None,
        channels: int = 1,
        collisions: bool = False,
        emission: str | None = None,
    ) -> Iterator[tuple[int, PairGroup, mi.Float]]:
        """Sweep groups of pairs; yield the dominant axis, the group, and the results of each.

        The results of a group are consecutive volumes, two per pair, along the axis and against it.
        ``source(group)`` returns volumes of the radiance that voxels emit or scatter. With a
        source, results have the four values of `sweep` per voxel and channel, or the two of
        ``collisions`` (see `SweptVolume`, also for ``emission``), which are undefined where there
        is no track; without, they have one value, irradiance, laid out by slices. Channels of a
        voxel are adjacent.
        """
        values, width = self.grid.voxel_count * channels, (2 if collisions else 4) if source else 1
        most = max(1, MAX_COPIED_VOXELS * 4 // (2 * values * width))
        for axis, pairs in table.by_axis:
            medium = self._medium(axis, source is not None)
            for start in range(0, len(pairs), most):
                group = PairGroup(table, pairs[start : start + most])
                number, track = block_and_index(self._count, len(group))
                size = 2 * len(group) * values * width
                # Zeros where empty slices are skipped.
                defined = collisions and medium.empty is None
                copies = dr.empty(mi.Float, size) if defined else dr.opaque(mi.Float, 0, size)
                begin = number * dr.opaque(mi.UInt32, 2 * values)
                volume = SweptVolume(
                    copies,
                    source(group) if source else None,
                    begin,
                    channels,
                    begin + dr.opaque(mi.UInt32, values),
                    collisions,
                    emission,
                )
                sweep_tracks(medium, volume, table, group.pair(number), track)
                dr.eval(copies)
                self.pause()
                yield axis, group, copies

    def _medium(self, axis: int, has_source: bool) -> SweptMedium:
        """Return the extinction for tracks along ``axis``, and empty space.

        Without a source, the row of values above a track is still in the processor's cache, so that
        rows are stored only once. With a source, the wider volumes would have evicted it.
        """
        by_rows = not has_source and not self.one_launch
        words = self._extinction.layout.words(has_source, by_rows)
        if self.one_launch:
            if words not in self._all_corners:
                parts = [self._extinction.corners(k, words) for k in range(3)]
                self._all_corners[words] = concatenated(parts)
            return SweptMedium(self._all_corners[words], words)
        corners = self._extinction.corners(axis, words)
        dr.eval(corners)
        return SweptMedium(corners, words, self._empty.slices if self._empty else None)

    def _sweep_axis(
        self, values: mi.Float, has_source: bool, table: TrackTable, axis: int, pairs: list[int]
    ) -> None:
        """Sweep the ``pairs`` of ``table``, all of which have the dominant ``axis``."""
        if self.one_launch:
            self._sweep_copies(values, has_source, table, pairs)
            return
        medium = self._medium(axis, has_source)  # one axis at a time is in memory
        source = values if has_source else None
        channels = self._channels(values, has_source)
        for i in pairs:
            volume = SweptVolume(values, source, dr.opaque(mi.UInt32, 0), channels)
            sweep_tracks(medium, volume, table, table.pair_index[i], self._indices)
            dr.eval(values)
            self.pause()

    def _sweep_copies(
        self, values: mi.Float, has_source: bool, table: TrackTable, pairs: list[int]
    ) -> None:
        """Sweep as `_sweep_axis` in one or a few launches, each pair into a copy of the volume.

        The ``pairs``, of any axes, are consecutive in the table's order.
        """
        kind, width = (mi.Vector4f, 4) if has_source else (mi.Float, 1)
        voxels = dr.width(values) // width  # of all channels
        most, medium = max(1, MAX_COPIED_VOXELS // voxels), self._medium(0, has_source)
        for start in range(0, len(pairs), most):
            group = PairGroup(table, pairs[start : start + most])
            number, track = block_and_index(self._count, len(group))
            copies = dr.opaque(mi.Float, 0, dr.width(values) * len(group))
            volume = SweptVolume(
                copies,
                values if has_source else None,
                number * dr.opaque(mi.UInt32, voxels),
                self._channels(values, has_source),
            )
            sweep_tracks(medium, volume, table, group.pair(number), track)
            dr.eval(copies)
            add_copies(values, copies, voxels, len(group), kind)
            dr.eval(values)
            self.pause()

    def _channels(self, values: mi.Float, has_source: bool) -> int:
        """Return the number of channels of a swept volume."""
        return dr.width(values) // (self.grid.voxel_count * (4 if has_source else 1))


class SweptBox(NamedTuple):
    """The voxels of ``grid`` between ``lower`` and ``upper`` (x, y, z), swept along an ``axis``."""

    grid: Grid
    lower: np.ndarray
    upper: np.ndarray
    axis: int


def values_at_centres(
    means: mi.Float,
    box: SweptBox,
    index: mi.UInt32,
    channel: int = 0,
    channels: int = 1,
    begin: mi.UInt32 | int = 0,
    cut: mi.Bool | None = None,
    layers: int = 0,
    along_axis: bool = True,
) -> mi.Float:
    """Return values at the centres of the voxels ``index`` of a box.

    ``means`` are those over the cross sections of all voxels of the grid across the box's axis.

    Tracks with a random shift sample a voxel's cross section uniformly; second differences along
    both transverse axes undo the smoothing. Results are never negative. ``means`` are laid out by
    slices, starting at ``begin``, with several ``channels``, of which ``channel`` is used. Second
    differences are omitted in voxels ``cut`` by surfaces, and next to them.

    In the outermost ``layers`` of voxels at each face of the grid, results are means over the voxel
    along the normal of the face instead, except for those across the axis unless ``along_axis``.
    """
    # docs/primer, eqs. (2.15), (4.5)
    grid, lower, upper, axis = box
    places, strides = grid.voxel_indices(index), strides_of(grid.resolution, slicewise(axis))
    place = flat_index(places, strides) + begin

    def read(i: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float:
        i = i if channels == 1 else i * channels + channel
        return dr.gather(mi.Float, means, i, active)

    value, change, factor = read(place), mi.Float(0), mi.Float(1)
    for k, (at, stride) in enumerate(zip(places, strides, strict=True)):
        if (k == axis and not (layers and along_axis)) or upper[k] - lower[k] < 3:
            continue
        stride, first, last = (dr.opaque(mi.UInt32, n) for n in (stride, lower[k], upper[k] - 1))
        # A voxel beside the box may lie on the border of the grid, with no neighbour beyond it.
        inside = (at >= first) & (at <= last)
        # At a border, the second difference of the voxel next to it.
        centre = place + dr.select(at == first, stride, 0) - dr.select(at == last, stride, 0)
        here, below, above = (read(i, inside) for i in (centre, centre - stride, centre + stride))
        # Voxels that no radiance has reached have no second difference.
        is_lit = (below > 0) & (above > 0)
        if cut is not None:
            is_lit &= ~_any_cut(grid, cut, places, k, (at == first, at == last), inside)
        second = dr.select(is_lit, below + above - 2 * here, 0)
        if layers:
            side = dr.opaque(mi.UInt32, grid.resolution[k])
            in_layers = (at < layers) | (at + layers >= side)
            if k == axis:
                is_lit &= here > 0
                mean = _mean_over_value(second / dr.select(is_lit, here, 1))
                factor = dr.select(in_layers & is_lit, mean, 1)
                continue
            second = dr.select(in_layers, 0, second)
        change -= second
    value = dr.maximum(dr.fma(change, dr.opaque(mi.Float, SECOND_DIFFERENCE), value), 0)
    return value * factor if layers else value


def means_at_faces(values: mi.Spectrum, grid: Grid, voxels: mi.UInt32, layers: int) -> mi.Spectrum:
    """Return values at the centres of ``voxels``, replaced by means along the normal of each face
    of the grid in the outermost ``layers`` of voxels there, see `values_at_centres`.
    """
    if not layers:
        return values
    found = [v * face_factor(v, grid, (voxels, 0, 1), layers, (0, 1, 2)) for v in values]
    dr.eval(found)
    return mi.Spectrum(*found)


def face_factor(
    values: mi.Float,
    grid: Grid,
    places: tuple[mi.UInt32, mi.UInt32 | int, int],
    layers: int,
    axes: Sequence[int],
) -> mi.Float:
    """Return means over values at the centres, as `means_at_faces` applies them, at the faces
    across ``axes``.

    ``places`` are the voxel and the channel of each of the ``values``, and the number of channels.
    """
    voxel, channel, channels = places
    volume = dr.zeros(mi.Float, grid.voxel_count * channels)
    dr.scatter(volume, values, voxel * channels + channel)
    indices, strides = grid.voxel_indices(voxel), strides_of(grid.resolution)
    factor = mi.Float(1)
    for axis in axes:
        at, count = indices[axis], int(grid.resolution[axis])
        if count < 3:
            continue
        stride, last = (dr.opaque(mi.UInt32, int(n)) for n in (strides[axis], count - 1))
        centre = voxel + dr.select(at == 0, stride, 0) - dr.select(at == last, stride, 0)
        around = (i * channels + channel for i in (centre - stride, centre, centre + stride))
        below, here, above = (dr.gather(mi.Float, volume, i) for i in around)
        in_layers = (at < layers) | (at + layers > last)
        in_layers &= (below > 0) & (here > 0) & (above > 0)
        curvature = (below + above - 2 * here) / dr.select(in_layers, here, 1)
        factor *= dr.select(in_layers, _mean_over_value(curvature), 1)
    return factor


def _mean_over_value(curvature: mi.Float) -> mi.Float:
    """Return the mean of a function over a voxel, over its value at the centre.

    ``curvature`` is its second difference between voxels, over the value. The result is exact for
    exponentials, and for cosines, whose second differences are negative.
    """
    s = 0.5 * dr.sqrt(dr.abs(curvature))
    steep = dr.maximum(s, 1e-2)
    angle = dr.select(curvature > 0, dr.asinh(steep), dr.asin(dr.minimum(steep, 1)))
    return dr.select(s < 1e-2, 1 + curvature * SECOND_DIFFERENCE, steep / angle)


def _any_cut(
    grid: Grid, cut: mi.Bool, places: tuple, k: int, ends: tuple, active: mi.Bool
) -> mi.Bool:
    """Return whether surfaces cut any voxel of the second difference along axis ``k``."""
    at_first, at_last = ends
    centre = mi.Int32(places[k]) + dr.select(at_first, 1, 0) - dr.select(at_last, 1, 0)
    result = mi.Bool(False)
    for shift in (-1, 0, 1):
        at = [mi.Int32(p) for p in places]
        at[k] = centre + shift
        result |= dr.gather(mi.Bool, cut, grid.index(*at), active)
    return result
