"""Arrows in the image that are dragged along an axis of the volume."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from viser.transforms import SO3

from mitsuba_irrcache.view.camera import Placement
from mitsuba_irrcache.volumes.data import VolumeData

#: Length of an arrow, where the radius of the volume is 1.
LENGTH = 0.3


class Handle:
    """An arrow through a point of the volume that moves along one of its axes.

    It points against it if ``sign`` is -1. ``dragged`` receives, in the server's thread, the share
    of the axis to which the arrow is dragged, from 0 to 1.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        axis: int,
        dragged: Callable[[float], None],
        sign: int = 1,
    ) -> None:
        self._server, self._name, self._axis, self._dragged = server, name, axis, dragged
        self._sign = sign
        self._handle: viser.TransformControlsHandle | None = None
        self._origin, self._along = np.zeros(3), np.eye(3)[0]
        self._held = False

    def hide(self) -> None:
        if self._handle is not None:
            self._handle.visible = False

    def place(self, volume: VolumeData, placement: Placement, at: np.ndarray) -> None:
        """Show the arrow at a point ``at`` (3), in shares of the volume's sides."""
        start = np.array(at, dtype=float)
        start[self._axis] = 0
        ends = np.stack([start, start + np.eye(3)[self._axis]])
        world = volume.to_world
        self._origin, end = placement.to_browser(ends @ world[:3, :3].T + world[:3, 3])
        self._along = end - self._origin
        position = self._origin + at[self._axis] * self._along
        if self._handle is None:
            self._add(position)
            return
        self._handle.visible = True
        if not self._held:  # the browser that drags it is ahead
            self._handle.position = position

    def _add(self, position: np.ndarray) -> None:
        self._handle = self._server.scene.add_transform_controls(
            self._name,
            LENGTH,
            active_axes=(True, False, False),
            disable_sliders=True,
            disable_rotations=True,
            depth_test=False,
            wxyz=SO3.from_matrix(_frame(self._sign * self._along)).wxyz,
            position=position,
        )
        self._handle.on_update(self._moved)

    async def _moved(self, event: viser.TransformControlsEvent) -> None:
        self._held = event.phase != "end"
        offset = np.asarray(event.target.position, dtype=np.float64) - self._origin
        share = float(np.dot(offset, self._along) / np.dot(self._along, self._along))
        if np.isfinite(share):
            self._dragged(min(max(share, 0.0), 1.0))


def _frame(first: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that turns the x axis to the direction ``first``."""
    x = first / np.linalg.norm(first)
    y = np.cross(np.eye(3)[np.abs(x).argmin()], x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)
