"""Properties that must hold for every image and cache, whatever the numbers in the scene.

A property maps `Found` to an error and the largest one that is admitted; both are plain numbers, so
that a table can list the smallest margins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import original_message


@dataclass(frozen=True)
class Found:
    """An image (rows, columns, channels) or radiances (n, channels) along given rays, and the
    cache.

    Of the cache it has the irradiance over 4 pi with its standard error (None without a cache).
    """

    image: np.ndarray
    phi: np.ndarray | None
    error: np.ndarray | None
    settings: dict

    @property
    def noisy(self) -> bool:
        """Return whether voxels are sampled independently."""
        return self.settings["solver"] == "path"


#: Name, error, largest error admitted.
Verdict = tuple[str, float, float]
Property = Callable[[Found], Verdict]


def finite(found: Found) -> Verdict:
    """Return the share of values that are not finite."""
    arrays = [found.image] + ([] if found.phi is None else [found.phi])
    return "finite", max(float((~np.isfinite(a)).mean()) if a.size else 0.0 for a in arrays), 0.0


def not_negative(found: Found) -> Verdict:
    """Return the most negative value, including alpha."""
    arrays = [found.image] + ([] if found.phi is None else [found.phi])
    return "not negative", max(float(-np.nanmin(a, initial=0.0)) for a in arrays), 0.0


def no_brighter(limit: float = 1.0) -> Property:
    """Without emission, no radiance exceeds that of the brightest emitter: energy is conserved.

    For sampled voxels, which are noisy, on average: within four standard errors, and 2 %.
    """

    def check(found: Found) -> Verdict:
        name, colour = "energy not made", found.image[..., :3]
        if not found.noisy or found.phi is None:
            peaks = [a.max(initial=0.0) for a in (colour, found.phi) if a is not None]
            return name, float(max(peaks)) / limit - 1, 0.01
        active = found.phi.sum(axis=-1) > 0
        if not active.any():
            return name, 0.0, 0.02
        error = np.sqrt(np.square(found.error[active]).sum()) / max(found.error[active].size, 1)
        excess = max(found.phi[active].mean(), colour.mean()) - limit
        return name, float(excess / limit), 0.02 + 4 * float(error) / limit

    return check


def furnace(found: Found) -> Verdict:
    """With albedo 1 under a sky of 1 every pixel is 1.

    To 1 % with `sweep` (which guarantees 1e-3 on average, while pixels depend on single voxels), 3
    % by the trapezoidal rule, which is not exact for constant radiance if the extinction varies;
    for sampled voxels the mean of an image, within four standard errors of the mean of four voxels:
    from a corner few more are visible.
    """
    colour = found.image[..., :3]
    if found.noisy and found.error is not None:
        return "furnace", abs(float(colour.mean()) - 1), 0.003 + 2 * _rms(found.error)
    admitted = 0.03 if found.settings["quadrature"] == "trapezoid" else 0.01
    return "furnace", float(np.abs(colour - 1).max()), admitted


def furnace_of_voxels(found: Found) -> Verdict:
    """The mean of all voxels in a furnace, to 2 %: voxels at visible surfaces are noisy."""
    phi = found.phi[found.phi.sum(axis=-1) > 0]
    return "furnace of voxels", abs(float(phi.mean()) - 1) if phi.size else 0.0, 0.02


def _rms(error: np.ndarray) -> float:
    """Return the root mean square of nonzero values."""
    known = error[error > 0]
    return float(np.sqrt(np.square(known).mean())) if known.size else 0.0


def is_sky(found: Found) -> Verdict:
    """The image of an empty medium is the sky, to rounding."""
    return "sky", float(np.abs(found.image[..., :3] - 1).max()), 1e-5


def is_value(expected: np.ndarray | float, tolerance: float = 1e-4) -> Property:
    """The image, or radiances along rays, in closed form, relative to the maximum."""

    def check(found: Found) -> Verdict:
        reference = np.asarray(expected, dtype=np.float64)
        colour = found.image[..., :3]
        error = np.abs(colour - reference).max() / max(np.abs(reference).max(), 1e-30)
        return "closed form", float(error), tolerance

    return check


def like(reference: Callable[[dict], Found], swept: float, sampled: float) -> Property:
    """The image equals that of another description of the same problem, in units of its mean.

    The first bound is for `sweep`, the other one for sampled caches, whose paths diverge after
    rounding errors.
    """

    def check(found: Found) -> Verdict:
        other = reference(found.settings)
        mean = np.abs(other.image[..., :3]).mean()
        error = np.abs(found.image[..., :3] - other.image[..., :3]).mean() / mean
        return "same problem", float(error), sampled if found.noisy else swept

    return check


def centre_is(value: float, tolerance: float) -> Property:
    """The irradiance of the middle voxel over 4 pi."""

    def check(found: Found) -> Verdict:
        middle = found.phi[tuple(n // 2 for n in found.phi.shape[:3])]
        return "closed form", float(np.abs(middle / value - 1).max()), tolerance

    return check


def observe(
    scene: mi.Scene, settings: dict, samples: int, rays: Callable[[], mi.Ray3f] | None = None
) -> Found:
    """Render a scene, or the radiance along ``rays``."""
    integrator = scene.integrator()
    if rays is None:
        image = np.array(mi.render(scene, spp=samples), dtype=np.float64)
    else:
        ray = rays()
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, dr.width(ray))
        radiance, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
        image = np.stack([np.broadcast_to(np.array(c), dr.width(ray)) for c in radiance], axis=-1)
        image = image.astype(np.float64)
    cache = integrator.cache
    if cache is None:
        return Found(image, None, None, settings)
    light = cache.irradiance, cache.standard_error
    phi, error = (np.array(v, dtype=np.float64) / (4 * np.pi) for v in light)
    return Found(image, phi, error, settings)


def refusal(action: Callable[[], object]) -> str:
    """Return the message of the error that ``action`` raises, "" if it raises none."""
    try:
        action()
    except (RuntimeError, ValueError) as error:
        return original_message(error) or type(error).__name__
    return ""
