"""Forward mode in scenes with surfaces, area emitters and several media.

It is the transpose of `surroundings_adjoint`, stage by stage: paths from all voxels have the change
of the radiance that is incident there at a fixed fluence; discrete ordinates scatter it within the
box of a medium; and paths from the voxels read what has left a medium and returns.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.gradients.coupled_medium import CoupledMedium, added_components
from mitsuba_irrcache.gradients.film import FilmTangent
from mitsuba_irrcache.gradients.path_derivatives import PathTangent
from mitsuba_irrcache.gradients.paths import Start
from mitsuba_irrcache.gradients.scattering import Components
from mitsuba_irrcache.gradients.surroundings import (
    CAMERA,
    DERIVATIVES,
    EXCHANGE,
    LANES,
    MOST_EXCHANGES,
    TOLERANCE,
    Surroundings,
    means,
    warn_of_exchanges,
)
from mitsuba_irrcache.gradients.tangent_fields import ChangesOfVoxels, MediumChanges, SceneChanges
from mitsuba_irrcache.gradients.tangent_transport import propagated

#: Number of paths from the voxels of a medium for changes through the irradiance from the
#: surroundings, and for each exchange with the surroundings; minimum number for each voxel.
RAYS, EXCHANGED, FEWEST = 1 << 20, 1 << 18, 16


class SurroundingsTangent(Surroundings):
    """Changes of images of a scene along those of its media, emitters and surfaces, through paths.

    ``changes`` do not include those of the fluence of the media. The other arguments are those of
    `Surroundings`.
    """

    paths = PathTangent

    def __init__(
        self,
        scene: mi.Scene,
        media: list[CoupledMedium],
        hide_emitters: bool,
        kinds: tuple[bool, bool],
        seed: int,
        changes: SceneChanges,
    ) -> None:
        super().__init__(scene, media, hide_emitters, kinds, seed)
        self._changes = changes
        with changes.attached.alone():
            pairs = zip(changes.media, self._transported(), strict=True)
        own = [replace(medium, collisions=collisions) for medium, collisions in pairs]
        #: changes of the scene and of the fluence
        self._all = changes._replace(media=own)

    def image(self, film: FilmTangent) -> mi.TensorXf:
        """Return the change of the image that ``film`` takes."""
        with self._changes.attached.alone():
            return self._image(film)

    def _image(self, film: FilmTangent) -> mi.TensorXf:
        self._views += 1
        sees = self._scene.environment() is not None and not self._hides
        has_alpha = film.has_alpha and not sees
        for number, (each, position) in enumerate(film.passes()):
            rng = self._random(CAMERA, number, dr.width(each.ray.d), self._views)
            paths = self._new_paths(from_camera=True)
            camera = mi.Ray3f(each.ray), each.radiance, None, None, rng
            paths.trace(Start(*camera, medium=film.medium))
            alpha = paths.alpha(self._all) if has_alpha else mi.Float(0)
            film.add(position, paths.radiance(self._all), alpha)
        return film.image()

    # Transport

    def _transported(self) -> list[ChangesOfVoxels]:
        """Return the changes of the fluence of collisions in all media, as camera rays read it."""
        # docs/primer, eqs. (8.22), (8.23)
        first = [self._incident(n, DERIVATIVES, self._changes) for n in range(len(self.media))]
        change = total = self._propagated(first)
        scale, number = self._norm(total), 0
        while not self.media[0].single and self._norm(change) > TOLERANCE * scale:
            if number == MOST_EXCHANGES:
                warn_of_exchanges()
                break
            change = self._propagated(self._returned(change, number))
            total = [added_components(*own) for own in zip(total, change, strict=True)]
            dr.eval(total)
            number += 1
        return self._readable(total)

    def _propagated(self, first: list[list[list[Components]]]) -> list[list[Components]]:
        return [propagated(m.transport, own) for m, own in zip(self.media, first, strict=True)]

    def _readable(self, change: list[list[Components]]) -> list[ChangesOfVoxels]:
        return [ChangesOfVoxels(m.grid, own) for m, own in zip(self.media, change, strict=True)]

    def _returned(
        self, change: list[list[Components]], exchange: int
    ) -> list[list[list[Components]]]:
        """Return the change of what is incident in the media after it has left its medium."""
        media = [MediumChanges({}, collisions=own) for own in self._readable(change)]
        read = self._changes._replace(media=media)
        use = EXCHANGE | exchange << 4
        return [self._incident(n, use, read, without_first=n) for n in range(len(self.media))]

    def _incident(
        self, number: int, use: int, changes: SceneChanges, without_first: int | None = None
    ) -> list[list[Components]]:
        """Return the change of the irradiance of a medium's voxels along ``changes`` of all media:
        by channel, the components for each part of the radiance.
        """
        medium, derivatives = self.media[number], use == DERIVATIVES
        voxels = medium.scattering_voxels
        paths_in_all = RAYS if derivatives else EXCHANGED
        each = max(paths_in_all // max(dr.width(voxels), 1), FEWEST)
        directions = min(1 << (each.bit_length() - 1), LANES)
        found = medium.no_irradiance()
        for own, start in self._starts(medium, voxels, directions, use << 4 | number, False):
            paths = self._new_paths(derivatives)
            paths.trace(start)
            parts = medium.by_part(start.ray.o, paths.incident(changes, without_first))
            for part, components in enumerate(parts):
                for layer, value in enumerate(means(components, directions)):
                    for channel in range(medium.channels):
                        dr.scatter(found[channel][part][layer], value[channel], own)
            dr.eval(found)
        return found

    def _norm(self, change: list[list[Components]]) -> float:
        """Return the sum of the magnitudes of changes of the radiance that all media scatter."""
        sums = [
            dr.sum(own * sum(dr.abs(layer) for layer in components))
            for medium, channels in zip(self.media, change, strict=True)
            for own, components in zip(medium.extinction, channels, strict=True)
        ]
        dr.eval(sums)
        return sum(float(each[0]) for each in sums)
