"""The adjoint of the film: how an objective depends on the radiance of each camera sample."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.render.film import PixelPositions, SampledFilm, camera_ray
from mitsuba_irrcache.render.pixel_filter import reconstructed

#: Camera samples of one launch, at most.
LANES = 1 << 20
#: Luminance of the primaries of linear sRGB.
LUMINANCE = (0.212671, 0.715160, 0.072169)


@dataclass(eq=False)
class CameraPass:
    """Camera samples of one launch: their rays, and the derivatives of the objective with respect
    to the radiance along the rays (including the sensor's weight), and with respect to ``alpha``.
    """

    sampler: mi.Sampler
    ray: mi.Ray3f
    radiance: mi.Spectrum
    alpha: mi.Float | None


class SampledCamera:
    """The camera samples of an image of ``sensor``, ``spp`` in each pixel (0: of its sampler), at
    most ``lanes`` in a launch.
    """

    def __init__(self, sensor: mi.Sensor, seed: int, spp: int, lanes: int = LANES) -> None:
        self._sensor, self._film = sensor, sensor.film()
        if "pixel_format = xyz" in str(self._film):  # no other sign of the conversion
            raise IrrcacheError(
                'irrcache: gradients of images with the pixel_format "xyz" or "xyza" are not '
                'supported; use a film with "rgb", "rgba" or "luminance", and convert the image in '
                "the loss."
            )
        self._seed, self._spp = seed, spp or sensor.sampler().sample_count()
        self._frame = SampledFilm(self._film, self._spp, lanes)
        #: medium around the sensor
        self.medium = sensor.get_medium()
        #: numbers of pixels, with those beside the image, and of camera samples
        self.pixels = self._frame.pixels
        self.samples = self.pixels * self._spp

    def _drawn(self) -> Iterator[tuple]:
        """Yield positions on the film, pixels, and rays of the camera samples of each launch."""
        sampler, frame = self._sensor.sampler().clone(), self._frame
        sampler.set_sample_count(self._spp)
        sampler.set_samples_per_wavefront(frame.per_pass)
        sampler.seed(self._seed, frame.lanes)
        spread = PixelPositions(sampler, self._seed, self._spp)
        for done in range(0, self._spp, frame.per_pass):
            spread.first = dr.opaque(mi.UInt32, done)
            position, index, _ = frame.positions(spread)
            ray, weight = camera_ray(self._sensor, sampler, position)
            yield position, index, sampler, ray, weight
            sampler.advance()
            sampler.schedule_state()
            dr.eval()


class FilmTangent(SampledCamera):
    """Reconstruct the derivative of an image from those of the radiance of its camera samples."""

    def __init__(self, sensor: mi.Sensor, seed: int, spp: int) -> None:
        super().__init__(sensor, seed, spp)
        self.has_alpha = mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha)
        self._sums: list[mi.Float] | None = None

    def passes(self) -> Iterator[tuple[CameraPass, mi.Point2f]]:
        """Yield the camera samples of each launch, with the weights of the sensor in place of
        derivatives, and their positions on the film.
        """
        for position, _, sampler, ray, weight in self._drawn():
            yield CameraPass(sampler, mi.Ray3f(ray), mi.Spectrum(weight), None), position

    def add(self, position: mi.Point2f, radiance: mi.Spectrum, alpha: mi.Float) -> None:
        """Add the derivatives of the radiance and alpha of the samples of a launch."""
        values = [*radiance, *([alpha] if self.has_alpha else [])]
        frame = self._frame
        found = reconstructed(self._film, frame.border, frame.per_pass, position, values)
        if self._sums is not None:
            found = [a + b for a, b in zip(self._sums, found, strict=True)]
        dr.eval(found)
        self._sums = found

    def image(self) -> mi.TensorXf:
        """Return the derivative of the image."""
        *planes, weights = self._sums
        planes = [dr.select(weights != 0, plane / weights, 0) for plane in planes]
        alpha = [planes.pop()] if self.has_alpha else []
        self._film.prepare([])
        shape = self._film.develop().shape
        colours = shape[2] - len(alpha)
        if mi.is_monochromatic:
            planes = planes * colours
        elif colours == 1:
            planes = [sum(s * plane for s, plane in zip(LUMINANCE, planes, strict=True))]
        return mi.TensorXf(interleaved(planes + alpha, shape[0] * shape[1]), shape)


class FilmAdjoint(SampledCamera):
    """Distribute derivatives ``grad`` (height, width, channels) of an objective with respect to the
    pixels of an image of ``sensor`` to its camera samples.
    """

    def __init__(
        self, sensor: mi.Sensor, grad: mi.TensorXf, seed: int, spp: int, lanes: int = LANES
    ) -> None:
        super().__init__(sensor, seed, spp, lanes)
        self.colour, self.alpha = _planes(self._film, grad)

    @property
    def largest(self) -> float:
        """The largest absolute derivative with respect to a channel of a pixel."""
        planes = self.colour + ([self.alpha] if self.alpha is not None else [])
        return max(float(dr.max(dr.abs(plane))[0]) for plane in planes)

    def passes(self) -> Iterator[CameraPass]:
        """Yield all camera samples, launch by launch."""
        # docs/primer, eq. (8.1)
        norm = None
        if not self._film.rfilter().is_box_filter():
            norm = mi.Float(0)
            for position, *_ in self._drawn():
                frame = self._frame
                (weights,) = reconstructed(self._film, frame.border, frame.per_pass, position, [])
                norm = norm + weights
                dr.eval(norm)
        for position, index, sampler, ray, weight in self._drawn():
            colour, alpha = self._of_samples(position, index, norm)
            weight = mi.Spectrum(weight)
            if mi.is_monochromatic:
                radiance = mi.Spectrum(sum(colour)) * weight
            else:
                radiance = mi.Spectrum(colour) * weight
            yield CameraPass(sampler, mi.Ray3f(ray), radiance, alpha)

    def _of_samples(
        self, position: mi.Point2f, index: mi.UInt32, norm: mi.Float | None
    ) -> tuple[list[mi.Float], mi.Float | None]:
        """Return the derivatives with respect to the channels of camera samples and to their alpha:
        derivatives with respect to the pixels around them, weighted by the reconstruction filter;
        ``norm`` holds the sum of the filter's weights in each pixel.
        """
        planes = [*self.colour, *([self.alpha] if self.alpha is not None else [])]
        if norm is None:
            share = dr.opaque(mi.Float, 1 / self._spp)
            found = [dr.gather(mi.Float, plane, index) * share for plane in planes]
        else:
            found = self._filtered(position, planes, norm)
        return (found[:-1], found[-1]) if self.alpha is not None else (found, None)

    def _filtered(
        self, position: mi.Point2f, planes: list[mi.Float], norm: mi.Float
    ) -> list[mi.Float]:
        filter_, size = self._film.rfilter(), self._film.crop_size()
        width, height = (dr.opaque(mi.Int32, int(n)) for n in size)
        reach, radius = int(filter_.border_size()), filter_.radius()
        at = position - mi.Vector2f(self._film.crop_offset())
        column, row = mi.Int32(dr.floor(at.x)), mi.Int32(dr.floor(at.y))
        sums = [mi.Float(0)] * len(planes)
        for dy in range(-reach - 1, reach + 2):
            for dx in range(-reach - 1, reach + 2):
                x, y = column + dx, row + dy
                away, down = at.x - (mi.Float(x) + 0.5), at.y - (mi.Float(y) + 0.5)
                inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
                inside &= (dr.abs(away) <= radius) & (dr.abs(down) <= radius)
                place = mi.UInt32(y * width + x)
                total = dr.gather(mi.Float, norm, place, inside)
                weight = filter_.eval(away) * filter_.eval(down)
                weight = dr.select(inside & (total != 0), weight / total, 0)
                for i, plane in enumerate(planes):
                    sums[i] = dr.fma(dr.gather(mi.Float, plane, place, inside), weight, sums[i])
        return sums


def _planes(film: mi.Film, grad: mi.TensorXf) -> tuple[list[mi.Float], mi.Float | None]:
    """Return arrays over the pixels: the derivatives with respect to red, green and blue, also for
    images of luminance, and with respect to alpha (None without that channel).
    """
    height, width, depth = grad.shape
    crop = film.crop_size()
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    colours = depth - has_alpha
    if (height, width) != (int(crop.y), int(crop.x)) or colours not in (1, 3):
        raise IrrcacheError(
            f"irrcache: gradients of an image of {width} x {height} pixels with {depth} channels "
            f"do not fit a film of {int(crop.x)} x {int(crop.y)}; use a film with pixel_format "
            '"rgb", "rgba" or "luminance", and its own size.'
        )
    values = mi.Float(grad.array)
    _check_finite(values, grad.shape)
    index = dr.arange(mi.UInt32, height * width) * depth
    planes = [dr.gather(mi.Float, values, index + c) for c in range(depth)]
    dr.eval(planes)
    alpha = planes.pop() if has_alpha else None
    if colours == 1:
        grey = planes[0]
        shares = (1.0, 0.0, 0.0) if mi.is_monochromatic else LUMINANCE
        planes = [grey * share for share in shares]
        dr.eval(planes)
    return planes, alpha


def _check_finite(values: mi.Float, shape: tuple[int, ...]) -> None:
    bad = ~dr.isfinite(values)
    if not dr.any(bad):
        return
    first = int(dr.min(dr.select(bad, dr.arange(mi.UInt32, dr.width(values)), 0xFFFFFFFF))[0])
    row, column, channel = (int(i) for i in np.unravel_index(first, shape))
    raise IrrcacheError(
        f"irrcache: the gradient of the image is {float(dr.slice(values, first))} at pixel "
        f"({column}, {row}), channel {channel}; check the loss (a logarithm, root or quotient of a "
        "pixel that is 0?)."
    )
