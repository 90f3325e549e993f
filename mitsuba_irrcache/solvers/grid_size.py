"""Choice of the resolution of a cache from estimates of the discretisation error."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid

#: Reason given for a choice that a property of the integrator determines.
REQUESTED = "as requested"

#: Estimated error of the pixels at the boundary of a medium [%] above which a warning is logged.
LARGE_BORDER_ERROR = 1.0
#: The same for meshes under suns and lamps, over the optical depth of a voxel: the irradiance of
#: several orders of scattering has a kink at a boundary that cuts voxels.
OBLIQUE_ERROR = 10.0

#: Estimated error [%] above which the irradiance of suns and points is not interpolated.
SMALL_BORDER_ERROR = 0.2

#: Maximum number of voxels that ``resolution`` 0 chooses, for isotropic and anisotropic scattering.
MOST_VOXELS, MOST_DIRECTIONAL = 1 << 25, 1 << 21
#: RMSE of the image, in % of its mean, that ``resolution`` 0 aims at. The error estimates below are
#: fits to images of a CT head and of random and smooth media of 0.3 to 100 optical depths per data
#: voxel. The error falls with the number of voxels along an axis to the power 1.2 at dense
#: boundaries (BORDER_ORDER) and 1.5 in opaque data (OPAQUE_SIZE_ORDER).
TARGET_ERROR = 0.5
#: RESOLVED is the optical depth of a data voxel up to which voxels of that size have the target
#: error. Above, the number of voxels is proportional to the optical depth, and above OPAQUE to its
#: power OPAQUE_POWER; at most MOST_PER_DATA_VOXEL voxels along each axis of a data voxel. From
#: EVEN voxels on that number is even, so that the kinks of trilinear data lie on faces of voxels:
#: 7 voxels per data voxel of depth 100 have a larger error than 6, and 9 than 8.
RESOLVED, OPAQUE, OPAQUE_POWER, EVEN, MOST_PER_DATA_VOXEL = 0.7, 1.2, 0.45, 4.0, 8.0
#: The error [%] of a medium that is dense at its boundary is about BORDER_ERROR d^BORDER_ORDER,
#: where d is the optical depth of a cache voxel at the boundary.
BORDER_ERROR, BORDER_ORDER = 3.5, 1.2
#: The same under smooth illumination and for an albedo of at least HIGH_ALBEDO at the boundary, if
#: it is less: an upper bound for cubes, for 0.25 <= d <= 1. With an albedo of 0.8 it is the RMSE of
#: the pixels that show the cube, with 0.5 it would be half of it.
SMOOTH_BORDER_ERROR, SMOOTH_BORDER_ORDER, HIGH_ALBEDO = 2.1, 1.3, 0.9
#: The error [%] of a medium that is dense at a boundary which cuts voxels, such as a sphere, is at
#: least CURVED_ERROR (1 - a)^ABSORBED_ORDER d^CURVED_ORDER with the albedo a at the boundary, 0 for
#: single scattering, where it is larger than that of a box. Found with balls of 48^3 voxels in
#: uniform light, for 0.2 <= d <= 0.8.
CURVED_ERROR, ABSORBED_ORDER, CURVED_ORDER = 6.0, 0.5, 1.4
#: RMSE [% of the mean] of an image with all orders of scattering through data with opaque detail as
#: fine as their voxels: OPAQUE_ERROR d^OPAQUE_DEPTH_ORDER r^OPAQUE_SIZE_ORDER at most, with the
#: optical depth d of a data voxel and the ratio r of the edges of cache and data voxels. Found with
#: noise and a steep transfer function on 16^3 and 32^3 voxels for 1.5 <= d <= 100 and
#: 1/12 <= r <= 1; errors of 4 x 4 pixels are up to OPAQUE_PEAK times as large. They are smaller in
#: smooth data, and saturate at MOST_OPAQUE_ERROR. A warning is logged above LARGE_OPAQUE_ERROR, and
#: above an optical depth of OPAQUE_VOXEL per cache voxel.
OPAQUE_ERROR, OPAQUE_VOXEL = 1.5, 10.0
OPAQUE_DEPTH_ORDER, OPAQUE_SIZE_ORDER, OPAQUE_PEAK = 0.7, 1.5, 2.7
LARGE_OPAQUE_ERROR, MOST_OPAQUE_ERROR = 4.5, 9.0
#: Optical depth of a data voxel above which there may be MOST_PER_OPAQUE_VOXEL voxels along each
#: axis of it, and MOST_IN_OPAQUE_DATA in all. Bone of depth 100 per voxel of 32^3 has an RMSE of
#: 0.94 % then, and of 1.15 % with MOST_PER_DATA_VOXEL (experiments/validation/thick).
VERY_OPAQUE, MOST_PER_OPAQUE_VOXEL, MOST_IN_OPAQUE_DATA = 60.0, 10.0, 1 << 25
#: Maximum number of voxels along each axis that a boundary of glass can require. Glass
#: reflects most of the radiance inside, which then varies less towards the boundary, and voxels are
#: more expensive. At an optical depth of 40 this number has an error of 0.5 % (ball) and 0.7 %
#: (cube).
MOST_IN_GLASS = 64
#: Maximum number of voxels of a cache that is finer than its data, unless these are opaque: all
#: orders of scattering then take half a minute on two cores.
MOST_REFINED = 1 << 24

#: Error [%] that voxels larger than those of the data may cause under smooth illumination, and
#: coefficients of its estimate, fits to images of 32 scenes (experiments/validation/defaults): with
#: the optical depth d of a voxel, and the part a of the data that interpolation between voxels
#: loses, it is DEPTH_ERROR d + DETAIL_ERROR a min(d, MOST_DETAIL_DEPTH).
SMOOTH_ERROR, DEPTH_ERROR, DETAIL_ERROR, MOST_DETAIL_DEPTH = 0.4, 0.3, 7.0, 0.25
#: RMSE [% of the mean] of an image due to detail of the data that voxels do not resolve:
#: UNRESOLVED_ERROR a min(d, OPAQUE), with a and d as above, about, for the scenes of
#: experiments/validation/defaults; compact dense bodies have a third of it and less. Voxels are
#: refined above LARGE_UNRESOLVED, to at most MOST_FOR_DETAIL voxels.
UNRESOLVED_ERROR, LARGE_UNRESOLVED, MOST_FOR_DETAIL = 6.0, 1.0, 1 << 21
#: Error [%] above which the warning is logged.
NOTABLE_UNRESOLVED = 0.8
#: Ratio of the minimum resolution of media that hold emitting shapes to that of others. Next
#: to a luminous surface images are too dark, by an error that falls with the edge of a voxel. The
#: mean of a foggy room is off by -0.55 % with 32 voxels and -0.17 % with 48 (1.2 times the time).
FINER_AROUND_EMITTERS = 1.5
#: Largest ratio of the voxels along a side of a long medium with surfaces to those of a cube.
MOST_ELONGATED = 4.0
#: Error [%] of images of surfaces in a homogeneous medium, at their distance, due to the voxels'
#: edge h: OBJECT_ERROR s^OBJECT_STRENGTH_ORDER (h / L)^2, about, with the size L of a surface and
#: s = 1 - exp(-sigma_t L), the share of the radiance that the medium scatters within its size.
#: Found with floors, walls and balls of 20 to 200 units in cubes of 1000 units and optical depths
#: of 3 to 30. Voxels are refined above NOTABLE_OBJECT_ERROR, for surfaces larger than
#: SMALLEST_OBJECT of the medium's longest side and WEAKEST_OBJECT of s: the shadows of others are
#: smaller or weaker. A warning is logged above LARGE_OBJECT_ERROR.
OBJECT_ERROR, OBJECT_STRENGTH_ORDER = 45.0, 1.5
NOTABLE_OBJECT_ERROR, LARGE_OBJECT_ERROR = 0.75, 1.5
SMALLEST_OBJECT, WEAKEST_OBJECT = 0.05, 0.15
#: Optical depth of a voxel below which the albedo within it hardly matters for the irradiance.
THIN_VOXEL = 0.02
#: Ratio of the voxels' edges that another medium among them requires to those that it requires of
#: its own cache: only the radiance that it scatters outwards matters.
COARSER_IN_OTHERS = 2.0
#: Ratio between the resolutions that are tried, the largest of them in units of the resolution
#: chosen otherwise, and number of positions at which detail is measured.
SIZE_RATIO, LARGEST_SHARE, POSITIONS = 2**0.25, 0.9, 1 << 18


#: Number of positions at which the extinction on the boundary is sampled for a percentile; and for
#: the maximum, which a voxel in a corner of the data may have, per voxel at a face of the data, and
#: at most.
FEW_POINTS, POINTS_PER_VOXEL, MOST_POINTS = 1 << 12, 8, 1 << 18


@dataclass(frozen=True)
class SizeAmongSurfaces:
    """Limits of the number of voxels along the longest side of a cache among surfaces.

    Shadows of surfaces have more detail than coarse data. Between the limits the number follows
    from the estimated error and ``target_error`` [%].
    """

    fewest: int
    most: int
    target_error: float


@dataclass(frozen=True)
class SizeRule:
    """Rule by which ``resolution`` 0 chooses the grid of a solver.

    Attributes:
        target_error: RMSE of the image that the grid aims at [%].
        fewest: minimum number of voxels along the longest side.
        most_by_contrast: maximum number along each axis that contrast inside of the medium can
            require; ``most_by_border`` is the same for media that are dense at their boundary or
            homogeneous.
        refines_dense_data: whether voxels may be smaller than those of dense data.
        most: maximum number of voxels along the longest side.
        larger_in_smooth_light: whether voxels may be larger than those of smooth data if all
            emitters are smooth environments, which cast no sharp shadows.
        among_surfaces: limits for media in which rays are traced through the scene's shapes; None:
            the same rule as for isolated media.
    """

    target_error: float
    fewest: int
    most_by_contrast: int
    most_by_border: int
    refines_dense_data: bool = True
    most: float = np.inf
    larger_in_smooth_light: bool = False
    among_surfaces: SizeAmongSurfaces | None = None


def choose_grid(medium: MediumGrid, resolution: int, rule: SizeRule) -> tuple[Grid, str]:
    """Choose the grid of the cache; also return the reason.

    With ``resolution`` 0 the voxels are those of the medium's data, smaller ones if it is dense, or
    larger ones under smooth illumination, within the limits of the ``rule``.
    """
    data, frame = (medium.original or medium).sigma_t.grid, medium.frame
    voxels = MOST_VOXELS if medium.phase.is_isotropic else MOST_DIRECTIONAL
    if resolution:
        grid, reason = Grid.near_cubic(frame, resolution), REQUESTED
    elif medium.is_traced and rule.among_surfaces is not None:
        least, most = rule.among_surfaces.fewest, rule.among_surfaces.most
        extinction = max(mean_extinction(medium), _border_extinction(medium))
        longest = np.linalg.norm(frame[:3, :3], axis=0).max()
        edge = _edge_of_error(rule.among_surfaces.target_error, medium)
        count = np.ceil(extinction * longest / edge)
        count = max(count, 0 if data is None else max(data.shape), *_albedo_resolution(medium))
        grid = Grid.near_cubic(frame, int(np.clip(count, least, most)))
        reason = f"by estimated error and data, {least} to {most} among surfaces"
    else:
        grid, reason = _estimated_grid(medium, rule, voxels)
    return grid.shared(medium.sigma_t.grid, medium.albedo.grid), reason


def _border_laws(medium: MediumGrid) -> list[tuple[float, float]]:
    """Return factors and exponents of the estimates of the error [%] at the boundary, as powers of
    the optical depth of a voxel; the smallest one applies.
    """
    laws = [(BORDER_ERROR, BORDER_ORDER)]
    if medium.detail is not Detail.SHARP and _border_albedo(medium) > HIGH_ALBEDO - 1e-4:
        laws.append((SMOOTH_BORDER_ERROR, SMOOTH_BORDER_ORDER))
    return laws


def _error_of_edge(depth: float, medium: MediumGrid) -> float:
    """Return the estimated error [%] for an optical ``depth`` of a voxel's edge."""
    # docs/primer, eq. (7.1)
    return min(factor * depth**order for factor, order in _border_laws(medium))


def _edge_of_error(error: float, medium: MediumGrid) -> float:
    """Return the optical depth of a voxel's edge at which the estimated error [%] is ``error``."""
    return max((error / factor) ** (1 / order) for factor, order in _border_laws(medium))


def _estimated_grid(medium: MediumGrid, rule: SizeRule, voxels: int) -> tuple[Grid, str]:
    """Choose the grid with the estimated error of the ``rule`` and at most this number of
    ``voxels``; also return the reason for its size.
    """
    # docs/primer, eq. (7.2)
    data, frame = (medium.original or medium).sigma_t.grid, medium.frame
    lengths = np.linalg.norm(frame[:3, :3], axis=0)
    mean, border = mean_extinction(medium), _border_extinction(medium)
    # Number of voxels along x, y, z that each criterion requires. A long medium with surfaces has
    # as many voxels as a cube: detail near surfaces is as fine across it as along it.
    share = lengths / lengths.max()
    if not medium.is_isolated:
        share = np.minimum(lengths / np.cbrt(np.prod(lengths)), MOST_ELONGATED)
    fewest = f"at least {rule.fewest}"
    wanted = {fewest: rule.fewest * share}
    if medium.holds_emitters:
        count = round(FINER_AROUND_EMITTERS * rule.fewest)
        wanted[f"at least {count} around emitters"] = count * share
    opaque = data is not None and mean * data.voxel_size.max() > VERY_OPAQUE
    if data is not None:
        ratio = np.ones(3)
        if rule.refines_dense_data:
            depth = mean * data.voxel_size
            ratio = np.minimum(depth, OPAQUE) / RESOLVED
            ratio *= np.maximum(depth / OPAQUE, 1) ** OPAQUE_POWER
        ratio = np.clip(ratio, 1, MOST_PER_OPAQUE_VOXEL if opaque else MOST_PER_DATA_VOXEL)
        ratio = np.where(ratio >= EVEN, 2 * np.floor(ratio / 2), ratio)
        dense = "finer than those of the medium, which is dense"
        wanted[dense if ratio.max() > 1 else "of the medium"] = data.resolution * ratio
    wanted["of the albedo"] = _albedo_resolution(medium)
    size, count = _resolution_of_objects(medium)
    most = rule.most_by_border if medium.homogeneous else rule.most_by_contrast
    wanted[f"for surfaces of size {size:.2g} in it"] = np.minimum(count, most)
    edge = _edge_of_error(rule.target_error, medium)
    most_by_border = rule.most_by_border
    if medium.refracts:
        most_by_border = min(most_by_border, MOST_IN_GLASS)
    per_path = f"{1 / edge:.0f} per mean free path"
    at_boundary = f"{per_path} at the boundary, which cuts the medium"
    for reason, extinction, most in (
        (per_path, mean, rule.most_by_contrast),
        (at_boundary, border, most_by_border),
    ):
        # Limit each axis by itself: a thin plate is resolved across.
        wanted[reason] = np.minimum(extinction * lengths / edge, most)
    for other in medium.others:
        if medium.overlaps(other):
            own = COARSER_IN_OTHERS * edge
            reason = f'{1 / own:.1f} per mean free path of medium "{other.name}" in it'
            count = mean_extinction(other) * lengths / own
            wanted[reason] = np.minimum(count, rule.most_by_contrast)
    sides = np.max(list(wanted.values()), axis=0)
    reason = max(wanted, key=lambda key: wanted[key].max())
    limit = voxels
    if data is not None and np.prod(sides) > data.voxel_count:
        finest = MOST_IN_OPAQUE_DATA if opaque else MOST_REFINED
        limit = min(voxels, max(finest, data.voxel_count))
    for bound, message in (
        ((limit / np.prod(sides)) ** (1 / 3), f"as fine as {limit} voxels allow"),
        (rule.most / sides.max(), f"at most {rule.most} along the longest side"),
    ):
        if bound < 1:
            sides, reason = sides * bound, message
    if rule.larger_in_smooth_light and data is not None:
        least = np.maximum(wanted[fewest], wanted[at_boundary])
        smooth = _size_in_smooth_light(medium, np.minimum(least, sides), sides)
        if smooth is not None:
            sides, reason = smooth, "as smooth light and data permit"
    if rule.refines_dense_data:
        refined = _refined_for_detail(medium, sides, min(voxels, MOST_REFINED, MOST_FOR_DETAIL))
        if refined is not sides:
            sides, reason = refined, "finer than those of the medium, which has dense detail"
    # Round down to respect the limits, except for rounding errors of whole numbers.
    sides = np.maximum(np.floor(sides + 1e-4), 1).astype(int)
    return Grid(tuple(int(n) for n in sides[::-1]), frame), reason


def _albedo_resolution(medium: MediumGrid) -> np.ndarray:
    """Return the numbers of voxels along x, y, z that resolve the data of the albedo: with voxels
    as large as these, or of the optical depth THIN_VOXEL.
    """
    albedo, frame = medium.albedo.grid, medium.frame[:3, :3]
    if albedo is None:
        return np.zeros(3)
    rate = np.linalg.solve(albedo.to_world[:3, :3], frame) * albedo.resolution[:, None]
    depth = mean_extinction(medium) * np.linalg.norm(frame, axis=0)
    return np.minimum(np.abs(rate).max(axis=0), depth / THIN_VOXEL)


def _resolution_of_objects(medium: MediumGrid) -> tuple[float, np.ndarray]:
    """Return the size of the surfaces in a medium whose shadows need the smallest voxels, and the
    numbers of voxels along x, y, z that resolve these; 0 without such surfaces.
    """
    edge, size = _edge_at_objects(medium, NOTABLE_OBJECT_ERROR)
    return size, np.linalg.norm(medium.frame[:3, :3], axis=0) / edge


def _edge_at_objects(medium: MediumGrid, target: float) -> tuple[float, float]:
    """Return the edge of voxels at which images of the surfaces in a medium have at most the
    ``target`` error [%], infinite without surfaces; and the size of those that require it.
    """
    longest = np.linalg.norm(medium.frame[:3, :3], axis=0).max()
    sigma_t, edges = mean_extinction(medium), [(np.inf, 0.0)]
    for size in medium.object_sizes:
        share = -np.expm1(-sigma_t * size)
        if share > WEAKEST_OBJECT and size > SMALLEST_OBJECT * longest:
            error = OBJECT_ERROR * share**OBJECT_STRENGTH_ORDER
            edges.append((size * np.sqrt(target / error), size))
    return min(edges)


def _size_in_smooth_light(
    medium: MediumGrid, least: np.ndarray, most: np.ndarray
) -> np.ndarray | None:
    """Return the smallest numbers of voxels along x, y, z whose estimated error is at most
    SMOOTH_ERROR.

    They are proportional to ``most``, and not below ``least``. Returns None if they are not smaller
    than ``most``, or if the illumination is not smooth.
    """
    if medium.detail is Detail.SHARP or medium.phase.forward:
        return None
    share = (least / most).max()
    depth = mean_extinction(medium) * np.linalg.norm(medium.frame[:3, :3], axis=0)
    while share <= LARGEST_SHARE:
        sides = np.maximum(share * most, 1)
        edge = (depth / sides).max()
        error = DEPTH_ERROR * edge
        if error < SMOOTH_ERROR:
            error += DETAIL_ERROR * min(edge, MOST_DETAIL_DEPTH) * _lost_detail(medium, sides)
        if error <= SMOOTH_ERROR:
            return sides
        share *= SIZE_RATIO
    return None


def _lost_detail(medium: MediumGrid, sides: np.ndarray) -> float:
    """Return the part of a medium's data that is lost by interpolation between this number of
    voxels along x, y, z.

    It is the root mean square of second differences over half a voxel, divided by the root mean
    square of the values; of the extinction or the scattering coefficient, whichever is larger.
    """
    grid = medium.sigma_t.grid
    stride = max(-(-grid.voxel_count // POSITIONS), 1)
    voxel = dr.arange(mi.UInt32, grid.voxel_count // stride)
    if stride > 1:
        voxel = voxel * stride + mi.sample_tea_32(voxel, 1)[0] % stride
    centre = grid.world.point(mi.Point3f(*grid.voxel_indices(voxel)) + 0.5)

    def values(p: mi.Point3f) -> list[mi.Float]:
        sigma_t = mi.Spectrum(medium.sigma_t.at_world(p))
        found = [luminance(sigma_t)]
        if medium.albedo.grid is not None:
            found.append(luminance(sigma_t * mi.Spectrum(medium.albedo.at_world(p))))
        return found

    middle = values(centre)
    squares = [[dr.square(v) for v in middle]]
    for axis, count in enumerate(sides):
        # Opaque, so that another number of voxels or another frame reuses the kernel.
        half = mi.Vector3f(*(dr.opaque(mi.Float, v / (2 * count)) for v in medium.frame[:3, axis]))
        ends = zip(values(centre + half), values(centre - half), middle, strict=True)
        squares.append([dr.square(m - 0.5 * (a + b)) for a, b, m in ends])
    dr.eval(squares)  # in one kernel
    total, *parts = np.array([[float(dr.sum(s)[0]) for s in row] for row in squares])
    parts = np.sum(parts, axis=0)
    ratios = [part / whole for part, whole in zip(parts, total, strict=True) if whole > 0]
    return float(np.sqrt(max(ratios, default=0.0)))


def unresolved_error(medium: MediumGrid, grid: Grid) -> float:
    """Estimate the error [%] of an image, in units of its mean, due to detail of a medium's data
    that is lost between the voxels of ``grid``.
    """
    return _error_of_detail(medium, np.array(grid.resolution))


def _error_of_detail(medium: MediumGrid, sides: np.ndarray) -> float:
    """Return `unresolved_error` for this number of voxels along x, y, z."""
    if medium.sigma_t.grid is None:
        return 0.0
    # docs/primer, eq. (7.3)
    lengths = np.linalg.norm(medium.frame[:3, :3], axis=0)
    depth = (mean_extinction(medium) * lengths / sides).max()
    return UNRESOLVED_ERROR * min(depth, OPAQUE) * _lost_detail(medium, sides)


def _refined_for_detail(medium: MediumGrid, sides: np.ndarray, most: int) -> np.ndarray:
    """Return numbers of voxels along x, y, z, at least ``sides`` and at most ``most`` in all, whose
    error due to unresolved detail is at most LARGE_UNRESOLVED, if so many suffice.
    """
    refined = sides
    while _error_of_detail(medium, np.maximum(np.floor(refined + 1e-4), 1)) > LARGE_UNRESOLVED:
        refined = refined * SIZE_RATIO
        if np.prod(refined) > most:
            break
        sides = refined
    return sides


def mean_extinction(medium: MediumGrid) -> float:
    """Return the mean extinction over collisions in uniform radiance, int sigma_t^2 / int sigma_t
    [1/scene unit].
    """
    sigma_t = medium.sigma_t
    if sigma_t.grid is None:
        return sigma_t.maximum
    total, squares = dr.sum(sigma_t.data), dr.squared_norm(sigma_t.data)
    dr.eval(total, squares)
    if not total[0] > 0:
        return 0.0
    return float(squares[0]) / float(total[0]) * float(sigma_t.scale[0])


def border_error(medium: MediumGrid, grid: Grid, max_depth: int = -1) -> float:
    """Estimate the error [%] of pixels at the boundary of a medium that is dense there, due to
    interpolation between the voxels of ``grid``.
    """
    return error_at_boundary(border_depth(medium, grid), medium, max_depth)


def error_at_boundary(depth: float, medium: MediumGrid, max_depth: int) -> float:
    """Estimate `border_error` for an optical ``depth`` of a voxel at the boundary."""
    error = _error_of_edge(depth, medium)
    if not medium.fills(Grid((1, 1, 1), medium.frame)):
        absorbed = 1.0 if max_depth == 2 else 1 - _border_albedo(medium)
        curved = CURVED_ERROR * max(absorbed, 0) ** ABSORBED_ORDER * depth**CURVED_ORDER
        error = max(error, curved)
    return error


def warn_of_dense_border(medium: MediumGrid, grid: Grid, max_depth: int = -1) -> None:
    """Log a warning if the cache is too coarse for a medium that is dense at its boundary.

    Irradiance decays within a fraction of a mean free path there, and no voxel lies beyond.
    """
    depth = border_depth(medium, grid)
    error = error_at_boundary(depth, medium, max_depth)
    if not medium.has_exact_boundary and max_depth != 2 and medium.detail is Detail.SHARP:
        error = max(error, OBLIQUE_ERROR * depth)
    if error > LARGE_BORDER_ERROR:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: dense matter reaches the boundary of the medium (optical depth {depth:.2g} "
            f"per cache voxel): errors of about {min(error, 100):.0f} % are expected there. Raise "
            "resolution, or leave two voxels of empty space around the matter.",
        )


def warn_of_opaque_voxels(medium: MediumGrid, grid: Grid, max_depth: int) -> bool:
    """Log a warning if voxels are too opaque for several orders of scattering.

    Returns whether it was logged.
    """
    data = (medium.original or medium).sigma_t.grid
    if max_depth == 2 or data is None:
        return False
    sigma_t = mean_extinction(medium)
    edge, size = data.voxel_size.max(), grid.voxel_size.max()
    error = OPAQUE_ERROR * (sigma_t * edge) ** OPAQUE_DEPTH_ORDER
    error = min(error * (size / edge) ** OPAQUE_SIZE_ORDER, MOST_OPAQUE_ERROR)
    is_large = error > LARGE_OPAQUE_ERROR or sigma_t * size > OPAQUE_VOXEL
    if is_large:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: voxels of the cache have a mean optical depth of {sigma_t * size:.2g}: "
            f"errors of up to about {error:.0f} % of the mean, and {OPAQUE_PEAK * error:.0f} % in "
            "small regions, are expected where the extinction varies within a few voxels. Raise "
            "resolution.",
        )
    return is_large


def warn_of_unresolved_detail(medium: MediumGrid, grid: Grid) -> None:
    """Log a warning if dense detail of the data is smaller than the voxels of the cache."""
    error = unresolved_error(medium, grid)
    if error > NOTABLE_UNRESOLVED:
        mi.Log(
            mi.LogLevel.Warn,
            "irrcache: the data have dense detail that the voxels of the cache do not resolve: "
            f"an error of about {error:.1f} % of the mean is expected, and several times as much "
            "in views that show little but this detail. Raise resolution "
            f"(now {max(grid.shape)}), or set tolerance to have it chosen.",
        )


def warn_of_unresolved_objects(medium: MediumGrid, grid: Grid) -> None:
    """Log a warning if the voxels of the cache are too large for surfaces in a homogeneous medium;
    in another one, surfaces may lie where it is thin.
    """
    if not medium.homogeneous:
        return
    edge, size = _edge_at_objects(medium, LARGE_OBJECT_ERROR)
    largest = grid.voxel_size.max()
    if largest > edge:
        error = LARGE_OBJECT_ERROR * (largest / edge) ** 2
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: voxels of the cache are large ({largest:.2g}) in comparison to surfaces of "
            f"size {size:.2g} in the medium: errors of about {min(error, 100):.0f} % are expected "
            f"around these. Raise resolution (now {max(grid.shape)}).",
        )


def border_depth(medium: MediumGrid, grid: Grid) -> float:
    """Return the largest optical depth of a voxel between opposite faces, at the boundary."""
    return _border_extinction(medium) * grid.voxel_thickness.max()


def densest_border_depth(medium: MediumGrid, grid: Grid) -> float:
    """Return `border_depth` for the densest part of the boundary, however small it is."""
    data, count = medium.sigma_t.grid, FEW_POINTS
    if data is not None:
        faces = 2 * data.voxel_count * float((1 / data.resolution).sum())
        count = int(np.clip(POINTS_PER_VOXEL * faces, FEW_POINTS, MOST_POINTS))
    found = medium.sigma_t.at_world(_on_boundary(medium, count))
    return float(dr.max(dr.max(mi.Spectrum(found), axis=0))[0]) * grid.voxel_thickness.max()


def _border_extinction(medium: MediumGrid) -> float:
    """Return the 95th percentile of sigma_t on the boundary of the medium, of the densest channel
    [1/scene unit].
    """
    found = medium.sigma_t.at_world(_on_boundary(medium))
    return float(np.quantile(np.array(dr.max(mi.Spectrum(found), axis=0)), 0.95))


def _border_albedo(medium: MediumGrid) -> float:
    """Return the 5th percentile of the albedo on the boundary, of its smallest channel."""
    found = medium.albedo.at_world(_on_boundary(medium))
    return float(np.quantile(np.array(dr.min(mi.Spectrum(found), axis=0)), 0.05))


def _on_boundary(medium: MediumGrid, count: int = FEW_POINTS) -> mi.Point3f:
    """Return random positions on the boundary of the medium."""
    rng = mi.PCG32(count)
    face = dr.arange(mi.UInt32, count) % 6
    place = [rng.next_float32() for _ in range(3)]
    side = mi.Float(face % 2)
    u = mi.Point3f([dr.select(face // 2 == axis, side, p) for axis, p in enumerate(place)])
    on_box = Grid((1, 1, 1), medium.frame).world.point(u)
    return medium.boundary.drawn_inside(on_box)
