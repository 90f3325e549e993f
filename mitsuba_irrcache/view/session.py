"""One scene, its light, and those who look at it; nothing of the web is in here.

All computing is done by one thread, the session's. What others want of it they leave with it:
windows their newest view, edits a function. The thread shows moving cameras first, then pictures at
rest, and improves the light in the time that is left; a solver that is at work stops between its
launches as long as a camera moves.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic, perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, essence
from mitsuba_irrcache.view.camera import Camera, Placement, camera_of, sensors_of
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.view.light import Light
from mitsuba_irrcache.view.picture import Look, Samples

LOG = logging.getLogger(__name__)

#: A camera rests when it has not moved for so long.
REST_SECONDS = 0.12
#: A picture of a moving camera should take so long.
MOVING_SECONDS = 0.05
#: Side of the pictures of moving cameras, as a part of the window's, and length of their steps: the
#: one that is quick enough is taken.
LEVELS = ((1.0, 1.0), (0.71, 1.0), (0.5, 1.0), (0.5, 2.0), (0.35, 2.0), (0.25, 2.0), (0.18, 3.0))
#: Samples per pixel of a picture at rest.
SAMPLES = 16
#: Samples per voxel that make new pictures worth while, over those that are shown.
GROWTH = 1.25
#: Windows are not rendered larger than this.
MOST_PIXELS = 1 << 22
#: Relative standard error of the light at which it is good enough, unless told otherwise.
TARGET_ERROR = 0.005
#: Seconds between two checks for cameras that have moved, while a solver is at work.
CHECK_SECONDS = 0.02


class Superseded(Exception):  # noqa: N818 (no error: the user wants it)
    """Ends a pass of the solver whose light nobody will see."""


@dataclass(frozen=True)
class View:
    """What a window wants to see: a camera and the window's (width, height) in pixels."""

    camera: Camera
    size: tuple[int, int]
    look: Look = field(default_factory=Look)


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


@dataclass(frozen=True)
class Status:
    """How far the light is."""

    samples: int = 0
    error: float = float("nan")
    seconds: float = 0.0
    solver: str = ""
    improving: bool = True
    message: str = ""


class Window:
    """One who looks. ``show`` is called with every `Picture`, in the session's thread."""

    def __init__(self, show: Callable[[Picture], None]) -> None:
        self.show = show
        self.view: View | None = None
        self.moved = -np.inf  # when the camera moved last
        self.fresh = False  # whether the view has not been shown at all
        self.level = len(LEVELS) // 2
        self.revision = -1  # of the light in `samples`
        self.light: Light | None = None  # that light
        self.samples: Samples | None = None
        self.resting: View | None = None  # what `samples` are of

    @property
    def is_moving(self) -> bool:
        return monotonic() - self.moved < REST_SECONDS


class Session:
    """Shows ``document`` to windows. `start` it, and `stop` it in the end."""

    def __init__(self, document: Document, variant: str | None = None) -> None:
        self.document = document
        self.target_error = TARGET_ERROR
        #: called with a `Status` whenever there is news, in the session's thread
        self.on_status: Callable[[Status], None] = lambda status: None
        #: the scene's own cameras by name, and how the scene lies in a browser; once started
        self.cameras: dict[str, Camera] = {}
        self.placement = Placement(np.zeros(3), 1.0)
        self.status = Status()
        #: of what the thread did, (what, when it began, when it ended), the newest last
        self.history: deque[tuple[str, float, float]] = deque(maxlen=20000)
        self._variant = variant or mi.variant()
        self._windows: list[Window] = []
        self._tasks: deque[Callable[[], None]] = deque()
        self._news = threading.Condition()
        self._stopped = False
        self._light: Light | None = None  # what is being improved
        self._shown: Light | None = None  # what is seen: the one before, until there is better
        self._shown_samples = 0
        self._revision = 0  # of all that is shown, across lights
        self._checked = 0.0
        self._resting_turn = False
        self._ready = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="irrcache view", daemon=True)

    # ------------------------------------------------------------------ for other threads

    def start(self) -> None:
        """Loads the scene and begins; raises what goes wrong with that."""
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """Ends the thread, and waits for it."""
        with self._news:
            self._stopped = True
            self._news.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def open(self, show: Callable[[Picture], None]) -> Window:
        """A new window; it shows nothing before it has a view."""
        window = Window(show)
        with self._news:
            self._windows.append(window)
        return window

    def close(self, window: Window) -> None:
        """Forgets a window."""
        with self._news, suppress(ValueError):
            self._windows.remove(window)

    def look(self, window: Window, view: View) -> None:
        """What ``window`` wants to see from now on. Another camera or size moves it."""
        width, height = (max(int(n), 1) for n in view.size)
        shrunk = min(1.0, (MOST_PIXELS / (width * height)) ** 0.5)
        view = View(view.camera, (int(width * shrunk) or 1, int(height * shrunk) or 1), view.look)
        with self._news:
            old = window.view
            if view == old:
                return
            if old is not None and (view.camera, view.size) != (old.camera, old.size):
                window.moved = monotonic()
            window.view, window.fresh = view, True
            self._news.notify_all()

    def edit(self, change: Callable[[Document], None]) -> None:
        """Changes the document, and with it the light; raises IrrcacheError if it cannot be."""
        self.call(lambda: self._edit(change))

    def call(self, action: Callable[[], object]) -> object:
        """Runs ``action`` in the session's thread, and returns or raises what it does."""
        done, result = threading.Event(), {}

        def task() -> None:
            try:
                result["value"] = action()
            except Exception as error:
                result["error"] = error
            finally:
                done.set()

        with self._news:
            if self._stopped:
                raise IrrcacheError("view: the viewer has ended.")
            self._tasks.append(task)
            self._news.notify_all()
        while not done.wait(0.5):
            if not self._thread.is_alive():
                raise IrrcacheError("view: the viewer has ended.")
        if "error" in result:
            raise result["error"]
        return result.get("value")

    @property
    def light(self) -> Light:
        """The light that is seen; in the session's thread only."""
        return self._shown

    # ------------------------------------------------------------------ the thread

    def _run(self) -> None:
        try:
            mi.set_variant(self._variant)
            self._begin()
        except Exception as error:
            self._failure = error
            return
        finally:
            self._ready.set()
        while not self._stopped:
            try:
                if not self._step():
                    with self._news:
                        if not (self._tasks or self._stopped or self._is_work_waiting):
                            self._news.wait(self._until_rest)
            except Superseded:
                continue
            except Exception as error:
                LOG.exception("the viewer could not show or improve something")
                self._give_up(error)
        self._light = self._shown = None
        self._windows.clear()

    def _give_up(self, error: Exception) -> None:
        """What failed once is not tried again before it is asked for anew."""
        self._light = self._shown
        if self._light is not None and self._light.failed:
            self._light = None
        for window in self._windows:
            window.view, window.fresh, window.resting = None, False, None
        self._say(message=essence(error))

    def _begin(self) -> None:
        scene = self.document.scene()
        self._light = self._light_of(scene)
        self._light.prepare()
        with self._noted("solver"):
            self._light.refine()
        self._adopt()
        frame = self._shown.parts[0].medium.frame
        corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
        world = frame[:3, :3] @ corners + frame[:3, 3:]
        centre = world.mean(axis=1)
        radius = float(np.linalg.norm(world - centre[:, None], axis=0).max())
        self.placement = Placement(centre, radius)
        sensors = sensors_of(scene)
        self.cameras = {name: camera_of(sensor, centre) for name, sensor in sensors.items()}
        if not self.cameras:
            away = centre + radius * np.array([0.0, -4.0, 1.0])
            self.cameras = {"front": Camera(tuple(away), tuple(centre), (0.0, 0.0, 1.0), 30.0)}

    def _light_of(self, scene: mi.Scene) -> Light:
        document = self.document
        return Light(scene, document.settings, document.seeing, self._pause)

    def _edit(self, change: Callable[[Document], None]) -> None:
        before = self.document.state()
        try:
            change(self.document)
            light = self._light_of(self.document.scene())
            light.prepare()
        except Exception as error:
            self.document.restore(before)
            raise IrrcacheError(essence(error)) from error
        self._light = light

    @property
    def _is_work_waiting(self) -> bool:
        return any(w.fresh for w in self._windows)

    @property
    def _until_rest(self) -> float | None:
        """Seconds until a camera that moves may have come to rest; None where none moves."""
        waits = [w.moved + REST_SECONDS - monotonic() for w in self._windows if w.is_moving]
        return max(min(waits), 1e-3) if waits else None

    def _step(self) -> bool:
        """Does what is most urgent; whether there was anything to do."""
        while self._tasks:
            self._tasks.popleft()()
        if self._show_moving():
            return True
        if any(w.is_moving for w in self._windows):
            return False
        if self._show_resting(first=True):
            return True
        improving = self._wants_light
        awaited = self._light is not None and self._light is not self._shown
        self._resting_turn = not self._resting_turn and not awaited
        if (self._resting_turn or not improving) and self._show_resting(first=False):
            return True
        if improving:
            self._improve()
        return improving

    @property
    def _wants_light(self) -> bool:
        light = self._light
        if light is None:
            return False
        if not light.parts:
            return True
        if light.is_dark:
            return False
        return light.samples < 1 or not light.error <= self.target_error

    def _improve(self) -> None:
        with self._noted("solver"):
            self._light.refine()
            dr.sync_thread()
        self._adopt()

    def _adopt(self) -> None:
        """Shows the light that has improved, if that is worth new pictures."""
        light = self._light
        other = light is not self._shown
        if other or not light.samples or light.samples >= GROWTH * self._shown_samples:
            self._revision += 1
            self._shown, self._shown_samples = light, light.samples
        elif not self._wants_light:
            self._revision += 1
        self._say()

    def _say(self, message: str = "") -> None:
        light = self._light or self._shown
        self.status = Status(
            light.samples if light else 0,
            light.error if light and light.samples else float("nan"),
            light.seconds if light else 0.0,
            light.solver if light else "",
            self._wants_light,
            message,
        )
        self.on_status(self.status)

    def _pause(self) -> None:
        """Between launches of the solver: whoever looks comes first."""
        if perf_counter() - self._checked < CHECK_SECONDS:
            return
        dr.sync_thread()
        self._checked = perf_counter()
        if self._tasks or self._stopped:
            raise Superseded
        if self._shown is None or not any(w.fresh or w.is_moving for w in self._windows):
            return
        with self._noted("interruption"):
            while not (self._tasks or self._stopped):
                if self._show_moving():
                    continue
                if any(w.is_moving for w in self._windows):
                    with self._news:
                        if not (self._is_work_waiting or self._tasks or self._stopped):
                            self._news.wait(self._until_rest)
                elif not self._show_resting(first=True):
                    return
        raise Superseded

    # ------------------------------------------------------------------ pictures

    def _show_moving(self) -> bool:
        """A quick picture for a window whose camera moves and was not shown yet."""
        waiting = [w for w in self._windows if w.fresh and w.is_moving]
        if not waiting or self._shown is None:
            return False
        window = min(waiting, key=lambda w: w.moved)
        with self._news:
            view, window.fresh = window.view, False
        share, stride = LEVELS[window.level]
        size = tuple(max(round(n * share), 1) for n in view.size)
        with self._noted("moving"):
            started = perf_counter()
            # Errors are not projected, nor is anything filtered, while there is no time for it.
            seen = self._shown.seen(view.look.kind != "image", view.look.kind == "error bar")
            seen.stride(stride)
            try:
                samples = Samples(seen, view.camera, size)
                samples.add(1)
                pixels = samples.picture(self._unfiltered(view.look), self.extent(view.camera))
            finally:
                seen.stride(1.0)
            window.level = _adapted(window.level, perf_counter() - started)
        window.show(Picture(pixels, view, 1, True, False))
        return True

    def _show_resting(self, first: bool) -> bool:
        """A sample more for the picture of a window at rest that lacks most; only pictures that
        are not there at all where ``first``.
        """
        lacking = [w for w in self._windows if w.view is not None and self._lacks(w, first)]
        if not lacking or self._shown is None:
            return False
        window = min(lacking, key=lambda w: w.samples.count if w.samples else 0)
        with self._news:
            view, window.fresh = window.view, False
        with self._noted("resting"):
            look = view.look
            seen = self._shown.seen(look.layered, look.with_error)
            same = self._is_same(window, view)
            alone = not same or window.samples.seen is not seen
            if alone:
                window.samples = Samples(seen, view.camera, view.size)
                window.resting, window.revision = view, self._revision
                window.light = self._shown
                window.samples.add(1)
            elif window.resting != view:
                window.resting = view  # another look at the same samples
            else:
                if window.samples.count == 1:  # the one in the pixel's centre is not one of many
                    window.samples = Samples(seen, view.camera, view.size)
                    window.samples.add(SAMPLES)
                window.samples.add(SAMPLES)
            pixels = window.samples.picture(look, self.extent(view.camera))
        count = window.samples.count
        final = count >= SAMPLES and not self._wants_light
        window.show(Picture(pixels, view, count, False, final))
        return True

    def _is_same(self, window: Window, view: View) -> bool:
        """Whether the samples that a window has can show ``view``."""
        old = window.resting
        return (
            old is not None
            and window.samples is not None
            and window.revision == self._revision
            and (old.camera, old.size) == (view.camera, view.size)
        )

    def _lacks(self, window: Window, first: bool) -> bool:
        old, view = window.resting, window.view
        if window.fresh or old is None or (old.camera, old.size) != (view.camera, view.size):
            return True
        if window.light is not self._shown:
            return True
        if first:
            return False
        return window.revision != self._revision or window.samples.count < SAMPLES

    @staticmethod
    def _unfiltered(look: Look) -> Look:
        return Look(look.kind, look.exposure, look.tone)

    def extent(self, camera: Camera) -> tuple[float, float]:
        """Distances between which a camera may see the medium."""
        distance = float(np.linalg.norm(self.placement.centre - camera.position))
        radius = self.placement.radius
        return max(distance - radius, 0.0), distance + radius

    def _noted(self, what: str) -> _Noted:
        return _Noted(self.history, what)


class _Noted:
    """Notes when a block began and ended."""

    def __init__(self, history: deque, what: str) -> None:
        self.history, self.what = history, what

    def __enter__(self) -> None:
        self.started = monotonic()

    def __exit__(self, *_: object) -> None:
        self.history.append((self.what, self.started, monotonic()))


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
