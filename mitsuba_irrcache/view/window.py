"""The state of one window: the view that it requests and the images rendered for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import monotonic, perf_counter

import numpy as np

from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.comparison import WAITING, Compared, Comparison
from mitsuba_irrcache.view.light import CacheSnapshot, Light
from mitsuba_irrcache.view.picture import Look, Samples

#: Seconds without a movement after which a camera counts as resting.
REST_SECONDS = 0.15
#: Target duration in seconds of an image of a moving camera.
MOVING_SECONDS = 0.05
#: Levels of detail for moving cameras: image size relative to the window, and factor of the
#: ray-marching step; the best level within `MOVING_SECONDS` is used.
LEVELS = ((1.0, 1.0), (0.71, 1.0), (0.5, 1.0), (0.5, 2.0), (0.35, 2.0), (0.25, 2.0), (0.18, 3.0))
#: Samples per pixel of a complete image at rest.
SAMPLES = 16
#: Upper limit of the number of pixels per image.
MOST_PIXELS = 1 << 22


@dataclass(frozen=True)
class View:
    """A requested view: a camera, and the window's ``size`` (width, height) in pixels.

    ``compared`` is one of `comparison.KINDS`.
    """

    camera: Camera
    size: tuple[int, int]
    look: Look = field(default_factory=Look)
    compared: str = "off"

    def bounded(self) -> View:
        """Return the view with a size of at least one pixel and at most `MOST_PIXELS`."""
        width, height = (max(int(n), 1) for n in self.size)
        shrunk = min(1.0, (MOST_PIXELS / (width * height)) ** 0.5)
        return replace(self, size=(int(width * shrunk) or 1, int(height * shrunk) or 1))

    def shows_place_of(self, other: View | None) -> bool:
        """Return whether ``other`` has the same camera and the same size."""
        return other is not None and (self.camera, self.size) == (other.camera, other.size)

    def shows_quantities_of(self, other: View) -> bool:
        """Return whether samples of ``other`` have the layers that this view displays."""
        mine, its = self.look, other.look
        return (mine.layered, mine.with_error) == (its.layered, its.with_error)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image for a window.

    Attributes:
        pixels: uint8 (height, width, 3).
        view: the view that it shows.
        samples: per pixel.
        moving: whether it is coarse, because the camera moves or for a first look after an edit.
        final: whether no better image will follow.
        compared: the comparison with ``volpath``, if one was requested.
    """

    pixels: np.ndarray
    view: View
    samples: int
    moving: bool
    final: bool
    compared: Compared | None = None


class Window:
    """One window; ``show`` receives every `Picture`, in the session's thread."""

    def __init__(self, show: Callable[[Picture], None]) -> None:
        self.show = show
        self.view: View | None = None
        self.moved = -np.inf  # time of the camera's last movement
        self.fresh = False  # whether the view has not been rendered yet
        # whether the displayed image is older than the last edit, or shows other quantities
        self.outdated = False
        self.level = len(LEVELS) // 2
        self.samples: Samples | None = None
        self._resting: View | None = None  # the view of `samples`
        self._light: Light | None = None  # the caches of `samples`
        self._revision = -1
        self._comparison: Comparison | None = None

    @property
    def has_first_sample(self) -> bool:
        """Return whether the reference of the comparison covers the image."""
        return self._comparison is not None and self._comparison.has_sample

    @property
    def is_moving(self) -> bool:
        return monotonic() - self.moved < REST_SECONDS

    def want(self, view: View) -> bool:
        """Set the view; return whether it differs from the previous one.

        The camera counts as moving unless only what the view displays has changed.
        """
        old, view = self.view, view.bounded()
        if view == old:
            return False
        if not view.shows_place_of(old):  # the first image of a window is a coarse one, too
            self.moved = monotonic()
        elif not view.shows_quantities_of(old):
            self.outdated = True
        self.view, self.fresh = view, True
        return True

    def forget(self) -> None:
        """Reset the window to the state without a view, and release its images."""
        self.view, self.fresh, self._resting = None, False, None
        self.samples = self._light = self._comparison = None
        self.outdated = False

    def expect(self, light: Light) -> None:
        """Note that images of caches other than ``light`` are outdated."""
        if self._light is not light:
            self.outdated = self.view is not None

    def release_others(self, light: Light) -> None:
        """Release images of caches other than ``light``."""
        if self._light is not light:
            self.samples = self._light = None
        if self._comparison is not None and self._comparison.light is not light:
            self._comparison = None

    def lacks(self, light: Light, revision: int, first: bool) -> bool:
        """Return whether an image at rest lacks samples, or has none at all if ``first``."""
        if self.view is None:
            return False
        if self.fresh or not self.view.shows_place_of(self._resting) or self._light is not light:
            return True
        if not self.view.shows_quantities_of(self._resting):
            return True
        return not first and (self._revision != revision or self.samples.count < SAMPLES)

    @property
    def needs_coarse(self) -> bool:
        """Return whether a coarse image has to come first: the camera moves, or the displayed image
        is older than the last edit or shows other quantities.
        """
        return self.outdated or (self.fresh and self.is_moving)

    def is_complete(self, seen: CacheSnapshot, view: View) -> bool:
        """Return whether all samples of an image at rest of ``view`` of these caches exist."""
        had = self.samples
        return (
            had is not None
            and had.count >= SAMPLES
            and (had.seen, had.camera, had.size) == (seen, view.camera, view.size)
            and had.slices is view.look.slices
        )

    def quick(self, light: Light, view: View, extent: tuple[float, float]) -> Picture:
        """Render an image at the level of detail that is fast enough for moving cameras."""
        share, stride = LEVELS[self.level]
        size = tuple(max(round(n * share), 1) for n in view.size)
        started, look = perf_counter(), replace(view.look, filtered=False)  # no time for that
        seen = light.snapshot(look.layered, look.with_error)
        seen.stride(stride)
        try:
            samples = Samples(seen, view.camera, size, slices=look.slices)
            samples.add(1)
            pixels = samples.picture(look, extent)
        finally:
            seen.stride(1.0)
        self.level = _adapted(self.level, perf_counter() - started)
        self.outdated = False
        return Picture(pixels, view, 1, True, False)

    def refined(
        self,
        light: Light,
        revision: int,
        view: View,
        extent: tuple[float, float],
        improving: bool,
        pause: Callable[[], None],
    ) -> Picture:
        """Render one more sample per pixel of an image at rest.

        ``light`` and its ``revision`` identify the caches; ``improving`` says whether they are
        still refined. If ``pause`` raises an exception, the window's state is unchanged.
        """
        look = view.look
        seen = light.snapshot(look.layered, look.with_error)
        samples = self.samples
        known = samples is not None and self._revision == revision
        known = known and (samples.seen, samples.slices) == (seen, look.slices)
        if not (known and view.shows_place_of(self._resting)):
            samples = Samples(seen, view.camera, view.size, slices=look.slices)
            samples.add(1, pause)
        elif self._resting == view:  # unless only the display of the same samples changes
            if samples.count == 1:  # the centre sample is not random
                samples = Samples(seen, view.camera, view.size, slices=look.slices)
                samples.add(SAMPLES, pause)
            samples.add(SAMPLES, pause)
        self.samples, self._resting = samples, view
        self._revision, self._light, self.outdated = revision, light, False
        return self._picture(view, extent, improving)

    def is_comparing(self, light: Light, revision: int) -> bool:
        """Return whether the image is compared with a reference that is not complete."""
        view = self.view
        if view is None or view.compared == "off" or self.lacks(light, revision, True):
            return False
        known = self._comparison_of(light, view)
        return known is None or not known.is_done

    def compared(
        self, light: Light, view: View, extent: tuple[float, float], improving: bool
    ) -> Picture | None:
        """Add samples to the reference; return an image if there is anything new to show."""
        known = self._comparison_of(light, view)
        if known is None:
            self._comparison = known = Comparison(light, view.camera, view.size)
        return self._picture(view, extent, improving) if known.refine() else None

    def _comparison_of(self, light: Light, view: View) -> Comparison | None:
        """Return the comparison of this scene and view if it exists."""
        known = self._comparison
        return known if known and known.belongs_to(light, view.camera, view.size) else None

    def _picture(self, view: View, extent: tuple[float, float], improving: bool) -> Picture:
        """Return the image that `samples` give."""
        count = self.samples.count
        pixels = self.samples.picture(view.look, extent)
        final = count >= SAMPLES and not improving
        if view.compared == "off":
            return Picture(pixels, view, count, False, final)
        known = self._comparison_of(self._light, view)
        if known is None:
            state = Compared(view.compared, WAITING)
            return Picture(pixels, view, count, False, False, state)
        image = self.samples.image(view.look.filtered)
        look = replace(view.look, kind="image")
        state = known.state(view.compared, image, look, self.samples.backdrop(look))
        if state.error is not None:
            pixels = state.error
        return Picture(pixels, view, count, False, final and known.is_done, state)


def _adapted(level: int, seconds: float) -> int:
    """Return the level of detail for the next image, given the time of this one."""
    if seconds > MOVING_SECONDS:
        return min(level + 1, len(LEVELS) - 1)
    if level == 0:
        return 0
    share, stride = LEVELS[level]
    better, shorter = LEVELS[level - 1]
    growth = (better / share) ** 2 * stride / shorter
    return level - 1 if seconds * growth < 0.8 * MOVING_SECONDS else level
