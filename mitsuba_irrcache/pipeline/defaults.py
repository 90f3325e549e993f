"""Defaults for properties left unset: the solver, and the integrator of scenes without a cache."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.clear_channels import extinction_by_channel
from mitsuba_irrcache.errors import IrrcacheError, UnsupportedSceneError
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.compile import media_of
from mitsuba_irrcache.solvers import half_space
from mitsuba_irrcache.solvers.base import Solver, registered, solver_named
from mitsuba_irrcache.solvers.grid_size import (
    REQUESTED,
    TARGET_ERROR,
    border_error,
    choose_grid,
)
from mitsuba_irrcache.solvers.sweep import SweepSolver

#: Ratio of the largest to the smallest channel of the extinction above which ``volpathmis`` needs
#: less time than ``volpath`` for the same error. Measured on a glass ball filled with fog: 1.4
#: times as much time at 1 : 1.5, 0.8 times at 1 : 2, 0.6 times at 1 : 3, a fortieth at 1 : 10.
CHROMATIC = 1.8


def choose_stock(scene: mi.Scene) -> tuple[str, str]:
    """Choose Mitsuba's integrator for a scene without a cache; also return the reason."""
    media = {*media_of(scene)}
    if not media:
        return "volpath", "there is no medium"
    ratio = max(_chromaticity(extinction_by_channel(scene, medium)) for medium in media)
    if ratio > CHROMATIC:
        return "volpathmis", f"extinction differs between the channels, 1 : {ratio:.2g}"
    return "volpath", "extinction is about the same in all channels"


def _chromaticity(sums: np.ndarray) -> float:
    """Return the ratio of the largest to the smallest channel of an extinction."""
    return float(sums.max() / max(sums.min(), 1e-6 * sums.max())) if sums.max() > 0 else 1.0


def choose_solver(
    scene: mi.Scene, medium: MediumGrid, solver: str, max_depth: int = -1, resolution: int = 0
) -> tuple[type[Solver], str]:
    """Choose the solver for a ``medium`` of a scene; also return the reason.

    ``solver`` is a name, or ``auto`` for the first one, by `Solver.precedence`, that supports the
    medium and is accurate. Raises IrrcacheError if the named solver does not support it, or if none
    does.
    """
    candidates = registered() if solver == "auto" else (solver_named(solver),)
    reasons, inaccurate = [], []
    for candidate in candidates:
        reason = candidate.why_not(scene, medium, max_depth, resolution)
        if reason is None:
            refuses_peak = medium.phase.forward and not candidate.supports_delta_m
            if inaccurate and refuses_peak:
                continue
            reason = candidate.weakness(scene, medium, max_depth)
            if reason is None:
                chosen = candidate
                break
            inaccurate.append((candidate, reason))
        reasons.append(reason)
    else:
        chosen = None
    if chosen is None and inaccurate:
        (chosen, weakness), *_ = inaccurate
        _warn_of_weakness(medium, chosen, weakness)
        reasons = []
    if chosen is None:
        names = " nor ".join(f'"{candidate.name}"' for candidate in candidates)
        raise IrrcacheError(
            f"irrcache: solver {names} cannot be used in this scene, since "
            f'{", and ".join(reasons)}; set solver to "path" or "auto".'
        )
    reason = REQUESTED if solver != "auto" else " and ".join(reasons)
    reason = reason or chosen.why(medium)
    if medium.phase.forward:
        _check_forward_peak(medium, chosen, reason, max_depth)
    return chosen, reason


def _warn_of_weakness(medium: MediumGrid, solver: type[Solver], weakness: str) -> None:
    """Log that a solver is inaccurate in this scene, and no other one is used."""
    remedy = "" if medium.phase.forward else ', or set solver to "path"'
    mi.Log(
        mi.LogLevel.Warn,
        f'irrcache: solver "{solver.name}" is inaccurate for medium "{medium.name}", since '
        f"{weakness}: the image depends on cache_seed. Raise cache_spp{remedy}.",
    )


def _check_forward_peak(
    medium: MediumGrid, solver: type[Solver], reason: str, max_depth: int
) -> None:
    """Raise UnsupportedSceneError for a medium whose delta-M scaling cannot be used.

    It cannot be used if the ``solver``, chosen for ``reason``, does not support it, or if
    ``max_depth`` limits the orders of scattering, because scattering into the forward peak does not
    count as an order.
    """
    cosine = medium.phase.forward + (1 - medium.phase.forward) * float(medium.phase.moments[1])
    sharp = f'irrcache: medium "{medium.name}" scatters sharply, with a mean cosine of {cosine:.2f}'
    remedy = 'make it broader, or render this scene with "volpath"'
    if not solver.supports_delta_m:
        why = REQUESTED if reason == REQUESTED else f"since {reason}"
        remedy = f'set solver to "auto", {remedy}' if reason == REQUESTED else remedy
        raise UnsupportedSceneError(
            f'{sharp}, too sharply for the solver "{solver.name}", which is used, {why}; {remedy}.'
        )
    if max_depth >= 0:
        raise UnsupportedSceneError(
            f"{sharp}: for such media only the sum of all orders can be computed, not max_depth "
            f"{max_depth}; set max_depth to -1, {remedy}."
        )


def needs_no_cache(
    scene: mi.Scene, medium: MediumGrid, max_depth: int, resolution: int
) -> str | None:
    """Return why `HalfSpace` is more accurate than a cache for ``medium``.

    Returns None if it is not more accurate, or if ``resolution`` is set, which requests a cache.
    """
    if resolution or max_depth > half_space.MOST_ORDERS:
        return None
    error = half_space.series_error(medium)
    if not np.isfinite(error) or not half_space.supports_emitters(scene):
        return None
    if not half_space.is_seen_from_outside(scene, medium):
        return None
    error *= max_depth != 2  # single scattering is exact
    grid, _ = choose_grid(medium, 0, SweepSolver.size_rule)
    depth = medium.sigma_t.maximum * grid.voxel_size.max()
    cached = border_error(medium, grid, max_depth)
    if cached <= max(error, 1.2 * TARGET_ERROR):
        return None
    return (
        f"opaque (optical depth {depth:.2g} per voxel of a cache, which would cause an error of "
        f"about {min(cached, 100):.0f} % instead of {error:.1f} %)"
    )
