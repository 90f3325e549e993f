"""The slider over the time steps of a file, which all windows share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import viser

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.volumes.colours import Colours
from mitsuba_irrcache.volumes.data import VolumeData


@dataclass(frozen=True)
class TimeSteps:
    """The time steps of a file: ``count`` of them, the ``first`` displayed, read by ``read``."""

    count: int
    first: int
    read: Callable[[int], tuple[VolumeData, Colours | None]]


class TimePanel:
    """Display one of the time ``steps``; the transfer function stays.

    ``changed`` is called when another one is displayed.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        appearance: Appearance,
        editing: Editing,
        steps: TimeSteps,
        changed: Callable[[], None],
    ) -> None:
        self._session, self._appearance, self._steps = session, appearance, steps
        self._changed = changed
        with server.gui.add_folder("Time", order=1.5):
            slider = server.gui.add_slider("time step", 0, steps.count - 1, 1, steps.first)
        editing.bind(slider, self._show)

    def _show(self, step: int) -> None:
        if not isinstance(step, int) or not 0 <= step < self._steps.count:
            raise IrrcacheError(f"there is no time step {step!r}.")
        volume, colours = self._steps.read(step)
        if volume.values.shape != self._appearance.volume.values.shape:
            raise IrrcacheError(f"time step {step} has another size: {volume.size}.")
        self._appearance.change(self._session.edit, volume=volume, colours=colours)
        self._changed()
