"""The solver ``sweep``: discrete ordinates along long characteristics, see `discrete_ordinates`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels, dilated, marked, occupied_box
from mitsuba_irrcache.lights.emitters import POINT_LIKE, EmitterKind, illuminating, kind_of
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.glossy_reflections import narrow_beam
from mitsuba_irrcache.scene.media_shares import media_shares, media_within, why_shared
from mitsuba_irrcache.scene.occluders import obstacle
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.solvers.base import Progress, Solver, SolverTask, register
from mitsuba_irrcache.solvers.discrete_ordinates import solver as sn_solver
from mitsuba_irrcache.solvers.discrete_ordinates.anisotropic import AnisotropicSweep, minimum_batch
from mitsuba_irrcache.solvers.discrete_ordinates.refracted_light import is_needed
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import MOST_REFINED
from mitsuba_irrcache.solvers.discrete_ordinates.solver import Sweep
from mitsuba_irrcache.solvers.grid_size import TARGET_ERROR, SizeRule, choose_grid
from mitsuba_irrcache.transport.path import Media

#: Kinds of emitters whose radiance can enter along tracks or be sampled from the voxels.
EMITTERS = frozenset(
    (
        EmitterKind.CONSTANT_ENVIRONMENT,
        EmitterKind.ENVIRONMENT_MAP,
        EmitterKind.SUN,
        *POINT_LIKE,
        EmitterKind.AREA,
    )
)
#: Default number of directions per voxel: for isolated media and those that hold emitters, and
#: among other surfaces, where camera paths add noise. It is doubled for single isotropic
#: scattering, where directions are cheaper and their noise is not blurred by further orders.
DEFAULT_DIRECTIONS, DIRECTIONS_AMONG_SURFACES = 128, 64
#: The same for isotropic scattering in a constant environment: errors are at most 1.5 times those
#: with 128.
DIRECTIONS_IN_UNIFORM_LIGHT = 64
#: The same for a phase function with a forward peak. Under a sun, blocks of an image of a lone
#: cloud have an RMSE of 3 to 4 % with 128 directions (the mean 1 to 2 %), and 1.4 % (0.4 %) with
#: 256, in 1.2 times the time. Above a ground under a sky with a wide sun it is 1.5 and 0.9 %.
DIRECTIONS_OF_SHARP_SCATTERING = 256
#: Cost among surfaces, in paths of ``volpath``: of a cache however small, and of a direction in a
#: voxel. Measured over ground: 9e5 for 6e6 directions in voxels; behind glass 1e6 to 1.6e7, at
#: least twice as much.
FIXED_COST, DIRECTION_COST = 5e5, 0.05


@register
class SweepSolver(Solver):
    """Solves for all voxels at once. Surfaces and other media may reach into media that scatter
    isotropically and do not emit.
    """

    name = "sweep"
    precedence = 10
    has_gradients = True
    size_rule = SizeRule(
        TARGET_ERROR,
        fewest=32,
        most_by_contrast=64,
        most_by_border=128,
        larger_in_smooth_light=True,
    )
    is_correlated = True
    is_kept = True
    supports_delta_m = True

    @classmethod
    def why_not(
        cls, scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
    ) -> str | None:
        name = f'medium "{medium.name}"'
        for emitter in illuminating(scene):
            if kind_of(emitter) not in EMITTERS:
                kind = f'"{emitter.id()}" ({emitter.class_name()})'
                return (
                    f"emitter {kind} is neither distant (with a uniform beam) nor point-like nor "
                    "an area emitter that emits in all directions"
                )
        if medium.is_isolated:
            return None
        if max_depth > 2:
            return (
                "among surfaces it computes single scattering (max_depth 2) or all orders (-1), "
                f"not max_depth {max_depth}"
            )
        grid, _ = choose_grid(medium, resolution, cls.size_rule)
        active = cls.active_voxels(scene, medium, grid)
        if not dr.width(active):
            return None
        box = occupied_box(grid, active)
        shared = why_shared(scene, medium, grid, box)
        if shared is not None:
            return _why_no_mixture(scene, medium, grid, box, shared)
        if medium.phase.is_isotropic and medium.emission is None:
            return None
        if medium.refracts and not medium.phase.is_isotropic and is_needed(scene):
            return (
                f"{name} scatters anisotropically behind glass, where only constant environments "
                "are supported"
            )
        # Emission without extinction must not be occluded either.
        box = box if medium.emission is None else (np.zeros(3, int), grid.resolution)
        found = obstacle(scene, grid, *box)
        what = "is emissive" if medium.phase.is_isotropic else "scatters anisotropically"
        return found and f"{found} reaches into {name}, which {what}"

    @classmethod
    def active_voxels(cls, scene: mi.Scene, medium: MediumGrid, grid: Grid) -> mi.UInt32:
        found, whole = active_voxels(medium, grid), (np.zeros(3, int), grid.resolution)
        if medium.is_isolated or not dr.width(found) or not why_shared(scene, medium, grid, whole):
            return found
        # Lookups read voxels beside those that the medium fills. In the others radiance is
        # scattered, too.
        own, *others = media_shares(scene, media_within(medium, grid, whole), grid)
        marks = marked(grid, found) & dilated(grid, own > 0)
        for share in others:
            marks |= share > 0
        return dr.compress(marks)

    @classmethod
    def weakness(cls, scene: mi.Scene, medium: MediumGrid, max_depth: int) -> str | None:
        if medium.is_isolated or 0 <= max_depth <= 2:
            return None
        return narrow_beam(scene, medium)

    @classmethod
    def why(cls, medium: MediumGrid) -> str:
        if medium.is_isolated:
            return "all emitters are distant or point-like"
        return "all emitters are supported among surfaces"

    @classmethod
    def default_samples(cls, medium: MediumGrid, max_depth: int, active_count: int) -> int:
        if medium.phase.forward:
            return DIRECTIONS_OF_SHARP_SCATTERING
        if medium.detail is Detail.UNIFORM and medium.phase.is_isotropic:
            return DIRECTIONS_IN_UNIFORM_LIGHT
        once = max_depth == 2 and medium.phase.is_isotropic
        few = not (medium.is_isolated or medium.holds_emitters)
        count = DIRECTIONS_AMONG_SURFACES if few else DEFAULT_DIRECTIONS
        return 2 * count if once else count

    @classmethod
    def batch_size(
        cls, medium: MediumGrid, max_depth: int, samples: int, basis: AngularBasis | None
    ) -> int:
        multiple = sn_solver.SMALLEST_BATCH if basis is None else minimum_batch(basis.order)
        return sn_solver.batch_of(samples, multiple)

    @classmethod
    def numbers_per_voxel(
        cls, medium: MediumGrid, max_depth: int, moments: int, voxels: int, channels: int
    ) -> int:
        # Extinction with its neighbours, the radiance along tracks, sums and spreads; and for
        # further orders of scattering, the values of voxels and those stored between sweeps.
        once = max_depth == 2
        extinctions = max(each.sigma_t.channels for each in (medium, *medium.others))
        sets = channels if sn_solver.swept_together(extinctions, voxels, moments) else 1
        numbers = 5 + 2 * channels + (0 if once else 5 + 12 * sets + 3 * channels)
        is_box = medium.boundary.kind == "box" and medium.has_exact_boundary
        if voxels <= MOST_REFINED and (not is_box or medium.others):
            numbers += 32  # the extinction may have half the edges
        return numbers + moments * (3 * channels + (4 if once else 10) * sets)

    @classmethod
    def cost(cls, medium: MediumGrid, active_count: int, samples: int) -> float:
        # An isolated medium takes tenths of a second, not more than a pilot image by ``volpath``.
        if medium.is_isolated:
            return 0.0
        cost = FIXED_COST + DIRECTION_COST * active_count * samples
        return 2 * cost if medium.refracts else cost

    @classmethod
    def voxel_classes(
        cls, scene: mi.Scene, media: Media, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> VoxelClasses | None:
        if medium.is_isolated or not dr.width(active):
            return None
        if obstacle(scene, grid, *occupied_box(grid, active)) is None:
            return None
        return VoxelClasses(scene, media, medium, grid)

    @classmethod
    def knows_direct_lights(
        cls, scene: mi.Scene, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> bool:
        if medium.is_isolated or not dr.width(active):
            return True
        return why_shared(scene, medium, grid, occupied_box(grid, active)) is None

    def __init__(self, task: SolverTask) -> None:
        kind = Sweep if task.cache.directional is None else AnisotropicSweep
        options = task.seed, task.rr_depth, task.pause
        self._sweep = kind(task.scene, task.medium, task.cache, *options)

    @property
    def direction_noise(self) -> float:
        return self._sweep.direction_noise

    def use(self, scene: mi.Scene | None) -> None:
        self._sweep.use(scene)

    def refine(self, samples: int, progress: Progress | None = None) -> None:
        self._sweep.refine(samples, progress)


def _why_no_mixture(
    scene: mi.Scene, medium: MediumGrid, grid: Grid, box: tuple, shared: str
) -> str | None:
    """Return why a `MediaMixture` does not represent ``medium`` in the ``box`` (lower, upper) of
    voxels of ``grid``; None if it does. ``shared`` is why one is needed.
    """
    media = media_within(medium, grid, box)
    for each in media:
        name = f'medium "{each.name}"'
        if each.refracts:
            return f"{shared}, and the boundary of {name} refracts"
        if each.emission is not None:
            return f"{shared}, and {name} is emissive"
        if len(media) > 1 and not each.phase.is_isotropic:
            return f"{shared}, and {name} scatters anisotropically"
    found = obstacle(scene, grid, *box)
    return found and f'{shared}, and {found} reaches into medium "{medium.name}"'
