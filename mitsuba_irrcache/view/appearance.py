"""From data to a medium: a volume, and the transfer function that it is seen through."""

from __future__ import annotations

from dataclasses import replace

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

#: Bars of the histogram.
BINS = 128


class Appearance:
    """A ``volume`` and the ``mapping`` that makes a medium of it."""

    def __init__(self, volume: VolumeData, mapping: TransferFunction | DensityMapping) -> None:
        self.volume = volume
        self.mapping = mapping.fitted_to(volume.values)
        sample = volume.values[:: max(1, volume.values.size // 4_000_000)]
        counts, self.edges = np.histogram(sample, BINS)
        #: logarithmic, in [0, 1], for each of `BINS` ranges between ``edges``
        self.histogram = np.log1p(counts) / max(np.log1p(counts).max(), 1e-9)

    @property
    def is_editable(self) -> bool:
        """Whether there is a transfer function; densities have none."""
        return isinstance(self.mapping, TransferFunction)

    def grids(self, mapping: TransferFunction | DensityMapping) -> dict[str, np.ndarray]:
        """Extinction (z, y, x) and albedo (z, y, x, 3), by the names of their files."""
        sigma_t, albedo = mapping.apply(self.volume.values)
        if not sigma_t.any():
            raise IrrcacheError("all of the volume would be transparent; raise an opacity.")
        return {SIGMA_T_FILE: sigma_t, ALBEDO_FILE: np.ascontiguousarray(albedo)}

    def document(
        self,
        settings: SceneSettings,
        parameters: dict[str, str] | None = None,
        integrator: str | None = None,
    ) -> Document:
        """The scene around the medium, as ``irrcache import`` makes it, with its ``parameters``,
        and an ``integrator`` such as ``irrcache{step=0.5}``.
        """
        grids = self.grids(self.mapping)
        view = camera(self.volume, grids[SIGMA_T_FILE], settings.up)
        text = scene_xml(self.volume.to_world, view, settings)
        return Document.of_text(text, grids, parameters, integrator or "irrcache")


def with_opacity(
    function: TransferFunction, index: int, value: float, opacity: float
) -> TransferFunction:
    """An opacity point moved, between its neighbours."""
    values, opacities = function.opacity_values.copy(), function.opacities.copy()
    values[index], opacities[index] = value, opacity
    _check_order(values, index)
    return replace(function, opacity_values=values, opacities=opacities)


def with_colour(
    function: TransferFunction, index: int, value: float, colour: tuple[float, float, float]
) -> TransferFunction:
    """A colour point moved, between its neighbours."""
    values, colours = function.colour_values.copy(), function.colours.copy()
    values[index], colours[index] = value, colour
    _check_order(values, index)
    return replace(function, colour_values=values, colours=colours)


def with_point_after(function: TransferFunction, curve: str, index: int) -> TransferFunction:
    """Another point of the ``curve`` ("opacity" or "colour") half-way to the next one, or to the
    one before where there is no next; the curve stays as it is.
    """
    values, heights = _points(function, curve)
    left = min(index, len(values) - 2)
    values = np.insert(values, left + 1, 0.5 * (values[left] + values[left + 1]))
    heights = np.insert(heights, left + 1, 0.5 * (heights[left] + heights[left + 1]), axis=0)
    return _with_points(function, curve, values, heights)


def without_point(function: TransferFunction, curve: str, index: int) -> TransferFunction:
    """A point less."""
    values, heights = _points(function, curve)
    return _with_points(
        function, curve, np.delete(values, index), np.delete(heights, index, axis=0)
    )


def _points(function: TransferFunction, curve: str) -> tuple[np.ndarray, np.ndarray]:
    if curve == "opacity":
        return function.opacity_values, function.opacities
    return function.colour_values, function.colours


def _with_points(
    function: TransferFunction, curve: str, values: np.ndarray, heights: np.ndarray
) -> TransferFunction:
    if curve == "opacity":
        return replace(function, opacity_values=values, opacities=heights)
    return replace(function, colour_values=values, colours=heights)


def _check_order(values: np.ndarray, index: int) -> None:
    low = values[index - 1] if index else -np.inf
    high = values[index + 1] if index + 1 < len(values) else np.inf
    if not low < values[index] < high:
        raise IrrcacheError(
            f"the value {values[index]:g} is not between those of the points beside it, {low:g} "
            f"and {high:g}."
        )
