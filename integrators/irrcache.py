"""The integrator plugin ``irrcache``.

This file is executed once for every variant, because its base class differs between variants.
"""

from __future__ import annotations

import html
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from weakref import ref

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core import properties
from mitsuba_irrcache.core.cancellation import StopCondition
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.parameters import enabled
from mitsuba_irrcache.imaging.camera_source import CameraRaySource
from mitsuba_irrcache.imaging.image import ImageRenderer
from mitsuba_irrcache.imaging.options import Options
from mitsuba_irrcache.imaging.stock import StockIntegrators
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.machine.variants import require_same_variant, require_variant
from mitsuba_irrcache.machine.versions import require_versions
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.pipeline.progressive import Frame, Targets, frames
from mitsuba_irrcache.render.aovs import Layers
from mitsuba_irrcache.render.camera import CameraRays, TracedCameraRays
from mitsuba_irrcache.render.certificate import Certificate
from mitsuba_irrcache.render.film import check_film, exclusive
from mitsuba_irrcache.scene.clearance import SeparatedScene

if TYPE_CHECKING:  # most programs compute no gradients: their modules are imported on use
    from mitsuba_irrcache.gradients.backward import ParameterAdjoint
    from mitsuba_irrcache.gradients.operations import SharedIrradiance
    from mitsuba_irrcache.gradients.traced import TracedAdjoint
    from mitsuba_irrcache.out_of_core.rendering import MappedMedium


class IrradianceCachingIntegrator(mi.SamplingIntegrator):
    r""".. _integrator-irrcache:

    Irradiance caching for participating media (:monosp:`irrcache`)
    ---------------------------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path depth, as in ``volpath``: 1 shows emitters through the medium, 2 adds single
         scattering, -1 all orders. (Default: -1)

     * - rr_depth
       - |int|
       - Depth from which paths of the solver ``path``, and paths between surfaces, are ended by
         Russian roulette. Images that ``volpath`` renders instead of a cache (see ``solver``) use
         50 unless it is set. (Default: 5)

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no, i.e. |false|)

     * - solver
       - |string|
       - How the cache is computed: ``sweep`` (discrete ordinates along long characteristics that
         all voxels share), ``path`` (Monte Carlo path tracing from every voxel), or ``auto``:
         ``sweep`` wherever it supports the scene (see below). The log states the choice
         and its reason. Whatever the solver, an opaque homogeneous medium without a ``resolution``
         has no cache but is treated as a half-space. With ``auto``, and no other property of
         caches set, ``volpath`` renders an image that it is estimated to need less time for at the
         same error, such as a small one of a medium in glass of an irregular shape. It then takes
         as many samples per pixel as this error needs, at least those requested, and after a few
         such images the cache is built. (Default: ``auto``)

     * - resolution
       - |int|
       - Cache voxels along the longest side of the medium, near-cubic whatever its data. 0: chosen
         for an estimated error of 0.5 % of the mean radiance (``path``: 1 %) from the data, their
         optical depth and the emitters, at least 32 (``path``: 16) and at most 2^25 voxels in total
         (2^21 with anisotropic scattering; ``path``: 128 along a side, 32 to 64 with surfaces or
         several media). The log states the rule that decided; the how-to page lists all. An opaque
         homogeneous medium in a box or sphere has no cache unless this is set: its radiance is that
         of a half-space. (Default: 0)

     * - tolerance
       - |float|
       - Largest error (RMSE) of the image, in units of its mean radiance, e.g. 0.005.
         ``resolution``, ``cache_spp``, ``step`` and the samples per pixel, unless
         :code:`mi.render` is called with ``spp``, are then chosen from error estimates that are
         measured on the image itself; those that are set are taken as they are. The estimate is
         logged, and available as the attribute ``certificate``. 0: the fixed rules stated for each
         property. It cannot be combined with ``cache_file``. (Default: 0)

     * - tolerance_of
       - |string|
       - The image whose mean radiance is the unit of the tolerance: ``image``, or ``volume`` for
         the radiance that media scatter, without visible emitters. (Default: ``image``)

     * - cache_spp
       - |int|
       - Samples (``path``) or directions (``sweep``) per cache voxel, rounded up to whole batches
         of 8 samples or 32 to 256 directions. Not counted are the directions with which all orders
         are solved for, those of ``directional`` emitters, those sampled from an ``envmap``, and
         those along which surfaces illuminate the medium. 0: 128 directions, 256 for forward peaks;
         64 with surfaces unless emitters are in the medium; twice as many for single
         isotropic scattering; 64 for all orders of it under constant environments; ``path``: 16 to
         256 samples, about 2^24 for all voxels, 2^22 with surfaces, 2^23 behind glass, and up to
         4 times as many where few of them meet what emits. Values above these multiply the rays
         that gather irradiance on surfaces, too. (Default: 0)

     * - cache_seed
       - |int|
       - Seed of the cache. Caches with different seeds can be merged. (Default: 0)

     * - quadrature
       - |string|
       - Rule of the ray marching: ``riemann`` (the paper's), ``trapezoid`` or ``exponential``.
         (Default: ``exponential``)

     * - step
       - |float|
       - Step length, relative to the shortest voxel edge of the medium and the cache. Where the
         medium is dense up to its boundary, ``exponential`` divides steps further. (Default: 1.0)

     * - filter
       - |string|
       - Filter of the illumination image: ``bilateral``, whose strength is proportional to the
         standard error of the cache and vanishes as the cache converges; ``fixed``, a bilateral
         filter of constant strength (the paper's, which biases converged images); ``none``.
         (Default: ``none``)

     * - aovs
       - |string|
       - Further images, specified as for the ``aov`` integrator: a comma-separated list of
         ``name:type`` or ``type`` with the types ``colour``, ``illumination`` and ``background``
         (the image is colour times illumination plus background), ``transmittance``, ``depth``
         (mean distance of the visible part of the medium), ``noise`` (standard error of the
         luminance due to the noise of the cache), ``bias`` (expected error of the luminance due to
         the resolution of the cache). (Default: none)

     * - emission
       - |float|, |rgb| or |volume|
       - Volumetric emission, which Mitsuba's media do not support: radiance emitted per unit length
         [W m^-3 sr^-1], the product sigma_a L_e in the paper's eq. 1. It is independent of the
         extinction, which may be 0. A ``gridvolume`` is placed in world space by its ``to_world``;
         all media inside of it are emissive. Emission counts as an emitter: it is visible from
         depth 1 on, and scattered from depth 2 on. ``hide_emitters`` does not hide it.
         (Default: none)

     * - emission_scale
       - |float|
       - Multiplies the emission. (Default: 1)

     * - cache_file
       - |string|
       - File from which the cache is loaded if it exists, and to which a computed cache is written.
         A file of another scene is rejected. With several media, each has a file with its id in
         the name. (Default: none)

     * - sigma_t_file
       - |string|
       - File with the extinction of the medium, for volumes larger than memory, of which a part at
         a time is read: ``.npy``, the folder of a Zarr array, or a raw file with a name like
         ``head_256x256x113_uint16.raw``, of shape (z, y, x). Its values replace those of a
         ``gridvolume`` in the scene, or are multiples of a constant extinction, and fill the box of
         the medium; the medium's ``scale`` multiplies them. For ``max_depth`` 2 and -1 in one
         medium with isotropic scattering under environments and suns, without surfaces.
         (Default: none)

     * - albedo_file
       - |string|
       - The same for the albedo, with the same voxels. (Default: none, the medium's)

     * - max_memory
       - |string|
       - Memory that a volume in ``sigma_t_file`` may take, such as ``8GB``. (Default: half of what
         is free)

     * - work_folder
       - |string|
       - Folder for working files: 10 bytes per voxel of ``sigma_t_file``, 22 for all orders; three
         channels: 26 and 62. (Default: that of ``sigma_t_file``)

     * - irradiance_file
       - |string|
       - File ``.npy`` to which the irradiance in the voxels of ``sigma_t_file`` is written: float32
         (z, y, x, channel). If it is there and was computed from the same inputs, it is read
         instead; ``irrcache farm cache`` computes it on many workers. (Default: none)

     * - timeout
       - |float|
       - Seconds after which no further batch of the cache and no further pass of camera samples is
         started; the image then consists of the completed ones. (Default: -1, never)

    On this page a *sun* is a ``directional`` emitter, a *point* a ``point`` or ``spot``, and a
    *lamp* an area emitter.

    Computes the irradiance (fluence rate) inside a medium once, independently of the camera, and
    integrates the radiative transfer equation along camera rays with it. The cache is reused for
    another camera, film or seed; it is recomputed when a medium or emitter changes. The image is
    consistent, not unbiased: it converges to that of ``volpath`` as ``resolution`` and
    ``cache_spp`` increase and ``step`` decreases.

    A scene may contain several media (``heterogeneous`` or ``homogeneous``) in arbitrary closed
    shapes with a null BSDF, which may be disjoint, touching or nested; each has its own cache.
    Surfaces and area emitters may be anywhere. If ``max_depth`` is -1, the irradiance on diffuse
    surfaces is cached, too, where the camera and other surfaces need it; each camera sample adds
    direct light and follows mirrors, glass and glossy surfaces by one path. With other depths,
    surfaces are path traced. What they reflect is part of the ``background``. A scene with a single
    medium in a box or sphere, and only distant and point emitters, requires no ray tracing. The
    solver ``sweep`` supports media in boxes or spheres without other media among their voxels; with
    surfaces, it requires ``max_depth`` 2 or -1, and where these reach into a medium, isotropic
    scattering without emission.
    Media may also be bounded by ``dielectric``, ``roughdielectric``, ``thindielectric`` and other
    BSDFs that transmit, such as milk in a ball of glass, if ``max_depth`` is -1 and their phase
    function is broad: ``sweep`` supports boxes and spheres (with anisotropic scattering, boxes
    under a constant environment), ``path`` all other shapes. Camera paths are split into what glass
    reflects and what it transmits. As in ``volpath``, suns and points contribute nothing through
    smooth glass.
    Unbounded media and sharp phase functions are rejected with an error that names them, and so are
    boundaries that overlap or contradict each other. Scenes without media, or whose media are all
    behind glass that no cache supports, are rendered by ``volpath`` or, if the extinction differs
    strongly between the channels, ``volpathmis``.

    Phase functions may be ``isotropic``, ``hg`` with :math:`|g|` up to 0.58, ``rayleigh``, or
    others that depend only on the scattering angle and are as broad. For anisotropic ones, the
    cache also stores spherical harmonics of the radiance up to degree 4, or 6 with delta-M (below),
    and, separately, the irradiance from suns, point lights and lamps, whose direction is known.
    With the solver ``sweep``, ``hg`` may have g up to 0.85 if ``max_depth`` is -1. Scattering into
    such a sharp forward peak is then treated as unscattered (delta-M), also in ``transmittance``
    and alpha.

    Gradients (``dr.backward``, ``dr.forward``) are computed by ``sigma_t`` and ``albedo`` of a
    medium, by ``g`` of its phase function ``hg``, and by the radiance of emitters, by solving the
    adjoint transport equation with the solver ``sweep``, for one medium in a box or sphere under
    distant and point emitters (not inside of it if delta-M applies), with ``max_depth`` 1, 2 or -1,
    no filter and no ``aovs``. There may be emission, surfaces, area emitters and several media if
    ``max_depth`` is 2 or -1; there are gradients by the reflectance of ``diffuse`` BSDFs, too. In
    isotropic media without surfaces there are also gradients by ``position`` of points and
    ``to_world`` of suns (``dr.backward`` only). All other gradients are refused with an error that
    names the parameter.
    While parameters carry gradients, the grid of the cache is kept. Images of the same state of the
    scene in one loss share one adjoint solve; ``cache_spp`` also sets its directions.

    .. tabs::
        .. code-tab:: xml

            <integrator type="irrcache">
                <integer name="max_depth" value="-1"/>
            </integrator>

        .. code-tab:: python

            'type': 'irrcache',
            'max_depth': -1
    """

    def __init__(self, props: mi.Properties) -> None:
        self._variant = mi.variant()
        require_variant(self._variant)
        require_llvm()
        require_versions()
        super().__init__(props)
        props = self._properties = properties.RecordedProperties(props)
        self._options = Options.of(props)
        settings, rays = self._options.settings, self._options.rays
        self._stopping = StopCondition()
        # Instead of a cache: where none is needed, and where it would take longer.
        self._stock, self._faster = (
            StockIntegrators(
                max_depth=settings.max_depth,
                rr_depth=rr_depth,
                hide_emitters=rays.hide_emitters,
                timeout=self._options.timeout,
            )
            for rr_depth in (settings.rr_depth, self._options.stock_rr_depth)
        )
        self._source = CameraRaySource(self._options, self._stopping, self._stock, self._faster)
        self._builder = self._source.builder
        self._separation = SeparatedScene()
        self._image = ImageRenderer(self._options)
        # Held by the images that share it: they hold the integrator.
        self._shared: ref[SharedIrradiance] | None = None
        self._has_warned_of_border = False
        #: called with (stage, done, total) while the cache is built; exceptions end the build
        self.progress = None

    @property
    def cache(self) -> IrradianceCache | None:
        """The irradiance cache of the last scene rendered; None before, and if none is needed.

        For a scene with several media use ``caches``. Waits while another thread renders with this
        integrator.
        """
        caches = self.caches
        if len(caches) > 1:
            names = ", ".join(f'"{name}"' for name in caches)
            raise IrrcacheError(
                f"irrcache: the scene has several media, each with a cache: caches[...] of {names}."
            )
        return next(iter(caches.values()), None)

    @property
    def caches(self) -> dict[str, IrradianceCache | None]:
        """The irradiance caches of the last scene rendered, by the ids of their media."""
        with self._builder.lock:
            return {part.medium.name: part.cache for part in self._builder.parts}

    @property
    def cache_spp(self) -> int:
        """Target number of samples per cache voxel, or 0 to have it chosen.

        After an increase the next rendering refines the cache: it continues the random stream and
        reuses all existing samples.
        """
        return self._builder.samples

    @cache_spp.setter
    def cache_spp(self, samples: int) -> None:
        self._builder.samples = properties.checked_integer(
            "cache_spp", samples, 0, "0 (chosen) or a number"
        )

    @property
    def emission(self) -> tuple[object, float]:
        """The volumetric emission (None: media do not emit), and the factor of it."""
        return self._options.emission, self._options.emission_scale

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        if isinstance(self._options.emission, mi.Object):
            callback.put("emission", self._options.emission, mi.ParamFlags.NonDifferentiable)

    @property
    def certificate(self) -> Certificate | None:
        """Estimated error of the last image rendered with a ``tolerance``; None without."""
        return self._source.certificate

    @property
    def seconds(self) -> dict[str, float]:
        """Duration [s] of those stages of the last image that are measured."""
        return self._image.seconds

    def prepare(self, scene: mi.Scene, sensor: int | mi.Sensor = 0) -> None:
        """Build or complete the cache for ``scene``, unless it is up to date.

        With a ``tolerance``, it is the cache for an image of ``sensor``. If several threads call
        this, one builds the cache and the others wait.
        """
        scene = self._separated(scene)
        if self._source.depends_on_view:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with dr.suspend_grad(), self._builder.lock:
                self._source.meet_tolerance(scene, sensor, 0, 0, self.progress)
        self._prepared(scene)

    @property
    def depends_on_view(self) -> bool:
        """Whether a ``tolerance`` chooses the caches anew for every view."""
        return self._source.depends_on_view

    @property
    def mapped_medium(self) -> MappedMedium | None:
        """The medium whose extinction is in ``sigma_t_file``, if that is set."""
        return self._source.mapped

    def cached_media(self, scene: mi.Scene) -> list[CachedMedium]:
        """Return the visible media of ``scene``, each with its cache as far as it is filled."""
        self._source.refuse_tolerance("it chooses the cache for one view, and here there is none")
        self._source.refuse_mapped("a cache in memory")
        with self._builder.lock, dr.suspend_grad():
            self._builder.fit(self._separated(scene))
            return list(self._builder.parts)

    def _separated(self, scene: mi.Scene) -> mi.Scene:
        """Return the scene to trace, in which no surface lies in the boundary of a medium."""
        with self._builder.lock:
            return self._separation.of(scene)

    def _prepared(self, scene: mi.Scene) -> CameraRays | None:
        """Return the camera rays for the cache of ``scene``; None if no medium is visible."""
        require_same_variant(self._variant, mi.variant())
        return self._source.camera_rays(scene, self.progress)

    def cancel(self) -> None:
        """End the current rendering, in any thread, with the samples completed so far."""
        self._stopping.cancel()
        self._stock.cancel()
        self._faster.cancel()

    def should_stop(self) -> bool:
        """Return whether rendering was cancelled or has reached its ``timeout``."""
        return self._stopping.is_due

    def aov_names(self) -> list[str]:
        """Return the names of the channels in addition to colour and alpha, in the film's order."""
        return self._image.aov_names()

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
        """Return the radiance along ``ray``, for wrappers such as ``aov``.

        The mask is a random rounding of alpha.
        """
        self._source.refuse_tolerance("another integrator calls this one, without the sensor")
        self._source.refuse_mapped("an integrator that calls this one")
        scene = self._separated(scene)
        camera_rays = self._prepared(scene)
        if camera_rays is None:
            radiance, valid, _ = self._stock.chosen.sample(scene, sampler, ray, medium, active)
            return radiance, valid, self._image.aov_values(Layers.background_only(radiance))
        radiance, alpha, layers = self._image.sample(
            camera_rays, scene, sampler, ray, medium, mi.Spectrum(1), mi.Bool(active)
        )
        return radiance, sampler.next_1d(active) < alpha, self._image.aov_values(layers)

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        check_film(sensor.film(), spp, len(self.aov_names()))  # before the cache is built
        # Threads exclude each other if they share the integrator, whose cache one of them may
        # refine, or the film, which stores one image only.
        with dr.suspend_grad(), self._builder.lock, exclusive(sensor.film()):
            scene = self._separated(scene)
            if self._source.depends_on_view:
                spp = self._source.meet_tolerance(scene, sensor, spp, seed, self.progress)
            film = self._rendered(scene, sensor, seed, spp)
            image = film.develop() if develop else mi.TensorXf()
            if evaluate:
                dr.eval(image)
                film.schedule_storage()
                dr.eval()
                dr.sync_thread()
            return image

    def _rendered(self, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int) -> mi.Film:
        """Render the film of ``sensor`` with the caches, or with one of Mitsuba's integrators if
        there are none, or if it is faster.
        """
        require_same_variant(self._variant, mi.variant())
        cheaper = self._source.cheaper_stock_image(scene, sensor, spp)
        if cheaper is not None:
            self._source.note_stock_image(cheaper)
            return self._image.render_instead(self._faster.chosen, scene, sensor, seed, cheaper.spp)
        camera_rays = self._prepared(scene)
        if camera_rays is None:
            return self._image.render_stock(self._stock.chosen, scene, sensor, seed, spp)
        if isinstance(camera_rays, TracedCameraRays):
            camera_rays.prepare_view(scene, sensor, spp, self._options.settings.seed)
        return self._image.render(camera_rays, scene, sensor, seed, spp, self.should_stop)

    def uses_cache(self, scene: mi.Scene, sensor: int | mi.Sensor = 0, spp: int = 0) -> bool:
        """Return whether `render` would use caches, and not Mitsuba's integrators, which can be
        faster for a single image.
        """
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        return self._source.cheaper_stock_image(self._separated(scene), sensor, spp) is None

    def progressive(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        **targets: object,
    ) -> Iterator[Frame]:
        """Yield images of ``scene`` while the cache is refined, until one of the ``targets`` is
        reached.

        See `mitsuba_irrcache.pipeline.progressive.Targets`.
        """
        self._source.refuse_tolerance("a progressive run has targets of its own")
        self._source.refuse_mapped("a progressive run (--budget, --error)")

        def image() -> tuple[mi.TensorXf, float]:
            tensor = self.render(scene, sensor, seed, spp)
            self._stopping.end()
            return tensor, self.seconds.get("filter", 0.0)

        self._stopping.begin()
        progress = self._stopping.raising(self.progress)
        traced = self._separated(scene)
        return frames(self._builder, traced, image, Targets(**targets), progress)

    def render_forward(
        self,
        scene: mi.Scene,
        params: mi.SceneParameters,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Return the derivative of the image along the derivatives of the parameters."""
        from mitsuba_irrcache.gradients.operations import SceneState

        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        if not enabled(params):
            return dr.zeros(mi.TensorXf, self.render(scene, sensor, seed, 1).shape)
        return SceneState(self, scene, params, alone=True).image_along(sensor, seed, spp)

    def render_backward(
        self,
        scene: mi.Scene,
        params: mi.SceneParameters,
        grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> None:
        """Add the gradients of an objective to the parameters that carry some, from those by the
        pixels of the image, ``grad_in``.
        """
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        if enabled(params):
            from mitsuba_irrcache.gradients.operations import SceneState

            # Without a graph: the irradiance is not shared with other images.
            SceneState(self, scene, params, alone=True).add_image(grad_in, sensor, seed, spp)

    def render_shared(
        self,
        scene: mi.Scene,
        params: mi.SceneParameters,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        seed_grad: int = 0,
        spp: int = 0,
        spp_grad: int = 0,
    ) -> mi.TensorXf:
        """`mi.render` for ``params`` that carry gradients: images of the same state of the scene
        share one adjoint solve in ``dr.backward``.
        """
        from mitsuba_irrcache.gradients import operations

        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        seeds = seed, seed_grad or mi.sample_tea_32(seed, 1)[0]
        shared = self._shared() if self._shared is not None else None
        image, shared = operations.image(
            self, shared, scene, params, sensor, seeds, (spp, spp_grad or spp)
        )
        self._shared = ref(shared)
        return image

    @contextmanager
    def exclusively(self) -> Iterator[None]:
        """Exclude other threads from the cache."""
        with self._builder.lock:
            yield

    def revision(self, scene: mi.Scene) -> int:
        """Bring the cache up to date, and return the number of its state."""
        with self._builder.lock:
            self._prepared(self._separated(scene))
            return self._builder.revision

    def adjoint(
        self, scene: mi.Scene, params: mi.SceneParameters, keys: list[str], seed: int
    ) -> ParameterAdjoint | TracedAdjoint:
        """Return the derivatives of images of ``scene`` by the parameters ``keys``."""
        from mitsuba_irrcache.gradients.backward import ParameterAdjoint, check, needs_paths
        from mitsuba_irrcache.gradients.border_error import warn_of_border_error
        from mitsuba_irrcache.gradients.traced import TracedAdjoint

        self._source.refuse_tolerance("an objective would jump with the resolution")
        self._source.refuse_mapped("a gradient")
        scene = self._separated(scene)
        camera_rays = self._prepared(scene)
        parts, rays = self._builder.parts, self._options.rays
        emission = self._options.emission
        traced = needs_paths(parts, params, keys, emission)
        check(parts, keys, rays.layered, traced)
        if traced:
            image = rays.step, rays.hide_emitters, emission
            adjoint = TracedAdjoint(scene, params, keys, parts, image, seed)
        else:
            image = camera_rays, rays.step, emission
            adjoint = ParameterAdjoint(scene, params, keys, parts[0], image, seed)
        if not self._has_warned_of_border:  # not in each step of an optimisation
            parts = adjoint.parts_by_extinction
            self._has_warned_of_border = warn_of_border_error(parts, isolated=not traced)
        return adjoint

    def to_string(self) -> str:
        """Return all properties with their values, to record how an image was computed."""
        aovs = ", ".join(f"{name}:{kind}" for name, kind in self._options.aovs.items())
        values = self._properties.values | {"cache_spp": self.cache_spp, "aovs": aovs}
        return f"IrradianceCachingIntegrator[\n{properties.described(values)}\n]"

    def _repr_html_(self) -> str:
        """Return the properties and slices of every cache as HTML, for notebooks."""
        caches = "".join(
            f"<h4>{html.escape(name)}</h4>{cache._repr_html_()}"
            for name, cache in self.caches.items()
            if cache is not None
        )
        return f"<pre>{html.escape(self.to_string())}</pre>{caches}"


mi.register_integrator("irrcache", IrradianceCachingIntegrator)
