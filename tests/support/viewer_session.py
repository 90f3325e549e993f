"""A scene file for the viewer, cameras around it, and a recorder of displayed images."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from time import monotonic, sleep

import numpy as np

from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import Picture, View, Window

SCENE = """<scene version="3.0.0">
    <integrator type="irrcache"> <integer name="max_depth" value="2"/> </integrator>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world">
            <lookat origin="0.5, -5, 1.5" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
    </sensor>
    <emitter type="constant"> <rgb name="radiance" value="0.3, 0.4, 0.5"/> </emitter>
    <emitter type="directional">
        <vector name="direction" x="1" y="0.5" z="-1"/>
        <rgb name="irradiance" value="3, 2.5, 2"/>
    </emitter>
    <medium type="heterogeneous" id="cloud">
        <volume name="sigma_t" type="gridvolume">
            <string name="filename" value="density.vol"/>
            <transform name="to_world">
                <matrix value="2 0 0 -1 0 2 0 -1 0 0 2 -1 0 0 0 1"/>
            </transform>
        </volume>
        <rgb name="albedo" value="0.9, 0.8, 0.6"/>
    </medium>
    <shape type="cube"> <bsdf type="null"/> <ref name="interior" id="cloud"/> </shape>
</scene>
"""


SIZE = (48, 40)
#: Seconds after which an expected image counts as missing. Kernels may be compiled before it, while
#: other programs use the machine.
PATIENCE = 240.0


class Screen:
    """Record the images that a window receives."""

    def __init__(self) -> None:
        self.pictures: list[Picture] = []
        self._news = threading.Condition()

    def show(self, picture: Picture) -> None:
        with self._news:
            self.pictures.append(picture)
            self._news.notify_all()

    def wait(self, condition, seconds: float = PATIENCE) -> Picture:
        """Wait for an image that fulfils ``condition``; the last recorded one counts, too."""
        with self._news:
            found = self._news.wait_for(
                lambda: self.pictures and condition(self.pictures[-1]) and self.pictures[-1],
                seconds,
            )
        assert found, f"none of {len(self.pictures)} pictures"
        return found


def drag(session: Session, window: Window, view: View, condition: Callable[[], bool]) -> View:
    """Turn the camera of ``view`` like a mouse until ``condition`` holds; return the last view."""
    began, moved = monotonic(), view
    for degrees in count(1):
        assert monotonic() - began < PATIENCE, "the images of the moving camera are not those"
        moved = replace(view, camera=turned(view.camera, degrees))
        session.look(window, moved)
        sleep(0.02)
        if condition():
            return moved


def front(session: Session) -> Camera:
    return next(iter(session.cameras.values()))


def turned(camera: Camera, degrees: float) -> Camera:
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return replace(camera, position=tuple((turn @ np.array(camera.position)).tolist()))
