"""Bilateral filter of the illumination (paper, section 3), whose strength adapts to the noise.

    I'(i) = sum_j w_ij I(j) / sum_j w_ij
    w_ij  = exp(-|i - j|^2 / (2 s^2)) exp(-(I(i) - I(j))^2 / (2 k^2 (e_i^2 + e_j^2)))

(Tomasi and Manduchi 1998), where e is the standard error of the illumination, projected from the
cache: as the cache converges, the filter approaches the identity. Strength k and spatial width s
minimise Stein's unbiased risk estimate (Stein 1981) of the mean squared error, which requires the
noise of the image but not the true image.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.uncertainty import PROBES, ROUNDS
from mitsuba_irrcache.core.jit import Divisor, symbolic
from mitsuba_irrcache.core.sequences import golden_words
from mitsuba_irrcache.core.spectrum import interleaved, luminance
from mitsuba_irrcache.render.aovs import Layers
from mitsuba_irrcache.render.pixel_filter import pixel_of

#: ``bilateral`` adapts to the noise; ``fixed`` has a constant strength, as in the paper.
FILTERS = ("none", "bilateral", "fixed")

#: The window has (2 RADIUS + 1)^2 taps; the spatial kernel has a standard deviation of SPREAD taps.
RADIUS = 5
SPREAD = 2.5
#: Candidate distances of taps in pixels: noise has the size of voxels, which may cover many pixels.
STRIDES = (1, 2, 4)
#: Candidate strengths: widths of the range kernel in standard errors of a difference.
STRENGTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0)
#: Width of the range kernel of ``fixed``, relative to the mean illumination.
FIXED_WIDTH = 0.2
#: Number of pixels from which the risk is estimated.
RISK_PIXELS = 8192
#: Relative noise below which the image is not filtered.
NEGLIGIBLE = 1e-3
#: Relative size of the perturbation by which the filter's response is measured.
PERTURBATION = 0.05


def filter_illumination(kind: str, layers: Layers, size: tuple[int, int]) -> mi.Spectrum | None:
    """Filter the illumination of an image of ``size`` (width, height).

    Returns None if ``kind`` is "none" or no pixel has an illumination.
    """
    if kind == "none":
        return None
    image, valid = _fill_channels(layers.illumination, layers.valid)
    if not dr.any(valid)[0]:
        return None
    if kind == "fixed":
        mean = dr.sum(dr.select(valid, luminance(image), 0)) / dr.count(valid)
        error = dr.select(valid, dr.abs(mean) * (FIXED_WIDTH / np.sqrt(2)), -1)
        everywhere = dr.arange(mi.UInt32, dr.width(valid))
        stride, strength = dr.opaque(mi.Int32, 1), dr.opaque(mi.Float, 1)
        return bilateral(_pack([image], error), size, everywhere, 0, stride, strength)
    brightness = dr.select(valid, luminance(layers.colour), 1)
    probes = [dr.select(valid, probe / brightness, 0) for probe in layers.probes]
    return _adaptive(image, valid, probes, layers.colour, size)


def denoise(image: np.ndarray, standard_error: np.ndarray) -> np.ndarray:
    """Apply the adaptive filter to an image (height, width, 1 | 3) with independent pixel errors.

    ``standard_error`` is that of the pixels (height, width).
    """
    height, width, channels = image.shape
    planes = [mi.Float(np.ascontiguousarray(image[..., c]).ravel()) for c in range(channels)]
    spectrum = mi.Spectrum(*(planes * 3)[: dr.size_v(mi.Spectrum)])
    error = mi.Float(np.ascontiguousarray(standard_error, dtype=np.float32).ravel())
    index = dr.arange(mi.UInt32, width * height)
    signs = [mi.sample_tea_32(index, mi.UInt32(k), ROUNDS)[0] >> 31 for k in range(PROBES)]
    probes = [dr.select(sign == 0, error, -error) for sign in signs]
    everywhere = dr.full(mi.Bool, True, width * height)
    white = dr.full(mi.Spectrum, 1, width * height)
    filtered = _adaptive(spectrum, everywhere, probes, white, (width, height))
    if filtered is None:
        return image
    return np.stack([np.array(c) for c in filtered][:channels], axis=1).reshape(image.shape)


def _adaptive(
    image: mi.Spectrum,
    valid: mi.Bool,
    probes: list[mi.Float],
    colour: mi.Spectrum,
    size: tuple[int, int],
) -> mi.Spectrum | None:
    """Apply the filter with the least risk; None if that is the identity.

    ``probes`` are random errors of the luminance of ``image``; errors are weighted by ``colour``.
    """
    if not probes:
        return None
    # Exclude the first probe, which measures the response below, to avoid a bias of the risk.
    variance = sum(dr.square(p) for p in probes[1:]) / (len(probes) - 1)
    weight = dr.square(luminance(colour))
    noise = dr.sum(dr.select(valid, variance * weight, 0))
    signal = dr.sum(dr.select(valid, dr.square(luminance(image)) * weight, 0))
    if not (noise > NEGLIGIBLE**2 * signal)[0]:
        return None
    error = dr.select(valid, dr.sqrt(variance), -1)
    # Errors change all channels in proportion to their values.
    intensity = luminance(image)
    relative = dr.select(
        valid & (intensity > 0), probes[0] / dr.select(intensity > 0, intensity, 1), 0
    )
    change = image * relative
    packed = _pack([image, image + PERTURBATION * change], error)
    best = _least_risk(packed, image, change, valid, colour, size)
    if best is None:
        return None
    stride, strength = dr.opaque(mi.Int32, best[0]), dr.opaque(mi.Float, best[1])
    everywhere = dr.arange(mi.UInt32, dr.width(valid))
    return bilateral(packed, size, everywhere, 0, stride, strength)


def _least_risk(
    packed: mi.Float,
    image: mi.Spectrum,
    change: mi.Spectrum,
    valid: mi.Bool,
    colour: mi.Spectrum,
    size: tuple[int, int],
) -> tuple[int, float] | None:
    """Choose the stride and strength with the least risk; None if no filter is expected to help.

    E |F(I) - truth|^2 = E |F(I) - I|^2 - E |noise|^2 + 2 E <noise, F(I)>. The last term is
    estimated by the filter's response to a small random error with the statistics of the noise,
    including its correlation between pixels (Ramani, Blu and Unser 2008).
    """
    # docs/primer, eq. (6.4)
    places = dr.compress(valid)
    available = dr.width(places)
    count = min(available, RISK_PIXELS)
    # Select pixels by multiples of the golden ratio, which are uniformly distributed.
    turn = mi.UInt64(golden_words(dr.arange(mi.UInt32, count)))
    nth = mi.UInt32((turn * dr.opaque(mi.UInt64, available)) >> 32)
    chosen = dr.gather(mi.UInt32, places, nth)
    settings = [(stride, strength) for stride in STRIDES for strength in STRENGTHS]
    lane = dr.arange(mi.UInt32, count * len(settings))
    # The number of valid pixels may change with every image and must not be a constant of the
    # kernel.
    setting, place = Divisor(count).split(lane)
    pixel = dr.gather(mi.UInt32, chosen, place)
    stride, strength = (
        dr.gather(kind, kind(values), setting)
        for kind, values in zip((mi.Int32, mi.Float), zip(*settings, strict=True), strict=True)
    )
    filtered, perturbed = (bilateral(packed, size, pixel, k, stride, strength) for k in (0, 1))
    before, noise, weight = (
        dr.gather(mi.Spectrum, interleaved(value), pixel) for value in (image, change, colour)
    )
    response = (perturbed - filtered) / PERTURBATION
    squared_weight = dr.square(weight)
    # Sum over the channels: dr.mean would make the number of pixels a constant of the kernel.
    risk = dr.sum(squared_weight * (dr.square(filtered - before) + 2 * noise * response))
    unfiltered = dr.sum(squared_weight * (2 * dr.square(noise)))
    risks = np.array(dr.block_sum(risk, count))
    least = int(np.argmin(risks))
    if risks[least] >= np.array(dr.block_sum(unfiltered, count))[0]:
        return None
    return settings[least]


@symbolic
def bilateral(
    packed: mi.Float,
    size: tuple[int, int],
    pixel: mi.UInt32,
    which: int,
    stride: mi.Int32,
    strength: mi.Float,
):
    """Filter pixels of the image with index ``which`` in ``packed``.

    ``stride`` is the distance of taps in pixels, ``strength`` the width of the range kernel in
    standard errors.
    """
    # docs/primer, eq. (6.3)
    width, height = (dr.opaque(mi.Int32, int(n)) for n in size)
    first = dr.opaque(mi.UInt32, which) * mi.UInt32(width * height)
    image, error = _unpack(packed, first + pixel, True)
    x, y = pixel_of(pixel, int(size[0]))
    tap = mi.Int32(0)
    side, count = 2 * RADIUS + 1, len(image)
    total, norm = mi.Spectrum(0), mi.Float(0)
    active = error >= 0
    while dr.hint(active, label="bilateral filter"):
        row = tap // side
        dx, dy = tap - row * side - RADIUS, row - RADIUS
        at_x, at_y = x + dx * stride, y + dy * stride
        inside = active & (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
        other, its_error = _unpack(packed, first + mi.UInt32(at_y * width + at_x), inside)
        spread = (dr.square(error) + dr.square(its_error)) * dr.square(strength)
        distance = dr.sum(dr.square(other - image)) / (count * dr.maximum(spread, 1e-30))
        distance += mi.Float(dx * dx + dy * dy) * (1 / SPREAD**2)
        weight = dr.select(inside & (its_error >= 0), dr.exp(-0.5 * distance), 0)
        total += weight * other
        norm += weight
        tap += 1
        active &= tap < side * side
    return dr.select(norm > 0, total / norm, image)


def _pack(images: list[mi.Spectrum], error: mi.Float) -> mi.Float:
    """Interleave images with the standard error (-1: invalid), one image after the other."""
    rows = [interleaved([*image, error]) for image in images]
    packed = dr.concat(rows) if len(rows) > 1 else rows[0]
    dr.eval(packed)
    return packed


def _unpack(packed: mi.Float, pixel: mi.UInt32, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
    kind = mi.Vector2f if mi.is_monochromatic else mi.Vector4f
    *image, error = dr.gather(kind, packed, pixel, active)
    return mi.Spectrum(*image), error


def _fill_channels(image: mi.Spectrum, valid: list[mi.Bool]) -> tuple[mi.Spectrum, mi.Bool]:
    """Replace undefined channels by the mean of the others; also return where any is defined."""
    known = sum(dr.select(ok, mi.Float(1), 0) for ok in valid)
    mean = sum(dr.select(ok, c, 0) for c, ok in zip(image, valid, strict=True))
    mean /= dr.maximum(known, 1)
    filled = [dr.select(ok, c, mean) for c, ok in zip(image, valid, strict=True)]
    return mi.Spectrum(*filled), known > 0
