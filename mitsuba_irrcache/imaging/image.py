"""The image: camera samples on the film, its layers and AOVs, and the composition of the result."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.imaging.options import Options
from mitsuba_irrcache.render.aovs import AOVS, Layers
from mitsuba_irrcache.render.camera import CameraRays, TracedCameraRays
from mitsuba_irrcache.render.denoise import filter_illumination
from mitsuba_irrcache.render.film import check_film, fill_film, planes, render_film
from mitsuba_irrcache.scene.consistency import check_sensor


class ImageRenderer:
    """Renders films with the AOVs and the filter of ``options``."""

    def __init__(self, options: Options) -> None:
        self._layered, self._aovs = options.rays.layered, options.aovs
        self._filter = options.illumination_filter
        #: duration [s] of the measured stages of the last image, by name
        self.seconds: dict[str, float] = {}

    def aov_names(self) -> list[str]:
        """Return the names of the channels in addition to colour and alpha, in the film's order."""
        return [f"{name}.{c}" for name, kind in self._aovs.items() for c in AOVS[kind]]

    def aov_values(self, layers: Layers | None) -> list[mi.Float]:
        """Return the values of the channels `aov_names`."""
        return [value for kind in self._aovs.values() for value in layers.aov(kind)]

    def sample(
        self,
        camera_rays: CameraRays,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        medium: mi.Medium | None,
        weight: mi.Spectrum,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Float, Layers | None]:
        """Return radiance times ``weight``, alpha, and the layers of the radiance if required.

        Raises UnsupportedSceneError if rays start in a ``medium`` without a cache.
        """
        if isinstance(medium, mi.Medium):  # not an array of pointers to media
            _check_medium(camera_rays, medium, "rays start")
        view = camera_rays.sample(scene, sampler, mi.Ray3f(ray), medium, active)
        layers = None
        if self._layered:
            layers = camera_rays.projection.layers(
                view.scattered, view.transmittance, view.gathered, view.background, weight
            )
        return (view.scattered + view.background) * weight, view.alpha, layers

    def render(
        self,
        camera_rays: CameraRays,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: int,
        spp: int,
        should_stop: Callable[[], bool],
    ) -> mi.Film:
        """Render the film of ``sensor``."""
        medium = sensor.get_medium()
        check_sensor(scene, sensor)  # the sensor may have moved, or may not belong to the scene
        if medium is not None:
            _check_medium(camera_rays, medium, f'sensor "{sensor.id()}" is')

        def radiance(sampler, ray, weight, active) -> tuple:
            found = self.sample(camera_rays, scene, sampler, ray, medium, weight, active)
            return *found[:2], found[2].channels() if found[2] else []

        count = camera_rays.projection.channel_count
        names = [f"layer.{i}" for i in range(count)]
        refine = isinstance(camera_rays, TracedCameraRays) and camera_rays.caches_surfaces
        film = render_film(sensor, radiance, seed, spp, should_stop, names, refine)
        if not count:
            return film
        _, alpha, channels = planes(film, count)
        self._finish(film, Layers.of(channels), alpha)
        return film

    def render_stock(
        self, stock: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int
    ) -> mi.Film:
        """Render a scene without a visible medium with Mitsuba's integrator ``stock``.

        In AOVs its radiance counts as background.
        """
        film = sensor.film()
        check_film(film, spp or sensor.sampler().sample_count(), 0, at_once=True)
        stock.render(scene, sensor, seed, spp)
        if self._aovs:
            colour, alpha, _ = planes(film, 0)
            channels = (colour * 3)[: dr.size_v(mi.Spectrum)]
            self._finish(film, Layers.background_only(mi.Spectrum(*channels)), alpha)
        return film

    def render_instead(
        self, stock: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int
    ) -> mi.Film:
        """Render a scene with a visible medium with Mitsuba's integrator ``stock``.

        The sampler keeps its number of samples, which ``spp`` may exceed.
        """
        check_sensor(scene, sensor)
        sampler = sensor.sampler()
        requested = sampler.sample_count()
        try:
            stock.render(scene, sensor, seed, spp)
        finally:
            sampler.set_sample_count(requested)
        return sensor.film()

    def _finish(self, film: mi.Film, layers: Layers, alpha: mi.Float | None) -> None:
        """Filter the layers, compose the image, and record the duration."""
        if self._filter != "none":
            dr.eval(layers)
            dr.sync_thread()
        started = perf_counter()
        filtered = filter_illumination(self._filter, layers, film.crop_size())
        if filtered is not None:
            dr.eval(filtered)
            dr.sync_thread()
        self.seconds = {"filter": perf_counter() - started}
        aovs = dict(zip(self.aov_names(), self.aov_values(layers), strict=True))
        fill_film(film, layers.radiance(filtered), alpha, aovs)


def _check_medium(camera_rays: CameraRays, medium: mi.Medium, what: str) -> None:
    """Raise UnsupportedSceneError if rays cannot start in ``medium``; ``what`` begins a clause."""
    if not camera_rays.shows(medium):
        raise UnsupportedSceneError(
            f'irrcache: {what} in medium "{medium.id()}", which is rendered for none of the '
            "sensors of the scene and has no cache. Add the sensor to the scene, or render this "
            'image with "volpath".'
        )
