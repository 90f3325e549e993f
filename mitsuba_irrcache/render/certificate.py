"""The estimated error of an image, and the settings that were chosen for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Certificate:
    """Estimated error of an image: RMSE over its pixels, in units of the mean radiance.

    Attributes:
        tolerance: the requested error.
        tolerance_of: "image", or "volume" if the unit is the mean radiance of the media alone.
        parts: estimated RMSE by "voxels", "directions", "steps" and "pixels"; parts that do not
            exist for a scene are 0. Empty if there is no estimate.
        settings: the chosen "resolution", "cache_spp", "step" and "spp".
        open_points: errors that the estimate does not include, or why the tolerance is not met.
    """

    tolerance: float
    tolerance_of: str
    parts: dict[str, float]
    settings: dict[str, float]
    open_points: tuple[str, ...] = ()

    @property
    def error(self) -> float:
        """Return the estimated RMSE of the image in units of the mean radiance; NaN if unknown."""
        if not self.parts:
            return float("nan")
        return float(np.sqrt(sum(part**2 for part in self.parts.values())))

    @property
    def is_met(self) -> bool:
        """Whether the estimated error is at most the tolerance; False without an estimate."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {100 * value:.2g} %" for name, value in self.parts.items())
        settings = ", ".join(f"{name} {value:g}" for name, value in self.settings.items())
        if not self.parts:
            return "; ".join((*self.open_points, settings))
        text = (
            f"error {100 * self.error:.2g} % of the mean radiance of the {self.tolerance_of} "
            f"({parts}), tolerance {100 * self.tolerance:.2g} %: {settings}"
        )
        return "; ".join((text, *self.open_points))
