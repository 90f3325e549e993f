"""A volume together with the transfer function that maps it to a medium."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.volumes.colours import Colours
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.scene import (
    ALBEDO_FILE,
    EMISSION_FILE,
    SIGMA_T_FILE,
    SceneSettings,
    camera,
    scene_xml,
)
from mitsuba_irrcache.volumes.transfer import DensityMapping, TransferFunction

#: A part of a volume: from which share of each side to which, along x, y and z.
Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
WHOLE: Box = ((0.0, 1.0),) * 3
#: Voxels along each side of a first look.
COARSE = 56
#: Number of bins of the histogram.
BINS = 128


#: `Session.edit`: changes the displayed document, or raises IrrcacheError.
Edit = Callable[[Callable[[Document], None]], None]


class Appearance:
    """A ``volume`` and the ``mapping`` from its values to extinction and albedo.

    ``preset`` is the name of the mapping if it is a preset; ``colours`` are those of the file.
    """

    def __init__(
        self,
        volume: VolumeData,
        mapping: TransferFunction | DensityMapping,
        preset: str = "",
        colours: Colours | None = None,
    ) -> None:
        self.volume, self.preset, self.colours = volume, preset, colours
        #: what lies outside is transparent
        self.box = WHOLE
        self.mapping = mapping.fitted_to(volume.values)
        sample = volume.values[:: max(1, volume.values.size // 4_000_000)]
        counts, self.edges = np.histogram(sample, BINS)
        #: logarithmic histogram in [0, 1] of `BINS` ranges between ``edges``
        self.histogram = np.log1p(counts) / max(np.log1p(counts).max(), 1e-9)

    @property
    def is_editable(self) -> bool:
        """Return whether there is a transfer function to edit; volumes of densities have none."""
        return isinstance(self.mapping, TransferFunction)

    @property
    def is_emissive(self) -> bool:
        """Return whether the medium emits."""
        return self.colours is not None and self.colours.use == "emission"

    @property
    def has_own_colours(self) -> bool:
        """Return whether the albedo is that of the file, whatever the mapping says."""
        return self.colours is not None and self.colours.use == "albedo"

    def grids(self, mapping: TransferFunction | DensityMapping) -> dict[str, np.ndarray]:
        """Return extinction (z, y, x[, 3]), albedo (z, y, x, 3) and, where the medium emits, its
        emission (z, y, x, 3), keyed by their file names.
        """
        (sigma_t, albedo), emission = mapping.apply(self.volume.values), None
        if self.colours is not None:
            sigma_t, albedo, emission = self.colours.apply(mapping, sigma_t, albedo)
        sigma_t = cropped(sigma_t, self.box)
        if not sigma_t.any():
            raise IrrcacheError(
                "all of the volume would be transparent; raise an opacity, or enlarge the crop box."
            )
        grids = {SIGMA_T_FILE: sigma_t, ALBEDO_FILE: np.ascontiguousarray(albedo)}
        return grids if emission is None else grids | {EMISSION_FILE: cropped(emission, self.box)}

    def change(self, edit: Edit, **attributes: object) -> None:
        """Set attributes, and ``edit`` the document that shows them; restore them if refused."""
        former = {name: getattr(self, name) for name in attributes}
        try:
            vars(self).update(attributes)
            grids = self.grids(self.mapping)
            edit(lambda document: document.set_volumes(grids))
        except IrrcacheError:
            vars(self).update(former)
            raise

    def document(
        self,
        settings: SceneSettings,
        parameters: dict[str, str] | None = None,
        integrator: str | None = None,
    ) -> Document:
        """Return the scene around the medium, as ``irrcache import`` writes it.

        ``parameters`` are those of the scene; ``integrator`` is a specification such as
        ``irrcache{step=0.5}``.
        """
        grids = self.grids(self.mapping)
        view = camera(self.volume, grids[SIGMA_T_FILE], settings.up)
        text = scene_xml(self.volume.to_world, view, settings, self.is_emissive)
        return Document.of_text(text, grids, parameters, integrator or "irrcache")


def coarse_appearance(
    volume: VolumeData,
    mapping: TransferFunction | DensityMapping,
    preset: str = "",
    colours: Colours | None = None,
) -> Appearance:
    """Return the appearance of every n-th voxel, with about `COARSE` of them along each side."""
    steps = [max(1, round(n / COARSE)) for n in volume.values.shape]
    chosen = tuple(slice(step // 2, None, step) for step in steps)
    first = [step // 2 for step in reversed(steps)]
    small = replace(
        volume,
        values=volume.values[chosen].copy(),
        spacing=tuple(np.multiply(volume.spacing, steps[::-1])),
        origin=tuple((volume.index_to_world @ [*first, 1])[:3]),
    )
    colours = colours and replace(colours, values=colours.values[chosen])
    return Appearance(small, mapping, preset, colours)


def cropped(values: np.ndarray, box: Box) -> np.ndarray:
    """Return values (z, y, x[, channel]) that are 0 outside of a box; whole voxels are kept."""
    if box == WHOLE:
        return values
    inside = tuple(
        slice(int(np.floor(low * n)), int(np.ceil(high * n)))
        for n, (low, high) in zip(values.shape[:3], reversed(box), strict=True)
    )
    result = np.zeros_like(values)
    result[inside] = values[inside]
    return result
