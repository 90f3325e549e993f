"""Slices of the values, in the panel and in the image, which all windows share."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import viser
from PIL import Image

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.channel import Channel
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.handles import Handle
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.slices import Slices, slice_values

AXES = ("x", "y", "z")
#: Which slices the image shows.
NONE, THIS, ALL = "none", "this one", "all three"


class SlicePanel:
    """Display a slice in the panel, and slices as planes in the image.

    ``changed`` is called when the image needs others.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        appearance: Appearance,
        editing: Editing,
        channel: Channel,
        changed: Callable[[], None],
    ) -> None:
        self._session, self._appearance, self._editing = session, appearance, editing
        self._channel, self._changed = channel, changed
        self._shares = [0.5, 0.5, 0.5]
        gui = server.gui
        self._axis = gui.add_dropdown("slice across", AXES, initial_value="z")
        self._position = gui.add_slider("position, %", 0, 100, 1, 50)
        self._in_image = gui.add_dropdown(
            "in the image", (NONE, THIS, ALL), hint="planes at their places in the medium, which "
            "covers them where it is opaque; drag the arrow",
        )  # fmt: skip
        # Viser's own image logs errors in the browser's console where it is folded away.
        gui.add_html("<irrcache-slice></irrcache-slice>")
        self._handles = [
            Handle(server, f"/slice/{name}", axis, self._dragged) for axis, name in enumerate(AXES)
        ]
        editing.bind(self._axis, self._choose)
        editing.bind(self._position, self._move)
        editing.bind(self._in_image, lambda _: self.show())
        self.show()

    def _choose(self, axis: str) -> None:
        if axis not in AXES:
            raise IrrcacheError(f"there is no slice across {axis!r}.")
        self._position.value = round(100 * self._shares[AXES.index(axis)])
        self.show()

    def _move(self, percent: float) -> None:
        if not 0 <= percent <= 100:
            raise IrrcacheError(f"there is no slice at {percent!r} %.")
        self._shares[AXES.index(self._axis.value)] = percent / 100
        self.show()

    def _dragged(self, share: float) -> None:
        """Queue a place to which the arrow was dragged."""

        def change() -> None:
            self._shares[AXES.index(self._axis.value)] = share
            self._position.value = round(100 * share)
            self.show()

        self._editing.submit("slice", change)

    def show(self) -> None:
        """Show the chosen slices of the present volume."""
        axis, in_image = AXES.index(self._axis.value), self._in_image.value
        volume, limits = self._appearance.volume, self._limits
        encoded = io.BytesIO()
        grey = slice_values(volume, axis, self._shares[axis], limits)
        rows = grey if axis == 2 else grey[::-1]  # seen from below the feet, as in radiology
        Image.fromarray(np.rint(255 * rows).astype(np.uint8)).save(encoded, "PNG")
        self._channel.send("slice", encoded.getvalue())
        chosen = {NONE: (), THIS: (axis,), ALL: (0, 1, 2)}.get(in_image)
        if chosen is None:
            raise IrrcacheError(f"{in_image!r} is no choice of slices.")
        shares = tuple(share if n in chosen else None for n, share in enumerate(self._shares))
        self._session.slices = Slices(volume, shares, limits) if chosen else None
        for number, handle in enumerate(self._handles):
            if chosen and number == axis:
                handle.place(volume, self._session.placement, np.array(self._shares))
            else:
                handle.hide()
        self._changed()

    @property
    def _limits(self) -> tuple[float, float]:
        """Return the values that are black and white."""
        return float(self._appearance.edges[0]), float(self._appearance.edges[-1])
