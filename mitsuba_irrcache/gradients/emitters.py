"""Derivatives with respect to the radiance of emitters, on which images depend linearly.

The derivative with respect to the radiance that enters the medium along an ordinate, or that
reaches the camera without scattering, is the adjoint radiance there. Mitsuba propagates it to the
emitters' parameters: the emitters are evaluated again, with gradients enabled, for the same
directions.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.gradients.resampling import volume_of
from mitsuba_irrcache.gradients.scattering import Components, OrdinatePart
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel


class EmitterAdjoint:
    """Derivatives with respect to the radiance of the emitters ``wanted`` of ``scene``, accumulated
    in the gradients of their parameters.
    """

    def __init__(self, scene: mi.Scene, wanted: Sequence[mi.Emitter]) -> None:
        self._scene, self._wanted = scene, list(wanted)
        environment = scene.environment()
        self._environment = environment if environment in self._wanted else None

    def __len__(self) -> int:
        return len(self._wanted)

    def add_background(self, direction: mi.Vector3f, adjoint: mi.Spectrum) -> None:
        """Accumulate the derivatives through the environment that camera rays see directly, where
        ``adjoint`` is the derivative with respect to its radiance in each ``direction`` of a ray.
        """
        if self._environment is not None:
            self._add_environment(-direction, adjoint)

    def add_transport(self, transport: AdjointTransport, found: Derivatives) -> None:
        """Accumulate the derivatives through the irradiance of voxels by emitters, where
        ``found.direct`` is the derivative with respect to the direct irradiance of each voxel.
        """
        lights = transport.lights
        for light, emitter in enumerate(lights.emitters[: lights.points]):
            if emitter in self._wanted:
                _add_point(light, transport, found)
        suns = lights.emitters[lights.points :]
        if self._environment is None and not any(sun in self._wanted for sun in suns):
            return
        derivatives = self._derivatives_by_ordinates(transport, found)
        directions = transport.ordinates.directions
        tracks, end = lights.sun_tracks, lights.even
        for number, sun in enumerate(suns):
            if sun in self._wanted:
                rows = derivatives[end + number * tracks : end + (number + 1) * tracks, 0]
                _add_sun(sun, rows.mean(axis=0))
        if self._environment is not None:
            both = np.stack([directions[:end], -directions[:end]], axis=1).reshape(-1, 3)
            angle = environment_angles(transport)
            towards = mi.Vector3f(both.T.astype(np.float32))
            adjoint = (derivatives[:end] * angle).reshape(len(both), -1)
            self._add_environment(towards, mi.Spectrum(adjoint.T.astype(np.float32)))

    def _add_environment(self, direction: mi.Vector3f, adjoint: mi.Spectrum) -> None:
        """Accumulate the derivatives through the environment's radiance along each ``direction`` of
        propagation, where ``adjoint`` is the derivative with respect to that radiance.
        """
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        interaction.wi = direction
        dr.eval(interaction, adjoint)
        with dr.resume_grad():
            pull(self._environment.eval(interaction), adjoint)

    def _derivatives_by_ordinates(
        self, transport: AdjointTransport, found: Derivatives
    ) -> np.ndarray:
        """Return the derivatives (n, 2, channels) with respect to the irradiance that enters along
        both directions of each of the n pairs of opposite ordinates.
        """
        result = np.zeros((len(transport.ordinates.directions), 2, transport.channels))
        for number, part in enumerate(transport.parts):
            for level, channels in transport.levels:
                scattered = [found.direct[c][number] for c in channels]
                for c, values in zip(
                    channels,
                    _transmitted_importance(level, transport, part, scattered),
                    strict=True,
                ):
                    own = result[part.rows, :, c]
                    result[part.rows, :, c] = np.where(part.mask, values, own)
        return result


def _transmitted_importance(
    level: MultigridLevel,
    transport: AdjointTransport,
    part: OrdinatePart,
    scattered: list[Components],
) -> list[np.ndarray]:
    """Return, for each channel, integrals (n, 2) over voxels of the transmittance from the point
    where each ordinate of a ``part`` enters, times the importance ``scattered`` along it.
    """
    # docs/primer, eq. (8.10)
    directions, _, unused, offsets = part.ordinates
    tracks, scattering = level.tracks, transport.scattering
    count, voxels = len(directions), transport.grid.voxel_count
    found = [np.zeros((count, 2)) for _ in scattered]
    if not count:
        return found
    table = tracks.table(directions, np.ones((count, 2)), 0 * unused, offsets)
    none, forward = [dr.zeros(mi.Float, voxels)] * scattering.count, table.geometry.forward
    for _, group, copies in tracks.sweep_separately(
        table, lambda group: scattering.along(level, none, group)
    ):
        place = dr.arange(mi.UInt32, 2 * len(group) * voxels)
        transmittance = dr.gather(mi.Float, copies, place * 4 + 1)
        for components, result in zip(scattered, found, strict=True):
            # The importance travels against the radiance.
            opposite = place + (1 - 2 * (place // voxels % 2)) * voxels
            importance = dr.gather(mi.Float, scattering.along(level, components, group), opposite)
            sums = dr.block_sum(transmittance * importance, voxels)
            both = np.array(sums, dtype=np.float64).reshape(-1, 2)
            rows = np.array(group.rows)
            # A table holds the direction along the dominant axis first.
            result[rows] = np.where(forward[rows, None], both, both[:, ::-1])
    return [result * volume_of(transport.grid) for result in found]


def environment_angles(transport: AdjointTransport) -> np.ndarray:
    """Return the solid angles (n, 2, channels) that the ordinates before those of suns represent
    for the radiance of the environment.
    """
    own = Ordinates(*(values[: transport.lights.even] for values in transport.ordinates))
    return transport.illumination.solid_angles(own)


def _add_point(light: int, transport: AdjointTransport, found: Derivatives) -> None:
    """Accumulate the derivatives through the irradiance of a point-like light."""
    lights = transport.lights
    emitter = lights.emitters[light]
    at = dr.zeros(mi.Interaction3f, transport.grid.voxel_count)
    at.p = lights.positions
    # Not the ratio of the irradiance to that without the medium: both may be 0 in a channel.
    share = lights.spread * dr.opaque(mi.Float, volume_of(transport.grid))
    adjoint = lights.transmittance(light) * lights.derivative(light, found.direct) * share
    dr.eval(at, adjoint)
    with dr.resume_grad():
        _, value = emitter.sample_direction(at, mi.Point2f(0.5))
        pull(value, adjoint)


def _add_sun(emitter: mi.Emitter, adjoint: np.ndarray) -> None:
    """Accumulate the derivatives through the irradiance of a sun, given by channel."""
    weights = mi.Spectrum([dr.opaque(mi.Float, float(v)) for v in adjoint])
    with dr.resume_grad():
        _, value = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
        pull(value, weights)


def pull(value: mi.Spectrum, adjoint: mi.Spectrum) -> None:
    """Accumulate derivatives of ``value . adjoint`` in the parameters that ``value`` depends on."""
    total = dr.sum(dr.dot(value, adjoint))
    if dr.grad_enabled(total):  # not if the adjoint is a literal 0
        # Keep the edges of the AD graph: an emitter is evaluated more than once.
        dr.backward_from(total, flags=dr.ADFlag.ClearVertices)
