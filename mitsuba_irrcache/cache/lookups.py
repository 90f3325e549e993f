"""Fields from which camera rays and paths interpolate the irradiance of a cache and its moments."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.border import BorderProfile, FittedBorder
from mitsuba_irrcache.cache.conservative import conserving, share_of_noise
from mitsuba_irrcache.cache.interpolation import Interpolation
from mitsuba_irrcache.cache.statistics import BatchSums, root_correction
from mitsuba_irrcache.core.spectrum import scatter_channels
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses


def on_grid(grid: Grid, active: mi.UInt32, values: list[mi.Float]) -> mi.TensorXf:
    """Return a tensor (z, y, x, channel) of the channels of the ``active`` voxels, 0 elsewhere."""
    flat = dr.zeros(mi.Float, grid.voxel_count * len(values))
    if dr.width(active):
        scatter_channels(flat, values, active)
    return mi.TensorXf(flat, (*grid.shape, len(values)))


def irradiance_field(
    grid: Grid, active: mi.UInt32, sums: BatchSums, interpolation: Interpolation
) -> RootField:
    """Create the field of `IrradianceCache.field`."""
    falloff, classes = interpolation.falloff, interpolation.voxel_classes
    lights = interpolation.direct_lights
    brightest = [dr.max(m)[0] for m in sums.irradiance()] if lights else []
    brightest += [light.maximum for light in lights]
    means = _interpolated_means(sums, interpolation)
    known, roots = marked(grid, active), [dr.sqrt(m) for m in means]
    variance = share = None
    if sums.has_own_errors:  # those shared by neighbours do not bias interpolation
        noise = [sums.relative_variance(m, c) for c, m in enumerate(means)]
        shares = [share_of_noise(grid, on_grid(grid, active, [v]).array, known) for v in noise]
        at_active = [dr.gather(mi.Float, each, active) for each in shares]
        roots = [
            r * root_correction(v * (1 - each))
            for r, v, each in zip(roots, noise, at_active, strict=True)
        ]
    if all(dr.all(r == roots[0])[0] for r in roots[1:]):
        roots = roots[:1]
    channels = len(roots)
    if falloff is not None:
        smooth = dr.rsqrt(falloff.of_voxels(active))
        roots = [r * smooth for r in roots]
    values = on_grid(grid, active, roots).array
    if sums.has_own_errors:
        variance = on_grid(grid, active, noise[:channels]).array
        share = on_grid(grid, active, at_active[:channels]).array
    border = border_of(sums, interpolation)
    field = root_field(grid, values, known, channels, border, classes, share, variance)
    if falloff is not None:
        field.maximum *= falloff.maximum(active)
    field.maximum = max(field.maximum, *brightest, 0.0)
    return field


def border_of(sums: BatchSums, interpolation: Interpolation) -> BorderProfile | None:
    """Return the profile at the faces of the grid, or None if the boundary is elsewhere or the
    profile would amplify noise of voxels.
    """
    border = interpolation.border
    return None if sums.has_own_errors or border is None or not border.is_at_faces else border


def root_field(
    grid: Grid,
    roots: mi.Float,
    known: mi.Bool,
    channels: int,
    border: BorderProfile | None,
    classes: VoxelClasses | None = None,
    share: mi.Float | None = None,
    variance: mi.Float | None = None,
) -> RootField:
    """Create a field from square ``roots`` of the values of ``known`` voxels.

    ``share`` is that of `conserving`, ``variance`` the relative variance of noisy values, both in
    each channel.
    """
    fitted, separated = None, None if classes is None else classes.separated
    if border is not None:
        fitted = FittedBorder(border, roots, known, channels, separated)
        roots = fitted.at_centres()
    roots = conserving(grid, roots, known, channels, share, separated)
    if classes is not None:
        roots = classes.filled(roots, channels)
    return RootField(grid, roots, channels, variance, fitted, separated)


def moment_field(
    grid: Grid, active: mi.UInt32, sums: BatchSums, interpolation: Interpolation, channels: int
) -> AngularField:
    """Create the field of `IrradianceCache.directional_field`."""
    classes, scattered = interpolation.voxel_classes, []
    for values in (_interpolated_means(sums, interpolation), sums.moment_means()):
        chosen = [v for i, v in enumerate(values) if i % sums.channels < channels]
        if classes is not None and classes.inside is not None:
            inside = dr.gather(mi.Bool, classes.inside, active)
            chosen = [dr.select(inside, v, 0) for v in chosen]
        scattered.append([on_grid(grid, active, [v]).array for v in chosen])
    depths, extinctions = interpolation.peak_depths, None
    if depths is not None:
        extinctions = [
            on_grid(grid, active, [c]).array for source in depths.extinctions for c in source
        ]
    return AngularField(interpolation.directional, grid, *scattered, depths, extinctions)


def _interpolated_means(sums: BatchSums, interpolation: Interpolation) -> list[mi.Float]:
    """Return Phi of the active voxels in each channel, without the direct lights."""
    means = sums.irradiance()
    for light in interpolation.direct_lights:
        means = [dr.maximum(m - e, 0) for m, e in zip(means, light.irradiance, strict=False)]
    return means
