"""The voxels of a cache, from estimates of the error that they cause."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid

#: Why something is as a property of the integrator says.
REQUESTED = "as requested"

#: Estimated error of the pixels at the boundary of a medium [%] above which a warning is logged.
LARGE_BORDER_ERROR = 3.0

#: The same above which the irradiance of suns and points is not interpolated.
SMALL_BORDER_ERROR = 0.2

#: Voxels of a cache that ``resolution`` 0 leads to, at most; the second where scattering is not
#: isotropic.
MOST_VOXELS, MOST_DIRECTIONAL = 1 << 25, 1 << 21
#: RMSE of the image, in % of its mean, that ``resolution`` 0 aims at by the estimates below, which
#: are fits to images of a CT head and of random and smooth media of 0.3 to 100 optical depths per
#: data voxel. The error falls with the square of the voxels along an axis.
TARGET_ERROR = 0.5
#: Optical depth of a data voxel up to which the data's own voxels have that error; one above which
#: the voxels that it takes grow less than in proportion to the depth, with this power; and the
#: most voxels along an axis for each of the data.
RESOLVED, OPAQUE, OPAQUE_POWER, MOST_PER_DATA_VOXEL = 0.7, 1.2, 0.45, 6.0
#: A medium that is dense at its boundary, with an optical depth d of a cache voxel there, has an
#: error of about this many % times d^1.2.
BORDER_ERROR, BORDER_ORDER = 3.5, 1.2
#: Voxels of a cache that is finer than its data, at most: all orders of scattering in so many take
#: half a minute on two cores.
MOST_REFINED = 8_000_000


@dataclass(frozen=True)
class SizeAmongSurfaces:
    """Limits of the voxels along the longest side of a cache among surfaces, whose shadows have
    more detail than coarse data, and the error [%] that decides between the limits.
    """

    fewest: int
    most: int
    target_error: float


@dataclass(frozen=True)
class SizeRule:
    """How a solver wants ``resolution`` 0 to be understood.

    Attributes:
        target_error: RMSE of the image that the grid aims at [%].
        fewest: voxels along the longest side that every medium gets.
        most_by_contrast: voxels along the longest side that high contrast inside of the medium can
            ask for; ``most_by_border`` the same where the medium is dense at its boundary or
            homogeneous.
        refines_dense_data: whether voxels may be smaller than those of dense data.
        most: voxels along the longest side, at most.
        among_surfaces: another rule where rays are traced through the scene's shapes; None: the
            same rule.
    """

    target_error: float
    fewest: int
    most_by_contrast: int
    most_by_border: int
    refines_dense_data: bool = True
    most: float = np.inf
    among_surfaces: SizeAmongSurfaces | None = None


def choose_grid(medium: MediumGrid, resolution: int, rule: SizeRule) -> tuple[Grid, str]:
    """The voxels of the cache, and why.

    With ``resolution`` 0 those of the medium, since larger ones lose detail, or smaller ones where
    the medium is dense, within the limits of the ``rule``.
    """
    data, frame = medium.sigma_t.grid, medium.frame
    voxels = MOST_VOXELS if medium.phase.is_isotropic else MOST_DIRECTIONAL
    if resolution:
        grid, reason = Grid.near_cubic(frame, resolution), REQUESTED
    elif medium.is_traced and rule.among_surfaces is not None:
        least, most = rule.among_surfaces.fewest, rule.among_surfaces.most
        extinction = max(_colliding_extinction(medium), _border_extinction(medium))
        longest = np.linalg.norm(frame[:3, :3], axis=0).max()
        count = np.ceil(extinction * longest / _edge_of_error(rule.among_surfaces.target_error))
        count = max(count, 0 if data is None else max(data.shape))
        grid = Grid.near_cubic(frame, int(np.clip(count, least, most)))
        reason = f"of the medium, {least} to {most} among surfaces"
    else:
        grid, reason = _estimated_grid(medium, rule, voxels)
    return grid.shared(medium.sigma_t.grid, medium.albedo.grid), reason


def _edge_of_error(error: float) -> float:
    """The optical depth of the edge of a voxel whose estimated error [%] is this."""
    return (error / BORDER_ERROR) ** (1 / BORDER_ORDER)


def _estimated_grid(medium: MediumGrid, rule: SizeRule, voxels: int) -> tuple[Grid, str]:
    """The grid whose estimated error is that of the ``rule``, with no more than so many ``voxels``,
    and the reason for its size.
    """
    # docs/primer, eq. (7.2)
    data, frame = medium.sigma_t.grid, medium.frame
    lengths = np.linalg.norm(frame[:3, :3], axis=0)
    mean, border = _colliding_extinction(medium), _border_extinction(medium)
    # Voxels along x, y, z that each criterion asks for.
    wanted = {f"at least {rule.fewest}": rule.fewest * lengths / lengths.max()}
    if data is not None:
        ratio = np.ones(3)
        if rule.refines_dense_data:
            depth = mean * data.voxel_size
            ratio = np.minimum(depth, OPAQUE) / RESOLVED
            ratio *= np.maximum(depth / OPAQUE, 1) ** OPAQUE_POWER
        ratio = np.clip(ratio, 1, MOST_PER_DATA_VOXEL)
        dense = "finer than those of the medium, which is dense"
        wanted[dense if ratio.max() > 1 else "of the medium"] = data.resolution * ratio
    edge = _edge_of_error(rule.target_error)
    per_path = f"{1 / edge:.0f} per mean free path"
    for reason, extinction, most in (
        (per_path, mean, rule.most_by_contrast),
        (f"{per_path} at the boundary, which cuts the medium", border, rule.most_by_border),
    ):
        counts = extinction * lengths / edge
        wanted[reason] = counts * min(1, most / max(counts.max(), 1))
    sides = np.max(list(wanted.values()), axis=0)
    reason = max(wanted, key=lambda key: wanted[key].max())
    limit = voxels
    if data is not None and np.prod(sides) > data.voxel_count:
        limit = min(voxels, max(MOST_REFINED, data.voxel_count))
    for bound, message in (
        ((limit / np.prod(sides)) ** (1 / 3), f"as fine as {limit} voxels allow"),
        (rule.most / sides.max(), f"of the medium, at most {rule.most}"),
    ):
        if bound < 1:
            sides, reason = sides * bound, message
    # Rounded down: limits hold. Counts that are whole numbers but for rounding stay what they are.
    sides = np.maximum(np.floor(sides + 1e-4), 1).astype(int)
    return Grid(tuple(int(n) for n in sides[::-1]), frame), reason


def _colliding_extinction(medium: MediumGrid) -> float:
    """The mean extinction over collisions in uniform radiance, int sigma_t^2 / int sigma_t
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


def border_error(medium: MediumGrid, grid: Grid) -> float:
    """The estimated error [%] of pixels at the boundary of a medium that is dense there, where
    irradiance is interpolated between the voxels of ``grid``.
    """
    # docs/primer, eq. (7.1)
    return BORDER_ERROR * (_border_extinction(medium) * grid.voxel_size.max()) ** BORDER_ORDER


def warn_of_dense_border(medium: MediumGrid, grid: Grid) -> None:
    """Logs a warning where the cache is too coarse for a medium that is dense at its boundary:
    irradiance falls off within a fraction of a mean free path there, and no voxel lies beyond.
    """
    depth = _border_extinction(medium) * grid.voxel_size.max()
    error = border_error(medium, grid)
    if error > LARGE_BORDER_ERROR:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: dense matter reaches the boundary of the medium (optical depth {depth:.2g} "
            f"per cache voxel): errors of about {min(error, 100):.0f} % are expected there. Raise "
            "resolution, or leave two voxels of empty space around the matter.",
        )


def _border_extinction(medium: MediumGrid) -> float:
    """The 95th percentile of sigma_t on the faces of the medium [1/scene unit]."""
    rng = mi.PCG32(4096)
    face = dr.arange(mi.UInt32, 4096) % 6
    place = [rng.next_float32() for _ in range(3)]
    side = mi.Float(face % 2)
    u = mi.Point3f([dr.select(face // 2 == axis, side, p) for axis, p in enumerate(place)])
    sigma_t = medium.sigma_t.at_world(Grid((1, 1, 1), medium.frame).world.point(u))
    return float(np.quantile(np.array(luminance(mi.Spectrum(sigma_t))), 0.95))
