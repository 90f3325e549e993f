"""A volume together with the transfer function that maps it to a medium."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.scene import (
    ALBEDO_FILE,
    SIGMA_T_FILE,
    SceneSettings,
    camera,
    scene_xml,
)
from mitsuba_irrcache.volumes.transfer import DensityMapping, TransferFunction

#: A part of a volume: from which share of each side to which, along x, y and z.
Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
WHOLE: Box = ((0.0, 1.0),) * 3
#: Number of bins of the histogram.
BINS = 128


#: `Session.edit`: changes the displayed document, or raises IrrcacheError.
Edit = Callable[[Callable[[Document], None]], None]


class Appearance:
    """A ``volume`` and the ``mapping`` from its values to extinction and albedo.

    ``preset`` is the name of the mapping if it is a preset.
    """

    def __init__(
        self, volume: VolumeData, mapping: TransferFunction | DensityMapping, preset: str = ""
    ) -> None:
        self.volume, self.preset = volume, preset
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

    def grids(self, mapping: TransferFunction | DensityMapping) -> dict[str, np.ndarray]:
        """Return extinction (z, y, x) and albedo (z, y, x, 3), keyed by their file names."""
        sigma_t, albedo = mapping.apply(self.volume.values)
        sigma_t = cropped(sigma_t, self.box)
        if not sigma_t.any():
            raise IrrcacheError(
                "all of the volume would be transparent; raise an opacity, or enlarge the crop box."
            )
        return {SIGMA_T_FILE: sigma_t, ALBEDO_FILE: np.ascontiguousarray(albedo)}

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
        text = scene_xml(self.volume.to_world, view, settings)
        return Document.of_text(text, grids, parameters, integrator or "irrcache")


def cropped(sigma_t: np.ndarray, box: Box) -> np.ndarray:
    """Return extinctions (z, y, x) that are 0 outside of a box; whole voxels are kept."""
    if box == WHOLE:
        return sigma_t
    inside = tuple(
        slice(int(np.floor(low * n)), int(np.ceil(high * n)))
        for n, (low, high) in zip(sigma_t.shape, reversed(box), strict=True)
    )
    result = np.zeros_like(sigma_t)
    result[inside] = sigma_t[inside]
    return result
