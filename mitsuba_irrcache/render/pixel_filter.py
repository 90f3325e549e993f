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
        self._packets = _packed([*position, *values], index)

    def read(self, index: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
        """Load position and values of samples."""
        return _read(self._packets, index, active)[: self.channels + 2]


class FurtherSamples:
    """Samples in place of one or both halves of those that all pixels have: ``count`` consecutive
    ones for each of the ``halves``, every ``further`` of which replace one. A pixel's halves have
    twice its number in the crop window and its margin, and that plus 1.
    """

    def __init__(
        self,
        halves: mi.UInt32,
        count: int,
        further: int,
        position: mi.Point2f,
        values: Sequence[mi.Float],
    ) -> None:
        self.halves, self.position, self.values = halves, position, list(values)
        self.count, self.weight = count, dr.opaque(mi.Float, 1 / further)

    def sums(self) -> list[mi.Float]:
        """Return the sums of the values of each half, with the weight of the samples that are
        replaced.
        """
        return [dr.block_sum(value, self.count) * self.weight for value in self.values]


def _packed(numbers: list[mi.Float], index: mi.UInt32) -> list[mi.Float]:
    """Return arrays as packets of four, at places ``index``."""
    numbers = numbers + [mi.Float(0)] * (-len(numbers) % 4)
    packets = []
    for start in range(0, len(numbers), 4):
        packet = dr.zeros(mi.Float, 4 * dr.width(index))
        dr.scatter(packet, mi.Vector4f(numbers[start : start + 4]), index)
        packets.append(packet)
    dr.eval(packets)
    return packets


def _read(packets: list[mi.Float], index: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
    """Load the numbers of `_packed` at ``index``."""
    found = [dr.gather(mi.Vector4f, packet, index, active) for packet in packets]
    return [number for packet in found for number in packet]


def reconstructed(
    film: mi.Film,
    border: int,
    per_pixel: int,
    position: mi.Point2f,
    values: Sequence[mi.Float],
    further: FurtherSamples | None = None,
) -> list[mi.Float]:
    """Sum the samples around each pixel of the crop window, weighted by the reconstruction filter.

    Returns one array for each channel, and the sums of the weights. The arguments are those of
    `Samples`; the ``further`` samples replace halves of them.
    """
    if not film.rfilter().is_box_filter():
        if further is None:
            return _gathered(Samples(film, border, per_pixel, position, values))
        elsewhere = _without(further.halves, per_pixel // 2, position)
        sums = _gathered(Samples(film, border, per_pixel, elsewhere, values))
        return [a + b for a, b in zip(sums, _further_gathered(film, border, further), strict=True)]
    # Assign samples to their own pixel, whatever the rounding of their positions.
    pixels = int(film.crop_size().x) * int(film.crop_size().y)
    everywhere = dr.zeros(mi.Float, pixels * per_pixel)
    sums = [value + everywhere for value in values]
    dr.eval(sums)
    if further is not None:
        sums = [dr.block_sum(value, per_pixel // 2) for value in sums]
        dr.eval(sums)
        for target, value in zip(sums, further.sums(), strict=True):
            dr.scatter(target, value, further.halves)
        dr.eval(sums)
        per_sum = 2
    else:
        per_sum = per_pixel
    if per_sum > 1:
        sums = [dr.block_sum(value, per_sum) for value in sums]
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


def _without(halves: mi.UInt32, per_half: int, position: mi.Point2f) -> mi.Point2f:
    """Return the positions of samples, those of some ``halves`` out of reach of all filters."""
    x = position.x + dr.zeros(mi.Float, dr.width(position))
    dr.eval(x)
    half, sample = Divisor(per_half).split(dr.arange(mi.UInt32, dr.width(halves) * per_half))
    place = dr.gather(mi.UInt32, halves, half) * per_half + sample
    dr.scatter(x, mi.Float(dr.inf), place)
    dr.eval(x)
    return mi.Point2f(x, position.y)


def _further_gathered(film: mi.Film, border: int, further: FurtherSamples) -> list[mi.Float]:
    """Return the sums of `reconstructed` over ``further`` samples."""
    reach = int(film.rfilter().border_size())
    parts = _around(film, border, reach, further)
    width, height = (int(n) for n in film.crop_size())
    framed_width, framed_height = width + 2 * border, height + 2 * border
    # The number plus 1 of each half with further samples, 0 for others.
    numbers = dr.zeros(mi.UInt32, 2 * framed_width * framed_height)
    dr.scatter(numbers, dr.arange(mi.UInt32, dr.width(further.halves)) + 1, further.halves)
    dr.eval(parts, numbers)
    column, row = pixel_of(dr.arange(mi.UInt32, width * height), width)
    frame = framed_width, framed_height
    return _collected(parts, numbers, mi.Vector2i(column, row) + border, reach, frame)


@symbolic
def _around(film: mi.Film, border: int, reach: int, further: FurtherSamples) -> list[mi.Float]:
    """Return the sums of values and weights of each half's ``further`` samples at the (2 ``reach``
    + 1)^2 pixels around, row by row.
    """
    filter_, side = film.rfilter(), 2 * reach + 1
    radius, count = filter_.radius(), dr.opaque(mi.UInt32, further.count)
    index = dr.arange(mi.UInt32, dr.width(further.position))
    packets = _packed([*further.position, *further.values], index)
    lane = dr.arange(mi.UInt32, dr.width(further.halves) * side * side)
    number, around = Divisor(side * side).split(lane)
    width = int(film.crop_size().x) + 2 * border
    pixel = pixel_of(dr.gather(mi.UInt32, further.halves, number) // 2, width)
    step = pixel_of(around, side) - reach
    centre = mi.Point2f(pixel + step - border + mi.Vector2i(film.crop_offset())) + 0.5
    sums = [dr.zeros(mi.Float, dr.width(lane)) for _ in range(len(further.values) + 1)]
    k = dr.zeros(mi.UInt32, dr.width(lane))
    while dr.hint(k < count, label="further samples of a pixel"):
        x, y, *values = _read(packets, number * count + k, mi.Bool(True))
        x, y = x - centre.x, y - centre.y
        inside = (dr.abs(x) <= radius) & (dr.abs(y) <= radius)
        weight = dr.select(inside, filter_.eval(x) * filter_.eval(y), 0)
        for i in range(len(further.values)):
            sums[i] = dr.fma(values[i], weight, sums[i])
        sums[-1] += weight
        k += 1
    return [total * further.weight for total in sums]


@symbolic
def _collected(parts: list, numbers, pixel, reach: int, frame: tuple[int, int]) -> list[mi.Float]:
    """Return the sums at each ``pixel`` of the ``parts`` of all pixels around it, two for each."""
    side = 2 * reach + 1
    count = dr.opaque(mi.UInt32, side * side)
    columns, rows = (dr.opaque(mi.Int32, n) for n in frame)
    sums = [mi.Float(0) for _ in parts]
    k = mi.UInt32(0)
    while dr.hint(k < 2 * count, label="halves with further samples"):
        around = k // 2
        at = pixel - (pixel_of(around, side) - reach)
        inside = (at.x >= 0) & (at.x < columns) & (at.y >= 0) & (at.y < rows)
        half = mi.UInt32(at.y * columns + at.x) * 2 + (k & 1)
        number = dr.gather(mi.UInt32, numbers, half, inside)
        place = (number - 1) * count + around
        for i in range(len(parts)):
            sums[i] += dr.gather(mi.Float, parts[i], place, inside & (number > 0))
        k += 1
    return sums
