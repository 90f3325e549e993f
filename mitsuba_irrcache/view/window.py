"""One who looks: what it wants to see, and the pictures that it gets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import monotonic, perf_counter

import numpy as np

from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.light import Light
from mitsuba_irrcache.view.picture import Look, Samples

#: A camera rests when it has not moved for so long.
REST_SECONDS = 0.12
#: A picture of a moving camera should take so long.
MOVING_SECONDS = 0.05
#: Side of the pictures of moving cameras, as a part of the window's, and length of their steps: the
#: one that is quick enough is taken.
LEVELS = ((1.0, 1.0), (0.71, 1.0), (0.5, 1.0), (0.5, 2.0), (0.35, 2.0), (0.25, 2.0), (0.18, 3.0))
#: Samples per pixel of a picture at rest.
SAMPLES = 16
#: Windows are not rendered larger than this.
MOST_PIXELS = 1 << 22


@dataclass(frozen=True)
class View:
    """What a window wants to see: a camera and the window's (width, height) in pixels."""

    camera: Camera
    size: tuple[int, int]
    look: Look = field(default_factory=Look)

    def bounded(self) -> View:
        """The same with at least one pixel, and at most `MOST_PIXELS`."""
        width, height = (max(int(n), 1) for n in self.size)
        shrunk = min(1.0, (MOST_PIXELS / (width * height)) ** 0.5)
        return replace(self, size=(int(width * shrunk) or 1, int(height * shrunk) or 1))

    def shows_place_of(self, other: View | None) -> bool:
        """Whether ``other`` is seen by the same camera, at the same size."""
        return other is not None and (self.camera, self.size) == (other.camera, other.size)


@dataclass(frozen=True, eq=False)
class Picture:
    """What a window gets: ``pixels`` uint8 (height, width, 3), of which ``view``, with how many
    samples per pixel; whether the camera is ``moving``, and whether nothing better will follow.
    """

    pixels: np.ndarray
    view: View
    samples: int
    moving: bool
    final: bool


class Window:
    """``show`` is called with every `Picture`, in the session's thread."""

    def __init__(self, show: Callable[[Picture], None]) -> None:
        self.show = show
        self.view: View | None = None
        self.moved = -np.inf  # when the camera moved last
        self.fresh = False  # whether the view has not been shown at all
        self.level = len(LEVELS) // 2
        self.samples: Samples | None = None
        self._resting: View | None = None  # what `samples` are of
        self._light: Light | None = None  # and of which light
        self._revision = -1

    @property
    def is_moving(self) -> bool:
        return monotonic() - self.moved < REST_SECONDS

    def want(self, view: View) -> bool:
        """Another view from now on, which moves the camera unless only its look is another; whether
        there is anything new.
        """
        old, view = self.view, view.bounded()
        if view == old:
            return False
        if old is not None and not view.shows_place_of(old):
            self.moved = monotonic()
        self.view, self.fresh = view, True
        return True

    def forget(self) -> None:
        """Shows nothing until there is another view."""
        self.view, self.fresh, self._resting = None, False, None

    def lacks(self, light: Light, revision: int, first: bool) -> bool:
        """Whether a picture at rest could be better; or where ``first``, whether there is none."""
        if self.view is None:
            return False
        if self.fresh or not self.view.shows_place_of(self._resting) or self._light is not light:
            return True
        return not first and (self._revision != revision or self.samples.count < SAMPLES)

    def quick(self, light: Light, view: View, extent: tuple[float, float]) -> Picture:
        """Of a camera that moves: as coarse as time wants it."""
        share, stride = LEVELS[self.level]
        size = tuple(max(round(n * share), 1) for n in view.size)
        started, look = perf_counter(), view.look
        # Errors are not projected, nor is anything filtered, while there is no time for it.
        seen = light.seen(look.kind != "image", look.kind == "error bar")
        seen.stride(stride)
        try:
            samples = Samples(seen, view.camera, size)
            samples.add(1)
            pixels = samples.picture(replace(look, filtered=False), extent)
        finally:
            seen.stride(1.0)
        self.level = _adapted(self.level, perf_counter() - started)
        return Picture(pixels, view, 1, True, False)

    def refined(
        self, light: Light, revision: int, view: View, extent: tuple[float, float], improving: bool
    ) -> Picture:
        """Of a camera at rest: a sample per pixel more than before, of the ``light`` as it is at
        this ``revision``, which may be ``improving`` still.
        """
        look = view.look
        seen = light.seen(look.layered, look.with_error)
        known = self.samples is not None and self._revision == revision
        if not (known and view.shows_place_of(self._resting) and self.samples.seen is seen):
            self.samples = Samples(seen, view.camera, view.size)
            self._revision, self._light = revision, light
            self.samples.add(1)
        elif self._resting == view:  # not only another look at the same samples
            if self.samples.count == 1:  # the one in the pixel's centre is not one of many
                self.samples = Samples(seen, view.camera, view.size)
                self.samples.add(SAMPLES)
            self.samples.add(SAMPLES)
        self._resting = view
        count = self.samples.count
        final = count >= SAMPLES and not improving
        return Picture(self.samples.picture(look, extent), view, count, False, final)


def _adapted(level: int, seconds: float) -> int:
    """The level for the next picture, where this one took so long."""
    if seconds > MOVING_SECONDS:
        return min(level + 1, len(LEVELS) - 1)
    if level == 0:
        return 0
    share, stride = LEVELS[level]
    better, shorter = LEVELS[level - 1]
    growth = (better / share) ** 2 * stride / shorter
    return level - 1 if seconds * growth < 0.8 * MOVING_SECONDS else level
