"""Ray marching of the radiative transfer equation with the cached irradiance (paper, eq. 1).

    L = int T (sigma_s Phi / (4 pi) + j) dt + T L_background

where j is the volumetric emission (`emission`).

The step length is the shortest voxel edge of the medium's grids and the cache, times ``step``;
steps end on the medium's bounds. The lattice of steps has a random offset per ray, so that the
discretisation error becomes noise instead of banding. Empty macrocells are skipped, and steps are
longer where little radiance remains to be added.

Rays read packed 16-bit copies of the fields (`packed_fields`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import Scattering
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays, RaySegment
from mitsuba_irrcache.cache.uncertainty import UncertaintyField
from mitsuba_irrcache.core.fast_math import minimum
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.grids.fields import ConstantField, Field, GridField
from mitsuba_irrcache.grids.packed_fields import AlongRay, Lookups
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.render.aovs import Layers
from mitsuba_irrcache.render.empty_space import Clearance
from mitsuba_irrcache.render.quadrature import RULES, curved, emission_weights, segment
from mitsuba_irrcache.scene.cut_cells import CutCells
from mitsuba_irrcache.transport.tracking import optical_depth

#: A ray ends once the remaining radiance, bounded by the largest in-scattered radiance and by the
#: background, cannot change its radiance by more than this fraction.
EARLY_STOP = 1e-4
#: Below these fractions of remaining radiance, steps are two and four times as long: their larger
#: error affects only a small remainder.
COARSER, COARSEST = 0.2, 0.03
#: Optical depth of a step above which it is divided where the medium is dense at its boundary, into
#: at most MOST_SUBSTEPS: the irradiance there decays within a fraction of a mean free path.
SUBSTEP_DEPTH, MOST_SUBSTEPS = 0.15, 8
#: Number of steps for each voxel of an emissive grid where no finer cache shortens the steps.
EMISSION_STEPS = 4
#: Number of lengths along the longest side of a medium without a cache over which its radiance is
#: assumed to vary: the number of voxels of the coarsest default cache.
UNCACHED_CELLS = 32
#: Multiple of the offset of a ray whose fraction is another random number.
FRACTION = 1024.0
#: Distance from the surfaces at its ends that a ray keeps in lookups in cut cells [cells].
SURFACE_MARGIN = 0.01
#: Maximum optical depth per step of the packed extinction: the 16-bit format has a limited range,
#: which larger values would waste.
OPAQUE = 4096.0
#: Number of direct lights from which on the march calls a function in the kernel for each, instead
#: of containing the code for each.
MANY_LIGHTS = 3


class MarchedPart:
    """A part of a medium through which rays are marched on from where the part before left them.

    ``state`` is the state of the rays at the start of the part, None in the first one; it is
    replaced by that at the end. Further components of `Layers`, emission and direct lights are not
    supported.
    """

    def __init__(self, state: _MarchState | None) -> None:
        self.state = state

    def holds(self, fields: AlongRay, t: mi.Float) -> mi.Bool:
        """Return whether the fields are known at a distance along rays."""
        raise NotImplementedError


@dataclass(frozen=True)
class CachedFields:
    """Fields of a cache other than its irradiance, and emitters that camera rays evaluate.

    Attributes:
        uncertainty: its error, if that is to be computed, too.
        directional: the factor of anisotropic scattering.
        edges: surfaces that cut voxels.
        falloff: inverse-square factor of nearby emitters, by which the irradiance is divided.
        direct_lights: emitters whose direct irradiance is excluded from the cached one.

    Attributes are None or empty if the cache has none.
    """

    uncertainty: UncertaintyField | None = None
    directional: AngularField | None = None
    edges: CutCells | None = None
    falloff: InverseSquareFactor | None = None
    direct_lights: Sequence[DirectLightAlongRays] = ()


#: Isotropic scattering, without lights and surfaces near the voxels.
IRRADIANCE_ALONE = CachedFields()


class Projection:
    """Ray marching of one medium: its fields, its cached irradiance, and the quadrature rule.

    With ``layered``, rays also compute the further components of `Layers`.
    """

    def __init__(
        self,
        medium: MediumGrid,
        irradiance: GridField | None,
        quadrature: str,
        step: float,
        layered: bool = False,
        cached: CachedFields = IRRADIANCE_ALONE,
        lookups: Callable = Lookups,
        border_depth: float = 0.0,
    ) -> None:
        """``lookups`` is called with the fields that rays read, and their limits; ``border_depth``
        is the optical depth of a voxel at the boundary.
        """
        self.medium, self._exponent = medium, None
        if medium.unscattered_exponent is not None:
            opaque = [dr.opaque(mi.Float, float(e)) for e in medium.unscattered_exponent]
            self._exponent = opaque[0] if len(opaque) == 1 else mi.Color3f(opaque)
        self.has_cache = irradiance is not None
        self._channels = irradiance.channels if irradiance else 1
        self.quadrature = quadrature
        self.layered = layered
        self.uncertainty, self.directional = cached.uncertainty, cached.directional
        self.falloff, self.direct_lights = cached.falloff, list(cached.direct_lights)
        #: surfaces that cut voxels, if any, and the irradiance they select voxels from
        self._edges = (cached.edges, irradiance) if cached.edges is not None else None
        albedo = _simplified(medium.albedo)
        fields = medium.sigma_t, medium.albedo, irradiance, medium.emission
        grids = [f.grid for f in fields if f and f.grid]
        emissive_grid = medium.emission.grid if medium.emission is not None else None
        # For constant fields, one step is exact.
        length = min((g.voxel_size.min() for g in grids), default=dr.inf) * step
        #: number of steps of the lattice into which a step is divided where the medium is dense;
        #: None: no step is divided
        self.substeps = None
        depth = border_depth * step
        if irradiance is None and np.isfinite(length):
            # The voxels of the data, which may be thick, determine the steps, not those of a cache.
            if emissive_grid is not None:
                length /= EMISSION_STEPS
            depth = max(depth, medium.sigma_t.maximum * length)
        if depth > SUBSTEP_DEPTH and RULES[quadrature].is_third_order and np.isfinite(length):
            count = min(2 ** int(np.ceil(np.log2(depth / SUBSTEP_DEPTH))), MOST_SUBSTEPS)
            self.substeps, length = dr.opaque(mi.Float, count), length / count
        self.step = dr.opaque(mi.Float, float(length))
        #: length over which the radiance of the medium varies: the shortest edge of a voxel of the
        #: cache or, without one, of the data, at most that of the coarsest default cache
        if irradiance is not None and irradiance.grid is not None:
            cell = irradiance.grid.voxel_size.min()
        else:
            longest = np.linalg.norm(medium.frame[:3, :3], axis=0).max()
            cell = min(medium.shortest_edge, longest / UNCACHED_CELLS)
            if emissive_grid is not None:
                cell = min(cell, emissive_grid.voxel_size.min())
        self.cell = dr.opaque(mi.Float, float(cell))
        #: scattering into the truncated forward peak over the remaining scattering coefficient
        self._peak_share: mi.Float | None = None
        if self.truncates_peak:
            self._peak_share = dr.opaque(mi.Float, medium.phase.peak_ratio)
        max_radiance = irradiance.maximum * albedo.maximum / (4 * dr.pi) if irradiance else 0.0
        if self.directional is not None:
            max_radiance *= self.directional.directional.phase.peak
        self.max_radiance = dr.opaque(mi.Float, max_radiance)
        emission = medium.emission
        self.max_emission = dr.opaque(mi.Float, emission.maximum if emission else 0.0)
        self.clearance = Clearance(medium.macrocells, emission)
        needed = [medium.sigma_t]
        needed += [irradiance] if irradiance else []
        needed += [albedo] if irradiance or layered else []
        opaque = OPAQUE / length if length < dr.inf else dr.inf
        self.lookups = lookups(needed, [opaque, *[dr.inf] * (len(needed) - 1)])

    def fetch(
        self,
        fields: AlongRay,
        t: mi.Float,
        view: tuple = (),
        peak: Sequence = (),
        length: mi.Float | None = None,
        scattering: Scattering = Scattering.ALL,
        bounds: tuple[mi.Float, mi.Float] | None = None,
    ) -> tuple:
        """Evaluate the fields at the distance ``t``.

        Returns the extinction; the source alpha * Phi / (4 pi), in-scattered radiance per unit of
        optical depth, without the inverse-square factor; the albedo and the relative errors of Phi,
        as far as layers need them; and the ``peak`` at ``t``. ``view`` is the result of
        `angular_terms`.

        ``peak`` is the optical depth of scattering into a truncated forward peak between the camera
        and the beginning of a segment of this ``length`` that ends at ``t``, and the extinction of
        the peak there. If it is empty, scattering into a truncated peak is excluded. ``scattering``
        selects the radiance that is scattered. ``bounds`` are the distances between which the ray
        is in the medium, None if it does not end at surfaces.
        """
        # docs/primer, eq. (1.3)
        p, active = fields.ray(t), mi.Bool(True)
        sigma_t, *rest = fields.at(t, active)
        extras = [rest[-1]] if self.layered else []
        if not self.has_cache:
            return sigma_t, mi.Float(0), extras, []
        phi, albedo = rest
        beside = p if bounds is None else fields.ray(self._within(t, *bounds))
        phi = self._exclude_occluded(beside, phi, active)
        if self.uncertainty is not None:
            extras += self.uncertainty.at_world(p, phi, active)
        if peak:
            depth, extinction = peak
            peak = [depth + 0.5 * length * extinction, sigma_t * albedo * self._peak_share]
            peak[0] += 0.5 * length * peak[1]
        if self.directional is not None:
            phi = phi * self._angular_factor(p, view, active, peak, scattering)
        return sigma_t, albedo * phi * dr.inv_four_pi, extras, list(peak)

    def _angular_factor(
        self, p: mi.Point3f, view: tuple, active: mi.Bool, peak: Sequence, scattering: Scattering
    ) -> mi.Float | mi.Color3f:
        if scattering is Scattering.WITHOUT_PEAK:
            return self.directional.sampled_factor(p, *view, active)
        if scattering is Scattering.PEAK:
            return self.directional.peak_factor(p, view[0], active, peak[0])
        depth = peak[0] if peak else None
        return self.directional.factor(p, *view, active, True, depth)

    def angular_terms(self, direction: mi.Vector3f) -> tuple:
        """Precompute the terms of `fetch` that depend on the direction; empty if isotropic."""
        if self.directional is None:
            return ()
        return direction, self.directional.directional.basis(direction)

    def irradiance_at(
        self, p: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> mi.Float | mi.Color3f:
        """Look up the cached irradiance at the end of a path from a surface along ``direction``.

        Anisotropic media weight it by the phase function, without the forward peak.
        """
        _, phi, *_ = self.lookups.at_world(p, active)
        phi = self._exclude_occluded(p, phi, active)
        if self.falloff is not None:
            phi = phi * self.falloff.at(p)
        if self.directional is not None:
            view = self.angular_terms(direction)
            phi = phi * self.directional.factor(p, *view, active, with_peak=False)
        for light in self.direct_lights:
            phi = phi + light.at(p, active, direction)
        return phi

    @property
    def truncates_peak(self) -> bool:
        """Whether scattering into a forward peak is treated as unscattered (see `delta_m`)."""
        return self.directional is not None and self.medium.original is not None

    def unscattered(
        self,
        transmittance: mi.Spectrum,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Convert a ``transmittance`` between two distances along ``ray`` to that of the original,
        untruncated medium.
        """
        if not self.truncates_peak:
            return transmittance
        if self._exponent is None:
            return dr.exp(-mi.Spectrum(optical_depth(self.medium.original, ray, near, far, active)))
        return dr.power(transmittance, self._exponent)

    def _within(self, t: mi.Float, near: mi.Float, far: mi.Float) -> mi.Float:
        """Return the distance next to ``t`` that is certainly between those of the surfaces at
        which a ray begins and ends.

        On a surface, rounding errors would determine of which side values are looked up.
        """
        if self._edges is None:
            return t
        margin = dr.minimum(SURFACE_MARGIN * self.cell, 0.5 * (far - near))
        return dr.clip(t, near + margin, far - margin)

    def _exclude_occluded(
        self, p: mi.Point3f, phi: mi.Float | mi.Color3f, active: mi.Bool
    ) -> mi.Float | mi.Color3f:
        """Correct a looked-up irradiance for voxels on the other side of surfaces."""
        if self._edges is None:
            return phi
        edges, irradiance = self._edges
        return edges.corrected(irradiance, p, phi, active)

    @symbolic
    def march(
        self,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        background: mi.Spectrum,
        offset: mi.Float,
        active: mi.Bool,
        part: MarchedPart | None = None,
        scattering: Scattering = Scattering.ALL,
    ):
        """March from ``near`` to ``far``, or through a ``part`` of the medium.

        Returns the scattered radiance, the transmittance, the sums for `Layers`, and the emitted
        radiance. ``offset`` in (0, 1] is the length of the first step in steps; ``background`` is
        the radiance behind the medium, required for early termination. ``scattering`` selects what
        is scattered (`Scattering.PEAK` requires `truncates_peak`).
        """
        # docs/primer, eqs. (1.1), (5.1)
        march = _RayMarch(self, ray, (near, far), background, offset, scattering)
        is_first = part is None or part.state is None
        state = march.begin(mi.Bool(active)) if is_first else part.state
        going = march.goes_on(state, part)
        while dr.hint(going, label="ray march"):
            march.advance(state)
            going = march.goes_on(state, part)
        if dr.hint(part is not None, mode="scalar"):
            part.state = state
        return state.radiance, mi.Spectrum(state.transmittance), state.gathered, state.emitted

    def called_march(
        self,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        background: mi.Spectrum,
        offset: mi.Float,
        active: mi.Bool,
        scattering: Scattering = Scattering.ALL,
    ) -> tuple:
        """Compute `march` by a function call in the kernel, for kernels that march at several
        places.

        They contain the code once, if it is the same: neither arguments nor results that only some
        places use are optimised away. Most of the time to the first image is that of compilation.
        """

        def through(*arguments: dr.ArrayBase) -> tuple:
            return self.march(*arguments, scattering=scattering)

        arguments = ray, near, far, background, offset, active
        with dr.scoped_set_flag(dr.JitFlag.OptimizeCalls, False):
            radiance, passed, *rest = dr.switch(mi.UInt32(0), [through], *arguments)
        return radiance, dr.select(active, passed, 1), *rest

    def zero_sample(self) -> tuple:
        """Return zeros of the same types as `fetch`."""

        def zero(*channels: int) -> mi.Float | mi.Color3f:
            return (mi.Color3f if 3 in channels else mi.Float)(0)

        albedo = self.medium.albedo.channels
        source = zero(albedo, self._channels) if self.has_cache else mi.Float(0)
        extras = [zero(albedo)] if self.layered else []
        if self.uncertainty is not None and self.has_cache:
            extras += [mi.Float(0)] * self.uncertainty.count
        return zero(self.medium.sigma_t.channels), source, extras

    def zero_peak(self) -> list:
        """Return the optical depth and the extinction of a truncated forward peak before a ray
        enters the medium; empty without such a peak.
        """
        if not self.truncates_peak:
            return []
        is_coloured = 3 in (self.medium.sigma_t.channels, self.medium.albedo.channels)
        return [(mi.Color3f if is_coloured else mi.Float)(0) for _ in range(2)]

    @property
    def channel_count(self) -> int:
        """Number of values in `Layers`, 0 without them."""
        errors = self.uncertainty.count if self.uncertainty is not None else 1
        return 4 * dr.size_v(mi.Spectrum) + 1 + errors if self.layered else 0

    def zero_sums(self) -> list:
        """Return the initial sums for `Layers`: colour, depth, errors."""
        if not self.layered:
            return []
        errors = self.uncertainty.count if self.uncertainty is not None else 0
        return [mi.Spectrum(0), mi.Float(0), *(mi.Float(0) for _ in range(errors))]

    def layers(
        self,
        scattered: mi.Spectrum,
        transmittance: mi.Spectrum,
        gathered: list,
        background: mi.Spectrum,
        weight: mi.Spectrum,
    ) -> Layers:
        """Convert results of `march` to `Layers`; ``weight`` is the sensor's weight of the
        radiance.
        """
        colour, depth, *errors = gathered
        scale = luminance(weight)
        return Layers(
            scattered=scattered * weight,
            colour=colour,
            background=background * weight,
            transmittance=transmittance,
            depth=depth,
            probes=[scale * e for e in errors[:-1]],
            bias=scale * errors[-1] if errors else mi.Float(0),
        )


@dataclass
class _FieldSample:
    """Results of `Projection.fetch` at a point: the extinction, the source, and the values
    that layers need.
    """

    extinction: mi.Float | mi.Color3f
    source: mi.Float | mi.Color3f
    extras: list


@dataclass
class _MarchState:
    """What a ray carries from segment to segment.

    Points of the lattice of steps are numbered. ``k`` is the number of the last evaluated one plus
    1, ``stride`` the number of steps from it to the next one, ``t`` the distance of the
    last one and ``here`` the fields there. ``previous`` and ``previous_length`` belong to the
    segment before. ``peak`` is that of `Projection.fetch`, and ``means`` are the mean extinctions
    towards the direct lights, empty for many lights.
    """

    k: mi.Float
    stride: mi.Float
    t: mi.Float
    here: _FieldSample
    previous: tuple
    previous_length: mi.Float
    peak: list
    means: list
    emission: mi.Spectrum
    transmittance: mi.Float | mi.Color3f
    radiance: mi.Spectrum
    emitted: mi.Spectrum
    gathered: list
    active: mi.Bool


@dataclass
class _MarchedSegment:
    """A segment up to the distance ``end``: the extinctions at both ends, with a correction for
    curvature, and the ``weights`` of the sources there. ``skip``: behind empty space.
    """

    end: mi.Float
    skip: mi.Bool
    extinctions: tuple
    weights: tuple


class _RayMarch:
    """The march of a `Projection` along rays between the distances of ``bounds``."""

    def __init__(
        self,
        projection: Projection,
        ray: mi.Ray3f,
        bounds: tuple[mi.Float, mi.Float],
        background: mi.Spectrum,
        offset: mi.Float,
        scattering: Scattering,
    ) -> None:
        near, far = bounds
        self._scattering = scattering
        self._projection, self._ray, self._near, self._far = projection, ray, near, far
        self._clearance = projection.clearance.along(ray)
        self._fields = projection.lookups.along(ray)
        self._view = projection.angular_terms(ray.d)
        falloff, step = projection.falloff, projection.step
        self._lamps = falloff.along(ray) if falloff is not None else []
        max_radiance = dr.maximum(projection.max_radiance, dr.max(background))
        max_radiance += projection.max_emission * dr.maximum(far - near, 0)
        self._dark = max_radiance == 0
        self._max_radiance = dr.select(self._dark, 1, max_radiance)
        # Floats represent step numbers exactly up to 2^24; longer lattices have coarser steps.
        limit = dr.minimum(dr.ceil((far - near) / step) + 1, 2**24)
        self._lattice = near, far, offset, step, dr.rcp(step), limit

    def begin(self, active: mi.Bool) -> _MarchState:
        """Return the state before the first segment.

        Points of the lattice are numbered from 1; number 0 is the beginning, reached by a first
        step of length 0 that only evaluates the fields there.
        """
        projection, t = self._projection, mi.Float(self._near)
        active = active & (self._near < self._far)
        here = _FieldSample(*projection.zero_sample())
        grey = projection.medium.sigma_t.channels == 1
        lights = projection.direct_lights
        if len(lights) >= MANY_LIGHTS:
            lights = []
        return _MarchState(
            k=mi.Float(0),
            stride=mi.Float(1),
            t=t,
            here=here,
            previous=(here.extinction, here.source),
            previous_length=mi.Float(dr.inf),
            peak=[] if self._scattering is Scattering.WITHOUT_PEAK else projection.zero_peak(),
            means=[light.mean_extinction(self._ray(t), active) for light in lights],
            emission=mi.Spectrum(0),
            transmittance=(mi.Float if grey else mi.Color3f)(1),
            radiance=mi.Spectrum(0),
            emitted=mi.Spectrum(0),
            gathered=projection.zero_sums(),
            active=active,
        )

    def goes_on(self, state: _MarchState, part: MarchedPart | None) -> mi.Bool:
        """Return whether there is a further segment; with ``part``, within that part."""
        if part is None:
            return mi.Bool(state.active)
        return state.active & part.holds(self._fields, self._next_point(state)[-1])

    def advance(self, state: _MarchState) -> None:
        """Add the next segment."""
        projection = self._projection
        empty, wall, skip, state.k, state.t, end = self._next_point(state)
        length = end - state.t
        self._skip_empty_space(state, skip)
        *values, peak = projection.fetch(
            self._fields,
            end,
            self._view,
            state.peak,
            length,
            self._scattering,
            (self._near, self._far),
        )
        there = _FieldSample(*values)
        before = self._with_inner_sources(state, there)
        extinctions, sources = self._curved(state, before, there, length)
        weights, transmittance = segment(projection.quadrature, extinctions, length)
        part = _MarchedSegment(end, skip, extinctions, weights)
        scattered = self._add_scattered(state, part, sources)
        self._add_direct(state, part, peak)
        if projection.layered:
            state.gathered = _gather(
                state.gathered,
                state.transmittance,
                weights[0] * state.t + weights[1] * end,
                weights,
                scattered,
                (state.here.extras, there.extras),
            )
        self._add_emitted(state, part, length)
        state.transmittance = state.transmittance * transmittance
        state.previous = state.here.extinction, state.here.source
        state.previous_length = length
        state.here, state.peak = there, peak
        self._choose_stride(state)
        state.t = end
        state.k += 1
        state.active &= (end < self._far) & (~empty | (wall < self._far))

    def _next_point(self, state: _MarchState) -> tuple:
        """Find the next point of the lattice of steps at which to evaluate the fields, behind the
        last one.

        Returns whether space is empty there and up to where, whether it is skipped, the number of
        the point, the distance from which the segment to it begins, and that of the point.
        """
        near, far, offset, step, per_step, limit = self._lattice
        empty, wall = self._clearance.exit(state.t, state.active)
        last = dr.floor(dr.fma(minimum(wall, far) - near, per_step, -offset)) + 1
        skip = empty & (last >= state.k) & (last >= 1)
        last = minimum(last, limit)
        k = dr.select(skip, last + 1, state.k + state.stride - 1)
        t = dr.select(skip, minimum(dr.fma(last - 1 + offset, step, near), far), state.t)
        end = minimum(dr.fma(k - 1 + offset, step, near), far)
        end = dr.select(k == 0, near, end)
        end = dr.select(k >= limit, far, end)
        return empty, wall, skip, k, t, end

    def _skip_empty_space(self, state: _MarchState, skip: mi.Bool) -> None:
        """Continue from the last lattice point inside of empty space."""
        state.here.extinction = dr.select(skip, 0, state.here.extinction)
        extinction, source = state.previous
        state.previous = dr.select(skip, 0, extinction), source
        state.previous_length = dr.select(skip, self._projection.step, state.previous_length)
        state.emission = dr.select(skip, 0, state.emission)
        if state.peak:
            state.peak = [state.peak[0], dr.select(skip, 0, state.peak[1])]

    def _with_inner_sources(self, state: _MarchState, there: _FieldSample) -> tuple:
        """Use the source of the end inside the medium where a segment enters or leaves it.

        At the other end the cache may have no value. Returns extinction and source before the
        segment.
        """
        here, (extinction, previous_source) = state.here, state.previous
        enters = dr.max(mi.Spectrum(here.extinction)) == 0
        here.source = dr.select(enters, there.source, here.source)
        previous_source = dr.select(enters, there.source, previous_source)
        here.extras = _select(enters, there.extras, here.extras)
        leaves = dr.max(mi.Spectrum(there.extinction)) == 0
        there.source = dr.select(leaves, here.source, there.source)
        there.extras = _select(leaves, here.extras, there.extras)
        return extinction, previous_source

    def _curved(
        self, state: _MarchState, before: tuple, there: _FieldSample, length: mi.Float
    ) -> tuple[tuple, tuple]:
        """Return the extinctions and sources at both ends, corrected for their curvature where the
        quadrature rule is of third order.
        """
        here, ratio = state.here, length / state.previous_length
        # Ignore the curvature behind a short first step.
        ratio = dr.select(ratio < 2, ratio, 0)
        if not RULES[self._projection.quadrature].is_third_order:
            return (here.extinction, there.extinction), (here.source, there.source)
        return (
            curved(before[0], here.extinction, there.extinction, ratio),
            curved(before[1], here.source, there.source, ratio),
        )

    def _add_scattered(self, state: _MarchState, part: _MarchedSegment, sources: tuple) -> tuple:
        """Add in-scattered radiance; return that of both ends before its attenuation."""
        near, far = part.weights[0] * sources[0], part.weights[1] * sources[1]
        if self._projection.falloff is not None:
            falloff = self._projection.falloff.means(self._lamps, state.t, part.end)
            near, far = near * falloff[0], far * falloff[1]
        state.radiance += state.transmittance * (near + far)
        return near, far

    def _add_direct(self, state: _MarchState, part: _MarchedSegment, peak: list) -> None:
        """Add radiance that is scattered once on its way from the direct lights."""
        projection, ray, end = self._projection, self._ray, part.end
        if not projection.direct_lights:
            return
        albedo = projection.medium.albedo
        albedos = tuple(mi.Spectrum(albedo.at_world(ray(t))) for t in (state.t, end))
        peak_depth = [0.5 * (state.peak[0] + peak[0])] if state.peak else []
        ends = state.t, end
        if not state.means:
            calls = [self._call(light) for light in projection.direct_lights]
            values = ray, ends, part.extinctions, part.weights, albedos, peak_depth
            state.radiance += state.transmittance * _sum_of_calls(calls, values)
            return
        for i, light in enumerate(projection.direct_lights):
            skipped = light.mean_extinction(ray(state.t), part.skip)
            mean = dr.select(part.skip, skipped, state.means[i])
            state.means[i] = light.mean_extinction(ray(end), state.active)
            means = mean, state.means[i]
            lit = RaySegment(ray, ends, part.extinctions, means, part.weights, albedos)
            scattered = light.scattered(lit, self._scattering, *peak_depth)
            state.radiance += state.transmittance * scattered

    def _call(self, light: DirectLightAlongRays) -> Callable:
        """Return a function of the values of a segment: the radiance that ``light`` adds."""

        def scattered(ray, ends, extinctions, weights, albedos, peak_depth):
            means = tuple(light.mean_extinction(ray(t), mi.Bool(True)) for t in ends)
            lit = RaySegment(ray, ends, extinctions, means, weights, albedos)
            return light.scattered(lit, self._scattering, *peak_depth)

        return scattered

    def _add_emitted(self, state: _MarchState, part: _MarchedSegment, length: mi.Float) -> None:
        emission = self._projection.medium.emission
        if emission is None:
            return
        at_end = mi.Spectrum(emission.at_world(self._ray(part.end), True))
        sides = emission_weights(self._projection.quadrature, part.extinctions, length)
        state.emitted += state.transmittance * (sides[0] * state.emission + sides[1] * at_end)
        state.emission = at_end

    def _choose_stride(self, state: _MarchState) -> None:
        """Choose the length of the next step by the radiance that remains, and end rays to which
        little is added.
        """
        # Compare an upper bound of the radiance still to be added with the accumulated radiance.
        # Where there is none (`_dark`), compare the transmittance with 1.
        remaining = dr.max(mi.Spectrum(state.transmittance)) * self._max_radiance
        accumulated = dr.select(self._dark, 1, dr.max(state.radiance + state.emitted))
        state.active &= remaining > EARLY_STOP * accumulated
        if RULES[self._projection.quadrature].is_third_order:
            stride = dr.select(remaining > COARSER * accumulated, mi.Float(1), 2)
            stride = dr.select(remaining > COARSEST * accumulated, stride, 4)
            if self._projection.substeps is not None:
                extinction = dr.max(mi.Spectrum(state.here.extinction))
                depth = dr.maximum(extinction * self._projection.step, 1e-6)
                count = dr.floor(SUBSTEP_DEPTH * dr.rcp(depth))
                stride *= dr.clip(count, 1, self._projection.substeps)
                # The random offset covers a short step only: vary the first one among all lengths.
                first = self._lattice[2] * FRACTION
                first = dr.floor((first - dr.floor(first)) * stride) + 1
                stride = dr.select(state.k == 0, first, stride)
            state.stride = stride


@symbolic
def _sum_of_calls(calls: Sequence[Callable], values: tuple):
    """Sum the spectra that functions of ``values`` return, by calls in the kernel: it contains code
    that several of them share once.
    """
    total, i, count = mi.Spectrum(0), mi.UInt32(0), dr.opaque(mi.UInt32, len(calls))
    while dr.hint(i < count, label="calls"):
        total += dr.switch(i, calls, *values)
        i += 1
    return total


def _simplified(field: Field) -> Field:
    """Replace a grid with equal values by a constant field."""
    if not isinstance(field, GridField) or _varies(field):
        return field
    index, n = dr.arange(mi.UInt32, field.grid.voxel_count), field.channels
    channels = [field.data]
    if n > 1:
        channels = [dr.gather(mi.Float, field.data, index * n + c) for c in range(n)]
    ends = [(dr.min(c)[0], dr.max(c)[0]) for c in channels]
    if any(a != b for a, b in ends):
        return field
    return ConstantField(np.array([a for a, _ in ends]) * field.scale[0])


def _varies(field: GridField) -> bool:
    """Return whether some of 4096 scattered voxels differ, which is faster than testing all of
    them.
    """
    voxels, channels = field.grid.voxel_count, field.channels
    count = min(voxels, 4096)
    place = dr.arange(mi.UInt32, count) * dr.opaque(mi.UInt32, voxels // count * channels)
    same = mi.Bool(True)
    for c in range(channels):
        first = dr.gather(mi.Float, field.data, mi.UInt32(c))
        same &= dr.gather(mi.Float, field.data, place + c) == first
    return not dr.all(same)[0]


def _select(mask: mi.Bool, a: list, b: list) -> list:
    return [dr.select(mask, x, y) for x, y in zip(a, b, strict=True)]


def _gather(
    gathered: list,
    transmittance: mi.Float | mi.Color3f,
    distance: mi.Float | mi.Color3f,
    weights: tuple,
    radiance: tuple,
    extras: tuple[list, list],
) -> list:
    """Add a segment to colour, depth and errors.

    The colour is weighted by the albedo, the depth by the absorptance times distance, and the
    errors are those of the radiance from both ends.
    """
    (near_albedo, *near_errors), (far_albedo, *far_errors) = extras
    colour = mi.Spectrum(transmittance * (weights[0] * near_albedo + weights[1] * far_albedo))
    near, far = (luminance(mi.Spectrum(transmittance * end)) for end in radiance)
    errors = [near * a + far * b for a, b in zip(near_errors, far_errors, strict=True)]
    added = [colour, luminance(mi.Spectrum(transmittance * distance)), *errors]
    return [old + new for old, new in zip(gathered, added, strict=True)]
