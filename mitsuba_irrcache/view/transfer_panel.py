"""The editor of the transfer function, which all windows share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import viser

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.channel import Channel
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.volumes.transfer import (
    TransferFunction,
    load_preset,
    parse_transfer_function,
    preset_names,
)

#: Maximum number of points of a curve that a browser sends.
MOST_POINTS = 256
#: Number of steps that can be undone.
STEPS = 100
_OWN = "(own)"


class TransferPanel:
    """Show the component `page/transfer.js`, apply its edits, and keep their history."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        appearance: Appearance,
        editing: Editing,
        channel: Channel,
    ) -> None:
        self._session, self._appearance, self._editing = session, appearance, editing
        self._channel = channel
        self._history = History(appearance.mapping, appearance.preset or _OWN)
        self._steps = 0  # to travel in the history, as queued
        self._is_step = False  # whether a queued edit ends a step of the history
        self._newest: object = None  # what a browser calls the edit that was applied last
        gui = server.gui
        with gui.add_folder("Transfer function", order=2):
            self._preset = gui.add_dropdown(
                "preset", (_OWN, *preset_names()), initial_value=self._history.now[1]
            )
            gui.add_html("<irrcache-transfer></irrcache-transfer>")
            if appearance.has_own_colours:
                gui.add_markdown("The colours are those of the file, not those of the band.")
        editing.bind(self._preset, self._take_preset)
        channel.receive("transfer", self._edited)
        channel.receive("load", self._load)
        channel.receive("undo", lambda _: self._travel(-1))
        channel.receive("redo", lambda _: self._travel(1))
        self._send_state()

    def _send_state(self) -> None:
        """Send the function to the editors of all windows."""
        mapping, appearance = self._appearance.mapping, self._appearance
        colours = zip(mapping.colour_values.tolist(), mapping.colours.tolist(), strict=True)
        state = {
            "opacity": np.stack([mapping.opacity_values, mapping.opacities], axis=-1).tolist(),
            "colour": [list(point) for point in colours],
            "histogram": appearance.histogram.round(3).tolist(),
            "range": [float(appearance.edges[0]), float(appearance.edges[-1])],
            "unit": mapping.unit or appearance.volume.unit,
            "length": f"{mapping.length:g} {appearance.volume.length_unit or 'unit of length'}",
            "undo": self._history.can(-1),
            "redo": self._history.can(1),
            "json": mapping.to_json(),
            "edit": self._newest,
        }
        self._channel.send("transfer", state)

    def _edited(self, value: object) -> None:
        """Queue an edit by a browser."""
        function = edited(self._appearance.mapping, value)
        number = int(value["id"])
        self._is_step |= bool(value["done"])

        def change() -> None:
            self._newest = number
            done, self._is_step = self._is_step, False
            self._apply(function, _OWN, done)

        self._editing.submit("transfer", change)

    def _travel(self, step: int) -> None:
        """Queue a step of the history; steps that wait already are added up."""
        self._steps += step

        def change() -> None:
            steps, self._steps = self._history.bounded(self._steps), 0
            function, preset = self._history.at(steps)
            self._apply(function, preset, done=False)
            self._history.travel(steps)
            self._send_state()

        self._editing.submit("travel", change)

    def _take_preset(self, name: str) -> None:
        if name != _OWN:
            self._apply(load_preset(name).fitted_to(self._appearance.volume.values), name)

    def _load(self, value: object) -> None:
        """Queue a transfer function that a browser has read from a file."""
        name, text = str(value["name"]), str(value["text"])

        def change() -> None:
            try:
                function = parse_transfer_function(text)
            except IrrcacheError as error:
                raise IrrcacheError(f"{name!r} is no transfer function: {error}") from error
            self._apply(function.fitted_to(self._appearance.volume.values), _OWN)

        self._editing.submit("load", change)

    def _apply(self, function: TransferFunction, preset: str, done: bool = True) -> None:
        """Apply a transfer function; restore the previous one if it is refused."""
        try:
            self._appearance.change(self._session.edit, mapping=function)
            self._preset.value = preset
            if done:
                self._history.add(function, preset)
        finally:
            self._send_state()


class History:
    """Transfer functions with the names of their presets, and which of them is current."""

    def __init__(self, function: TransferFunction, preset: str) -> None:
        self._steps = [(function, preset)]
        self._index = 0

    @property
    def now(self) -> tuple[TransferFunction, str]:
        return self._steps[self._index]

    def add(self, function: TransferFunction, preset: str) -> None:
        """Append a step to the current one; those that were undone are dropped."""
        self._steps = [*self._steps[: self._index + 1], (function, preset)][-STEPS:]
        self._index = len(self._steps) - 1

    def can(self, steps: int) -> bool:
        return 0 <= self._index + steps < len(self._steps)

    def bounded(self, steps: int) -> int:
        """Return the nearest number of steps that there are."""
        return min(max(steps, -self._index), len(self._steps) - 1 - self._index)

    def at(self, steps: int) -> tuple[TransferFunction, str]:
        """Return the function so many steps later, or earlier if ``steps`` is negative."""
        return self._steps[self._index + steps]

    def travel(self, steps: int) -> None:
        self._index += steps


def edited(function: TransferFunction, value: object) -> TransferFunction:
    """Return a function with the points that a browser sent.

    Raises IrrcacheError, ValueError or TypeError if they are none.
    """
    opacity, colour = value["opacity"], value["colour"]
    if not (0 < len(opacity) <= MOST_POINTS and 0 < len(colour) <= MOST_POINTS):
        raise IrrcacheError(f"a curve has 1 to {MOST_POINTS} points.")
    return replace(
        function,
        opacity_values=np.array([point[0] for point in opacity], dtype=np.float64),
        opacities=np.array([point[1] for point in opacity], dtype=np.float64),
        colour_values=np.array([point[0] for point in colour], dtype=np.float64),
        colours=np.array([point[1] for point in colour], dtype=np.float64).reshape(-1, 3),
    )
