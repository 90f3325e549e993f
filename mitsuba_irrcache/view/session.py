"""A viewer session: one scene, its caches and the windows that display it, independent of the web.

All computation happens in the session's own thread. Other threads submit work to it: windows their
newest view, controls an edit as a function. The thread renders moving cameras first, then images at
rest, and refines the caches in the remaining time. While a camera moves, the solver is interrupted
between two launches.
"""

from __future__ import annotations

import gc
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic, perf_counter, sleep

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, original_message
from mitsuba_irrcache.view.camera import Camera, Placement, cameras_of
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.view.light import CacheSnapshot, Light, Status
from mitsuba_irrcache.view.picture import Look, Samples, exposure_of
from mitsuba_irrcache.view.slices import Slices
from mitsuba_irrcache.view.window import REST_SECONDS, Picture, View, Window

LOG = logging.getLogger(__name__)

#: Images are rendered anew once the samples per voxel exceed those displayed by this factor.
GROWTH = 1.5
#: Default relative standard error of the caches at which refinement stops.
TARGET_ERROR = 0.005
#: Seconds between two checks for moved cameras while the solver runs.
CHECK_SECONDS = 0.02
#: Seconds for which another edit waits for the first image of an edit. Otherwise no image would
#: appear while a slider or the sun is dragged, which makes an edit before the last one is shown.
EDIT_SECONDS = 0.5
#: Seconds of an image at rest that follow a pass of the solver, in units of that pass.
PICTURE_SHARE = 0.5
#: Seconds without work after which unused memory is released: the next edit allocates it again.
IDLE_SECONDS = 10.0
#: (width, height) of an image that is displayed until windows have cameras of their own. It is
#: wider than most windows; they crop it.
FIRST_LOOK = (480, 240)


class Superseded(Exception):  # noqa: N818 (not an error: the user caused it)
    """Raised to abort a solver pass or an image that has become obsolete."""


class Session:
    """Render ``document`` for windows. Call `start` first and `stop` in the end."""

    def __init__(self, document: Document, variant: str | None = None) -> None:
        self.document = document
        self.target_error = TARGET_ERROR
        #: called in the session's thread with each new `Status`
        self.on_status: Callable[[Status], None] = lambda status: None
        #: the scene's sensors by name, and its mapping to browser coordinates; set by `start`
        self.cameras: dict[str, Camera] = {}
        self.placement = Placement(np.zeros(3), 1.0)
        #: coarse image of the first camera, uint8 (height, width, 3); set by `start`
        self.first_look: np.ndarray | None = None
        #: in stops, with which windows begin; set by `start`
        self.exposure = 0.0
        #: of the values, which windows display unless they compare
        self.slices: Slices | None = None
        self.status = Status()
        #: log of the thread: (activity, start time, end time), the newest last
        self.history: deque[tuple[str, float, float]] = deque(maxlen=20000)
        self._variant = variant or mi.variant()
        self._windows: list[Window] = []
        self._closed: list[Window] = []  # windows whose memory the thread still has to release
        self._tasks: deque[Callable[[], None]] = deque()
        self._news = threading.Condition()
        self._stopped = False
        self._light: Light | None = None  # the caches under refinement
        self._shown: Light | None = None  # displayed; the previous caches until new ones exist
        self._shown_samples = 0
        self._holds_previous = False  # whether windows may still hold the previous caches
        self._holds_unused = False  # whether there was work since unused memory was released
        self._edited = -np.inf  # time of the last edit
        self._revision = 0  # number of the displayed state, counted across edits
        self._checked = 0.0
        # tasks while no camera moves, in turn
        self._chores = deque((self._refine_picture, self._improve, self._compare))
        self._comparisons = self._reserved = 0
        self._pass_seconds = 0.0
        self._ready = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="irrcache view", daemon=True)

    # ------------------------------------------------------------------ for other threads

    def start(self) -> None:
        """Load the scene and start the thread; raise the exception if that fails."""
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """Stop the thread and wait for it."""
        with self._news:
            self._stopped = True
            self._news.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def open(self, show: Callable[[Picture], None]) -> Window:
        """Open a window; it displays nothing before `look` sets a view."""
        window = Window(show)
        with self._news:
            self._windows.append(window)
        return window

    def close(self, window: Window) -> None:
        """Close a window and release the memory of its images, even if others still refer to it."""
        with self._news, suppress(ValueError):
            self._windows.remove(window)
            self._closed.append(window)
            self._news.notify_all()

    def look(self, window: Window, view: View) -> None:
        """Set the view of ``window``. A different camera or size marks its camera as moving."""
        with self._news:
            if window.want(view):
                self._news.notify_all()

    def edit(self, change: Callable[[Document], None]) -> None:
        """Change the document and rebuild the caches; raise IrrcacheError if that is refused."""
        self.call(lambda: self._edit(change))

    def call(self, action: Callable[[], object]) -> object:
        """Run ``action`` in the session's thread, and return its result or raise its exception."""
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

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Suspend refinement within this context; calls and new views are still processed.

        It begins when the last edit is displayed.
        """
        while self.has_edit and self._thread.is_alive():
            sleep(CHECK_SECONDS)  # a call would interrupt the solver
        self.call(lambda: self._reserve(1))
        try:
            yield
        finally:
            self.call(lambda: self._reserve(-1))

    @property
    def has_edit(self) -> bool:
        """Return whether an edit is not displayed yet."""
        return self._light not in (None, self._shown)

    @property
    def light(self) -> Light:
        """Return the displayed caches; for the session's thread only."""
        return self._shown

    def _look_first(self) -> None:
        """Render an image by the first camera with one sample per pixel, and choose an exposure."""
        camera = next(iter(self.cameras.values()))
        samples = Samples(self._shown.snapshot(layered=False, with_error=False), camera, FIRST_LOOK)
        samples.add(1)
        if self._shown.is_emissive:  # of any radiance, in contrast to what usual emitters light
            self.exposure = exposure_of(samples.image())
        self.first_look = samples.picture(Look(exposure=self.exposure), self.extent(camera))

    def complete(self, seen: CacheSnapshot, view: View) -> Samples | None:
        """Return all samples of ``view`` if a window has them; for the session's thread only."""
        return next((w.samples for w in self._windows if w.is_complete(seen, view)), None)

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
                # Read before the step: a camera may come to rest during it.
                rest = self._until_rest
                if self._step():
                    self._holds_unused = True
                else:
                    if self._tasks and rest is None:
                        rest = CHECK_SECONDS  # they wait for an image
                    self._wait(rest)
            except Superseded:
                continue
            except Exception as error:
                LOG.exception("the viewer failed to render an image or to refine the caches")
                self._give_up(error)
        self._light = self._shown = None
        self._windows.clear()

    def _wait(self, seconds: float | None) -> None:
        """Wait for work, at most for these ``seconds``; without work, release unused memory."""
        is_idle = seconds is None and self._holds_unused
        with self._news:
            if self._is_called or self._closed or self._is_work_waiting:
                return
            if self._news.wait(IDLE_SECONDS if is_idle else seconds) or not is_idle:
                return
        self._release_memory()
        self._holds_unused = False

    @staticmethod
    def _release_memory() -> None:
        """Release arrays that nothing refers to, and those that Dr.Jit retains for reuse."""
        gc.collect()  # media with surfaces are part of reference cycles
        dr.flush_malloc_cache()

    def _give_up(self, error: Exception) -> None:
        """Cancel what failed; it is retried only after a new edit or view."""
        self._light = self._shown
        if self._light is not None and self._light.failed:
            self._light = None
        for window in self._windows:
            window.forget()
        self._publish_status(message=original_message(error))

    def _begin(self) -> None:
        scene = self.document.scene()
        self._light = self._light_of(scene)
        self._light.prepare()
        with self._noted("solver"):
            self._light.refine()
        self._adopt()
        self.placement = Placement.around(self._shown.parts[0].medium.frame)
        self.cameras = cameras_of(scene, self.placement)
        self.document.orient(next(iter(self.cameras.values())).up)
        self._look_first()

    def _light_of(self, scene: mi.Scene) -> Light:
        document = self.document
        return Light(scene, document.settings, document.march, self._pause)

    def _edit(self, change: Callable[[Document], None]) -> None:
        before = self.document.state()
        try:
            change(self.document)
            light = self._light_of(self.document.scene())
            light.prepare()
        except Exception as error:
            self.document.restore(before)
            raise IrrcacheError(original_message(error)) from error
        self._light, self._edited = light, monotonic()

    @property
    def _is_called(self) -> bool:
        """Return whether a task may be done, or the thread has to end."""
        return (bool(self._tasks) and not self._owes_image) or self._stopped

    @property
    def _owes_image(self) -> bool:
        """Return whether the last edit is to be displayed before other tasks."""
        if self._reserved or monotonic() - self._edited > EDIT_SECONDS:
            return False
        return self.has_edit or any(w.outdated for w in self._windows)

    @property
    def _is_work_waiting(self) -> bool:
        return any(w.fresh for w in self._windows)

    @property
    def _until_rest(self) -> float | None:
        """Return the seconds until a moving camera may count as resting; None if none moves."""
        windows = list(self._windows)
        waits = [w.moved + REST_SECONDS - monotonic() for w in windows if w.is_moving]
        return max(min(waits), 1e-3) if waits else None

    def _reserve(self, change: int) -> None:
        self._reserved += change

    def _step(self) -> bool:
        """Do the most urgent work; return whether there was any."""
        while self._closed:
            self._closed.pop().forget()
        while self._tasks and self._is_called:
            self._tasks.popleft()()
        if self._show_coarse():
            return True
        if self._holds_previous:
            self._release_previous()
        if any(w.is_moving for w in self._windows):
            return False
        if self.has_edit and not self._reserved:
            return self._improve()  # an edit is displayed only after its first refinement
        if self._show_resting(first=True):
            return True
        if self._reserved:
            return False
        # Further samples of an image of coarse caches would be discarded.
        if self._light is not None and self._light.is_preliminary and self._improve():
            return True
        for _ in range(len(self._chores)):
            self._chores.rotate()
            if self._chores[0]():
                return True
        return False

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

    def _improve(self) -> bool:
        """Refine the caches if needed and display new ones, even if they are zero."""
        if self._light in (None, self._shown) and not self._wants_light:
            return False
        with self._noted("solver"):
            self._light.refine()
            dr.sync_thread()
        self._pass_seconds = self.history[-1][2] - self.history[-1][1]
        self._adopt()
        return True

    def _adopt(self) -> None:
        """Display the refined caches if they justify rendering the images anew."""
        light = self._light
        other = light is not self._shown
        if other or not light.samples or light.samples >= GROWTH * self._shown_samples:
            self._revision += 1
            self._shown, self._shown_samples = light, light.samples
            if other:
                self._holds_previous = True
                for window in list(self._windows):
                    window.expect(light)
        elif not self._wants_light:
            self._revision += 1
        self._publish_status()

    def _release_previous(self) -> None:
        """Release the previous caches, whose arrays are as large as the displayed ones.

        This takes some hundredths of a second, hence only after the first image with new caches.
        """
        self._holds_previous = False
        for window in list(self._windows):
            window.release_others(self._shown)
        self._release_memory()

    def _publish_status(self, message: str = "") -> None:
        self.status = Status.of(self._light or self._shown, self._wants_light, message)
        self.on_status(self.status)

    def _pause(self) -> None:
        """Render waiting views between two launches of the solver."""
        if perf_counter() - self._checked < CHECK_SECONDS:
            return
        dr.sync_thread()
        self._checked = perf_counter()
        if self._is_called:
            raise Superseded
        if self._shown is None or not any(w.fresh or w.is_moving for w in self._windows):
            return
        with self._noted("interruption"):
            while not self._is_called:
                if self._show_coarse():
                    continue
                rest = self._until_rest
                if rest is not None:
                    with self._news:
                        if not (self._is_work_waiting or self._is_called):
                            self._news.wait(rest)
                elif not self._show_resting(first=True):
                    return
        raise Superseded

    # ------------------------------------------------------------------ pictures

    def _show_coarse(self) -> bool:
        """Render a low-cost image for a window whose camera moves, or whose image is older than
        the last edit.
        """
        waiting = [w for w in self._windows if w.needs_coarse]
        if not waiting or self._shown is None:
            return False
        window = min(waiting, key=lambda w: w.moved)
        view = self._taken(window)
        with self._noted("moving"):
            picture = window.quick(self._shown, view, self.extent(view.camera))
        window.show(picture)
        return True

    def _show_resting(self, first: bool) -> bool:
        """Add one sample per pixel to the image at rest that has the fewest.

        If ``first``, only images without any sample are considered.
        """
        light, revision = self._shown, self._revision
        lacking = [w for w in self._windows if w.lacks(light, revision, first)]
        if not lacking or light is None:
            return False
        window = min(lacking, key=lambda w: w.samples.count if w.samples else 0)
        view = self._taken(window)
        with self._noted("resting"):
            extent = self.extent(view.camera)
            wanted, pause = self._wants_light, self._give_way
            try:
                picture = window.refined(light, revision, view, extent, wanted, pause)
            except Superseded:  # raised by this image's own check, not by the interrupted solver
                return True
        window.show(picture)
        return True

    def _give_way(self) -> None:
        """Abort an image at rest between two bands if a camera has moved, or for an edit."""
        if self._is_called or any(w.needs_coarse for w in self._windows):
            raise Superseded

    def _refine_picture(self) -> bool:
        """Add samples to images at rest for as long as a part of a solver pass."""
        until, done = monotonic() + PICTURE_SHARE * self._pass_seconds, False
        while self._show_resting(first=False):
            done = True
            if monotonic() > until or self._is_called or self._is_work_waiting:
                break
        return done

    def _compare(self) -> bool:
        """Add samples to the reference of one window, in turn."""
        light, revision = self._shown, self._revision
        comparing = [w for w in self._windows if w.is_comparing(light, revision)]
        if not comparing:
            return False
        self._comparisons += 1
        window = comparing[self._comparisons % len(comparing)]
        view, until = window.view, monotonic() + self._pass_seconds  # as long as one solver pass
        with self._noted("reference"):
            extent = self.extent(view.camera)
            while True:
                picture = window.compared(light, view, extent, self._wants_light)
                if picture is not None:
                    window.show(picture)
                if self._is_called or self._is_work_waiting:
                    return True
                if monotonic() > until and window.has_first_sample:  # the user waits for it
                    return True

    def _taken(self, window: Window) -> View:
        """Return the view of a window and mark it as processed."""
        with self._news:
            window.fresh = False
            return window.view

    def extent(self, camera: Camera) -> tuple[float, float]:
        """Return the interval of distances from the camera in which the medium may lie."""
        distance = float(np.linalg.norm(self.placement.centre - camera.position))
        radius = self.placement.radius
        return max(distance - radius, 0.0), distance + radius

    @contextmanager
    def _noted(self, what: str) -> Iterator[None]:
        """Record the start and end time of a block in the history."""
        started = monotonic()
        try:
            yield
        finally:
            self.history.append((what, started, monotonic()))
