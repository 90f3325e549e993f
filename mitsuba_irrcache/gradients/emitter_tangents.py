"""Forward mode for the radiance of emitters, on which images depend linearly."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.emitters import environment_angles
from mitsuba_irrcache.gradients.lights import LightsOfOneDirection
from mitsuba_irrcache.gradients.parameters import refuse
from mitsuba_irrcache.gradients.transport import AdjointTransport
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of, suns


class EmitterTangents:
    """Changes of the emitters of ``scene``.

    ``changes`` has the change of the parameter on which the radiance of an emitter depends and the
    value and key of this parameter, by emitter. ``is_coloured`` states that the extinction of the
    medium has several channels.
    """

    def __init__(
        self,
        scene: mi.Scene,
        changes: dict[mi.Emitter, tuple[object, object, str]],
        is_coloured: bool,
    ) -> None:
        self._scene, self._changes, self._is_coloured = scene, changes, is_coloured
        environment = scene.environment()
        self._environment = None
        if environment in changes:
            change, *_ = changes[environment]
            self._environment = _ChangedEnvironment(environment, change)

    def __len__(self) -> int:
        return len(self._changes)

    def background(self, direction: mi.Vector3f) -> mi.Spectrum:
        """Return the change of the radiance of the environment in each ``direction`` of a ray."""
        return mi.Spectrum(0) if self._environment is None else self._environment.along(-direction)

    def lights(self, lights: LightsOfOneDirection) -> list[mi.Spectrum]:
        """Return, for each emitter of ``lights``, the change of its irradiance in all voxels.

        It is 0 for suns, whose change `incoming` returns.
        """
        found = []
        pairs = zip(lights.emitters, lights.irradiance, strict=True)
        for number, (emitter, irradiance) in enumerate(pairs):
            relative = [(0, 0.0)] * dr.size_v(mi.Spectrum)
            if number < lights.points and emitter in self._changes:
                relative = self._relative_by_channel(emitter)
            changes = [dr.opaque(mi.Float, factor) * irradiance[c] for c, factor in relative]
            found.append(mi.Spectrum(changes))
        return found

    def _relative_by_channel(self, emitter: mi.Emitter) -> list[tuple[int, float]]:
        """Return, for each channel of an emitter without extent, a channel in which it emits and
        whose radiance the medium attenuates equally, and the change relative to that channel.
        """
        change, value, key = self._changes[emitter]
        brightest, factors = _relative(change, value, key)
        if not self._is_coloured:
            return [(brightest, factor) for factor in factors]
        values, changes = _by_channel(value), _by_channel(change)
        if (changes[values <= 0] != 0).any():
            raise IrrcacheError(
                f'irrcache: dr.forward from "{key}" in coloured extinction needs positive values '
                f"in all channels that change, not {values}; start with small positive ones, or "
                "use dr.backward."
            )
        relative = changes / np.where(values > 0, values, 1)
        return list(enumerate(relative.tolist()))

    def incoming(self, transport: AdjointTransport) -> np.ndarray | None:
        """Return the changes (n, 2, channels) of the irradiance that enters along the ordinates;
        None if there are none.
        """
        all_suns = suns(self._scene)
        if self._environment is None and not any(sun in self._changes for sun in all_suns):
            return None
        directions, incoming, *_ = transport.ordinates
        result = np.zeros((len(directions), 2, transport.channels))
        tracks, end = transport.lights.sun_tracks, transport.lights.even
        for number, sun in enumerate(all_suns):
            if sun in self._changes:
                rows = slice(end + number * tracks, end + (number + 1) * tracks)
                channel, factor = _relative(*self._changes[sun])
                result[rows] = incoming[rows][..., [channel]] * np.array(factor)
        if self._environment is not None:
            both = np.stack([directions[:end], -directions[:end]], axis=1).reshape(-1, 3)
            angle = environment_angles(transport)
            change = self._environment.along(mi.Vector3f(both.T.astype(np.float32)))
            values = [np.broadcast_to(np.array(c, np.float64), len(both)) for c in change]
            result[:end] = np.stack(values, axis=1).reshape(end, 2, -1) * angle
        return result


class _ChangedEnvironment:
    """The change of the radiance of an environment whose parameter changes."""

    def __init__(self, environment: mi.Emitter, change: object) -> None:
        self._constant, self._maps = None, []
        if kind_of(environment) is EmitterKind.CONSTANT_ENVIRONMENT:
            self._constant = mi.Spectrum(change)
            return
        # Maps are sampled in proportion to their luminance, which has to be positive.
        for sign in (1, -1):
            values = np.maximum(sign * np.array(change), 0)
            if values.any():
                self._maps.append((sign, _like(environment, values)))

    def along(self, direction: mi.Vector3f) -> mi.Spectrum:
        """Return the change along each ``direction`` of propagation."""
        if self._constant is not None:
            return self._constant
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        interaction.wi = direction
        return sum((sign * own.eval(interaction) for sign, own in self._maps), mi.Spectrum(0))


def _like(environment: mi.Emitter, values: np.ndarray) -> mi.Emitter:
    """Return an environment map with other texels."""
    own = mi.traverse(environment)
    start = np.ones((values.shape[0], values.shape[1] - 1, 3), dtype=np.float32)
    place = mi.ScalarTransform4f(np.array(own["to_world"].matrix, dtype=np.float64).reshape(4, 4))
    result = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(start), "to_world": place})
    params = mi.traverse(result)
    params["scale"] = own["scale"]
    params["data"] = type(params["data"])(values.astype(np.float32))
    params.update()
    return result


def _relative(change: object, value: object, key: str) -> tuple[int, list[float]]:
    """Return the brightest channel of an emitter, and changes of all, relative to that channel."""
    if dr.is_tensor_v(value):
        refuse(key, "dr.forward was called from a texture")
    values, changes = _by_channel(value), _by_channel(change)
    channel = int(values.argmax())
    if values[channel] <= 0:
        raise IrrcacheError(
            f'irrcache: dr.forward from "{key}" needs a positive value, not {values.max():g}; '
            "start with a small positive one, or use dr.backward."
        )
    return channel, (changes / values[channel]).tolist()


def _by_channel(value: object) -> np.ndarray:
    """Return the values of a number or colour by channel."""
    columns = np.array(mi.Spectrum(dr.detach(value)), np.float64)
    return columns.reshape(dr.size_v(mi.Spectrum), -1)[:, 0]
