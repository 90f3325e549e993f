"""A progressive ``volpath`` reference of a window's view, and the error of our image against it.

The samples go to two halves in turn. With ``x`` our image and ``a``, ``b`` the means of the halves,
whose noise is independent, the mean of ``(x - a) (x - b)`` is an estimate of the mean squared error
of ``x`` without the noise of the reference.
"""

from __future__ import annotations

import math
from time import perf_counter

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


class ViewReference:
    """Samples by ``volpath`` of the scene of a ``light``, at its maximum depth, from ``camera``.

    ``window_size`` is (width, height); each pixel of the reference covers ``coarseness`` x
    ``coarseness`` pixels of the window, those on the right and at the bottom left out that do not
    fill one.
    """

    def __init__(
        self, light: Light, camera: Camera, window_size: tuple[int, int], coarseness: int = 1
    ) -> None:
        self.light, self.camera, self.window_size = light, camera, window_size
        self.coarseness = max(min(coarseness, *window_size), 1)
        self.size = tuple(n // self.coarseness for n in window_size)
        self._pixels = self.size[0] * self.size[1]
        settings = light.settings
        self._integrator = mi.load_dict(
            {
                "type": "volpath",
                "max_depth": settings.max_depth,
                "rr_depth": settings.rr_depth,
                "hide_emitters": light.march.hide_emitters,
            }
        )
        self._inside = medium_at(light.scene, np.array(camera.position))[0]
        self._sums = np.zeros((2, self._pixels, 3))
        self._counts = np.zeros((2, self._pixels), dtype=np.int64)
        self._bands = Bands()
        self._first = 0  # next pixel to render
        self._passes = 0
        #: seconds of rendering
        self.seconds = 0.0

    @property
    def progress(self) -> float:
        """Return the share of the image that the current pass has rendered."""
        return self._first / self._pixels

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
        started = perf_counter()
        with self._bands.timed(band):
            self._sums[half, place] += self._trace(band)
        self.seconds += perf_counter() - started
        self._counts[half, place] += 1
        complete = band.stop == self._pixels
        self._first = 0 if complete else band.stop
        self._passes += complete
        return complete

    def radiance(self) -> np.ndarray:
        """Return the current estimate (height, width, 3); pixels without samples are black."""
        counts = np.maximum(self._counts.sum(axis=0), 1)
        return (self._sums.sum(axis=0) / counts[:, None]).reshape(*self.size[::-1], 3)

    def reduced(self, image: np.ndarray) -> np.ndarray:
        """Return means of an ``image`` of the window over the pixels of the reference."""
        n, (width, height) = self.coarseness, self.size
        whole = image[: n * height, : n * width]
        return whole.reshape(height, n, width, n, 3).mean(axis=(1, 3))

    def error_of(self, image: np.ndarray) -> tuple[float, float] | None:
        """Return bounds between which the relative RMSE of ``image`` (height, width, 3) lies.

        Both are in units of the mean radiance, and exclude the noise of the reference, of which
        they are two standard errors away from the estimate. Returns None until both halves cover
        the image, and if the reference is black.
        """
        if self._passes < 2:
            return None
        a, b = self._sums / self._counts[..., None]
        mean = 0.5 * float((a + b).mean())
        if not mean > 0:
            return None
        apart = self.reduced(image).reshape(-1, 3)
        # The noise of the channels of a pixel is not independent, that of pixels is.
        products = ((apart - a) * (apart - b)).mean(axis=-1)
        square, spread = float(products.mean()), 2 * float(products.std()) / np.sqrt(products.size)
        low, high = max(square - spread, 0.0), max(square, 0.0) + spread
        return float(np.sqrt(low)) / mean, float(np.sqrt(high)) / mean

    def comparison(self, image: np.ndarray) -> str:
        """Describe the difference of ``image`` (height, width, 3) from the reference in words."""
        if not self.samples:
            return f"volpath, first sample: {self.progress:.0%} of the image"
        samples = "1 sample" if self.samples == 1 else f"{self.samples} samples"
        text = f"volpath, {samples} per pixel"
        if self.coarseness > 1:
            text += f" of {self.coarseness} x {self.coarseness}"
        found = self.error_of(image)
        if found is None:
            return text
        return f"{text}; RMSE {between(*found)} of the mean, its noise taken out"

    def signed_error(self, image: np.ndarray) -> np.ndarray:
        """Return the error of ``image``, mean over the channels, in units of the mean radiance.

        The reference's noise is included. The shape is (height, width) of the reference.
        """
        truth = self.radiance()
        return (self.reduced(image) - truth).mean(axis=-1) / (float(truth.mean()) or 1.0)

    @property
    def noise(self) -> float | None:
        """Return the standard deviation of the noise in `signed_error`, None before the second
        sample.
        """
        if self._passes < 2:
            return None
        a, b = (self._sums / self._counts[..., None]).mean(axis=-1)
        return 0.5 * float(np.sqrt(((a - b) ** 2).mean())) / (0.5 * float((a + b).mean()) or 1.0)

    def _trace(self, band: range) -> np.ndarray:
        """Render the colours of a band, (pixels, 3)."""
        count = len(band)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(_seed(self._passes, band.start), count)
        width, height = self.window_size
        index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, band.start)
        scale = (dr.opaque(mi.Float, self.coarseness / n) for n in self.window_size)
        at = mi.Point2f(pixel_of(index, self.size[0])) + sampler.next_2d()
        ray = mi.RayDifferential3f(self.camera.rays(at * mi.Vector2f(*scale), width / height))
        colour, _, _ = self._integrator.sample(self.light.scene, sampler, ray, self._inside)
        planes = mi.Color3f(colour.x) if mi.is_monochromatic else mi.Color3f(colour)
        return np.stack([np.broadcast_to(np.array(p), count) for p in planes], axis=-1)


def between(low: float, high: float) -> str:
    """Describe an error between two bounds, by the upper one only where its value is unclear."""
    if high > 2 * low:
        return f"below {float(f'{100 * high:.2g}'):g} %"
    error, spread = 50 * (low + high), 50 * (high - low)
    digits = max(-math.floor(math.log10(spread)), 0) if spread > 0 else 2
    return f"{error:.{digits}f} ± {spread:.{digits}f} %"


def _seed(number: int, first: int) -> int:
    """Return the seed of a band, hashed because neighbouring seeds give correlated numbers."""
    return mi.sample_tea_32(mi.UInt32(number), mi.UInt32(first))[0][0]
