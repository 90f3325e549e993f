"""Interface of solvers, and their registry.

A solver fills the cache of one medium. To add one, derive a class from `Solver`, decorate it with
`register`, and import its module in ``solvers/__init__.py``: the property ``solver``, the choice of
``auto``, memory checks, progressive rendering and cache files then support it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.solvers.grid_size import SizeRule
from mitsuba_irrcache.transport.path import Media

#: Callback (done, total), in voxels times samples per voxel; a sample is a path in ``path``, and a
#: direction in ``sweep``.
Progress = Callable[[int, int], None]


def _no_pause() -> None:
    """Do nothing."""


@dataclass(frozen=True, eq=False)
class SolverTask:
    """Input of a solver.

    Attributes:
        scene: Mitsuba's scene.
        description: result of `compile_scene` for this scene.
        medium: one of its visible media.
        cache: the cache of this medium that the solver fills.
        seed: seed of the random stream.
        rr_depth: depth above which Russian roulette ends paths.
        pause: called often between kernel launches; if it raises, the batch in progress is lost.
    """

    scene: mi.Scene
    description: SceneDescription
    medium: MediumGrid
    cache: IrradianceCache
    seed: int = 0
    rr_depth: int = 5
    pause: Callable[[], None] = _no_pause


class Preview(ABC):
    """The first two batches of a cache while they are incomplete, for early images."""

    size: int  #: samples of each batch so far

    @abstractmethod
    def grow(self, size: int, progress: Progress | None = None) -> None:
        """Add samples until there are ``size`` in each batch."""

    @abstractmethod
    def fill(self, cache: IrradianceCache) -> None:
        """Store both batches in an empty ``cache`` for batches of this size."""


class Solver(ABC):
    """Computes the values of a cache. Methods needed before the cache exists are class methods."""

    #: value of the integrator's property ``solver``
    name: ClassVar[str]
    #: order in which ``auto`` tries solvers, low numbers first; the default is after ``sweep`` and
    #: before ``path``, which supports all scenes
    precedence: ClassVar[int] = 50
    #: rule for the grid of a cache with ``resolution`` 0
    size_rule: ClassVar[SizeRule]
    #: whether all voxels share their samples, and so their errors
    is_correlated: ClassVar[bool] = False
    #: whether one instance is kept for all samples, because it holds tables that take long to
    #: build, see `use`; other instances are released after each call, and so is the scene
    is_kept: ClassVar[bool] = False
    #: whether the first batches may be rendered while they are incomplete, see `preview`
    has_preview: ClassVar[bool] = False
    #: whether it supports media with delta-M scaling (see `delta_m`)
    supports_delta_m: ClassVar[bool] = False
    #: whether gradients of its irradiance are computed, see `gradients`
    has_gradients: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def why_not(
        cls, scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
    ) -> str | None:
        """Return why it does not support ``medium`` in its scene; None if it does."""

    @classmethod
    def weakness(cls, scene: mi.Scene, medium: MediumGrid, max_depth: int) -> str | None:
        """Return why it supports ``medium`` in its scene but is inaccurate; None if it is not.

        ``auto`` tries other solvers then.
        """
        return None

    @classmethod
    @abstractmethod
    def why(cls, medium: MediumGrid) -> str:
        """Return why ``auto`` chooses it for ``medium`` if it is the first candidate."""

    @classmethod
    @abstractmethod
    def default_samples(cls, medium: MediumGrid, max_depth: int, active_count: int) -> int:
        """Return the default number of samples per voxel for this number of active voxels."""

    @classmethod
    @abstractmethod
    def batch_size(
        cls, medium: MediumGrid, max_depth: int, samples: int, basis: AngularBasis | None
    ) -> int:
        """Return the samples per batch of a cache with ``samples`` per voxel (0: the default).

        It must be `cache.statistics.BATCH`, which cache files require, unless it `is_correlated`.
        """

    @classmethod
    @abstractmethod
    def numbers_per_voxel(
        cls, medium: MediumGrid, max_depth: int, moments: int, voxels: int, channels: int
    ) -> int:
        """Return how many float32 values per voxel are needed to fill a cache."""

    @classmethod
    def cost(cls, medium: MediumGrid, active_count: int, samples: int) -> float:
        """Return the cost of a cache with ``samples`` in each active voxel, in paths of ``volpath``
        that take the same processor time: a lower estimate, or 0 if ``volpath`` is never faster.
        """
        return 0.0

    @classmethod
    def active_voxels(cls, scene: mi.Scene, medium: MediumGrid, grid: Grid) -> mi.UInt32:
        """Return the ascending flat indices of the voxels of ``grid`` that need values, if surfaces
        are ignored: those that lookups in ``medium`` can read, at least.
        """
        return active_voxels(medium, grid)

    @classmethod
    def voxel_classes(
        cls, scene: mi.Scene, media: Media, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> VoxelClasses | None:
        """Classify the voxels of ``grid``; return None if there are no surfaces among them.

        ``active`` are the flat indices of the voxels that lookups in the medium can read.
        """
        return None

    @classmethod
    def knows_direct_lights(
        cls, scene: mi.Scene, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> bool:
        """Return whether the uncollided irradiance includes exactly that of each direct light.

        Lookups subtract it, and camera rays evaluate it in closed form. Otherwise the cache gets no
        direct lights.
        """
        return False

    @classmethod
    def batches_at_once(cls, cache: IrradianceCache) -> int:
        """Return the maximum number of batches that `refine` adds to ``cache`` at once.

        Machines that compute that many batches each, appended in order, give the same bits as one.
        """
        return 1

    @abstractmethod
    def __init__(self, task: SolverTask) -> None: ...

    @abstractmethod
    def refine(self, samples: int, progress: Progress | None = None) -> None:
        """Add ``samples`` per voxel, a multiple of the cache's batch.

        The random stream continues after the samples already in the cache. If ``progress`` raises,
        complete batches remain in the cache.
        """

    @property
    def direction_noise(self) -> float:
        """Noise of the irradiance due to directions that neighbouring voxels share: its root mean
        square over the mean; 0 if unknown.
        """
        return 0.0

    def use(self, scene: mi.Scene | None) -> None:  # noqa: B027 (most hold nothing)
        """Set the scene for `refine`; None: release it.

        A scene references its integrator, which references a kept solver. If the solver referenced
        the scene between calls, none of them would be freed: Python's garbage collection does not
        see references within Mitsuba.
        """

    def preview(self) -> Preview:
        """Return a `Preview` without samples; only for solvers with `has_preview`."""
        raise NotImplementedError


_REGISTRY: dict[str, type[Solver]] = {}


def register(solver: type[Solver]) -> type[Solver]:
    """Register a solver by its name."""
    if solver.name in _REGISTRY or solver.name == "auto":
        raise ValueError(f'there is a solver "{solver.name}" already')
    _REGISTRY[solver.name] = solver
    return solver


def registered() -> tuple[type[Solver], ...]:
    """Return all solvers in the order in which ``auto`` tries them."""
    return tuple(sorted(_REGISTRY.values(), key=lambda solver: solver.precedence))


def solver_named(name: str) -> type[Solver]:
    """Return the solver of this name; raise IrrcacheError if there is none."""
    if name not in _REGISTRY:
        known = ("auto", *(solver.name for solver in registered()))
        names = ", ".join(f'"{each}"' for each in known)
        raise IrrcacheError(f'irrcache: there is no solver "{name}"; set solver to one of {names}.')
    return _REGISTRY[name]
