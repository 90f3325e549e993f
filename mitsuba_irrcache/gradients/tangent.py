"""Forward mode: the derivative of images in the direction of given changes of the parameters."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.emitter_tangents import EmitterTangents
from mitsuba_irrcache.gradients.film import LUMINANCE, CameraPass, FilmTangent
from mitsuba_irrcache.gradients.forward_peak import changes_without_peak
from mitsuba_irrcache.gradients.medium import MediumAdjoint, field_of, original_of
from mitsuba_irrcache.gradients.parameters import ALBEDO, EMISSION, SIGMA_T
from mitsuba_irrcache.gradients.points import add_paths_to_light
from mitsuba_irrcache.gradients.replay import RaySegments
from mitsuba_irrcache.gradients.tangent_fields import ChangesOfVoxels, FieldReader, MediumChanges
from mitsuba_irrcache.gradients.tangent_transport import FluenceTangent, VoxelTangents
from mitsuba_irrcache.grids.fields import ConstantField, Field, GridField


class ImageTangent:
    """Derivatives of images along changes of the medium and of the emitters.

    Args:
        medium: the medium and its fluence.
        changes: changes of the scene's fields, by role.
        mean_cosine: change of the mean cosine of the phase function.
        emitters: changes of the emitters.
    """

    def __init__(
        self,
        medium: MediumAdjoint,
        changes: dict[str, Field],
        mean_cosine: float,
        emitters: EmitterTangents,
    ) -> None:
        self._adjoint, self._emitters, self._g = medium, emitters, mean_cosine
        self._original = changes.get(SIGMA_T)
        self._fields = dict(changes)
        if medium.medium.original is not None:
            share = mean_cosine * medium.phases.forward if medium.phases is not None else 0.0
            own = changes.get(SIGMA_T), changes.get(ALBEDO)
            scaled = changes_without_peak(medium.medium, *own, share)
            self._fields |= dict(zip((SIGMA_T, ALBEDO), scaled, strict=True))
        self._collisions: ChangesOfVoxels | None = None
        if medium.transport is not None:
            self._collisions = self._transported()

    def _transported(self) -> ChangesOfVoxels:
        """Return the changes of the fluence of collisions as camera rays read it."""
        adjoint = self._adjoint
        transport, fields = adjoint.transport, self._fields
        roles = SIGMA_T, ALBEDO, EMISSION
        sigma_t, collided, emitted = adjoint.quadrature.means(
            *(fields.get(role) for role in roles), transport.albedo
        )
        dr.eval(sigma_t, collided, emitted)
        tangents = VoxelTangents(g=self._g, lights=self._emitters.lights(transport.lights))
        if SIGMA_T in fields:
            tangents.sigma_t = list(sigma_t)
            lights = transport.lights
            removed = [
                -irradiance * self._depth_to_light(light)
                for light, irradiance in enumerate(lights.irradiance)
            ]
            # Where camera rays evaluate the irradiance of an emitter, `_of_rays` finds its change.
            evaluated = [adjoint.march.evaluates(emitter) for emitter in lights.emitters]
            if any(evaluated):
                tangents.unseen = [
                    own if seen else mi.Spectrum(0)
                    for own, seen in zip(removed, evaluated, strict=True)
                ]
            tangents.lights = [
                change if seen else change + own
                for change, own, seen in zip(tangents.lights, removed, evaluated, strict=True)
            ]
        if fields.keys() & {SIGMA_T, ALBEDO}:
            tangents.collided = list(collided)
        if EMISSION in fields:
            tangents.emitted = list(emitted)
        tangents.incoming = self._emitters.incoming(transport)
        dr.eval(tangents.lights, tangents.unseen)
        of = FluenceTangent(transport, adjoint.fluence.collided, adjoint.extinction, tangents)
        return ChangesOfVoxels(adjoint.grid, of.for_camera())

    def _depth_to_light(self, light: int) -> mi.Spectrum:
        """Return the change of the optical depth between all voxels and an emitter."""
        adjoint, lights = self._adjoint, self._adjoint.transport.lights
        reader = FieldReader(
            mi.Spectrum(dr.zeros(mi.Float, adjoint.grid.voxel_count)), self._fields[SIGMA_T]
        )
        emitter, step = lights.emitters[light], adjoint.march.path_step
        for p, share in lights.positions_within(light, adjoint.positions):
            reader = add_paths_to_light(adjoint.medium, emitter, p, share, step, reader)
            dr.eval(reader.total)
        return reader.total

    def image(self, film: FilmTangent) -> mi.TensorXf:
        """Return the derivative of the image that ``film`` takes."""
        for each, position in film.passes():
            radiance, alpha = self._of_rays(each, film)
            film.add(position, radiance, alpha)
        return film.image()

    def _of_rays(self, each: CameraPass, film: FilmTangent) -> tuple[mi.Spectrum, mi.Float]:
        """Return the derivatives of the radiance and alpha of camera rays."""
        adjoint = self._adjoint
        segments, behind, weights = adjoint.rays(each, film.medium)
        ahead, transmittance, original = adjoint.marched(segments)
        peaked, blurred = adjoint.blurred(each, segments, weights[0], transmittance, original)
        behind = behind[0] + blurred, behind[1] - blurred
        ahead, unscattered = ahead + transmittance * behind[0], original * behind[1]
        visible = (transmittance * weights[0] + original * weights[1]) * each.radiance
        visible -= sum((weight for _, weight in peaked), mi.Spectrum(0))
        dr.eval(ahead, unscattered, visible, transmittance, original, peaked)
        random = each.sampler.next_1d()
        radiance = self._replayed(segments, ahead, unscattered, random)
        if self._emitters:
            radiance = radiance + visible * self._emitters.background(each.ray.d)
            for direction, weight in peaked:
                radiance += weight * self._emitters.background(direction)
        alpha = mi.Float(0)
        if film.has_alpha and not adjoint.shows_environment and SIGMA_T in self._fields:
            # Alpha is 1 - the mean transmittance.
            share = mi.Spectrum(-1 / dr.size_v(mi.Spectrum))
            none = mi.Spectrum(dr.zeros(mi.Float, dr.width(segments.near)))
            ends = [none + share * transmittance, none]
            if adjoint.is_scaled:
                ends = [none, none + share * original]
            dr.eval(ends)
            alpha = dr.sum(self._replayed(segments._replace(adjoint=none), *ends))
        dr.eval(radiance, alpha)
        return radiance, alpha

    def _replayed(
        self,
        segments: RaySegments,
        ahead: mi.Spectrum,
        unscattered: mi.Spectrum,
        random: mi.Float | None = None,
    ) -> mi.Spectrum:
        """Return the sum of all changes along rays, see `CameraReplay.replay`; with ``random``
        numbers also those of `CameraReplay.replay_light_paths`.
        """
        original = self._original if self._adjoint.is_scaled else None
        changes = MediumChanges(self._fields, self._g, self._collisions, original)
        readers = changes.readers(dr.width(segments.near))
        readers = self._adjoint.march.replay(segments, ahead, unscattered, readers)
        if random is not None and readers.sigma_t is not None:
            readers = self._adjoint.march.replay_light_paths(segments, random, readers)
        total = readers.total()
        dr.eval(total)
        return total


def changed_field(value: object, tangent: object, medium: MediumAdjoint, role: str) -> Field:
    """Return the change of a field of the scene's medium.

    ``tangent`` is the change of the parameter with this ``value`` from which it is computed: the
    transpose of `by_parameter`.
    """
    field = field_of(original_of(medium.medium), role)
    if field.grid is None:
        count = dr.size_v(mi.Spectrum)
        values = np.array(mi.Spectrum(tangent), np.float64).reshape(count, -1)[:, 0]
        return ConstantField(values, field.scale)
    flat = tangent.array
    if value.shape[3] != field.channels:
        place = dr.arange(mi.UInt32, field.grid.voxel_count) * 3
        parts = [dr.gather(mi.Float, flat, place + c) * s for c, s in enumerate(LUMINANCE)]
        flat = interleaved([sum(parts)])
    flat = flat * field.scale
    dr.eval(flat)
    return GridField(field.grid, flat, field.channels)
