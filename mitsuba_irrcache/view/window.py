"""One who looks: what it wants to see, and the pictures that it gets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import monotonic, perf_counter

import numpy as np

from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.light import Light, Seen
from mitsuba_irrcache.view.picture import Look, Samples, displayed
from mitsuba_irrcache.view.reference import Reference

#: A camera rests when it has not moved for so long.
REST_SECONDS = 0.15
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
    """What a window wants to see: a camera, and the window's (width, height) in pixels, of which
    half is for volpath's picture where that is ``compared``.
    """

    camera: Camera
    size: tuple[int, int]
    look: Look = field(default_factory=Look)
    compared: bool = False

    @property
    def part(self) -> tuple[int, int]:
        """(width, height) of the picture by irrcache."""
        return (max(self.size[0] // 2, 1), self.size[1]) if self.compared else self.size

    def bounded(self) -> View:
        """The same with at least one pixel, and at most `MOST_PIXELS`."""
        width, height = (max(int(n), 1) for n in self.size)
        shrunk = min(1.0, (MOST_PIXELS / (width * height)) ** 0.5)
        return replace(self, size=(int(width * shrunk) or 1, int(height * shrunk) or 1))

    def shows_place_of(self, other: View | None) -> bool:
        """Whether ``other`` is seen by the same camera, at the same size."""
        return other is not None and (self.camera, self.part) == (other.camera, other.part)


@dataclass(frozen=True, eq=False)
class Picture:
    """What a window gets: ``pixels`` uint8 (height, width, 3), of which ``view``, with how many
    samples per pixel; whether the camera is ``moving``, and whether nothing better will follow.
    What is on its right by volpath, and how far it is from that, is told by ``comparison``.
    """

    pixels: np.ndarray
    view: View
    samples: int
    moving: bool
    final: bool
    comparison: str = ""


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
        self._reference: Reference | None = None

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
        """Shows nothing until there is another view, and holds nothing that was computed."""
        self.view, self.fresh, self._resting = None, False, None
        self.samples = self._light = self._reference = None

    def let_go(self, light: Light) -> None:
        """Holds nothing any more that was computed of any other ``light``."""
        if self._light is not light:
            self.samples = self._light = None
        if self._reference is not None and self._reference.light is not light:
            self._reference = None

    def lacks(self, light: Light, revision: int, first: bool) -> bool:
        """Whether a picture at rest could be better; or where ``first``, whether there is none."""
        if self.view is None:
            return False
        if self.fresh or not self.view.shows_place_of(self._resting) or self._light is not light:
            return True
        return not first and (self._revision != revision or self.samples.count < SAMPLES)

    def is_complete(self, seen: Seen, view: View) -> bool:
        """Whether it has all samples of ``seen`` that a picture of ``view`` at rest has."""
        had = self.samples
        return (
            had is not None
            and had.count >= SAMPLES
            and (had.seen, had.camera, had.size) == (seen, view.camera, view.size)
        )

    def quick(self, light: Light, view: View, extent: tuple[float, float]) -> Picture:
        """Of a camera that moves: as coarse as time wants it."""
        share, stride = LEVELS[self.level]
        size = tuple(max(round(n * share), 1) for n in view.part)
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
        if view.compared:
            pixels = np.concatenate([pixels, np.zeros_like(pixels)], axis=1)
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
        """Of a camera at rest: a sample per pixel more than before, of the ``light`` as it is at
        this ``revision``, which may be ``improving`` still. Where ``pause`` raises something, all
        is as it was.
        """
        look = view.look
        seen = light.seen(look.layered, look.with_error)
        samples = self.samples
        known = samples is not None and self._revision == revision
        if not (known and view.shows_place_of(self._resting) and samples.seen is seen):
            samples = Samples(seen, view.camera, view.part)
            samples.add(1, pause)
        elif self._resting == view:  # not only another look at the same samples
            if samples.count == 1:  # the one in the pixel's centre is not one of many
                samples = Samples(seen, view.camera, view.part)
                samples.add(SAMPLES, pause)
            samples.add(SAMPLES, pause)
        self.samples, self._resting = samples, view
        self._revision, self._light = revision, light
        return self._picture(view, extent, improving)

    def is_comparing(self, light: Light, revision: int) -> bool:
        """Whether there is something to compare with, that could be better."""
        if self.view is None or not self.view.compared or self.lacks(light, revision, True):
            return False
        known = self._reference_of(light, self.view)
        return known is None or not known.is_done

    def compared(
        self, light: Light, view: View, extent: tuple[float, float], improving: bool
    ) -> Picture | None:
        """Some more of the reference; a picture if all of it has changed, or it is new."""
        known = self._reference_of(light, view)
        if known is None:
            self._reference = known = Reference(light, view.camera, view.part)
        return self._picture(view, extent, improving) if known.refine() else None

    def _reference_of(self, light: Light, view: View) -> Reference | None:
        """The reference for this scene as it is and this view, if there is one."""
        known = self._reference
        if known is None or (known.light, known.camera, known.size) != (
            light,
            view.camera,
            view.part,
        ):
            return None
        return known

    def _picture(self, view: View, extent: tuple[float, float], improving: bool) -> Picture:
        """What `samples` show."""
        count = self.samples.count
        pixels = self.samples.picture(view.look, extent)
        final = count >= SAMPLES and not improving
        if not view.compared:
            return Picture(pixels, view, count, False, final)
        known, other, told = self._reference_of(self._light, view), np.zeros_like(pixels), ""
        if known is not None:
            other = displayed(known.radiance(), replace(view.look, kind="image"))
            told = known.comparison(self.samples.image(view.look.filtered))
            final &= known.is_done
        beside = np.concatenate([pixels, other], axis=1)
        return Picture(beside, view, count, False, final and known is not None, told)


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
