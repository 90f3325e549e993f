"""Projection of the cache to the screen: ray marching of the radiative transfer equation (paper,
eq. 1).

    L = int T (sigma_s Phi / (4 pi) + j) dt + T L_background

where j is what the medium sends out itself (`emission`).

One step is as long as the shortest voxel edge, of the medium's grids and the cache's, times
``step``; steps end on the medium's bounds, never beyond. The lattice of steps is shifted by a
random offset per ray, so that what is left of the discretisation is noise, not bands. Macrocells
without extinction are crossed many at a time, and what is hardly seen in longer steps.

Rays read copies of the fields that are laid out for them, in 16 bits (`packed_fields`).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularField
from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays
from mitsuba_irrcache.cache.uncertainty import UncertaintyField
from mitsuba_irrcache.core.fast_math import least
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.grids.fields import ConstantField, Field, GridField
from mitsuba_irrcache.grids.packed_fields import AlongRay, Lookups
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.render.aovs import Layers
from mitsuba_irrcache.render.empty_space import Clearance
from mitsuba_irrcache.render.quadrature import curved, emission_weights, segment
from mitsuba_irrcache.scene.cut_cells import CutCells

#: A ray ends early once nothing ahead, not even the brightest cache voxel or the background seen
#: through the transmittance left, can change its radiance by more than this fraction.
EARLY_STOP = 1e-4
#: Where no more than these fractions of a ray's radiance can still be added, steps are twice and
#: four times as long: what they miss, they miss of a small rest only.
COARSER, COARSEST = 0.2, 0.03
#: Optical depth of a step that counts for greater ones, too: what 16 bits tell of thin matter is
#: measured by the densest.
OPAQUE = 4096.0


class Projection:
    """Everything a camera ray needs: the medium, the cached irradiance, and the quadrature rule.

    With ``layered``, rays also gather what `Layers` holds beside the radiance; with an
    ``uncertainty``, the error of the cache too.
    """

    def __init__(
        self,
        medium: MediumGrid,
        irradiance: GridField | None,
        quadrature: str,
        step: float,
        layered: bool = False,
        uncertainty: UncertaintyField | None = None,
        directional: AngularField | None = None,
        edges: CutCells | None = None,
        falloff: InverseSquareFactor | None = None,
        direct_lights: Sequence[DirectLightAlongRays] = (),
    ) -> None:
        self.medium = medium
        self.lit = irradiance is not None
        self._channels = irradiance.channels if irradiance else 1
        self.quadrature = quadrature
        self.layered = layered
        self.uncertainty = uncertainty
        self.directional = directional
        #: how the light of lamps falls off, which the cache is without
        self.falloff = falloff
        #: spot lights, which are not in the irradiance
        self._direct_lights = list(direct_lights)
        #: surfaces that end the light, where there are any, and the light that they choose from
        self._edges = (edges, irradiance) if edges is not None else None
        albedo = _constant_if_it_is(medium.albedo)
        fields = medium.sigma_t, medium.albedo, irradiance, medium.emission
        grids = [f.grid for f in fields if f and f.grid]
        # Where nothing varies, one step is exact.
        length = min((g.voxel_size.min() for g in grids), default=dr.inf) * step
        self.step = dr.opaque(mi.Float, float(length))
        brightest = irradiance.maximum * albedo.maximum / (4 * dr.pi) if irradiance else 0.0
        if directional is not None:
            brightest *= directional.directional.phase.peak
        self.brightest = dr.opaque(mi.Float, brightest)
        emission = medium.emission
        self.brightest_emission = dr.opaque(mi.Float, emission.maximum if emission else 0.0)
        self.clearance = Clearance(medium.macrocells, emission)
        needed = [medium.sigma_t]
        needed += [irradiance] if irradiance else []
        needed += [albedo] if irradiance or layered else []
        opaque = OPAQUE / length if length < dr.inf else dr.inf
        self.lookups = Lookups(needed, [opaque, *[dr.inf] * (len(needed) - 1)])

    def fetch(self, fields: AlongRay, t: mi.Float, view: tuple = ()) -> tuple:
        """Extinction; albedo Phi / (4 pi), in-scattered radiance per unit of optical depth, without
        the falloff; and what layers need to know of the point: the albedo, and the relative errors
        of Phi. ``view`` is what `seen_along` says of the ray.
        """
        # docs/primer, eq. (1.3)
        p, active = fields.ray(t), mi.Bool(True)
        sigma_t, *rest = fields.at(t, active)
        known = [rest[-1]] if self.layered else []
        if not self.lit:
            return sigma_t, mi.Float(0), known
        phi, albedo = rest
        phi = self._within_edges(p, phi, active)
        if self.uncertainty is not None:
            known += self.uncertainty.at_world(p, phi, active)
        if self.directional is not None:
            phi = phi * self.directional.factor(p, *view, active)
        return sigma_t, albedo * phi * dr.inv_four_pi, known

    def seen_along(self, direction: mi.Vector3f) -> tuple:
        """What `fetch` has to know of a ray: nothing where the medium is isotropic."""
        if self.directional is None:
            return ()
        return direction, self.directional.directional.basis(direction)

    def irradiance_at(
        self, p: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> mi.Float | mi.Color3f:
        """The cached irradiance alone, as much as paths from surfaces see along ``direction``."""
        _, phi, *_ = self.lookups.at_world(p, active)
        phi = self._within_edges(p, phi, active)
        if self.falloff is not None:
            phi = phi * self.falloff.at(p)
        for light in self._direct_lights:
            phi = phi + light.at(p, active)
        if self.directional is None:
            return phi
        view = self.seen_along(direction)
        return phi * self.directional.factor(p, *view, active, with_peak=False)

    @property
    def blurs(self) -> bool:
        """Whether light in a forward peak counts as not scattered (see `delta_m`)."""
        return self.directional is not None and self.medium.unscattered_exponent != 1

    def unscattered(self, transmittance: mi.Spectrum) -> mi.Spectrum:
        """What is left of a ``transmittance`` where it counts as scattered."""
        if not self.blurs:
            return transmittance
        return dr.power(transmittance, dr.opaque(mi.Float, self.medium.unscattered_exponent))

    def _within_edges(
        self, p: mi.Point3f, phi: mi.Float | mi.Color3f, active: mi.Bool
    ) -> mi.Float | mi.Color3f:
        """Irradiance that was looked up, without what is on the other side of surfaces."""
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
    ):
        """Scattered radiance, transmittance and the radiance that the medium itself sends out,
        between ``near`` and ``far``, each an ``mi.Spectrum``; between the last two the sums that
        `aovs` makes `Layers` of.

        ``offset`` in (0, 1] is the length of the first step in steps; ``background`` is the
        radiance behind the medium, which early termination has to know.
        """
        # docs/primer, eqs. (1.1), (5.1)
        clear, fields = self.clearance.along(ray), self.lookups.along(ray)
        active = mi.Bool(active) & (near < far)
        # Points of the lattice are counted from 1; number 0 is ``near``, reached by a first step
        # of no length that only finds the values there.
        k, stride = mi.Float(0), mi.Float(1)
        t, step = mi.Float(near), self.step
        per_step = dr.rcp(step)
        extinction, source, known = self._nowhere()
        before, before_source, before_length = extinction, source, mi.Float(dr.inf)
        grey = self.medium.sigma_t.channels == 1
        view = self.seen_along(ray.d)
        lamps = self.falloff.along(ray) if self.falloff is not None else []
        transmittance = mi.Float(1) if dr.hint(grey, mode="scalar") else mi.Color3f(1)
        radiance, emitted, shine = mi.Spectrum(0), mi.Spectrum(0), mi.Spectrum(0)
        emission = self.medium.emission
        gathered = self.nothing()
        means = [light.mean_extinction(ray(t), active) for light in self._direct_lights]
        brightest = dr.maximum(self.brightest, dr.max(background))
        brightest += self.brightest_emission * dr.maximum(far - near, 0)
        dark = brightest == 0
        brightest = dr.select(dark, 1, brightest)
        # A float counts steps exactly up to 2^24; longer lattices are coarser, not endless.
        limit = dr.minimum(dr.ceil((far - near) / step) + 1, 2**24)
        while dr.hint(active, label="ray march"):
            # In empty space, go on from the last point of the lattice inside it.
            empty, wall = clear.exit(t, active)
            last = dr.floor(dr.fma(least(wall, far) - near, per_step, -offset)) + 1
            skip = empty & (last >= k) & (last >= 1)
            last = least(last, limit)
            k = dr.select(skip, last + 1, k + stride - 1)
            t = dr.select(skip, least(dr.fma(last - 1 + offset, step, near), far), t)
            extinction = dr.select(skip, 0, extinction)
            before = dr.select(skip, 0, before)
            before_length = dr.select(skip, step, before_length)
            shine = dr.select(skip, 0, shine)
            end = least(dr.fma(k - 1 + offset, step, near), far)
            end = dr.select(k == 0, near, end)
            end = dr.select(k >= limit, far, end)
            next_extinction, next_source, next_known = self.fetch(fields, end, view)
            # The light of a segment that enters or leaves matter comes from its end inside:
            # where there is none the cache may know nothing.
            enters = dr.max(mi.Spectrum(extinction)) == 0
            source = dr.select(enters, next_source, source)
            before_source = dr.select(enters, next_source, before_source)
            known = _select(enters, next_known, known)
            leaves = dr.max(mi.Spectrum(next_extinction)) == 0
            next_source = dr.select(leaves, source, next_source)
            next_known = _select(leaves, known, next_known)
            length = end - t
            ratio = length / before_length
            ratio = dr.select(ratio < 2, ratio, 0)  # a short first step tells no curvature
            ends = (extinction, next_extinction), (source, next_source)
            if dr.hint(self.quadrature == "exponential", mode="scalar"):
                ends = (
                    curved(before, extinction, next_extinction, ratio),
                    curved(before_source, source, next_source, ratio),
                )
            weights, passed = segment(self.quadrature, ends[0], length)
            near_light, far_light = weights[0] * ends[1][0], weights[1] * ends[1][1]
            if dr.hint(self.falloff is not None, mode="scalar"):
                falloff = self.falloff.means(lamps, t, end)
                near_light, far_light = near_light * falloff[0], far_light * falloff[1]
            radiance += transmittance * (near_light + far_light)
            for i, light in enumerate(self._direct_lights):
                albedos = self._albedo_at(ray(t)), self._albedo_at(ray(end))
                mean = dr.select(skip, light.mean_extinction(ray(t), skip), means[i])
                means[i] = light.mean_extinction(ray(end), active)
                radiance += transmittance * light.scattered(
                    ray, (t, end), ends[0], (mean, means[i]), weights, albedos
                )
            if dr.hint(self.layered, mode="scalar"):
                gathered = _gather(
                    gathered,
                    transmittance,
                    weights[0] * t + weights[1] * end,
                    weights,
                    (near_light, far_light),
                    (known, next_known),
                )
            if dr.hint(emission is not None, mode="scalar"):
                next_shine = mi.Spectrum(emission.at_world(ray(end), True))
                sides = emission_weights(self.quadrature, ends[0], length)
                emitted += transmittance * (sides[0] * shine + sides[1] * next_shine)
                shine = next_shine
            transmittance *= passed
            before, before_source, before_length = extinction, source, length
            extinction, source, known = next_extinction, next_source, next_known
            # The most that can still be added, over what there is (without any light: 1).
            left = dr.max(mi.Spectrum(transmittance)) * brightest
            sofar = dr.select(dark, 1, dr.max(radiance + emitted))
            active &= left > EARLY_STOP * sofar
            if dr.hint(self.quadrature == "exponential", mode="scalar"):
                stride = dr.select(left > COARSER * sofar, mi.Float(1), 2)
                stride = dr.select(left > COARSEST * sofar, stride, 4)
            t = end
            k += 1
            active &= (t < far) & (~empty | (wall < far))
        return radiance, mi.Spectrum(transmittance), gathered, emitted

    def _albedo_at(self, p: mi.Point3f) -> mi.Spectrum:
        return mi.Spectrum(self.medium.albedo.at_world(p))

    def _nowhere(self) -> tuple:
        """What `fetch` returns, of no place."""

        def zero(*channels: int) -> mi.Float | mi.Color3f:
            return (mi.Color3f if 3 in channels else mi.Float)(0)

        albedo = self.medium.albedo.channels
        source = zero(albedo, self._channels) if self.lit else mi.Float(0)
        known = [zero(albedo)] if self.layered else []
        if self.uncertainty is not None and self.lit:
            known += [mi.Float(0)] * self.uncertainty.count
        return zero(self.medium.sigma_t.channels), source, known

    @property
    def channel_count(self) -> int:
        """Values in `Layers`, 0 without them."""
        errors = self.uncertainty.count if self.uncertainty is not None else 1
        return 4 * dr.size_v(mi.Spectrum) + 1 + errors if self.layered else 0

    def nothing(self) -> list:
        """What has been gathered at the start of a ray: colour, depth, errors."""
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
        """What `march` returned, with names; ``weight`` is the sensor's weight of the radiance."""
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


def _constant_if_it_is(field: Field) -> Field:
    """A grid that holds one value only, as that value."""
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
    """Whether some of its voxels, scattered over the grid, differ: it takes less time to find out
    than that none does.
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
    light: tuple,
    known: tuple[list, list],
) -> list:
    """Adds a segment to colour, depth and errors: the sources' weights times the albedo, absorbed
    light times distance, and the radiance from both ends times its relative errors.
    """
    (near_albedo, *near_errors), (far_albedo, *far_errors) = known
    colour = mi.Spectrum(transmittance * (weights[0] * near_albedo + weights[1] * far_albedo))
    near, far = (luminance(mi.Spectrum(transmittance * end)) for end in light)
    errors = [near * a + far * b for a, b in zip(near_errors, far_errors, strict=True)]
    added = [colour, luminance(mi.Spectrum(transmittance * distance)), *errors]
    return [old + new for old, new in zip(gathered, added, strict=True)]
