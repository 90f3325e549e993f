"""A progressive ``volpath`` reference of a window's view, and the error of our image against it.

The samples go to two halves in turn. With ``x`` our image and ``a``, ``b`` the means of the halves,
whose noise is independent, the mean of ``(x - a) (x - b)`` is an estimate of the mean squared error
of ``x`` without the noise of the reference.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.render.pixel_filter import pixel_of
from mitsuba_irrcache.scene.medium_probe import medium_at
from mitsuba_irrcache.view.bands import Bands
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.light import Light

#: Samples per pixel at which the reference is complete.
MOST_SAMPLES = 4096


class Reference:
    """Samples by ``volpath`` of the scene of a ``light``, at its maximum depth, from ``camera``.

    ``size`` is (width, height).
    """

    def __init__(self, light: Light, camera: Camera, size: tuple[int, int]) -> None:
        self.light, self.camera, self.size = light, camera, size
        self._pixels = size[0] * size[1]
        settings = light.settings
        self._integrator = mi.load_dict(
            {
                "type": "volpath",
                "max_depth": settings.max_depth,
                "rr_depth": settings.rr_depth,
                "hide_emitters": light.seeing.hide_emitters,
            }
        )
        self._inside = medium_at(light.scene, np.array(camera.position))[0]
        self._sums = np.zeros((2, self._pixels, 3))
        self._counts = np.zeros((2, self._pixels), dtype=np.int64)
        self._bands = Bands()
        self._first = 0  # next pixel to render
        self._passes = 0

    @property
    def samples(self) -> int:
        """Return the samples per pixel that all pixels have."""
        return self._passes

    @property
    def is_done(self) -> bool:
        return self._passes >= MOST_SAMPLES

    def refine(self) -> bool:
        """Add one sample per pixel to a band; return whether all pixels have equally many."""
        band = self._bands.at(self._first, self._pixels)
        half, place = self._passes % 2, slice(band.start, band.stop)
        with self._bands.timed(band):
            self._sums[half, place] += self._trace(band)
        self._counts[half, place] += 1
        complete = band.stop == self._pixels
        self._first = 0 if complete else band.stop
        self._passes += complete
        return complete

    def radiance(self) -> np.ndarray:
        """Return the current estimate (height, width, 3); pixels without samples are black."""
        counts = np.maximum(self._counts.sum(axis=0), 1)
        return (self._sums.sum(axis=0) / counts[:, None]).reshape(*self.size[::-1], 3)

    def error_of(self, image: np.ndarray) -> tuple[float, float] | None:
        """Return the relative RMSE of ``image`` (height, width, 3) and the smallest detectable one.

        Both are in units of the mean radiance, and exclude the noise of the reference. Returns None
        until both halves cover the image, and if the reference is black.
        """
        if self._passes < 2:
            return None
        a, b = self._sums / self._counts[..., None]
        mean = 0.5 * float((a + b).mean())
        if not mean > 0:
            return None
        apart = image.reshape(-1, 3)
        square = float(((apart - a) * (apart - b)).mean())
        # The mean of products of independent noise has a standard error of variance / sqrt(n).
        noise = float(((a - b) ** 2).mean()) / 2
        resolved = np.sqrt(noise * np.sqrt(2 / a.size))
        return float(np.sqrt(max(square, 0.0))) / mean, float(resolved) / mean

    def comparison(self, image: np.ndarray) -> str:
        """Describe the difference of ``image`` (height, width, 3) from the reference in words."""
        found = self.error_of(image)
        told = f"volpath, {self.samples} samples per pixel"
        if found is None:
            return told
        error, resolved = found
        amount = f"{error:.2%}" if error > resolved else f"below {resolved:.2%}"
        return f"{told}; RMSE {amount} of the mean, its noise taken out"

    def _trace(self, band: range) -> np.ndarray:
        """Render the colours of a band, (pixels, 3)."""
        count = len(band)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(_seed(self._passes, band.start), count)
        width, height = self.size
        index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, band.start)
        scale = mi.Vector2f(*(dr.opaque(mi.Float, 1 / n) for n in self.size))
        at = mi.Point2f(pixel_of(index, width)) + sampler.next_2d()
        ray = mi.RayDifferential3f(self.camera.rays(at * scale, width / height))
        colour, _, _ = self._integrator.sample(self.light.scene, sampler, ray, self._inside)
        planes = mi.Color3f(colour.x) if mi.is_monochromatic else mi.Color3f(colour)
        return np.stack([np.broadcast_to(np.array(p), count) for p in planes], axis=-1)


def _seed(number: int, first: int) -> int:
    """Return the seed of a band, hashed because neighbouring seeds give correlated numbers."""
    return mi.sample_tea_32(mi.UInt32(number), mi.UInt32(first))[0][0]
