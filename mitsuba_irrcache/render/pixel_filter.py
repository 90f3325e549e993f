"""Reconstruct pixels from camera samples with the film's reconstruction filter.

Mitsuba splats samples with atomic additions, whose order and hence rounding is not deterministic.
Here each pixel gathers the samples around it in a fixed order.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import Divisor, symbolic


class Samples:
    """Camera samples, ``per_pixel`` consecutive ones for each pixel in row-major order.

    They cover the crop window and a margin of ``border`` pixels. Position and values of a sample
    are stored in packets of four, which load much faster than single numbers.
    """

    def __init__(
        self,
        film: mi.Film,
        border: int,
        per_pixel: int,
        position: mi.Point2f,
        values: Sequence[mi.Float],
    ) -> None:
        self.film, self.border, self.per_pixel = film, border, per_pixel
        self.channels = len(values)
        width, height = (int(n) + 2 * border for n in film.crop_size())
        index = dr.arange(mi.UInt32, width * height * per_pixel)
        numbers = [*position, *values]
        numbers += [mi.Float(0)] * (-len(numbers) % 4)
        self.packets = []
        for start in range(0, len(numbers), 4):
            packet = dr.zeros(mi.Float, 4 * dr.width(index))
            dr.scatter(packet, mi.Vector4f(numbers[start : start + 4]), index)
            self.packets.append(packet)
        dr.eval(self.packets)

    def read(self, index: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
        """Load position and values of samples."""
        packets = [dr.gather(mi.Vector4f, packet, index, active) for packet in self.packets]
        numbers = [number for packet in packets for number in packet]
        return numbers[: self.channels + 2]


def reconstructed(
    film: mi.Film,
    border: int,
    per_pixel: int,
    position: mi.Point2f,
    values: Sequence[mi.Float],
) -> list[mi.Float]:
    """Sum the samples around each pixel of the crop window, weighted by the reconstruction filter.

    Returns one array for each channel, and the sums of the weights. The arguments are those of
    `Samples`.
    """
    if not film.rfilter().is_box_filter():
        return _gathered(Samples(film, border, per_pixel, position, values))
    # Assign samples to their own pixel, whatever the rounding of their positions.
    pixels = int(film.crop_size().x) * int(film.crop_size().y)
    everywhere = dr.zeros(mi.Float, pixels * per_pixel)
    sums = [value + everywhere for value in values]
    dr.eval(sums)
    if per_pixel > 1:
        sums = [dr.block_sum(value, per_pixel) for value in sums]
    return [*sums, dr.opaque(mi.Float, per_pixel, pixels)]


def pixel_of(index: mi.UInt32, width: int) -> mi.Vector2i:
    """Convert flat pixel indices to column and row for rows of ``width`` pixels."""
    row, column = Divisor(width).split(index)
    return mi.Vector2i(mi.Int32(column), mi.Int32(row))


def _gathered(samples: Samples) -> list[mi.Float]:
    """Compute the sums of `reconstructed` in two passes."""
    film, reach = samples.film, int(samples.film.rfilter().border_size())
    parts = _columns(samples, reach)
    dr.eval(parts)
    width, height = (int(n) for n in film.crop_size())
    wide, high = (dr.opaque(mi.Int32, n) for n in (width, height + 2 * samples.border))
    column, row = pixel_of(dr.arange(mi.UInt32, width * height), width)
    sums = [mi.Float(0)] * (samples.channels + 1)
    for part, down in zip(parts, range(-reach, reach + 1), strict=True):
        source_row = row + (dr.opaque(mi.Int32, samples.border) - down)
        inside = (source_row >= 0) & (source_row < high)
        place = mi.UInt32(source_row * wide + column)
        sums = [
            s + dr.gather(mi.Float, values, place, inside)
            for s, values in zip(sums, part, strict=True)
        ]
    dr.eval(sums)
    return sums


@symbolic
def _columns(samples: Samples, reach: int) -> list[list[mi.Float]]:
    """Sum the contributions of each row of samples to the columns of nearby rows of pixels.

    Returns for each of the 2 ``reach`` + 1 rows the sums of `reconstructed`, over rows of samples
    and columns of the crop window.
    """
    film = samples.film
    filter_, width = film.rfilter(), int(film.crop_size().x)
    height = int(film.crop_size().y) + 2 * samples.border
    wide, count, edge = (
        dr.opaque(mi.Int32, n)
        for n in (width + 2 * samples.border, samples.per_pixel, samples.border)
    )
    radius, first, last = filter_.radius(), dr.opaque(mi.Int32, -reach), dr.opaque(mi.Int32, reach)
    left, top = (dr.opaque(mi.Float, int(n) + 0.5) for n in film.crop_offset())
    column, row = pixel_of(dr.arange(mi.UInt32, width * height), width)
    x, y = mi.Float(column) + left, mi.Float(row - edge) + top
    rows = 2 * reach + 1
    sums = [
        [dr.zeros(mi.Float, width * height) for _ in range(samples.channels + 1)]
        for _ in range(rows)
    ]
    dx, k = first + 0 * row, 0 * row
    while dr.hint(dx <= last, label="samples of a pixel"):
        at = column + edge + dx
        inside = (at >= 0) & (at < wide)
        values = samples.read(mi.UInt32((row * wide + at) * count + k), inside)
        away, down = values[0] - x, values[1] - y
        inside &= dr.abs(away) <= radius
        along = dr.select(inside, filter_.eval(away), 0)
        for j in range(rows):
            below = down - (j - reach)
            weight = dr.select(dr.abs(below) <= radius, along * filter_.eval(below), 0)
            for i in range(samples.channels):
                sums[j][i] = dr.fma(values[i + 2], weight, sums[j][i])
            sums[j][samples.channels] += weight
        k += 1
        ended = k == count
        k, dx = dr.select(ended, 0, k), dr.select(ended, dx + 1, dx)
    return sums
