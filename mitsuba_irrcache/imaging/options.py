"""The properties of the integrator, read and checked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core import properties
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.out_of_core.volume_settings import VolumeSettings
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings
from mitsuba_irrcache.render.aovs import parse_aovs
from mitsuba_irrcache.render.camera import CameraRays, camera_rays_of
from mitsuba_irrcache.render.denoise import FILTERS
from mitsuba_irrcache.render.quadrature import QUADRATURES
from mitsuba_irrcache.render.tolerance import SCALES, ToleranceSearch
from mitsuba_irrcache.solvers.base import registered

#: Properties that state how a cache is computed, looked up, filtered or stored.
OF_CACHES = (
    "resolution", "cache_spp", "cache_seed", "cache_file", "quadrature", "step", "filter", "aovs",
)  # fmt: skip
#: Default ``rr_depth`` of Mitsuba's integrators instead of a cache. In bright media behind glass
#: the product of time and variance is 1.5 to 35 times as large with 5.
STOCK_RR_DEPTH = 50
SOLVERS = ("auto", *sorted(solver.name for solver in registered()))


@dataclass(frozen=True)
class RayOptions:
    """Properties of camera rays that do not depend on the caches; see `camera_rays_of`."""

    hide_emitters: bool
    quadrature: str
    step: float
    layered: bool = False
    with_error: bool = False

    def camera_rays(self, builder: CacheBuilder, step: float) -> CameraRays | None:
        """Create the camera rays for the caches of ``builder``; None if no medium is visible."""
        return camera_rays_of(
            builder.parts,
            builder.settings,
            self.hide_emitters,
            self.quadrature,
            step,
            self.layered,
            self.with_error,
        )


@dataclass(frozen=True)
class Tolerance:
    """Largest error of the image, relative to the mean radiance of ``unit`` (``tolerance_of``)."""

    error: float
    unit: str
    #: the step of camera rays if the user set it; None: the search chooses it
    step: float | None


@dataclass(frozen=True)
class Options:
    """All properties of the integrator; see the plugin's documentation. None: not set."""

    settings: CacheSettings
    rays: RayOptions
    aovs: dict[str, str]
    illumination_filter: str
    emission: object
    emission_scale: float
    timeout: float
    tolerance: Tolerance | None
    volume: VolumeSettings | None
    #: ``rr_depth`` of Mitsuba's integrators if they render a scene with a visible medium
    stock_rr_depth: int
    #: whether an image may be rendered by another integrator if that is faster
    may_use_stock: bool

    @classmethod
    def of(cls, props: properties.RecordedProperties) -> Options:
        """Read ``props``; raise IrrcacheError if one is invalid or misspelt, or two exclude each
        other.
        """
        max_depth = properties.integer(props, "max_depth", -1, -1, "-1 (all orders) or at least 0")
        hide_emitters = properties.flag(props, "hide_emitters", False)
        illumination_filter = properties.choice(props, "filter", "none", FILTERS)
        aovs = parse_aovs(properties.text(props, "aovs"))
        with_error = illumination_filter == "bilateral" or bool(
            {"noise", "bias"} & {*aovs.values()}
        )
        settings = CacheSettings(
            max_depth=max_depth,
            rr_depth=properties.integer(props, "rr_depth", 5, 1, "at least 1"),
            solver=properties.choice(props, "solver", "auto", SOLVERS),
            resolution=properties.integer(
                props, "resolution", 0, 0, "0 (chosen) or a number of voxels"
            ),
            samples=properties.integer(
                props, "cache_spp", 0, 0, "0 (chosen) or a number of samples"
            ),
            seed=properties.integer(props, "cache_seed", 0, 0, "at least 0"),
            file=properties.file_name(props, "cache_file"),
            with_error=with_error,
        )
        rays = RayOptions(
            hide_emitters,
            properties.choice(props, "quadrature", "exponential", QUADRATURES),
            properties.number(props, "step", 1.0, 1e-3, 1e3, "between 0.001 and 1000 voxel edges"),
            layered=bool(aovs) or illumination_filter != "none",
            with_error=with_error,
        )
        emission = props.get("emission", None)
        largest = float(np.finfo(np.float32).max)
        emission_scale = properties.number(
            props, "emission_scale", 1.0, 0.0, largest, "a finite number that is not negative"
        )
        timeout = properties.number(
            props, "timeout", -1.0, -1.0, 1e9, "a number of seconds, or -1 for none"
        )
        tolerance = _tolerance(props, settings, rays)
        volume = VolumeSettings.of(props)
        properties.refuse_misspelt(props.wrapped, props.values)
        image = aovs, illumination_filter
        cached = tolerance is not None or emission is not None or volume is not None
        may_use_stock = not (cached or settings.solver != "auto" or requests_cache(props.wrapped))
        return cls(
            settings,
            rays,
            *image,
            emission,
            emission_scale,
            timeout,
            tolerance,
            volume,
            settings.rr_depth if "rr_depth" in props.wrapped else STOCK_RR_DEPTH,
            may_use_stock,
        )

    def builder(self, settings: CacheSettings) -> CacheBuilder:
        """Create a builder of caches with other ``settings``."""
        return CacheBuilder(settings, self.emission, self.emission_scale)

    def tolerance_search(self) -> ToleranceSearch | None:
        """Create the search for settings that meet the ``tolerance``, None without one."""
        if self.tolerance is None:
            return None
        radiance = replace(self.rays, layered=False, with_error=False)
        return ToleranceSearch(
            self.tolerance.error,
            self.tolerance.unit,
            self.settings,
            self.tolerance.step,
            self.builder,
            radiance.camera_rays,
        )


def requests_cache(props: mi.Properties) -> bool:
    """Return whether any property is set that only has a meaning for a cache."""
    return any(name in props for name in OF_CACHES)


def _tolerance(
    props: properties.RecordedProperties, settings: CacheSettings, rays: RayOptions
) -> Tolerance | None:
    error = properties.number(props, "tolerance", 0.0, 0.0, 1.0, "between 0 (none) and 1")
    unit = properties.choice(props, "tolerance_of", "image", SCALES)
    if not error:
        return None
    if settings.file:
        raise IrrcacheError(
            "irrcache: tolerance chooses the resolution anew for every view, so it cannot be "
            "combined with cache_file; set resolution and cache_spp for a cache in a file."
        )
    return Tolerance(error, unit, rays.step if "step" in props.wrapped else None)
