"""The editor of the transfer function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from viser import uplot

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.appearance import (
    Appearance,
    with_colour,
    with_opacity,
    with_point_after,
    without_point,
)
from mitsuba_irrcache.view.editing import Editing
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.volumes.transfer import (
    TransferFunction,
    load_preset,
    parse_transfer_function,
    preset_names,
)

#: Maximum size of uploaded files in bytes.
LARGEST_FILE = 1 << 20
_OWN = "(own)"
_CURVES = ("opacity", "colour")


class TransferPanel:
    """Display histogram and opacities as a chart, and edit both curves point by point."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        appearance: Appearance,
        editing: Editing,
    ) -> None:
        self._session, self._appearance, self._editing = session, appearance, editing
        gui = server.gui
        low, high = float(appearance.edges[0]), float(appearance.edges[-1])
        with gui.add_folder("Transfer function", order=4):
            self._chart = gui.add_uplot(
                self._curves(appearance.mapping),
                (
                    uplot.Series(label="value"),
                    uplot.Series(label="data", stroke="#888", fill="#8884"),
                    uplot.Series(label="opacity", stroke="#e8590c", width=2),
                ),
                scales={
                    "x": uplot.Scale(time=False, min=low, max=high, auto=False),
                    "y": uplot.Scale(min=0, max=1, auto=False),
                },
                aspect=1.6,
            )
            self._preset = gui.add_dropdown("preset", (_OWN, *preset_names()))
            self._curve = gui.add_dropdown("curve", _CURVES)
            self._point = gui.add_dropdown("point", ("1",))
            self._value = gui.add_number("value", 0.0)
            self._opacity = gui.add_slider("opacity", 0.0, 0.999, 0.001, 0.0)
            self._colour = gui.add_rgb("colour", (255, 255, 255))
            self._add = gui.add_button("add a point")
            self._delete = gui.add_button("delete the point")
            self._load = gui.add_upload_button("load JSON", mime_type="application/json")
            self._download = gui.add_button("save JSON")
        self._fill()
        editing.bind(self._curve, lambda _: self._fill())
        editing.bind(self._point, lambda _: self._fill(points=False))
        editing.bind(self._preset, self._take_preset)
        editing.bind(self._value, lambda _: self._move())
        editing.bind(self._opacity, lambda _: self._move())
        editing.bind(self._colour, lambda _: self._move())
        self._add.on_click(lambda _: self._submit("add", with_point_after))
        self._delete.on_click(lambda _: self._submit("delete", without_point))
        self._load.on_upload(lambda _: editing.submit("load", self._upload))
        self._download.on_click(self._save)

    @property
    def _mapping(self) -> TransferFunction:
        return self._appearance.mapping

    @property
    def _index(self) -> int:
        count = len(self._values)
        text = self._point.value.split(":")[0]
        index = int(text) - 1 if text.isdigit() else -1
        if not 0 <= index < count:
            raise IrrcacheError(f"there is no point {self._point.value!r}.")
        return index

    @property
    def _values(self) -> np.ndarray:
        mapping = self._mapping
        return mapping.opacity_values if self._curve.value == "opacity" else mapping.colour_values

    def _curves(self, mapping: TransferFunction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return values, histogram and opacities for the chart."""
        edges = self._appearance.edges
        values = 0.5 * (edges[1:] + edges[:-1])
        opacity = np.interp(values, mapping.opacity_values, mapping.opacities)
        return values, self._appearance.histogram, opacity

    def _fill(self, points: bool = True) -> None:
        """Display the selected point."""
        if points:
            labels = tuple(f"{i + 1}: {v:g}" for i, v in enumerate(self._values))
            old = self._point.value.split(":")[0]
            index = min(int(old) - 1 if old.isdigit() else 0, len(labels) - 1)
            self._point.options = labels
            self._point.value = labels[index]
        index, opacity = self._index, self._curve.value == "opacity"
        self._value.value = float(self._values[index])
        self._opacity.visible, self._colour.visible = opacity, not opacity
        if opacity:
            self._opacity.value = float(self._mapping.opacities[index])
        else:
            self._colour.value = tuple(round(255 * c) for c in self._mapping.colours[index])

    def _submit(self, key: str, change: Callable[[TransferFunction, str, int], object]) -> None:
        def apply() -> None:
            self._apply(change(self._mapping, self._curve.value, self._index))

        self._editing.submit(f"transfer {key}", apply)

    def _move(self) -> None:
        value = float(self._value.value)
        try:
            if self._curve.value == "opacity":
                opacity = float(self._opacity.value)
                changed = with_opacity(self._mapping, self._index, value, opacity)
            else:
                colour = tuple(c / 255 for c in self._colour.value)
                changed = with_colour(self._mapping, self._index, value, colour)
            self._apply(changed)
        except IrrcacheError:
            self._fill()
            raise

    def _take_preset(self, name: str) -> None:
        if name != _OWN:
            self._apply(load_preset(name).fitted_to(self._appearance.volume.values), name)

    def _upload(self) -> None:
        file = self._load.value
        if len(file.content) > LARGEST_FILE:
            raise IrrcacheError(f"{file.name!r} is no transfer function: it is too large.")
        try:
            function = parse_transfer_function(file.content.decode("utf-8"))
        except UnicodeDecodeError as error:
            raise IrrcacheError(f"{file.name!r} is no transfer function: {error}") from error
        self._apply(function.fitted_to(self._appearance.volume.values))

    def _apply(self, function: TransferFunction, preset: str = _OWN) -> None:
        """Apply a transfer function; restore the previous one if it is refused."""
        grids = self._appearance.grids(function)
        self._session.edit(lambda document: document.set_volumes(grids))
        self._appearance.mapping = function
        self._chart.data = self._curves(function)
        self._preset.value = preset
        self._fill()

    def _save(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            text = self._mapping.to_json().encode()
            event.client.send_file_download("transfer_function.json", text, save_immediately=True)
