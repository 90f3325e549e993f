"""Sample the sensor and accumulate on the film, for integrators written in Python.

Mitsuba's render loop for Python integrators supports only masks as alpha, but media need fractional
alpha. It also writes samples to the film as they are, while here an image may be developed and
filtered before it is put on the film.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Lock
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor
from mitsuba_irrcache.core.locks import ComputationLock
from mitsuba_irrcache.core.sequences import kronecker, kronecker_words, unit_floats
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.render.pixel_filter import FurtherSamples, pixel_of, reconstructed
from mitsuba_irrcache.render.sampled_emitters import EmitterSample

#: Maximum number of camera samples per kernel launch, to limit the memory of samples and sampler.
LANES = 1 << 22
#: Refinement of pixels: half of a pixel's samples is replaced if the variance of its other half
#: plus the mean variance of the halves around it exceeds OUTLIER times the mean (2 if all are
#: equal); maximum number of new samples per replaced one; maximum number of new samples over that
#: of all.
OUTLIER, MOST_FURTHER, FURTHER_SHARE = 2.0, 64, 0.5
#: Lower bound of the threshold of the variance; positive, so that it can be raised by a factor.
LEAST_VARIANCE = 1e-30
#: Minimum number of new samples that replace one; if fewer were available, the threshold of the
#: variance is raised by this factor.
FEWEST_FURTHER, RAISED = 4, 1.5
#: Where pixels are refined, the samples of each in a launch are a multiple of this number, so that
#: each half consists of pairs.
MULTIPLE = 4
#: Decorrelates new samples from others, from those of other passes, and parts of a pixel's samples.
REFINEMENT, PASS, PART = 0x9E3779B9, 0x85EBCA6B, 0xC2B2AE35
#: The sampler stores the number of samples per pixel in 32 bits.
SPP_LIMIT = 1 << 32

#: (sampler, ray, weight of the sensor, active) -> radiance, alpha, further channels; the radiance
#: includes the weight
RadianceFunction = Callable[..., tuple]

#: Films in use by threads: the lock of each, and the number of threads that hold or await it.
_films: dict[mi.Film, tuple[ComputationLock, int]] = {}
_films_lock = Lock()


@contextmanager
def exclusive(film: mi.Film) -> Iterator[None]:
    """Exclude other threads from the same ``film``, which can store one image only."""
    with _films_lock:
        lock, users = _films.get(film, (None, 0))
        lock = lock or ComputationLock()
        _films[film] = lock, users + 1
    try:
        with lock:
            yield
    finally:
        with _films_lock:
            lock, users = _films.pop(film)
            if users > 1:
                _films[film] = lock, users - 1


def render_film(
    sensor: mi.Sensor,
    radiance: RadianceFunction,
    seed: int,
    spp: int,
    should_stop: Callable[[], bool] = lambda: False,
    channels: Sequence[str] = (),
    refine: bool = False,
) -> mi.Film:
    """Render ``radiance`` to the sensor's film with ``spp`` samples per pixel.

    With ``spp`` 0 the sampler's count is used; ``channels`` are the names of channels in addition
    to radiance and alpha. With ``refine``, pixels of large variance get more samples. Raises
    IrrcacheError for a film without pixels, and for one that exceeds the memory.
    """
    film, sampler = sensor.film(), sensor.sampler().clone()
    check_film(film, spp, len(channels))
    if spp:
        sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    film.prepare(list(channels))
    frame = SampledFilm(film, spp, LANES)
    border, per_pass = frame.border, frame.per_pass
    sampler.set_samples_per_wavefront(per_pass)
    sampler.seed(seed, frame.lanes)
    refine = refine and per_pass % MULTIPLE == 0
    spread, sums = PixelPositions(sampler, seed, per_pass // 2 if refine else spp), None
    for done in range(0, spp, per_pass):
        spread.first = dr.opaque(mi.UInt32, done)
        samples = _sampled(sensor, sampler, spread, frame, spp, radiance, refine)
        further = None
        if refine:
            stream = REFINEMENT ^ (done * PASS & 0xFFFFFFFF)
            seeds = seed ^ stream, spread.seed ^ dr.opaque(mi.UInt32, stream)
            samples, further = _refined(sensor, sampler, seeds, frame, radiance, *samples)
        found = reconstructed(film, border, per_pass, *samples, further)
        sums = found if sums is None else [a + b for a, b in zip(sums, found, strict=True)]
        if per_pass < spp:
            sampler.advance()
            sampler.schedule_state()
            dr.eval(sums)
            dr.sync_thread()  # otherwise all passes are queued before the rendering can be stopped
        if should_stop():
            break
    *values, weights = sums
    colours = 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3
    _put(film, [*values[:colours], weights, *values[colours:]])
    return film


def planes(film: mi.Film, count: int) -> tuple[list[mi.Float], mi.Float | None, list[mi.Float]]:
    """Develop the film into arrays over pixels.

    Returns the colour (or luminance), alpha (None if the film has none), and the last ``count``
    channels.
    """
    image = film.develop()
    height, width, depth = image.shape
    index = dr.arange(mi.UInt32, height * width) * depth
    values = [dr.gather(mi.Float, image.array, index + i) for i in range(depth)]
    further = values[depth - count :]
    values = values[: depth - count]
    alpha = values.pop() if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else None
    return values, alpha, further


def fill_film(
    film: mi.Film,
    radiance: mi.Spectrum,
    alpha: mi.Float | None,
    channels: dict[str, mi.Float],
) -> None:
    """Replace the content of a film by a finished image."""
    film.prepare(list(channels))
    rgb = mi.Color3f(radiance.x) if mi.is_monochromatic else mi.Color3f(radiance)
    alphas = [] if alpha is None else [alpha]
    values = [*rgb, *alphas, mi.Float(1), *channels.values()]
    _put(film, values)


def _put(film: mi.Film, values: list[mi.Float]) -> None:
    """Add sums of samples, one array per channel, to a prepared film."""
    width, height = (int(n) for n in film.crop_size())
    flat = interleaved(values, width * height)
    tensor = mi.TensorXf(flat, (height, width, len(values)))
    film.put_block(mi.ImageBlock(tensor, film.crop_offset()))


def check_film(film: mi.Film, spp: int, channels: int, at_once: bool = False) -> None:
    """Raise IrrcacheError if the film has no pixels or its rendering exceeds the available memory.

    ``channels`` is the number in addition to radiance and alpha; ``at_once`` states that all
    ``spp`` samples are rendered in one launch.
    """
    width, height = (int(n) for n in film.crop_size())
    if min(width, height) == 0:
        raise IrrcacheError(
            f"irrcache: the crop window of the film is {width} x {height} pixels; crop_width and "
            "crop_height must be at least 1."
        )
    if not 0 <= spp < SPP_LIMIT:
        raise IrrcacheError(
            f"irrcache: spp is {spp}; it must be 0 (the sampler's) or a number of samples per "
            f"pixel below {SPP_LIMIT}."
        )
    pixels, values = width * height, channels + 5  # colour, alpha, weight
    lanes = pixels * max(spp, 1) if at_once else max(pixels, min(LANES, pixels * max(spp, 1)))
    # Memory of the film's sums, those of a pass, and two copies during development; for each sample
    # its values, position and sampler state.
    needed = 4 * (4 * pixels * values + lanes * (values + 6))
    what = f"irrcache: an image of {width} x {height} pixels"
    what += f" with {channels} further channels" if channels else ""
    remedy = f"lower width{', height or spp' if at_once else ' and height'} of the film"
    remedy += ", ask for fewer aovs" if channels else ""
    what += f" and {spp} samples each" if at_once else ""
    remedy += ", or render it in crop windows"
    require_memory(needed, what, remedy)
    if lanes >= 2**32:
        raise IrrcacheError(f"{what} needs {lanes} samples at once, 2^32 or more; {remedy}.")


def largest_divisor(n: int, limit: int) -> int:
    """Return the largest divisor of ``n`` that is at most ``limit``."""
    return next(d for d in range(min(n, limit), 0, -1) if n % d == 0)


class SampledFilm:
    """The sampled pixels of a ``film``, including a border that its filter needs, and the number of
    samples per pixel in one launch, which has at most ``most`` of the ``spp`` samples of all
    pixels.
    """

    def __init__(self, film: mi.Film, spp: int, most: int) -> None:
        self.film = film
        self.border = film.rfilter().border_size() if film.sample_border() else 0
        size = mi.ScalarVector2u(film.crop_size()) + 2 * self.border
        self.width, self.pixels = int(size.x), int(size.x) * int(size.y)
        self.per_pass = largest_divisor(spp, max(1, most // self.pixels))
        #: samples of a launch
        self.lanes = self.pixels * self.per_pass

    def positions(self, spread: PixelPositions) -> tuple[mi.Point2f, mi.UInt32, mi.UInt32]:
        """Return the film positions of the samples of a launch, the flat indices of their pixels,
        and the number of each sample within its pixel.
        """
        index, sample = Divisor(self.per_pass).split(dr.arange(mi.UInt32, self.lanes))
        return self.corner(index) + spread.next(index, sample), index, sample

    def around(self, values: mi.Float) -> mi.Float:
        """Return for both halves of each pixel half the mean ``values`` of the pixels around."""
        dr.eval(values)
        pixel = dr.arange(mi.UInt32, 2 * self.pixels) // 2
        place, height = pixel_of(pixel, self.width), self.pixels // self.width
        total, count = mi.Float(0), mi.Float(0)
        for step in ((-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)):
            x, y = place.x + step[0], place.y + step[1]
            inside = (x >= 0) & (y >= 0) & (x < self.width) & (y < height)
            total += dr.gather(mi.Float, values, mi.UInt32(y * self.width + x), inside)
            count += dr.select(inside, 1.0, 0.0)
        return total / dr.maximum(2 * count, 1)

    def corner(self, pixel: mi.UInt32) -> mi.Point2f:
        """Return the position on the film of the upper left corner of a pixel."""
        place = mi.Point2f(pixel_of(pixel, self.width) - self.border)
        return place + mi.Vector2f(self.film.crop_offset())


class AntitheticPairs:
    """Two-dimensional golden-ratio sequences in antithetic pairs: symmetric about the centre, so
    that they integrate linear functions exactly. Each point of a pair is uniformly distributed.

    A sequence has ``count`` points; the last one of an odd number is single.
    """

    def __init__(self, count: int) -> None:
        self._paired = dr.opaque(mi.UInt32, count - count % 2)
        pairs = max(count // 2, 1)
        # Multiples of a number without common divisors are all pairs in another order.
        stride = next(
            n for n in range(max(1, int(0.618 * pairs)), 0, -1) if math.gcd(n, pairs) == 1
        )
        self._stride = dr.opaque(mi.UInt32, stride if pairs < 1 << 16 else 1)
        self._pairs = Divisor(pairs)

    def words(
        self, number: mi.UInt32, shifts: Sequence[mi.UInt32], permuted: bool = False
    ) -> tuple[list[mi.UInt32], mi.Bool, mi.Bool]:
        """Return a point of the sequence with these ``shifts`` as coordinates times 2^32; whether
        it is the second one of a pair; and whether it belongs to a pair.

        Two sequences of one pixel are independent if one of them has a ``permuted`` order of pairs.
        """
        pair, is_second, is_paired = number // 2, number % 2 == 1, number < self._paired
        if permuted:
            _, other = self._pairs.split(pair * self._stride)
            pair = dr.select(is_paired, other, pair)
        words = kronecker_words(pair, shifts)
        return [dr.select(is_second, ~word, word) for word in words], is_second, is_paired


class PixelPositions:
    """Positions of the camera samples within their pixels.

    Mitsuba's ``independent`` sampler does not stratify the samples of a pixel. If the radiance is
    free of noise, this dominates the noise of the image. Positions therefore are `AntitheticPairs`
    with a random shift per pixel. The last sample of an odd number is at the centre, so that images
    with one sample per pixel do not depend on the seed. Other samplers are used unchanged.
    """

    def __init__(self, sampler: mi.Sampler, seed: int, count: int) -> None:
        """Every ``count`` samples of a pixel form a sequence, independent of other sequences."""
        self.sampler = sampler
        self.independent = sampler.class_name() == "IndependentSampler"
        # Wrapping integrators pass the seed as an array.
        given = isinstance(seed, mi.UInt32)
        self.seed = seed if given else dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        self.first = dr.opaque(mi.UInt32, 0)
        self._sequence, self._count = AntitheticPairs(count), Divisor(count)
        #: whether a pixel has one sample, at its centre: such an image has no noise
        self._is_single = dr.opaque(mi.Bool, count == 1)

    def next(self, pixel: mi.UInt32, sample: mi.UInt32) -> mi.Point2f:
        """Return the position in [0, 1)^2 of a ``sample`` of this pass."""
        if not self.independent:
            return self.sampler.next_2d()
        part, number = self._count.split(self.first + sample)
        shifts = mi.sample_tea_32(pixel ^ part * PART, self.seed, 8)
        words, *_ = self._sequence.words(number, shifts)
        centre = mi.UInt32(1 << 31)
        return mi.Point2f(unit_floats([dr.select(self._is_single, centre, w) for w in words]))

    def emitter_sample(self, pixel: mi.UInt32, sample: mi.UInt32) -> EmitterSample:
        """Return the position on emitters for a ``sample`` of this pass."""
        if not self.independent:
            return EmitterSample(self.sampler.next_2d())
        part, number = self._count.split(self.first + sample)
        shifts = mi.sample_tea_32(self.seed, pixel ^ part * PART, 8)
        words, is_second, _ = self._sequence.words(number, shifts, permuted=True)
        return EmitterSample(mi.Point2f(unit_floats(words)), dr.select(is_second, mi.Float(-1), 1))


class CameraSampler:
    """A sampler of Mitsuba; ``emitter_sample`` returns a stratified position on emitters for each
    camera sample.
    """

    def __init__(self, sampler: mi.Sampler, emitter_sample: Callable[[], EmitterSample]) -> None:
        self._sampler, self.emitter_sample = sampler, emitter_sample

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        """Return the sampler's next number."""
        return self._sampler.next_1d(active)

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        """Return the sampler's next pair of numbers."""
        return self._sampler.next_2d(active)


def camera_ray(
    sensor: mi.Sensor, sampler: mi.Sampler, position: mi.Point2f
) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
    """Sample a ray through each ``position`` on the film [pixels]; also return its weight."""
    film = sensor.film()
    scale = mi.Vector2f(*(dr.opaque(mi.Float, 1 / int(n)) for n in film.crop_size()))
    on_film = (position - mi.Vector2f(film.crop_offset())) * scale
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    return sensor.sample_ray_differential(time, 0, on_film, aperture)


def scattered_rays(sensor: mi.Sensor, least: int) -> mi.Ray3f:
    """Return rays from the centre of the aperture, evenly distributed over the film: one per pixel,
    or up to 16 if there would be fewer than ``least`` rays.
    """
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    per_pixel = min(max(least // (width * height), 1), 16)
    lane = dr.arange(mi.UInt32, width * height * per_pixel)
    pixel, k = Divisor(per_pixel).split(lane)
    within = mi.Point2f(kronecker(k, 2, (mi.Float(0.5), mi.Float(0.5))))
    position = mi.Vector2f(pixel_of(pixel, width)) + within
    scale = mi.Vector2f(*(dr.opaque(mi.Float, 1 / n) for n in (width, height)))
    time = mi.Float(sensor.shutter_open() + 0.5 * sensor.shutter_open_time())
    ray, _ = sensor.sample_ray(time, 0.5, position * scale, mi.Point2f(0.5))
    return ray


class ViewExtent(NamedTuple):
    """Extent of what an image shows at a distance from the sensor.

    Attributes:
        at_sensor: extent at the sensor [scene units].
        per_distance: growth of the extent with distance.
        pixels: number of pixels along it.
        position, direction: means over the image of where rays start, and of their directions.
        spread: largest distance of where rays start from ``position``.
    """

    at_sensor: float
    per_distance: float
    pixels: float
    position: tuple[float, float, float]
    direction: tuple[float, float, float]
    spread: float


def view_extent(sensor: mi.Sensor) -> ViewExtent:
    """Measure the extent of what an image shows by the rays of neighbouring pixels."""
    film, count = sensor.film(), 16
    size, scale = np.array(film.size(), float), 1 / np.array(film.crop_size(), float)
    lane, axis = np.divmod(np.arange(2 * count * count), 2)
    position = (np.stack([lane % count, lane // count]) + 0.5) / count * size[:, None]
    position -= np.array(film.crop_offset(), float)[:, None]
    rays = []
    for side in (-0.5, 0.5):
        on_film = (position + side * np.stack([axis == 0, axis == 1])) * scale[:, None]
        time = mi.Float(sensor.shutter_open())
        ray, _ = sensor.sample_ray(time, 0.5, mi.Point2f(np.float32(on_film)), mi.Point2f(0.5))
        rays.append(ray)
    first, second = rays
    apart = dr.norm(second.o - first.o), dr.norm(second.d - first.d)
    extent = (float(np.median(np.array(each) * size[axis])) for each in apart)
    starts, directions = np.array(first.o, float), np.array(first.d, float)
    position = starts.mean(axis=1)
    spread = np.linalg.norm(starts - position[:, None], axis=0).max()
    means = (tuple(each.tolist()) for each in (position, directions.mean(axis=1)))
    return ViewExtent(*extent, float(np.sqrt(size.prod())), *means, float(spread))


def _sampled(
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    spread: PixelPositions,
    frame: SampledFilm,
    spp: int,
    radiance: RadianceFunction,
    refine: bool,
) -> tuple[mi.Point2f, list[mi.Float]]:
    """Trace the samples of a pass; return their film positions and the values of all channels."""
    position, index, sample = frame.positions(spread)

    def on_emitter() -> EmitterSample:
        return spread.emitter_sample(index, sample)

    if refine and spread.independent:
        found = _known(sampler, position, on_emitter())
        return position, _values(sensor, sampler, position, lambda: found, spp, radiance)
    return position, _values(sensor, sampler, position, on_emitter, spp, radiance)


def _known(sampler: mi.Sampler, position: mi.Point2f, sample: EmitterSample) -> EmitterSample:
    """Evaluate the arguments that are computed differently for the first samples of a pixel and for
    further ones, so that one kernel traces both: kernels for scenes with surfaces take many seconds
    to compile.
    """
    sampler.schedule_state()
    dr.eval(position, sample.u, sample.sign)
    return sample


def _values(
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    position: mi.Point2f,
    on_emitter: Callable[[], EmitterSample],
    spp: int,
    radiance: RadianceFunction,
) -> list[mi.Float]:
    """Trace samples at these positions on the film; return the values of all channels."""
    film = sensor.film()
    ray, weight = camera_ray(sensor, sampler, position)
    ray.scale_differential(dr.rsqrt(dr.opaque(mi.Float, spp)))
    camera_sampler = CameraSampler(sampler, on_emitter)
    value, alpha, further = radiance(camera_sampler, ray, weight, mi.Bool(True))
    rgb = mi.Color3f(value.x) if mi.is_monochromatic else mi.Color3f(value)
    alphas = [alpha] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
    return [*rgb, *alphas, *further]


def _refined(
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    seeds: tuple[int, mi.UInt32],
    frame: SampledFilm,
    radiance: RadianceFunction,
    position: mi.Point2f,
    values: list[mi.Float],
) -> tuple[tuple[mi.Point2f, list[mi.Float]], FurtherSamples | None]:
    """Replace samples by more numerous ones in pixels of large variance, such as at the edge of an
    area emitter.

    Returns all original samples, evaluated, and the new ones (None without any). Whether one half
    of a pixel's samples is replaced depends on the variance of the other half and of the pixels
    around. If it depended on its own variance, the image would be too dark, because halves that
    miss rare bright paths would be kept. The ``seeds`` of sampler and positions differ between the
    passes of an image, whose samples are independent.
    """
    # docs/primer, eq. (5.10)
    count, half = dr.width(position), frame.per_pass // 2
    everywhere = dr.zeros(mi.Float, count)
    values = [value + everywhere for value in values]
    dr.eval(position, values)
    brightness = values[0] + values[1] + values[2]
    mean = dr.block_sum(brightness, half) / half
    square = dr.block_sum(dr.square(brightness), half) / half
    variance = dr.maximum(square - dr.square(mean), 0)
    dr.eval(variance)
    halves = dr.arange(mi.UInt32, dr.width(variance))
    others = dr.gather(mi.Float, variance, halves ^ 1) + frame.around(dr.block_sum(variance, 2))
    chosen, further = _most_needed(others, dr.maximum(OUTLIER * dr.mean(variance), LEAST_VARIANCE))
    if not dr.width(chosen):
        return (position, values), None
    # A number of samples that differs between images must not be a constant of the kernel.
    each, lanes = dr.opaque(mi.UInt32, further), dr.width(chosen) * half * further
    lane, k = Divisor(further).split(dr.arange(mi.UInt32, lanes))
    number, cell = Divisor(half).split(lane)
    number = dr.gather(mi.UInt32, chosen, number)
    source = number * half
    words = mi.sample_tea_32(source + cell, seeds[1])
    within = mi.Point2f(kronecker(k, 2, unit_floats(words)))
    place = frame.corner(number // 2) + PixelCells(half).position(cell, within)
    shifts = mi.sample_tea_32(seeds[1], source)
    sequence = AntitheticPairs(half * further)
    words, is_second, _ = sequence.words(cell * each + k, shifts, permuted=True)
    sign = dr.select(is_second, mi.Float(-1), 1)
    on_emitter = EmitterSample(mi.Point2f(unit_floats(words)), sign)
    own = sampler.clone()
    own.seed(seeds[0], lanes)
    _known(own, place, on_emitter)
    spp = further * frame.per_pass
    found = _values(sensor, own, place, lambda: on_emitter, spp, radiance)
    everywhere = dr.zeros(mi.Float, lanes)
    found = [value + everywhere for value in found]
    dr.eval(found, place)
    return (position, values), FurtherSamples(chosen, half * further, further, place, found)


def _most_needed(variance: mi.Float, threshold: mi.Float) -> tuple[mi.UInt32, int]:
    """Choose the halves of pixels to refine: those whose ``variance`` is above the ``threshold``,
    which is raised until enough new samples are available for each.

    Returns their numbers, and the number of new samples that replace one.
    """
    dr.eval(variance, threshold)
    while True:
        chosen = dr.compress(variance > threshold)
        share = FURTHER_SHARE * dr.width(variance) / max(dr.width(chosen), 1)
        if share >= FEWEST_FURTHER:
            return chosen, min(MOST_FURTHER, int(share))
        threshold = threshold * RAISED
        dr.eval(threshold)


class PixelCells:
    """Division of a pixel into ``count`` cells of equal area, which stratify its samples, in rows
    whose numbers of cells differ by at most one.
    """

    def __init__(self, count: int) -> None:
        rows = math.isqrt(count)
        narrow, longer = divmod(count, rows)  # cells of a row, and rows with one cell more
        self._longer_end = dr.opaque(mi.UInt32, longer * (narrow + 1))
        self._columns = [Divisor(narrow + 1), Divisor(narrow)]
        self._widths = [dr.opaque(mi.Float, 1 / n) for n in (narrow + 1, narrow)]
        self._area = dr.opaque(mi.Float, 1 / count)

    def position(self, cell: mi.UInt32, within: mi.Point2f) -> mi.Point2f:
        """Return the position in the pixel, in [0, 1)^2, of a point ``within`` a cell."""
        is_longer = cell < self._longer_end
        begin = dr.select(is_longer, 0, self._longer_end)
        columns = [each.split(cell - begin)[1] for each in self._columns]
        column, width = (dr.select(is_longer, *pair) for pair in (columns, self._widths))
        # The area of all rows before, and that of the row's part: width times height is the area.
        before = mi.Float(cell - column) * self._area
        return mi.Point2f(
            (mi.Float(column) + within.x) * width, before + within.y * self._area / width
        )
