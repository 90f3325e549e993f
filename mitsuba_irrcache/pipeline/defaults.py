"""What is not told is chosen: solver, voxels and samples of a cache, from the scene."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.errors import IrrcacheError, UnsupportedSceneError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.compile import media_of
from mitsuba_irrcache.scene.consistency import described
from mitsuba_irrcache.scene.occluders import boxes_meet, corners_of, obstacle
from mitsuba_irrcache.solvers import half_space
from mitsuba_irrcache.solvers.discrete_ordinates import solver as sn_solver
from mitsuba_irrcache.transport.path import is_null

#: Why something is as a property says.
AS_TOLD = "as told"
#: Estimated error of the pixels at the boundary of a medium [%] from which on a warning is logged.
LARGE_BORDER_ERROR = 3.0

#: The same from which on the light of suns and points is not interpolated.
SMALL_BORDER_ERROR = 0.2

#: Voxels along the longest side of a cache among surfaces, unless told otherwise: shadows have more
#: detail than coarse data.
AMONG_SURFACES = (32, 64)

#: Voxels of a cache that ``resolution`` 0 leads to, at most; where light is known by its direction.
MOST_VOXELS, MOST_DIRECTIONAL = 1 << 25, 1 << 21
#: RMSE of the image, in % of its mean, that ``resolution`` 0 aims at by the estimates below, which
#: are fits to images of a CT head and of random and smooth media of 0.3 to 100 optical depths per
#: data voxel. The error falls with the square of the voxels along an axis.
TARGET_ERROR = 0.5
#: Optical depth of a data voxel up to which the data's own voxels have that error; one from which
#: on the voxels that it takes grow less than in proportion to the depth, with this power; and the
#: most voxels along an axis for each of the data.
RESOLVED, OPAQUE, OPAQUE_POWER, MOST_PER_DATA_VOXEL = 0.7, 1.2, 0.45, 6.0
#: A medium whose boundary cuts through matter, with an optical depth d of a cache voxel there, has
#: an error of about this many % times d^1.2.
BORDER_ERROR, BORDER_ORDER = 3.5, 1.2
#: Voxels along the longest side that media get at least, whatever their data: so few cost next to
#: nothing, and light has detail that a few data voxels lack. Matter with high contrast gets up to
#: the second number, and one that the boundary cuts, or that is homogeneous, up to the third.
FEWEST, CONTRASTED, BORDERED = 32, 64, 128
#: The same for the solver ``path``, whose work grows with the voxels and whose noise is about as
#: large as the first of these, the error that it aims at.
PATH_TARGET_ERROR, PATH_FEWEST, PATH_MOST = 1.0, 16, 32
#: The same among surfaces, where the number of paths does not depend on that of the voxels.
SURFACES_TARGET_ERROR = 0.25
#: Voxels of a cache that is finer than its data, at most: all orders of scattering in so many take
#: half a minute on two cores.
MOST_REFINED = 8_000_000
#: Directions per voxel of the solver ``sweep``, unless told otherwise: for all orders of
#: scattering, and among surfaces, whose light has the noise of the image's samples besides. Twice
#: as many for single scattering of irradiance, where each is less work and blurs less.
SWEPT, SWEPT_AMONG_SURFACES = 128, 64
#: The same among surfaces where the phase function has a forward peak: 128 leave an error of 1.5 %
#: under a sky with a wide sun, these 0.9 %.
SWEPT_SHARP = 256

#: Largest over smallest channel of the extinction from which on ``volpathmis`` needs less time than
#: ``volpath`` for the same error. Measured on a glass ball full of fog: 1.4 times as much time at
#: 1 : 1.5, 0.8 times at 1 : 2, 0.6 times at 1 : 3, a fortieth at 1 : 10.
CHROMATIC = 1.8


def choose_stock(scene: mi.Scene) -> tuple[str, str]:
    """The integrator of Mitsuba that renders a scene without a cache, and why."""
    media = {*media_of(scene)}
    if not media:
        return "volpath", "there is no medium"
    ratio = max(_chromaticity(scene, medium) for medium in media)
    if ratio > CHROMATIC:
        return "volpathmis", f"extinction differs between the channels, 1 : {ratio:.2g}"
    return "volpath", "extinction is about the same in all channels"


def _chromaticity(scene: mi.Scene, medium: mi.Medium) -> float:
    """The largest channel of a medium's extinction over the smallest one, on average over it."""
    rng = mi.PCG32(4096)
    lower, upper = mi.Point3f(scene.bbox().min), mi.Point3f(scene.bbox().max)
    at = dr.zeros(mi.MediumInteraction3f, 4096)
    u = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    at.p = lower + u * (upper - lower)
    sigma_t = np.array(medium.get_scattering_coefficients(at, True)[2], dtype=np.float64)
    sums = sigma_t.reshape(dr.size_v(mi.Spectrum), -1).sum(axis=1)
    return float(sums.max() / max(sums.min(), 1e-6 * sums.max())) if sums.max() > 0 else 1.0


def choose_solver(
    scene: mi.Scene, medium: MediumGrid, solver: str, max_depth: int = -1, resolution: int = 0
) -> tuple[str, str]:
    """The solver for a ``medium`` of a scene, and why.

    Raises IrrcacheError where ``sweep`` is told that cannot be used.
    """
    reason = AS_TOLD if solver == "path" else None
    reason = reason or _why_not_sweep(scene, medium, max_depth, resolution)
    if medium.phase is not None and medium.phase.forward:
        _check_sharp(medium, reason, max_depth)
    if solver == "path":
        return solver, reason
    if reason and solver == "sweep":
        raise IrrcacheError(
            f'irrcache: solver "sweep" cannot be used in this scene, since {reason}; set solver to '
            '"path" or "auto".'
        )
    if reason:
        return "path", reason
    if solver == "sweep":
        return solver, AS_TOLD
    if medium.is_isolated:
        return "sweep", "all light comes from far away or from points"
    return "sweep", "no surface and no other medium is among the voxels"


def _check_sharp(medium: MediumGrid, reason: str | None, max_depth: int) -> None:
    """Refuses a medium without its forward peak where there is a ``reason`` not to sweep it, or
    orders of scattering are told apart: those in the peak are none.
    """
    cosine = medium.phase.forward + (1 - medium.phase.forward) * float(medium.phase.moments[1])
    sharp = f'irrcache: medium "{medium.name}" scatters sharply, with a mean cosine of {cosine:.2f}'
    remedy = 'make it broader, or render this scene with "volpath"'
    if reason:
        why = AS_TOLD if reason == AS_TOLD else f"since {reason}"
        remedy = f'set solver to "auto", {remedy}' if reason == AS_TOLD else remedy
        raise UnsupportedSceneError(
            f'{sharp}, too sharply for the solver "path", which is used, {why}; {remedy}.'
        )
    if max_depth >= 0:
        raise UnsupportedSceneError(
            f"{sharp}: light of all orders is known, not of max_depth {max_depth}; set max_depth "
            f"to -1, {remedy}."
        )


def _why_not_sweep(
    scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
) -> str | None:
    """Why light cannot be swept through ``medium``; None where it can."""
    name = f'medium "{medium.name}"'
    for emitter in scene.emitters():
        if not sn_solver.takes(emitter):
            kind = f'"{emitter.id()}" ({emitter.class_name()})'
            return f"emitter {kind} is neither far away nor a point nor an even area"
    if medium.is_isolated:
        return None
    if not medium.has_exact_boundary:
        return f"{name} is bounded by other shapes than one box or sphere"
    if max_depth > 2:
        return f"among surfaces it knows one or all orders of scattering, not max_depth {max_depth}"
    grid, _ = choose_grid(medium, resolution, "sweep")
    active = active_voxels(medium, grid)
    if not dr.width(active):
        return None
    box = sn_solver.occupied_box(grid, active)
    for other in medium.surroundings.media.grids:
        if other is not medium and boxes_meet(grid, *box, corners_of(other.frame)):
            return f'medium "{other.name}" reaches into {name}'
    hole = _hole(scene, medium, grid, box)
    if hole:
        return f"{hole} is a hole in {name}, or bounds another medium in it"
    # What shines where no matter is, nothing may stand before either.
    box = box if medium.emission is None else (np.zeros(3, int), grid.resolution)
    found = obstacle(scene, grid, *box)
    return found and f"{found} reaches into {name}"


def needs_no_cache(
    scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
) -> str | None:
    """Why `HalfSpace` is more accurate than a cache for ``medium``; None where it is not, or where
    ``resolution`` asks for a cache.
    """
    if resolution or max_depth > half_space.MOST_ORDERS:
        return None
    error = half_space.series_error(medium)
    if not np.isfinite(error) or not half_space.is_seen_from_outside(scene, medium):
        return None
    error *= max_depth != 2  # single scattering is exact
    grid, _ = choose_grid(medium, 0, "sweep")
    depth = medium.sigma_t.maximum * grid.voxel_size.max()
    cached = BORDER_ERROR * depth**BORDER_ORDER
    if cached <= max(error, 1.2 * TARGET_ERROR):
        return None
    return (
        f"opaque (optical depth {depth:.2g} per voxel of a cache, which would cause an error of "
        f"about {min(cached, 100):.0f} % instead of {error:.1f} %)"
    )


def follows_straight_ways(
    scene: mi.Scene, medium: MediumGrid, grid: Grid, active: mi.UInt32
) -> bool:
    """Whether all of a straight way within the boundary of ``medium`` is in the medium, unless it
    ends at a surface.
    """
    if medium.is_isolated or not dr.width(active):
        return medium.is_isolated
    if not medium.has_exact_boundary or len(medium.surroundings.media.grids) > 1:
        return False
    return _hole(scene, medium, grid, sn_solver.occupied_box(grid, active)) is None


def _hole(scene: mi.Scene, medium: MediumGrid, grid: Grid, box: tuple) -> str | None:
    """A shape behind whose null surface ``medium`` ends, among the voxels of the ``box``."""
    for shape in scene.shapes():
        outer = shape.exterior_medium()
        null = shape.bsdf() is not None and is_null(int(shape.bsdf().flags()))
        if outer is None or not null or not dr.all(mi.MediumPtr(outer) == medium.pointer):
            continue
        ends = np.array([shape.bbox().min, shape.bbox().max], dtype=np.float64)
        corners = np.array(list(itertools.product(*ends.T)))
        if not np.isfinite(ends).all() or boxes_meet(grid, *box, corners):
            return described(shape)
    return None


def choose_grid(medium: MediumGrid, resolution: int, solver: str) -> tuple[Grid, str]:
    """The voxels of the cache, and why.

    With ``resolution`` 0 those of the medium: the light of coarser ones lacks its detail, and finer
    ones are worth it in dense matter only. ``path`` takes at most 128 along the longest side, which
    are work enough; ``sweep`` as many as memory lets it. A homogeneous medium gets half a mean free
    path per voxel.
    """
    data, frame = medium.sigma_t.grid, medium.frame
    voxels = MOST_VOXELS if medium.phase is None else MOST_DIRECTIONAL
    if resolution:
        grid, reason = Grid.near_cubic(frame, resolution), AS_TOLD
    elif medium.surroundings is not None and solver == "path":
        least, most = AMONG_SURFACES
        extinction = max(_colliding_extinction(medium), _border_extinction(medium))
        longest = np.linalg.norm(frame[:3, :3], axis=0).max()
        count = np.ceil(extinction * longest / _edge_of_error(SURFACES_TARGET_ERROR))
        count = max(count, 0 if data is None else max(data.shape))
        grid = Grid.near_cubic(frame, int(np.clip(count, least, most)))
        reason = f"of the medium, {least} to {most} among surfaces"
    else:
        grid, reason = _estimated_grid(medium, solver, voxels)
    return grid.shared(medium.sigma_t.grid, medium.albedo.grid), reason


def _edge_of_error(error: float) -> float:
    """The optical depth of the edge of a voxel whose estimated error [%] is this."""
    return (error / BORDER_ERROR) ** (1 / BORDER_ORDER)


def _estimated_grid(medium: MediumGrid, solver: str, voxels: int) -> tuple[Grid, str]:
    """The grid whose estimated error is `TARGET_ERROR`, with no more than so many ``voxels``, and
    the reason for its size.
    """
    data, frame = medium.sigma_t.grid, medium.frame
    lengths = np.linalg.norm(frame[:3, :3], axis=0)
    mean, border = _colliding_extinction(medium), _border_extinction(medium)
    # Voxels along x, y, z that each criterion asks for.
    by_path = solver == "path"
    target = PATH_TARGET_ERROR if by_path else TARGET_ERROR
    fewest = PATH_FEWEST if by_path else FEWEST
    wanted = {f"at least {fewest}": fewest * lengths / lengths.max()}
    if data is not None:
        ratio = np.ones(3)
        if not by_path:  # its noise in finer voxels exceeds the error of these
            depth = mean * data.voxel_size
            ratio = np.minimum(depth, OPAQUE) / RESOLVED
            ratio *= np.maximum(depth / OPAQUE, 1) ** OPAQUE_POWER
        ratio = np.clip(ratio, 1, MOST_PER_DATA_VOXEL)
        dense = "finer than those of the medium, which is dense"
        wanted[dense if ratio.max() > 1 else "of the medium"] = data.resolution * ratio
    edge = _edge_of_error(target)
    per_path = f"{1 / edge:.0f} per mean free path"
    for reason, extinction, most in (
        (per_path, mean, CONTRASTED),
        (f"{per_path} at the boundary, which cuts the medium", border, BORDERED),
    ):
        counts = extinction * lengths / edge
        most = PATH_MOST if by_path else most
        wanted[reason] = counts * min(1, most / max(counts.max(), 1))
    sides = np.max(list(wanted.values()), axis=0)
    reason = max(wanted, key=lambda key: wanted[key].max())
    limit = voxels
    if data is not None and np.prod(sides) > data.voxel_count:
        limit = min(voxels, max(MOST_REFINED, data.voxel_count))
    most = 128 if by_path else np.inf
    for bound, message in (
        ((limit / np.prod(sides)) ** (1 / 3), f"as fine as {limit} voxels allow"),
        (most / sides.max(), f"of the medium, at most {most}"),
    ):
        if bound < 1:
            sides, reason = sides * bound, message
    # Rounded down: limits hold. Counts that are whole numbers but for rounding stay what they are.
    sides = np.maximum(np.floor(sides + 1e-4), 1).astype(int)
    return Grid(tuple(int(n) for n in sides[::-1]), frame), reason


def _colliding_extinction(medium: MediumGrid) -> float:
    """The mean extinction over collisions in even light, int sigma_t^2 / int sigma_t
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


def choose_samples(cache: IrradianceCache, solver: str, medium: MediumGrid) -> int:
    """Samples per voxel: for ``path`` about 2^24 in all, 2^22 among surfaces, where each is more
    work; 16 to 256 each.
    """
    if solver == "sweep":
        return swept_samples(cache.max_depth, medium)
    paths = 2**24 if cache.survey is None else 2**22
    return int(np.clip(paths // max(cache.active_count, 1), 16, 256))


def swept_samples(max_depth: int, medium: MediumGrid) -> int:
    """Directions per voxel of the solver ``sweep``."""
    once = max_depth == 2 and medium.phase is None
    if medium.phase is not None and medium.phase.forward and not medium.is_isolated:
        return SWEPT_SHARP
    return (SWEPT if medium.is_isolated else SWEPT_AMONG_SURFACES) * (2 if once else 1)


def border_error(medium: MediumGrid, grid: Grid) -> float:
    """The estimated error of the pixels at the boundary of a medium that cuts through matter [%],
    where irradiance is interpolated between the voxels of ``grid``.
    """
    return BORDER_ERROR * (_border_extinction(medium) * grid.voxel_size.max()) ** BORDER_ORDER


def warn_of_dense_border(medium: MediumGrid, grid: Grid) -> None:
    """Logs a warning where the cache is too coarse for matter that the boundary cuts: irradiance
    falls off within a fraction of a mean free path there, and no voxel lies beyond.
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
    """What 95 % of the medium's faces do not exceed: sigma_t [1/scene unit]."""
    rng = mi.PCG32(4096)
    face = dr.arange(mi.UInt32, 4096) % 6
    place = [rng.next_float32() for _ in range(3)]
    side = mi.Float(face % 2)
    u = mi.Point3f([dr.select(face // 2 == axis, side, p) for axis, p in enumerate(place)])
    sigma_t = medium.sigma_t.at_world(Grid((1, 1, 1), medium.frame).world.point(u))
    return float(np.quantile(np.array(luminance(mi.Spectrum(sigma_t))), 0.95))
