"""The integrator plugin ``irrcache``. Executed anew for every variant, since its base class belongs
to one.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.build import CacheBuilder, CacheSettings
from mitsuba_irrcache.cache import IrradianceCache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.projection import QUADRATURES, Projection
from mitsuba_irrcache.rendering import render_film
from mitsuba_irrcache.runtime import require_llvm
from mitsuba_irrcache.variants import require_variant
from mitsuba_irrcache.versions import check_versions

SOLVERS = ("auto", "path")
FILTERS = ("none",)
_NO_GRADIENTS = 'irrcache computes no gradients; use the integrator "prbvolpath" for them.'


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
       - Depth from which paths in the cache are ended by Russian roulette. (Default: 5)

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no, i.e. |false|)

     * - solver
       - |string| - How the cache is computed: ``path`` (Monte Carlo at every voxel) or ``auto``.
       (Default: ``auto``)

     * - resolution
       - |int|
       - Cache voxels along the longest side of the medium, near-cubic whatever its data;
         0: that of the data, at most 128; two per mean free path, 32 to 96, in a
         homogeneous medium. (Default: 0)

     * - cache_spp
       - |int|
       - Samples per cache voxel, rounded up to a multiple of 8;
         0: 16 to 256, about 2^24 for all voxels together. (Default: 0)

     * - cache_seed
       - |int|
       - Random stream of the cache. Caches of different seeds can be merged. (Default: 0)

     * - quadrature
       - |string|
       - Rule of the ray marching: ``riemann`` (the paper's), ``trapezoid`` or ``exponential``.
         (Default: ``exponential``)

     * - step
       - |float|
       - Length of a step in shortest voxel edges of the medium and the cache. (Default: 1.0)

     * - filter
       - |string|
       - Filter of the illumination image: ``none``. (Default: ``none``)

     * - cache_file
       - |string|
       - Load the cache from this file if it is there, write it when it was computed. A file
         of another scene is refused. (Default: none)

    Computes the irradiance (fluence rate) that reaches every point of an isotropically scattering
    medium once, independently of the camera, and integrates the radiative transfer equation along
    camera rays from it. A moved camera, another film or another seed reuse the cache; an edited
    medium or emitter renews it. The image is consistent, not unbiased: it converges to
    ``volpath``'s as ``resolution`` and ``cache_spp`` grow and ``step`` falls.

    One medium (``heterogeneous`` or ``homogeneous``, isotropic phase function) in a box or sphere
    with a null BSDF, and emitters that are not surfaces (point-like ones outside of the medium),
    are supported; whatever else is refused by name. A scene without media is rendered by
    ``volpath``.

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
        require_variant(mi.variant())
        require_llvm()
        check_versions()
        super().__init__(props)
        self._hide_emitters = bool(props.get("hide_emitters", False))
        self._settings = CacheSettings(
            max_depth=_integer(props, "max_depth", -1, -1, "-1 (all orders) or at least 0"),
            rr_depth=_integer(props, "rr_depth", 5, 1, "at least 1"),
            solver=_choice(props, "solver", "auto", SOLVERS),
            resolution=_integer(props, "resolution", 0, 0, "0 (chosen) or a number of voxels"),
            samples=_integer(props, "cache_spp", 0, 0, "0 (chosen) or a number of samples"),
            seed=_integer(props, "cache_seed", 0, 0, "at least 0"),
            file=str(props.get("cache_file", "")),
        )
        self._quadrature = _choice(props, "quadrature", "exponential", QUADRATURES)
        self._step = float(props.get("step", 1.0))
        if not 1e-3 <= self._step <= 1e3:
            raise IrrcacheError(
                f"irrcache: step is {self._step:g}; it must lie between 0.001 and 1000 voxel edges."
            )
        self._filter = _choice(props, "filter", "none", FILTERS)
        self._builder = CacheBuilder(self._settings)
        self._projection: Projection | None = None
        self._volpath: mi.Integrator | None = None
        #: called with (stage, done, total) while the cache is built; what it raises ends the build
        self.progress = None

    @property
    def cache(self) -> IrradianceCache | None:
        """The irradiance cache of the last scene rendered; None before, and where none is
        needed.
        """
        return self._builder.cache

    def prepare(self, scene: mi.Scene) -> None:
        """Builds or completes the cache for ``scene``, unless it is up to date."""
        changed = self._builder.update(scene, self.progress)
        medium, cache = self._builder.medium, self._builder.cache
        if medium is None:
            self._projection = None
        elif changed or self._projection is None:
            lit = cache is not None and cache.active_count
            field = cache.field() if lit else None
            self._projection = Projection(medium, field, self._quadrature, self._step)

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
        """Radiance along ``ray``, for wrappers such as ``aov``; alpha is rounded at random to be a
        mask.
        """
        self.prepare(scene)
        if self._projection is None:
            return self._fallback().sample(scene, sampler, ray, medium, active)
        radiance, alpha = self._radiance(scene, sampler, ray, medium is not None, mi.Bool(active))
        return radiance, sampler.next_1d(active) < alpha, []

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
        with dr.suspend_grad():
            self.prepare(scene)
            if self._projection is None:
                return self._fallback().render(scene, sensor, seed, spp, develop, evaluate)
            inside = sensor.get_medium() is not None
            film = render_film(
                sensor,
                lambda sampler, ray, active: self._radiance(scene, sampler, ray, inside, active),
                seed,
                spp,
                self.should_stop,
            )
            image = film.develop() if develop else mi.TensorXf()
            if evaluate:
                dr.eval(image)
                film.schedule_storage()
                dr.eval()
                dr.sync_thread()
            return image

    def render_forward(self, *args: object, **kwargs: object) -> mi.TensorXf:
        raise NotImplementedError(_NO_GRADIENTS)

    def render_backward(self, *args: object, **kwargs: object) -> None:
        raise NotImplementedError(_NO_GRADIENTS)

    def _radiance(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        inside: bool,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Float]:
        ray = mi.Ray3f(ray)
        background = mi.Spectrum(0)
        environment = scene.environment()
        visible = (
            environment is not None and not self._hide_emitters and self._settings.max_depth != 0
        )
        if visible:
            escaped = dr.zeros(mi.SurfaceInteraction3f)
            escaped.wi = -ray.d
            escaped.wavelengths = ray.wavelengths
            background = environment.eval(escaped, active)
        hit, near, far = self._builder.medium.intersect(ray)
        # As in volpath, a sensor is in the medium only if the scene says so, and the way in leads
        # through the boundary, wherever inside of it the medium's grid begins.
        _, entry, leave = self._builder.medium.boundary.intersect(ray)
        entered = entry > -1e-5 * (leave - entry)
        hit &= (far > 0) if inside else entered
        near = dr.maximum(near, 0)
        scattered, transmittance = self._projection.march(
            ray, near, far, background, 1 - sampler.next_1d(active), active & hit
        )
        alpha = mi.Float(1) if visible else 1 - dr.mean(transmittance)
        return scattered + transmittance * background, alpha

    def _fallback(self) -> mi.Integrator:
        if self._volpath is None:
            self._volpath = mi.load_dict(
                {
                    "type": "volpath",
                    "max_depth": self._settings.max_depth,
                    "rr_depth": self._settings.rr_depth,
                    "hide_emitters": self._hide_emitters,
                }
            )
        return self._volpath

    def to_string(self) -> str:
        s = self._settings
        return (
            f"IrradianceCachingIntegrator[\n  max_depth = {s.max_depth},\n  rr_depth = "
            f"{s.rr_depth},\n"
            f"  hide_emitters = {str(self._hide_emitters).lower()},\n  solver = {s.solver},\n"
            f"  resolution = {s.resolution},\n  cache_spp = {s.samples},\n  cache_seed = "
            f"{s.seed},\n"
            f"  quadrature = {self._quadrature},\n  step = {self._step:g},\n  filter = "
            f"{self._filter},\n"
            f'  cache_file = "{s.file}"\n]'
        )


def _integer(props: mi.Properties, name: str, default: int, least: int, wanted: str) -> int:
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 2**31:
        raise IrrcacheError(f"irrcache: {name} is {value!r}; it must be {wanted}.")
    return value


def _choice(props: mi.Properties, name: str, default: str, choices: tuple[str, ...]) -> str:
    value = props.get(name, default)
    if value not in choices:
        raise IrrcacheError(
            f"irrcache: {name} is {value!r}; it must be one of: {', '.join(choices)}."
        )
    return value


mi.register_integrator("irrcache", IrradianceCachingIntegrator)
