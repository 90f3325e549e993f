"""The crop box, which all windows share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import WHOLE, Appearance, Box
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.handles import Handle
from mitsuba_irrcache.view.session import Session

AXES = ("x", "y", "z")
#: Edges of a cube as pairs of corners, whose coordinates are the bits of their numbers.
_EDGES = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]


class CropPanel:
    """Crop the medium to a box of the volume, by ranges or by arrows on its faces."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        appearance: Appearance,
        editing: Editing,
    ) -> None:
        self._server, self._session, self._appearance = server, session, appearance
        self._editing = editing
        self._ranges = [
            server.gui.add_multi_slider(
                f"{axis}, %", 0, 100, 1, (0, 100), min_range=1, hint="what is shown"
            )
            for axis in AXES
        ]
        self._arrows = server.gui.add_checkbox(
            "drag faces", False, hint="by arrows in the image, on the faces of the box"
        )
        whole = server.gui.add_button("whole volume", color="gray")
        self._handles = {
            (axis, side): Handle(
                server, f"/crop/{AXES[axis]}{side}", axis, self._drag_of(axis, side), 2 * side - 1
            )
            for axis in range(3)
            for side in range(2)
        }
        for slider in self._ranges:
            editing.bind(slider, lambda _: self._crop(tuple(s.value for s in self._ranges)))
        editing.bind(self._arrows, lambda _: self._draw())
        whole.on_click(lambda _: editing.submit("whole", self._reset))

    def _reset(self) -> None:
        for slider in self._ranges:
            slider.value = (0, 100)
        self._crop(((0, 100),) * 3)

    def _crop(self, percent: Box) -> None:
        self._appearance.change(self._session.edit, box=checked_box(percent))
        self._draw()

    def _drag_of(self, axis: int, side: int) -> Callable[[float], None]:
        """Return what drags a side of the box."""

        def change(share: float) -> None:
            box = [list(ends) for ends in self._appearance.box]
            other = box[axis][1 - side]
            box[axis][side] = min(share, other - 0.01) if side == 0 else max(share, other + 0.01)
            box = tuple(tuple(min(max(end, 0.0), 1.0) for end in ends) for ends in box)
            self._appearance.change(self._session.edit, box=box)
            low, high = box[axis]
            self._ranges[axis].value = (round(100 * low), round(100 * high))
            self._draw()

        return lambda share: self._editing.submit(f"crop {axis} {side}", lambda: change(share))

    def _draw(self) -> None:
        """Draw the edges of the box over the image, unless it holds the whole volume, and arrows
        if they are wanted.
        """
        sides, dragged = np.array(self._appearance.box), bool(self._arrows.value)
        corners = np.array([[sides[a, n >> a & 1] for a in range(3)] for n in range(8)])
        volume, placement = self._appearance.volume, self._session.placement
        world = volume.to_world
        points = placement.to_browser(corners @ world[:3, :3].T + world[:3, 3])[np.array(_EDGES)]
        self._server.scene.add_line_segments(
            "/box", points.astype(np.float32), (255, 209, 102), line_width=1.5,
            visible=dragged or self._appearance.box != WHOLE,
        )  # fmt: skip
        for (axis, side), handle in self._handles.items():
            if dragged:
                at = sides.mean(axis=1)
                at[axis] = sides[axis, side]
                handle.place(volume, placement, at)
            else:
                handle.hide()


def checked_box(percent: object) -> Box:
    """Return the shares of the volume along x, y, z for ranges in percent that a browser sent."""
    box = tuple(tuple(float(end) / 100 for end in side) for side in percent)
    if len(box) != 3 or not all(len(s) == 2 and 0 <= s[0] < s[1] <= 1 for s in box):
        raise IrrcacheError(f"the crop box is {percent!r}; give ranges of 0 to 100 %.")
    return box
