"""The controls that all windows share: illumination, and density of the medium."""

from __future__ import annotations

import math
from dataclasses import replace

import viser

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.document import Document, Lighting
from mitsuba_irrcache.view.editing import Editing, plain
from mitsuba_irrcache.view.light import Status
from mitsuba_irrcache.view.session import Session


class LightPanel:
    """Display the progress of the caches of ``session``, and edit its illumination and density."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        gui, document = server.gui, session.document
        lighting = document.lighting
        with gui.add_folder("Light", order=2):
            self._status = gui.add_markdown("")
            self._refusal = gui.add_markdown("", visible=False)
            self.editing = Editing(self.refuse)
            target = gui.add_number(
                "target error %", 100 * session.target_error, min=0.01, max=100.0, step=0.01,
                hint="relative standard error of the caches at which refinement stops",
            )  # fmt: skip
            depth = gui.add_number(
                "max_depth", document.settings.max_depth, min=-1, step=1,
                hint="-1: all orders of scattering; 2: single scattering; 1: none",
            )  # fmt: skip
            self.editing.bind(target, self._set_target)
            self.editing.bind(depth, self._set_depth)
            if document.has_environment:
                self._light("environment", lighting.environment, 0.0, 10.0, gui)
                self._light("rotation", lighting.rotation, -180.0, 180.0, gui, slider=True)
            self._light("sun", lighting.sun, 0.0, 1000.0, gui)
            self._light("azimuth", lighting.azimuth, -180.0, 180.0, gui, slider=True)
            self._light("elevation", lighting.elevation, -90.0, 90.0, gui, slider=True)
        with gui.add_folder("Medium", order=3):
            density = gui.add_number(
                "density", document.density, min=0.001, max=1000.0, step=0.01,
                hint="factor of the extinction",
            )  # fmt: skip
            self.editing.bind(density, self._set_density)

    def show(self, status: Status) -> None:
        """Display the progress of the cache refinement; called in the session's thread."""
        error = "" if math.isnan(status.error) else f", standard error {status.error:.2%}"
        state = "improving" if status.improving else "done"
        self._status.content = (
            f"{state}: {status.samples} samples per voxel{error}, {status.seconds:.1f} s"
            + (f" ({status.solver})" if status.solver else "")
        )
        if status.message:
            self.refuse(status.message)

    def refuse(self, reason: str) -> None:
        """Display why a change was refused."""
        self._refusal.content = f"**Refused:** {plain(reason)}" if reason else ""
        self._refusal.visible = bool(reason)

    def _light(
        self, name: str, value: float, low: float, high: float, gui: viser.GuiApi, slider=False
    ) -> None:
        add = gui.add_slider if slider else gui.add_number
        value = min(max(round(value, 3), low), high)
        step = 1.0 if slider else 0.01
        handle = (
            add(name, low, high, step, value)
            if slider
            else add(name, value, min=low, max=high, step=step)
        )

        def apply(number: float) -> None:
            self._edit_light(name, _number(name, number, low, high))

        self.editing.bind(handle, apply)

    def _edit_light(self, name: str, value: float) -> None:
        def change(document: Document) -> None:
            lighting: Lighting = replace(document.lighting, **{name: value})
            document.set_lighting(lighting)

        self._session.edit(change)

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
