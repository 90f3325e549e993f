"""The crop box, and slices of the values, which all windows share."""

from __future__ import annotations

import io

import numpy as np
import viser
from PIL import Image
from viser.transforms import SO3

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import Appearance, Box
from mitsuba_irrcache.view.channel import Channel
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.volumes.data import VolumeData

AXES = ("x", "y", "z")
#: Edges of a cube as pairs of corners, whose coordinates are the bits of their numbers.
_EDGES = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]


class CropPanel:
    """Crop the medium to a box of the volume, and display slices of the volume's values."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        appearance: Appearance,
        editing: Editing,
        channel: Channel,
    ) -> None:
        self._server, self._session, self._appearance = server, session, appearance
        self._channel = channel
        with server.gui.add_folder("Crop and slices", order=4.5, expand_by_default=False):
            self._ranges = [
                server.gui.add_multi_slider(
                    f"{axis}, %", 0, 100, 1, (0, 100), min_range=1, hint="what is shown"
                )
                for axis in AXES
            ]
            whole = server.gui.add_button("whole volume", color="gray")
            self._axis = server.gui.add_dropdown("slice across", AXES, initial_value="z")
            self._position = server.gui.add_slider("position, %", 0, 100, 1, 50)
            self._in_image = server.gui.add_checkbox(
                "in the image", False, hint="draw the slice at its place, over the volume"
            )
            # Viser's own image logs errors in the browser's console where it is folded away.
            server.gui.add_html("<irrcache-slice></irrcache-slice>")
        for slider in self._ranges:
            editing.bind(slider, lambda _: self._crop(tuple(s.value for s in self._ranges)))
        whole.on_click(lambda _: editing.submit("whole", self._reset))
        for control in (self._axis, self._position, self._in_image):
            editing.bind(control, lambda _: self._show_slice())
        self._show_slice()

    def _reset(self) -> None:
        for slider in self._ranges:
            slider.value = (0, 100)
        self._crop(((0, 100),) * 3)

    def _crop(self, percent: Box) -> None:
        box = checked_box(percent)
        self._appearance.change(self._session.edit, box=box)
        self._draw(box)

    def _draw(self, box: Box) -> None:
        """Draw the edges of the box over the image, unless it holds the whole volume."""
        sides = np.array(box)
        corners = np.array([[sides[a, n >> a & 1] for a in range(3)] for n in range(8)])
        world = self._appearance.volume.to_world
        placed = corners @ world[:3, :3].T + world[:3, 3]
        points = self._session.placement.to_browser(placed)[np.array(_EDGES)]
        self._server.scene.add_line_segments(
            "/crop", points.astype(np.float32), (255, 209, 102), line_width=1.5,
            visible=bool(np.ptp(sides, axis=1).min() < 1),
        )  # fmt: skip

    def _show_slice(self) -> None:
        encoded, pixels = io.BytesIO(), self._slice()
        Image.fromarray(pixels).save(encoded, "PNG")
        self._channel.send("slice", encoded.getvalue())
        if not self._in_image.value:
            self._server.scene.remove_by_name("/slice")
            return
        centre, right, down = slice_place(
            self._appearance.volume, AXES.index(self._axis.value), self._position.value / 100
        )
        width, height = np.linalg.norm(right), np.linalg.norm(down)
        right, down = right / width, down / height
        place, turned = self._session.placement, np.stack([right, down, np.cross(right, down)], 1)
        self._server.scene.add_image(
            "/slice",
            np.repeat(pixels[..., None], 3, axis=-1),
            width / place.radius,
            height / place.radius,
            wxyz=SO3.from_matrix(turned).wxyz,
            position=place.to_browser(centre),
            cast_shadow=False,
            receive_shadow=False,
        )

    def _slice(self) -> np.ndarray:
        """Return the chosen slice in grey levels, uint8 (rows, columns), head or front on top."""
        axis, position = self._axis.value, self._position.value
        if axis not in AXES or not 0 <= position <= 100:
            raise IrrcacheError(f"there is no slice across {axis!r} at {position!r} %.")
        values, number = self._appearance.volume.values, 2 - AXES.index(axis)
        index = _index(position / 100, values.shape[number])
        found = np.asarray(values.take(index, axis=number), dtype=np.float32)
        low, high = self._appearance.edges[0], self._appearance.edges[-1]
        grey = 255 * np.clip((found - low) / max(high - low, 1e-30), 0, 1)
        rows = grey if axis == "z" else grey[::-1]  # seen from below the feet, as in radiology
        return rows.astype(np.uint8)


def slice_place(
    volume: VolumeData, axis: int, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre of a slice in the world, and its extent to the right and downwards.

    ``axis`` is 0, 1 or 2 for x, y or z; ``share`` says where along it, from 0 to 1.
    """
    to_world, count = volume.to_world, volume.size[axis]
    centre = np.array([0.5, 0.5, 0.5, 1.0])
    centre[axis] = (_index(share, count) + 0.5) / count
    right, down = (1, 2) if axis == 0 else (0, 2) if axis == 1 else (0, 1)
    sign = 1 if axis == 2 else -1  # the head, or the front, is on top
    return (to_world @ centre)[:3], to_world[:3, right], sign * to_world[:3, down]


def _index(share: float, count: int) -> int:
    return round(share * (count - 1))


def checked_box(percent: object) -> Box:
    """Return the shares of the volume along x, y, z for ranges in percent that a browser sent."""
    box = tuple(tuple(float(end) / 100 for end in side) for side in percent)
    if len(box) != 3 or not all(len(s) == 2 and 0 <= s[0] < s[1] <= 1 for s in box):
        raise IrrcacheError(f"the crop box is {percent!r}; give ranges of 0 to 100 %.")
    return box
