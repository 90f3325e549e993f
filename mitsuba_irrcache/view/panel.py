"""The controls that all windows share: illumination, and density of the medium."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import viser

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.channel import Channel
from mitsuba_irrcache.view.document import Document, Lighting
from mitsuba_irrcache.view.editing import Editing, plain
from mitsuba_irrcache.view.light import Status
from mitsuba_irrcache.view.session import Session

HINTS = {
    "environment": "factor of the radiance that the scene gives its environment",
    "sun": "irradiance on a surface that faces it, in the units of the scene; 0: no sun",
}
#: Irradiance of a sun that is switched on by dragging it.
SUN = 3.0


class LightPanel:
    """Display the progress of the caches of ``session``, and edit its illumination and density."""

    def __init__(self, server: viser.ViserServer, session: Session, channel: Channel) -> None:
        self._session, self._channel = session, channel
        gui, document, lighting = server.gui, session.document, session.document.lighting
        with gui.add_folder("Light", order=3):
            self._status = gui.add_markdown("")
            self._refusal = gui.add_markdown("", visible=False)
            self.editing = Editing(self.refuse)
            if document.has_environment:
                self._light("environment", lighting.environment, 0.0, 10.0, gui)
            self._sun = self._light("sun", lighting.sun, 0.0, 1000.0, gui)
            gui.add_html("<irrcache-light></irrcache-light>")
            if document.has_environment_map:
                self._light("rotation", lighting.rotation, -180.0, 180.0, gui, slider=True)
            hidden = gui.add_checkbox(
                "hide emitters", document.march.hide_emitters,
                hint='they light the medium, but are not seen: "background" is',
            )  # fmt: skip
            self.editing.bind(
                hidden, lambda value: session.edit(lambda d: d.set_hide_emitters(value))
            )
        with gui.add_folder("Scattering and error", order=4, expand_by_default=False):
            self._add_details(gui)
        channel.receive("sun", self._turn_sun)
        channel.receive("angles", self._set_angles)
        self._tell_light()

    def _add_details(self, gui: viser.GuiApi) -> None:
        document = self._session.document
        density = gui.add_number(
            "density, ×", document.density, min=0.001, max=1000.0, step=0.01,
            hint="factor of the extinction",
        )  # fmt: skip
        depth = gui.add_number(
            "max_depth", document.settings.max_depth, min=-1, step=1,
            hint="-1: all orders of scattering; 2: single scattering; 1: none",
        )  # fmt: skip
        target = gui.add_number(
            "target error %", 100 * self._session.target_error, min=0.01, max=100.0, step=0.01,
            hint="relative standard error of the illumination at which refinement stops",
        )  # fmt: skip
        self.editing.bind(density, self._set_density)
        self.editing.bind(depth, self._set_depth)
        self.editing.bind(target, self._set_target)

    def show(self, status: Status) -> None:
        """Display the progress of the cache refinement; called in the session's thread."""
        error = "" if math.isnan(status.error) else f"error {100 * status.error:.2g} %, "
        state = "improving" if status.improving else "done"
        self._status.content = f"{state}: {error}{status.samples} samples"
        target = self._session.target_error
        above = status.improving and status.error > target
        shown = f"illumination: error {100 * status.error:.2g} %, target {100 * target:.2g} %"
        coarse = "coarse illumination, being refined" if status.improving else ""
        self._channel.send("hint", shown if above else "" if status.samples else coarse)
        if status.message:
            self.refuse(status.message)

    def refuse(self, reason: str) -> None:
        """Display why a change was refused."""
        self._refusal.content = f"**Refused:** {plain(reason)}" if reason else ""
        self._refusal.visible = bool(reason)

    def _light(
        self, name: str, value: float, low: float, high: float, gui: viser.GuiApi, slider=False
    ) -> viser.GuiInputHandle:
        """Add a control for a field of `Lighting`: a slider for angles, otherwise a number."""
        value = min(max(round(value, 3), low), high)
        if slider:
            handle = gui.add_slider(f"{name}, °", low, high, 1.0, value)
        else:
            handle = gui.add_number(name, value, min=low, max=high, step=0.01, hint=HINTS[name])

        def apply(number: float) -> None:
            self._edit_light(name, _number(name, number, low, high))

        self.editing.bind(handle, apply)
        return handle

    def _turn_sun(self, towards: object) -> None:
        """Queue another direction to the sun, which a browser sent; switch it on if needed."""
        direction = np.array([float(c) for c in towards]).reshape(3)
        if not np.isfinite(direction).all() or not direction.any():
            raise ValueError("the direction to the sun is no vector")

        def change() -> None:
            self._light_from(*self._session.document.angles(direction))

        self.editing.submit("sun", change)

    def _set_angles(self, value: object) -> None:
        """Queue angles of the sun, in degrees, which a browser sent; switch it on if needed."""
        azimuth = _number("azimuth", value["azimuth"], -360.0, 360.0)
        elevation = _number("elevation", value["elevation"], -90.0, 90.0)
        self.editing.submit("sun", lambda: self._light_from(azimuth, elevation))

    def _light_from(self, azimuth: float, elevation: float) -> None:
        lighting = self._session.document.lighting
        sun = lighting.sun or SUN
        turned = replace(lighting, azimuth=azimuth, elevation=elevation, sun=sun)
        self._session.edit(lambda d: d.set_lighting(turned))
        self._sun.value = sun
        self._tell_light()

    def _tell_light(self) -> None:
        """Send the direction to the sun to the components of all windows."""
        document = self._session.document
        towards, lighting = document.towards_sun.round(4).tolist(), document.lighting
        angles = {"azimuth": lighting.azimuth, "elevation": lighting.elevation}
        self._channel.send("lighting", {"towards": towards, "sun": lighting.sun} | angles)

    def _edit_light(self, name: str, value: float) -> None:
        def change(document: Document) -> None:
            lighting: Lighting = replace(document.lighting, **{name: value})
            document.set_lighting(lighting)

        self._session.edit(change)
        self._tell_light()

    def _set_target(self, percent: float) -> None:
        target = _number("target error", percent, 0.01, 100.0) / 100

        def change() -> None:
            self._session.target_error = target

        self._session.call(change)

    def _set_depth(self, depth: float) -> None:
        depth = int(_number("max_depth", depth, -1, 1 << 20))
        self._session.edit(lambda document: document.set_max_depth(depth))

    def _set_density(self, factor: float) -> None:
        factor = _number("density", factor, 0.001, 1000.0)
        self._session.edit(lambda document: document.set_density(factor))


def _number(name: str, value: object, low: float, high: float) -> float:
    """Return a value that a browser sent if it is a number between ``low`` and ``high``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise IrrcacheError(f"{name} is {value!r}; it must be a number from {low:g} to {high:g}.")
    return value
