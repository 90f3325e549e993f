"""Camera paths of animations, and their frames."""

from __future__ import annotations

import dataclasses

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import read_image
from mitsuba_irrcache.view.animation import along_path, turntable, write_frames
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import View
from tests.support.viewer_session import SCENE, SIZE, Screen, front

CAMERA = Camera((3.0, 1.0, 2.0), (1.0, 0.0, 0.0), (0.0, 0.0, 2.0), 40.0)


def test_turntable_is_a_circle():
    """The cameras are evenly spaced at one height and distance, the first one unchanged."""
    cameras = turntable(CAMERA, 8)
    arms = np.array([c.position for c in cameras]) - CAMERA.target
    np.testing.assert_allclose(arms[0], np.subtract(CAMERA.position, CAMERA.target), atol=1e-12)
    np.testing.assert_allclose(arms[4], [-2, -1, 2], atol=1e-12)
    np.testing.assert_allclose(arms[:, 2], 2)
    steps = np.linalg.norm(np.diff(arms, axis=0, append=arms[:1]), axis=1)
    np.testing.assert_allclose(steps, steps[0])
    assert {(c.target, c.up, c.fov) for c in cameras} == {(CAMERA.target, CAMERA.up, CAMERA.fov)}


def test_path_passes_through_its_views():
    views = [CAMERA, dataclasses.replace(CAMERA, position=(0.0, 5.0, 1.0)), turntable(CAMERA, 3)[1]]
    path = along_path(views, 9)
    for view, found in zip(views, path[::4], strict=True):
        np.testing.assert_allclose(found.position, view.position, atol=1e-12)
    straight = along_path([CAMERA, views[1]], 3)[1]
    np.testing.assert_allclose(straight.position, [1.5, 3, 1.5])
    with pytest.raises(IrrcacheError, match="at least two"):
        along_path(views[:1], 5)


@pytest.mark.usefixtures("rgb")
def test_frames_are_the_images_of_windows(tmp_path, scenes):
    """A frame equals the final image of a window with its camera; the number is limited."""
    mi.VolumeGrid(scenes.texture((8, 8, 8, 1), 0.5, 6, 1)).write(str(tmp_path / "density.vol"))
    (tmp_path / "scene.xml").write_text(SCENE)
    session = Session(Document.load(tmp_path / "scene.xml"))
    session.target_error = 0.1
    session.start()
    try:
        screen, done = Screen(), []
        view = View(front(session), SIZE)
        session.look(session.open(screen.show), view)
        final = screen.wait(lambda p: p.final).pixels
        cameras = turntable(view.camera, 3)
        files = write_frames(session, view, cameras, tmp_path / "out", 24, done.append)
        frames = [np.rint(255 * read_image(f)) for f in files if f.suffix == ".png"]
        assert len(frames) == 3 and done == [1, 2, 3]
        assert np.abs(frames[0] - final).mean() < 0.5
        assert np.abs(frames[1] - final).mean() > 3
        with pytest.raises(IrrcacheError, match="0 frames"):
            write_frames(session, view, [], tmp_path / "out", 24, done.append)
    finally:
        session.stop()
