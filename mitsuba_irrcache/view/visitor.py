"""One browser window: its camera, its controls, and the files that it saves."""

from __future__ import annotations

import io
import math
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic

import numpy as np
import viser
from PIL import Image

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.display import TONES, linear
from mitsuba_irrcache.view.camera import NARROWEST, WIDEST, Camera
from mitsuba_irrcache.view.channel import Channel
from mitsuba_irrcache.view.comparison import CHOICES, WAITING, Compared, described
from mitsuba_irrcache.view.editing import Editing, plain
from mitsuba_irrcache.view.export_panel import ExportPanel
from mitsuba_irrcache.view.picture import CAPTIONS, EXPOSURES, KINDS, MARKED, Look
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import Picture, View

#: JPEG quality for moving cameras and for images that better ones will replace.
MOVING_QUALITY, RESTING_QUALITY = 80, 95
#: How often the first camera is placed again in a page that is still loading. It sends its own
#: camera at each step of its layout.
ATTEMPTS = 40
#: Largest side of a window in pixels.
LARGEST_SIDE = 1 << 15
#: Seconds between two updates of the text below the image.
NOTE_SECONDS = 0.25


class Visitor:
    """Connect a browser ``client`` with a window of the session.

    Files are saved in ``folder``, or downloaded by the browser if it is None.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        folder: Path | None,
        channel: Channel,
    ) -> None:
        self.client, self.session, self.folder = client, session, folder
        self._channel, self._key = channel, channel.open()
        self._encoder = ThreadPoolExecutor(1)
        self._lock = threading.Lock()
        self._waiting: Picture | None = None
        self._gone = False
        self._noted = 0.0
        self._view: View | None = None
        self._size: tuple[int, int] | None = None  # of the image in the browser, pixels
        # Where the camera was placed, where it looks, how much further away it is for a window that
        # is high, and how often it may still be placed again.
        self._placed, self._aimed, self._away = np.zeros(3), np.zeros(3), 1.0
        self._attempts = ATTEMPTS
        self._look = Look(exposure=session.exposure)
        self.window = session.open(self._show)
        self._add_controls(client.gui)
        client.camera.on_update(self._camera_moved)
        # Windows that were open before the scene was loaded have viser's camera, and the first
        # camera was placed for wide windows.
        self._go_to(self._sensor.value)

    def close(self) -> None:
        """Release the window after the browser has disconnected."""
        self._gone = True
        self._export.close()
        self._channel.close(self._key)
        self.session.close(self.window)
        self._encoder.shutdown(wait=False, cancel_futures=True)

    # ------------------------------------------------------------------ controls

    def _add_controls(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("View", order=1):
            self._refusal = gui.add_markdown("", visible=False)
            self.editing = Editing(self._refuse)
            cameras = list(self.session.cameras)
            self._sensor = gui.add_dropdown(
                "camera", cameras, initial_value=cameras[0], visible=len(cameras) > 1
            )
            self._kind = gui.add_dropdown("show", KINDS)
            self._exposure = gui.add_slider("exposure, EV", *EXPOSURES, 0.1, self.session.exposure)
            self._compare = gui.add_dropdown(
                "compare", tuple(CHOICES),
                hint="with Mitsuba's path tracer, which is refined while no camera moves: swipe "
                "with the divider, or the error in false colours",
            )  # fmt: skip
            self._reset = gui.add_button("reset camera", color="gray")
            gui.add_html(f'<irrcache-window key="{self._key}"></irrcache-window>')
        with gui.add_folder("Camera, tone, background", order=5, expand_by_default=False):
            fov = round(self.session.cameras[cameras[0]].fov, 1)
            self._fov = gui.add_slider("field of view, °", NARROWEST, WIDEST, 0.5, fov)
            self._tone = gui.add_dropdown("tone mapping", tuple(TONES))
            self._filter = gui.add_checkbox(
                "filter", False, hint="of the illumination; weaker as the caches converge"
            )
            gui.add_html("<irrcache-background></irrcache-background>")
        for handle in (self._kind, self._exposure, self._tone, self._filter, self._compare):
            self.editing.bind(handle, lambda _: self._set_look())
        self.editing.bind(self._sensor, lambda name: self._go_to(name))
        self.editing.bind(self._fov, self._set_fov)
        self._reset.on_click(lambda _: self._go_to(self._sensor.value))
        self._channel.receive("size", self._set_size, self._key)
        self._channel.receive("background", self._set_background, self._key)
        self._export = ExportPanel(
            self.client, self.session, self.folder, self.editing, self._current_view
        )

    def _set_look(self) -> None:
        kind, tone, exposure = self._kind.value, self._tone.value, self._exposure.value
        if kind not in KINDS or tone not in TONES or not -64 <= exposure <= 64:
            raise IrrcacheError(f"{kind!r}, {tone!r}, exposure {exposure!r}: nothing to be shown.")
        if self._compare.value not in CHOICES:
            raise IrrcacheError(f"{self._compare.value!r} is no comparison.")
        if self._compare.value != "off" and self.session.light.is_emissive:
            raise IrrcacheError("volpath does not render the emission of media.")
        if self._compare.value == "off":  # what is shown until the next image is ours alone
            self._channel.send("comparison", {"mode": "off"}, self._key)
        colour = self._look.background
        self._look = Look(kind, float(exposure), tone, bool(self._filter.value), colour)
        self.look_again()

    def _set_size(self, value: object) -> None:
        """Request images of a size in pixels that the browser sent."""
        width, height = (int(n) for n in value)
        if not 0 < width <= LARGEST_SIDE or not 0 < height <= LARGEST_SIDE:
            raise ValueError("the window has no such size")
        self._size = width, height
        self.look_again()

    def _set_background(self, value: object) -> None:
        """Queue a colour that the browser sent, as sRGB values in [0, 1]."""
        red, green, blue = (linear(max(0.0, min(1.0, float(c)))) for c in value)
        colour = red, green, blue

        def change() -> None:
            self._look = replace(self._look, background=colour)
            self._channel.send("background", value, self._key)
            self.look_again()

        self.editing.submit("background", change)

    def _set_fov(self, degrees: float) -> None:
        if not NARROWEST <= degrees <= WIDEST:
            raise IrrcacheError(
                f"the field of view is {degrees!r}; it must be {NARROWEST:g} to {WIDEST:g} degrees."
            )
        self.client.camera.fov = math.radians(degrees)
        self.look_again()

    @property
    def _distance_factor(self) -> float:
        """Return how much further away than in wide windows a camera has to be."""
        camera = self.client.camera
        return max(1.0, max(camera.image_height, 1) / max(camera.image_width, 1))

    def _go_to(self, name: str) -> None:
        if name not in self.session.cameras:
            raise IrrcacheError(f"the scene has no camera {name!r}.")
        camera, place = self.session.cameras[name], self.session.placement.to_browser
        with self.client.atomic():
            self.client.camera.up_direction = np.array(camera.up)
            self._away, target = self._distance_factor, np.array(camera.target)
            self._placed = place(target + self._away * (np.array(camera.position) - target))
            self.client.camera.position = self._placed
            self._aimed = place(camera.target)
            self.client.camera.look_at = self._aimed
            self.client.camera.fov = math.radians(camera.fov)
        self._fov.value = round(camera.fov, 1)
        self.look_again()

    def _current_view(self) -> View | None:
        """Return the view without its comparison, None if there is none yet."""
        return self._view and replace(self._view, compared="off")

    def _refuse(self, reason: str) -> None:
        self._refusal.content = f"**Refused:** {plain(reason)}" if reason else ""
        self._refusal.visible = bool(reason)

    # ------------------------------------------------------------------ to and from the session

    async def _camera_moved(self, camera: viser.CameraHandle) -> None:
        if self._attempts:  # the page has not confirmed yet where its camera is
            places = (camera.position, self._placed), (camera.look_at, self._aimed)
            if not all(np.allclose(*pair, atol=1e-3) for pair in places):
                self._attempts -= 1
                self._go_to(self._sensor.value)
                return
            self._attempts = 0
        self.look_again()

    def look_again(self) -> None:
        """Request an image of the present view."""
        camera = self.client.camera
        if self._size is None:
            return
        scene = self.session.placement.to_scene
        seen = Camera(
            tuple(scene(camera.position).tolist()),
            tuple(scene(camera.look_at).tolist()),
            tuple(np.asarray(camera.up_direction, dtype=np.float64).tolist()),
            float(np.clip(math.degrees(camera.fov), NARROWEST, WIDEST)),
        )
        numbers = (*seen.position, *seen.target, *seen.up)
        if not np.isfinite(numbers).all() or seen.distance == 0 or not any(seen.up):
            return  # the browser sent values that are no camera
        size = self._size
        if self._away != self._distance_factor and np.allclose(camera.position, self._placed):
            self._go_to(self._sensor.value)  # the window was resized before the camera was moved
            return
        self._channel.send("camera", seen.axes.round(4).tolist(), self._key)
        look, compared = self._look, CHOICES[self._compare.value]
        if look.kind == MARKED:
            look = replace(look, target=self.session.target_error)
        if compared == "off":  # volpath renders no slices
            look = replace(look, slices=self.session.slices)
        view = View(seen, size, look, compared)
        if self._view is not None and view != self._view and view.shows_place_of(self._view):
            self._channel.send("note", "rendering ...", self._key)  # may take seconds
        if self._view is not None and compared != self._view.compared:
            self._announce_comparison(compared)
        self._view = view
        self.session.look(self.window, self._view)

    def _announce_comparison(self, compared: str) -> None:
        """Replace the captions of the comparison before, until the first image of the new one."""
        found = {"mode": "off"}
        if compared != "off":
            found = described(Compared(compared, WAITING))
        self._channel.send("comparison", found, self._key)

    def _show(self, picture: Picture) -> None:
        """Queue an image for sending; called in the session's thread, which must not block."""
        with self._lock:
            busy, self._waiting = self._waiting is not None, picture
        if not busy:
            with suppress(RuntimeError):  # the browser has just disconnected
                self._encoder.submit(self._send)

    def _send(self) -> None:
        """Send the newest image, and drop older ones that were not sent yet."""
        with self._lock:
            picture, self._waiting = self._waiting, None
        if self._gone:
            return
        # By viser's own connection it would be a texture, which is slow in browsers without a
        # graphics processor.
        self._channel.send("picture", _encoded(picture), self._key)
        if not picture.moving or monotonic() - self._noted > NOTE_SECONDS:
            self._noted = monotonic()
            self._send_note(picture)

    def _send_note(self, picture: Picture) -> None:
        """Send what lies over the image: a note about it, and the comparison."""
        height, width, _ = picture.pixels.shape
        state = "preview" if picture.moving else "final" if picture.final else "at rest"
        samples = "1 sample" if picture.samples == 1 else f"{picture.samples} samples"
        send, key = self._channel.send, self._key
        send("wait", "", key)
        send("note", f"{state}: {width} x {height}, {samples} per pixel", key)
        found = picture.compared
        if found is None and picture.view.compared == "off":
            send("comparison", {"mode": "off", "left": CAPTIONS.get(picture.view.look.kind)}, key)
            return
        if found is None:
            found = Compared(picture.view.compared, "volpath waits until the camera stops")
        send("comparison", described(found), key)
        if found.reference is not None:
            send("reference", _jpeg(found.reference, RESTING_QUALITY), key)


def _encoded(picture: Picture) -> bytes:
    """Return the file of an image: a PNG if it is final, otherwise a JPEG."""
    if not picture.final:
        return _jpeg(picture.pixels, MOVING_QUALITY if picture.moving else RESTING_QUALITY)
    file = io.BytesIO()
    Image.fromarray(picture.pixels).save(file, "PNG", compress_level=1)
    return file.getvalue()


def _jpeg(pixels: np.ndarray, quality: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality)
    return file.getvalue()
