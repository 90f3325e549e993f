"""From the caches to the pixels of a window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.io.display import TONES
from mitsuba_irrcache.render.aovs import AOVS, Layers
from mitsuba_irrcache.render.denoise import filter_illumination
from mitsuba_irrcache.render.film import PixelPositions
from mitsuba_irrcache.render.pixel_filter import pixel_of
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.light import CacheSnapshot
from mitsuba_irrcache.view.slices import SlicedCameraRays, Slices

#: The kind of image in which pixels with too large an error bar are marked, the colour of the
#: marks, and the share of the brightest pixels below which an error is not relative any more.
MARKED, MARK, FLOOR = "image, errors marked", (1.0, 0.0, 0.8), 0.02
#: Quantities that a window can display.
KINDS = ("image", MARKED, "colour", "illumination", "error bar", "transmittance", "depth")
#: What the kinds that are no images show.
CAPTIONS = {
    MARKED: "magenta: pixels whose error bar exceeds the target",
    "colour": "albedo, as seen",
    "illumination": "illumination, without the colour of the medium",
    "error bar": "standard error and bias of each pixel, × 10",
    "transmittance": "share of the background that is seen",
    "depth": "mean depth: bright is near",
}
#: Scale factor with which the standard error is displayed.
ERROR_SCALE = 10.0
#: Exposures in stops that can be chosen.
EXPOSURES = (-8.0, 8.0)
#: Pixels traced in one launch. It is the same for all images, since all random numbers depend on
#: it.
BAND = 1 << 15
#: Distance between the random streams of successive passes: one number per sample selects the
#: luminance channel.
STREAM = 0x9E3779B9


@dataclass(frozen=True)
class Look:
    """What to display and how: one of `KINDS`, ``exposure`` in stops, and one of `TONES`.

    ``filtered`` says whether the illumination is filtered; ``background`` is the colour behind the
    image, linear RGB in [0, 1], where emitters are hidden. The exposure does not change it, nor
    ``slices`` of the values.
    """

    kind: str = "image"
    exposure: float = 0.0
    tone: str = "sRGB"
    filtered: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target: float = 0.0
    slices: Slices | None = None

    @property
    def layered(self) -> bool:
        """Return whether layers other than radiance are needed."""
        return self.kind != "image" or self.filtered

    @property
    def with_error(self) -> bool:
        return self.kind in ("error bar", MARKED) or self.filtered


class Samples:
    """The sum of camera samples of one view of one state of the caches.

    ``size`` is (width, height). Rays end at ``slices``.
    """

    def __init__(
        self,
        seen: CacheSnapshot,
        camera: Camera,
        size: tuple[int, int],
        seed: int = 0,
        slices: Slices | None = None,
    ) -> None:
        self.seen, self.camera, self.size, self.seed = seen, camera, size, seed
        self.slices, self.count = slices, 0
        self._sums: list[mi.Float] = []

    def add(self, total: int, pause: Callable[[], None] | None = None) -> None:
        """Add one sample per pixel, of ``total`` planned.

        The image is traced in bands. ``pause`` is called between bands; if it raises an exception,
        the sample is discarded.
        """
        pixels, first, found = self.size[0] * self.size[1], 0, []
        while first < pixels:
            band = range(first, min(first + BAND, pixels))
            found.append(self._trace(band, total))
            if pause is not None:
                dr.eval(found[-1])
                dr.sync_thread()
                pause()
            first = band.stop
        values = [dr.concat(parts) for parts in zip(*found, strict=True)]
        if self.count:
            values = [a + b for a, b in zip(self._sums, values, strict=True)]
        self._sums = values
        self.count += 1
        dr.eval(self._sums)

    def advance(self, total: int) -> None:
        """Add one sample per pixel like `add`, and wait for it.

        The kernels that `add` launches are asynchronous: many of them would delay what follows.
        """
        self.add(total)
        dr.sync_thread()

    @property
    def layers(self) -> Layers:
        """Return the layers as means over the samples; without layers, all is background."""
        scale = dr.opaque(mi.Float, 1 / self.count)
        means = [s * scale for s in self._sums[: -1 if self.slices is None else -4]]
        if not self.seen.layered:
            return Layers.background_only(mi.Spectrum(*means))
        return Layers.of(means)

    def radiance(self, filtered: bool = False) -> mi.Spectrum:
        """Return the image, with filtered illumination if ``filtered``."""
        layers = self.layers
        dr.eval(layers)
        kind = "bilateral" if filtered and self.seen.layered else "none"
        return layers.radiance(filter_illumination(kind, layers, self.size))

    def image(self, filtered: bool = False) -> np.ndarray:
        """Return `radiance` as float32 (height, width, 3)."""
        radiance = self.radiance(filtered)
        rgb = mi.Color3f(radiance.x) if mi.is_monochromatic else mi.Color3f(radiance)
        return self._array(list(rgb))

    def backdrop(self, look: Look) -> np.ndarray:
        """Return `behind` as float32 (height, width, 3)."""
        return self._array(list(self.behind(look)))

    def picture(self, look: Look, extent: tuple[float, float]) -> np.ndarray:
        """Return the displayed image, uint8 (height, width, 3).

        ``extent`` holds the distances that a depth image shows as black and white.
        """
        return _display(self._shown(look, extent), look, self.size, self.behind(look))

    def behind(self, look: Look) -> mi.Color3f:
        """Return what is added to the display: slices, and the background where the image is
        transparent.
        """
        if look.kind not in ("image", MARKED):
            return mi.Color3f(0)
        found = self._sums[-1] * mi.Color3f(*(dr.opaque(mi.Float, c) for c in look.background))
        if self.slices is not None:
            found += mi.Color3f(*self._sums[-4:-1])
        return found * dr.opaque(mi.Float, 1 / self.count)

    def channels(self, aovs: tuple[str, ...], filtered: bool = False) -> tuple[np.ndarray, list]:
        """Return image and layers as float32 (height, width, channel), and the channel names."""
        image, layers = self.image(filtered), self.layers
        planes, names = [], []
        for kind in aovs:
            planes += layers.aov(kind)
            names += [f"{kind}.{channel}" for channel in AOVS[kind]]
        return np.concatenate([image, self._array(planes)], axis=-1), names

    def _trace(self, band: range, total: int) -> list[mi.Float]:
        """Return the next sample of some pixels: radiance, or all layers; and transparency."""
        seen, (width, height) = self.seen, self.size
        sampler = mi.load_dict({"type": "independent"})
        # Each pixel has a random stream of its own, whichever band and pass it is traced in.
        sampler.seed((self.seed + self.count * STREAM + band.start) & 0xFFFFFFFF, len(band))
        spread = PixelPositions(sampler, self.seed, total)
        spread.first = dr.opaque(mi.UInt32, self.count)
        index = dr.arange(mi.UInt32, len(band)) + dr.opaque(mi.UInt32, band.start)
        at = mi.Point2f(pixel_of(index, width)) + spread.next(index, mi.UInt32(0))
        scale = mi.Vector2f(*(dr.opaque(mi.Float, 1 / n) for n in self.size))
        ray = self.camera.rays(at * scale, width / height)
        medium = seen.medium_at(np.array(self.camera.position))
        rays, sliced = seen.camera_rays, []
        if self.slices is not None:
            rays = SlicedCameraRays(rays, self.slices)
        view = rays.sample(seen.scene, sampler, ray, medium, mi.Bool(True))
        if self.slices is not None:
            sliced = list(rays.shown)
        if seen.layered:
            parts = view.scattered, view.transmittance, view.gathered, view.background
            values = seen.camera_rays.projection.layers(*parts, mi.Spectrum(1)).channels()
        else:
            values = list(view.scattered + view.background)
        values += [*sliced, 1 - view.alpha]
        return [value + dr.zeros(mi.Float, len(band)) for value in values]

    def _array(self, planes: list[mi.Float]) -> np.ndarray:
        """Convert to float32 (height, width, plane)."""
        width, height = self.size
        flat = [np.broadcast_to(np.array(p), width * height) for p in planes]
        return np.stack(flat, axis=-1).reshape(height, width, len(flat))

    def _shown(self, look: Look, extent: tuple[float, float]) -> mi.Color3f:
        if look.kind == "image":
            return mi.Color3f(self.radiance(look.filtered))
        layers = self.layers
        if look.kind == "illumination" and look.filtered:
            found = filter_illumination("bilateral", layers, self.size)
            return mi.Color3f(layers.illumination if found is None else found)
        if look.kind == "error bar":
            return mi.Color3f(
                ERROR_SCALE * dr.sqrt(dr.square(layers.noise) + dr.square(layers.bias))
            )
        if look.kind == MARKED:
            return self._marked(look)
        if look.kind == "depth":
            (distance,) = layers.aov("depth")
            near, far = (dr.opaque(mi.Float, value) for value in extent)
            seen = luminance(layers.transmittance) < 0.99
            return mi.Color3f(dr.select(seen, (far - distance) / (far - near), 0))
        return mi.Color3f(*layers.aov(look.kind))

    def _marked(self, look: Look) -> mi.Color3f:
        """Return the image, coloured where its error bar exceeds the target."""
        layers, shown = self.layers, mi.Color3f(self.radiance(look.filtered))
        error = luminance(dr.sqrt(dr.square(layers.noise) + dr.square(layers.bias)))
        radiance = luminance(shown)
        allowed = dr.opaque(mi.Float, look.target) * dr.maximum(radiance, FLOOR * dr.max(radiance))
        share = dr.clip(0.5 * error / dr.maximum(allowed, 1e-12) - 0.5, 0, 0.7)
        return dr.lerp(shown, mi.Color3f(*MARK) * dr.maximum(radiance, 0.2), share)


def exposure_of(image: np.ndarray) -> float:
    """Return the exposure in stops with which the brightest pixels of an ``image`` (height, width,
    channel) are just not clipped, but for one in a hundred; 0 for a black one.
    """
    bright = float(np.quantile(image.max(axis=-1), 0.99))
    return float(np.clip(np.round(-np.log2(bright), 1), *EXPOSURES)) if bright > 0 else 0.0


def displayed(image: np.ndarray, look: Look, behind: np.ndarray) -> np.ndarray:
    """Tone map radiance for display, as uint8 (height, width, 3), before what lies ``behind``."""
    return _display(_colour(image), look, image.shape[1::-1], _colour(behind))


def _colour(image: np.ndarray) -> mi.Color3f:
    return mi.Color3f(*(mi.Float(p) for p in image.reshape(-1, 3).T.astype(np.float32)))


def _display(
    colour: mi.Color3f, look: Look, size: tuple[int, int], behind: mi.Color3f
) -> np.ndarray:
    """Return pixels in sRGB; transmittance and depth ignore the exposure."""
    if look.kind not in ("transmittance", "depth", "colour"):
        colour = dr.maximum(colour, 0) * dr.opaque(mi.Float, 2.0**look.exposure)
        colour = TONES[look.tone](colour)
    width, height = size
    colour = dr.clip(colour + behind, 0, 1)
    curved = dr.select(colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    r, g, b = (mi.UInt32(c * 255 + 0.5) for c in curved)
    packed = np.array((r | (g << 8) | (b << 16)) + dr.zeros(mi.UInt32, width * height))
    return packed.view(np.uint8).reshape(height, width, 4)[..., :3]
