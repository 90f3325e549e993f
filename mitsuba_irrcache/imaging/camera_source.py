"""Provide camera rays for the current state of a scene, after completing its caches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.cancellation import StopCondition, Stopped
from mitsuba_irrcache.core.clear_channels import medium_with_clear_channel, warn_of_clear_channel
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.imaging.options import Options
from mitsuba_irrcache.imaging.stock import StockIntegrators
from mitsuba_irrcache.imaging.stock_estimate import StockImage, cheaper_stock_image
from mitsuba_irrcache.pipeline.builder import Progress
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.camera import CameraRays, ClosedFormCameraRays, TracedCameraRays
from mitsuba_irrcache.render.certificate import Certificate
from mitsuba_irrcache.scene.consistency import check_sensor

# few volumes stay in files: these modules are imported on use
if TYPE_CHECKING:
    from mitsuba_irrcache.out_of_core.rendering import MappedMedium


#: Revision that no builder has: camera rays are created anew.
NO_REVISION = -1


class CameraRaySource:
    """Creates the camera rays for a scene, and reuses them while its caches do not change.

    Media and caches are those of ``builder``; with the property ``tolerance``, those that the
    search finds for a view; with ``sigma_t_file``, those of the volume in that file. For scenes
    without a visible medium there are no camera rays, and ``stock`` chooses one of Mitsuba's
    integrators; for those where one of these is faster, ``faster`` does. ``stopping`` ends the
    construction of a cache early.
    """

    def __init__(
        self,
        options: Options,
        stopping: StopCondition,
        stock: StockIntegrators,
        faster: StockIntegrators,
    ) -> None:
        self._options, self._stopping = options, stopping
        self._stock, self._faster = stock, faster
        self.builder = options.builder(options.settings)
        self._search = options.tolerance_search()
        self._step = options.rays.step  # replaced by the step that the search finds
        #: the medium whose extinction is in a file
        self.mapped: MappedMedium | None = None
        if options.volume is not None:
            from mitsuba_irrcache.out_of_core.rendering import MappedMedium

            whole = not (self._search or options.rays.layered or options.emission is not None)
            self.mapped = MappedMedium(options.settings, options.volume, whole)
        #: estimated error of the last image with a ``tolerance``
        self.certificate: Certificate | None = None
        #: camera rays of the last scene whose caches are in memory
        self.latest: CameraRays | None = None
        self._parts: list[CachedMedium] | None = None  # the media of `latest`
        self._revision = 0  # revision of the builder for which `latest` was created
        # Paths of images that were rendered without the caches of these media.
        self._without_caches: tuple[list[CachedMedium] | None, float] = None, 0.0

    @property
    def depends_on_view(self) -> bool:
        """Whether caches are chosen anew for every view."""
        return self._search is not None

    def refuse_tolerance(self, reason: str) -> None:
        """Raise an error if settings are searched for."""
        if self._search is not None:
            raise IrrcacheError(
                f"irrcache: tolerance cannot be used here, since {reason}; set resolution, "
                "cache_spp and step instead."
            )

    def refuse_mapped(self, what: str) -> None:
        """Raise an error if the extinction of the medium is in a file."""
        if self.mapped is not None:
            raise IrrcacheError(
                f"irrcache: {what} is not supported for a medium in sigma_t_file; remove "
                "sigma_t_file, and reduce the volume to one that fits into memory."
            )

    def meet_tolerance(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: int, progress: Progress | None
    ) -> int:
        """Choose cache and step for an image of ``sensor``; return the samples per pixel.

        The timeout starts here, for search and image together. If it ends the search, the finest
        cache found so far is used.
        """
        check_sensor(scene, sensor)
        try:
            found = self._search.find(scene, sensor, spp, seed, self._begin(progress))
        except Stopped:
            self.certificate = None
            finest = self._search.finest
            if finest is not None:
                self.builder.adopt(finest)
            mi.Log(
                mi.LogLevel.Warn,
                "irrcache: stopped before the error of the image was estimated; the tolerance is "
                "not guaranteed.",
            )
            return spp
        before, is_step_new = self.certificate, found.step != self._step
        self._step, self.certificate = found.step, found.certificate
        self.builder.adopt(found.builder)
        rays = self._options.rays
        if found.camera_rays is not None and not (rays.layered or rays.with_error):
            self.latest, self._parts = found.camera_rays, self.builder.parts
            self._revision = self.builder.revision
        elif is_step_new:
            self._revision = NO_REVISION  # the same cache is ray marched with other steps
        if self.certificate is not before:
            exceeded = self.certificate.parts and not self.certificate.is_met
            level = mi.LogLevel.Warn if exceeded else mi.LogLevel.Info
            mi.Log(level, f"irrcache: {self.certificate}.")
        return found.spp

    def camera_rays(self, scene: mi.Scene, progress: Progress | None) -> CameraRays | None:
        """Return the camera rays for the cache of ``scene``; None if no medium is visible."""
        with self.builder.lock:
            if self._search is None:
                progress = self._begin(progress)
            else:  # started by `meet_tolerance`
                progress = self._stopping.raising(progress)
            if self.mapped is not None:
                return self._mapped_camera_rays(scene, progress)
            try:
                with dr.suspend_grad():
                    self.builder.update(scene, progress)
            except Stopped:
                self._log_what_is_missing()
            if self._revision != self.builder.revision:
                self._renew(scene)
            return self.latest

    def cheaper_stock_image(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int
    ) -> StockImage | None:
        """Return the image by one of Mitsuba's integrators that is estimated to be faster than to
        build the caches first; None if none is, if caches exist, or if the user requests them.
        """
        builder, stock = self.builder, self._faster
        if not self._options.may_use_stock or builder.samples:
            return None
        with builder.lock, dr.suspend_grad():
            builder.fit(scene)
            parts = builder.parts
            if not parts or builder.carries_gradients or not builder.is_untouched:
                return None
            stock.choose(scene)
            spent = self._without_caches[1] if self._without_caches[0] is parts else 0.0
            spp = spp or sensor.sampler().sample_count()
            image = cheaper_stock_image(scene, sensor, spp, parts, stock.chosen, spent)
            # Few images are cheaper, so that only few scenes are searched for such a medium.
            if image is not None and medium_with_clear_channel(scene) is not None:
                return None
            return image

    def note_stock_image(self, image: StockImage) -> None:
        """Log that ``image`` is rendered without caches, and count its paths: after some such
        images, caches are estimated to be faster.
        """
        parts, (counted, spent) = self.builder.parts, self._without_caches
        self._without_caches = parts, image.paths + (spent if counted is parts else 0.0)
        names = " or ".join(sorted({f'"{part.solver.name}"' for part in parts}))
        mi.Log(
            mi.LogLevel.Info,
            f"irrcache: {self._faster.name} renders this image, which is estimated to be faster "
            f"than to build a cache: {image}. If more images of the scene follow, a cache will be "
            f"built. Set solver to {names} to build it now.",
        )

    def _begin(self, progress: Progress | None) -> Progress:
        """Start the timeout; return a ``progress`` that raises `Stopped` when it expires."""
        self._stopping.begin(self._options.timeout)
        return self._stopping.raising(progress)

    def _mapped_camera_rays(self, scene: mi.Scene, progress: Progress) -> ClosedFormCameraRays:
        options = self._options.rays
        try:
            with dr.suspend_grad():
                return self.mapped.camera_rays(
                    scene, options.hide_emitters, options.quadrature, options.step, progress
                )
        except Stopped:
            raise IrrcacheError(
                "irrcache: stopped before the irradiance of the medium in sigma_t_file was "
                "complete, so there is no image; raise timeout, or lower cache_spp."
            ) from None

    def _renew(self, scene: mi.Scene) -> None:
        """Create the camera rays for the current caches of ``scene``."""
        parts = self.builder.parts
        earlier, is_same_scene = self.latest, self._parts is parts
        self.latest = self._options.rays.camera_rays(self.builder, self._step)
        if is_same_scene and isinstance(earlier, TracedCameraRays):
            self.latest.adopt(earlier)
        self._parts = parts
        # Only the thread that recorded a scatter operation can evaluate it.
        dr.eval()
        self._revision = self.builder.revision
        if self.latest is None:
            reason = self._stock.choose(scene)
            mi.Log(
                mi.LogLevel.Info,
                "irrcache: no medium is visible, so no cache is used: "
                f"{self._stock.name} renders this scene ({reason}).",
            )
            warn_of_clear_channel(scene, self._stock.name)

    def _log_what_is_missing(self) -> None:
        done, target = self.builder.done, self.builder.target
        if done < target:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: stopped with {done} of {target} samples per voxel in the cache. The "
                "next rendering completes them.",
            )
