"""A volume together with the transfer function that maps it to a medium."""

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

#: Number of bins of the histogram.
BINS = 128


class Appearance:
    """A ``volume`` and the ``mapping`` from its values to extinction and albedo."""

    def __init__(self, volume: VolumeData, mapping: TransferFunction | DensityMapping) -> None:
        self.volume = volume
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
        if not sigma_t.any():
            raise IrrcacheError("all of the volume would be transparent; raise an opacity.")
        return {SIGMA_T_FILE: sigma_t, ALBEDO_FILE: np.ascontiguousarray(albedo)}

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


def with_opacity(
    function: TransferFunction, index: int, value: float, opacity: float
) -> TransferFunction:
    """Return a copy in which one opacity point is moved between its neighbours."""
    values, opacities = function.opacity_values.copy(), function.opacities.copy()
    values[index], opacities[index] = value, opacity
    _check_order(values, index)
    return replace(function, opacity_values=values, opacities=opacities)


def with_colour(
    function: TransferFunction, index: int, value: float, colour: tuple[float, float, float]
) -> TransferFunction:
    """Return a copy in which one colour point is moved between its neighbours."""
    values, colours = function.colour_values.copy(), function.colours.copy()
    values[index], colours[index] = value, colour
    _check_order(values, index)
    return replace(function, colour_values=values, colours=colours)


def with_point_after(function: TransferFunction, curve: str, index: int) -> TransferFunction:
    """Return a copy in which ``curve`` ("opacity" or "colour") has one more point.

    The point lies half-way to the next one, or to the previous one after the last. The shape of the
    curve does not change.
    """
    values, heights = _points(function, curve)
    left = min(index, len(values) - 2)
    values = np.insert(values, left + 1, 0.5 * (values[left] + values[left + 1]))
    heights = np.insert(heights, left + 1, 0.5 * (heights[left] + heights[left + 1]), axis=0)
    return _with_points(function, curve, values, heights)


def without_point(function: TransferFunction, curve: str, index: int) -> TransferFunction:
    """Return a copy without one point of a curve."""
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
