"""What is not told is chosen: solver, voxels and samples of a cache, from the scene."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from .agreement import described
from .cache import IrradianceCache, active_voxels
from .errors import IrrcacheError, UnsupportedSceneError
from .grid import Grid, GridField
from .layers import luminance
from .medium import MediumGrid
from .obstacles import boxes_meet, corners_of, obstacle
from .scene import media_of
from .solvers import sweep
from .transport import is_null

#: Why something is as a property says.
AS_TOLD = "as told"
#: Optical depth of a voxel at the boundary of a medium from which on the pixels there are off by
#: more than 10 % (a homogeneous cube; at half of it, by 5 %).
DENSE_BORDER = 1.0

#: Voxels along the longest side of a cache among surfaces, unless told otherwise: shadows have more
#: detail than coarse data.
AMONG_SURFACES = (32, 64)

#: Voxels of a cache that ``resolution`` 0 leads to, at most; where light is known by its direction.
MOST_VOXELS, MOST_DIRECTIONAL = 1 << 25, 1 << 21
#: Optical depth of a cache voxel, where light collides, that ``resolution`` 0 keeps below by up to
#: twice the voxels of the data along an axis: the light falls off within denser ones. On a CT head
#: of 1.2 per voxel the error of single scattering falls from 0.7 to 0.3 % of the mean.
DENSE_VOXEL, FINEST = 0.7, 2.0
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
    if medium.alone:
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
        if not sweep.takes(emitter):
            kind = f'"{emitter.id()}" ({emitter.class_name()})'
            return f"emitter {kind} is neither far away nor a point nor an even area"
    if medium.alone:
        return None
    if not medium.exact:
        return f"{name} is bounded by other shapes than one box or sphere"
    if max_depth > 2:
        return f"among surfaces it knows one or all orders of scattering, not max_depth {max_depth}"
    grid, _ = choose_grid(medium, resolution, "sweep")
    active = active_voxels(medium, grid)
    if not dr.width(active):
        return None
    box = sweep.occupied_box(grid, active)
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
    longest = np.linalg.norm(frame[:3, :3], axis=0).max()
    per_path = 2 * longest * medium.sigma_t.maximum
    voxels = MOST_VOXELS if medium.phase is None else MOST_DIRECTIONAL
    if not resolution and medium.surroundings is not None and solver == "path":
        least, most = AMONG_SURFACES
        count = np.ceil(per_path) if data is None else max(data.shape)
        grid = Grid.near_cubic(frame, int(np.clip(count, least, most)))
        reason = f"of the medium, {least} to {most} among surfaces"
    elif resolution:
        grid, reason = Grid.near_cubic(frame, resolution), AS_TOLD
    elif data is None:
        count = np.clip(np.ceil(per_path), 32, 96)
        grid, reason = Grid.near_cubic(frame, int(count)), "two per mean free path, 32 to 96"
    elif solver == "sweep" and data.voxel_count <= voxels:
        sides, reason = _finer(medium.sigma_t, voxels), "of the medium"
        if (sides > data.resolution).any():
            reason = "finer than those of the medium, which is dense"
        if not medium.alone and sides.max() < AMONG_SURFACES[0]:
            sides = np.ceil(sides * (AMONG_SURFACES[0] / sides.max())).astype(int)
            reason = f"finer than those of the medium, {AMONG_SURFACES[0]} among surfaces"
        grid = Grid(tuple(int(n) for n in sides[::-1]), frame)
    else:
        most = 128 if solver == "path" else round(voxels ** (1 / 3))
        grid = Grid.near_cubic(frame, min(max(data.shape), most))
        reason = f"of the medium, at most {most}"
    return grid.shared(medium.sigma_t.grid, medium.albedo.grid), reason


def _finer(sigma_t: GridField, voxels: int) -> np.ndarray:
    """Voxels along x, y, z that light needs to be known in: those of the data or, where they are
    dense, more, but no more than so many ``voxels``.
    """
    total, squares = dr.sum(sigma_t.data), dr.squared_norm(sigma_t.data)
    dr.eval(total, squares)
    if not total[0] > 0:
        return sigma_t.grid.resolution
    # Extinction on average over collisions in even light.
    extinction = float(squares[0]) / float(total[0]) * float(sigma_t.scale[0])
    factor = np.clip(extinction * sigma_t.grid.voxel_size / DENSE_VOXEL, 1, FINEST)
    most = (voxels / sigma_t.grid.voxel_count) ** (1 / 3)
    return np.floor(sigma_t.grid.resolution * np.minimum(factor, most)).astype(int)


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
    if medium.phase is not None and medium.phase.forward and not medium.alone:
        return SWEPT_SHARP
    return (SWEPT if medium.alone else SWEPT_AMONG_SURFACES) * (2 if once else 1)


def warn_of_dense_border(medium: MediumGrid, grid: Grid) -> None:
    """Tells where the cache is too coarse for matter that the boundary cuts: light falls off within
    a fraction of a mean free path there, and nothing is known of it beyond the outermost voxels.
    """
    depth = _border_extinction(medium) * grid.voxel_size.max()
    if depth > DENSE_BORDER:
        mi.Log(
            mi.LogLevel.Warn,
            f"irrcache: dense matter reaches the boundary of the medium (optical depth {depth:.2g} "
            "per cache voxel), whose light is known poorly in the outermost layer. Raise "
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
