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
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.solvers.grid_size import SizeRule
from mitsuba_irrcache.transport.path import Media

#: called with (samples done, samples in all), both in voxels times samples, which are directions in
#: ``sweep``
Progress = Callable[[int, int], None]


def _no_pause() -> None:
    """Do nothing."""


@dataclass(frozen=True, eq=False)
class SolverTask:
    """Input of a solver.

    Attributes:
        scene: Mitsuba's scene.
        description: what `compile_scene` found in it.
        medium: one of its visible media.
        cache: the cache over this medium that is to be filled.
        seed: number of the random stream.
        rr_depth: depth from which Russian roulette ends paths.
        pause: called often between kernel launches; what it raises ends the work on a batch.
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
    """Fills a cache. Methods that are needed before the cache exists are class methods."""

    #: value of the integrator's property ``solver``
    name: ClassVar[str]
    #: place among the candidates of ``auto``, which tries low numbers first: by default after
    #: ``sweep`` and before ``path``, which supports all scenes
    precedence: ClassVar[int] = 50
    #: voxels of a cache with ``resolution`` 0
    size_rule: ClassVar[SizeRule]
    #: whether all voxels share their samples, and so their errors
    is_correlated: ClassVar[bool] = False
    #: whether one instance should be kept for all samples, since it holds tables that take a while
    #: to be made, see `use`; the others do not outlive a call, so that they do not hold the scene
    is_kept: ClassVar[bool] = False
    #: whether the first batches may be shown while they are incomplete, see `preview`
    has_preview: ClassVar[bool] = False
    #: whether it solves for media with delta-M scaling (see `delta_m`)
    supports_delta_m: ClassVar[bool] = False
    #: whether it finds emitters behind glass by chance only, as ``volpath`` does
    finds_refracted_by_chance: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def why_not(
        cls, scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
    ) -> str | None:
        """Return why it does not support ``medium`` in its scene; None if it does."""

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
        """Return the samples per batch of a cache with ``samples`` per voxel (0: the default)."""

    @classmethod
    @abstractmethod
    def numbers_per_voxel(
        cls, medium: MediumGrid, max_depth: int, moments: int, voxels: int, channels: int
    ) -> int:
        """Return how many float32 values per voxel are needed to fill a cache."""

    @classmethod
    def voxel_classes(
        cls, scene: mi.Scene, media: Media, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> VoxelClasses | None:
        """Classify the voxels of ``grid``, of which lookups in the medium read the ``active`` ones;
        None if there cannot be surfaces among them.
        """
        return None

    @classmethod
    def knows_direct_lights(
        cls, scene: mi.Scene, medium: MediumGrid, grid: Grid, active: mi.UInt32
    ) -> bool:
        """Whether the uncollided layer holds, for each of ``cache.direct_lights``, exactly its
        ``irradiance``, which lookups subtract.

        Otherwise the cache gets no direct lights.
        """
        return False

    @classmethod
    def batches_at_once(cls, cache: IrradianceCache) -> int:
        """Return how many batches `refine` adds to ``cache`` at once, at most: several machines
        that compute so many each can give the same bits as one.
        """
        return 1

    @abstractmethod
    def __init__(self, task: SolverTask) -> None: ...

    @abstractmethod
    def refine(self, samples: int, progress: Progress | None = None) -> None:
        """Add ``samples`` per voxel, a multiple of the cache's batch.

        The random stream goes on where it stopped. If ``progress`` raises, batches that are
        complete stay in the cache.
        """

    def use(self, scene: mi.Scene | None) -> None:  # noqa: B027 (most hold nothing)
        """Refine in this ``scene`` from now on; hold none between calls, where it is None.

        A scene holds its integrator, and that a kept solver. If this held the scene, neither would
        ever be freed: garbage collection does not see references within Mitsuba.
        """

    def preview(self) -> Preview:
        """Return the first two batches without samples, if it `has_preview`."""
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
