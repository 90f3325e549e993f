"""Viewer sessions without a browser: displayed images, and scheduling of the solver."""

from __future__ import annotations

import shlex
import threading
import time
import weakref
from collections import deque
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenImageIO
import pytest

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import read_image
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.view import light as lights
from mitsuba_irrcache.view import picture, saving
from mitsuba_irrcache.view import session as sessions
from mitsuba_irrcache.view import window as windows
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.view.light import Light
from mitsuba_irrcache.view.picture import KINDS, Look, Samples
from mitsuba_irrcache.view.saving import render_command, save_view
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import Picture, View
from mitsuba_irrcache.volumes.colours import Colours
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.scene import SceneSettings
from mitsuba_irrcache.volumes.transfer import DensityMapping
from tests.support.viewer_session import PATIENCE, SCENE, SIZE, Screen, drag, front, turned

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture
def path(tmp_path, scenes):
    density = np.zeros((16, 16, 16, 1), np.float32)
    density[3:13, 3:13, 3:13] = scenes.texture((10, 10, 10, 1), 0.5, 6, 1)
    mi.VolumeGrid(density).write(str(tmp_path / "density.vol"))
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


@pytest.fixture
def session(path):
    session = Session(Document.load(path))
    session.target_error = 0.02
    session.start()
    yield session
    session.stop()


def final(picture: Picture) -> bool:
    return picture.final


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.8, 0.6)])
def test_a_window_at_rest_gets_the_image_that_render_gives(session, tmp_path, background):
    """A window at rest displays the image of the command that is shown when it is saved.

    The command replaces no file of the view.
    """
    screen = Screen()
    window = session.open(screen.show)
    hidden = any(background)
    session.edit(lambda document: document.set_hide_emitters(hidden))
    look = Look(exposure=0.5, tone="filmic", background=background)
    view = View(turned(front(session), 40), SIZE, look)
    session.look(window, view)
    shown = screen.wait(final).pixels
    files = save_view(session, view, tmp_path, "kept", with_cache=True)
    assert {f.name for f in files} == {"kept.exr", "kept.png", "kept-scene.xml", "kept.cache"}
    np.testing.assert_array_equal(np.rint(255 * read_image(tmp_path / "kept.png")), shown)
    _, *words = shlex.split(render_command("kept", look))
    words[1] = str(tmp_path / words[1])
    assert main(words) == 0
    again = np.rint(255 * read_image(tmp_path / "kept-scene.png"))
    assert not hidden or shown[0, 0].tolist() == [255, 231, 203]
    difference = np.abs(again - shown.astype(float))
    assert shown.std() > 20
    assert difference.mean() < 0.6 and difference.max() < 12
    names = OpenImageIO.ImageBuf(str(tmp_path / "kept.exr")).spec().channelnames
    layers = dict(zip(names, np.moveaxis(read_image(tmp_path / "kept.exr"), -1, 0), strict=True))
    parts = (layers[f"{kind}.G"] for kind in ("colour", "illumination", "background"))
    colour, illumination, background = parts
    np.testing.assert_allclose(colour * illumination + background, layers["G"], atol=2e-5)


def test_a_view_that_is_saved_during_an_edit_shows_the_edit(session, tmp_path, monkeypatch):
    """Image and scene are of one state, the edited one, though the edit came in between."""
    screen = Screen()
    window = session.open(screen.show)
    view = View(front(session), SIZE)
    session.look(window, view)
    before = screen.wait(final).pixels
    sampled, edits = saving._samples, [4.0]

    def and_edited(*arguments, **options) -> Samples:
        found = sampled(*arguments, **options)
        if edits:
            session.edit(lambda document: document.set_density(edits.pop()))
        return found

    monkeypatch.setattr(saving, "_samples", and_edited)
    save_view(session, view, tmp_path, "kept", with_cache=True)
    assert session.document.density == 4 and not session.has_edit
    shown = np.rint(255 * read_image(tmp_path / "kept.png"))
    assert main(["render", str(tmp_path / "kept-scene.xml")]) == 0
    again = np.rint(255 * read_image(tmp_path / "kept-scene.png"))
    # The first caches after an edit are noisy.
    assert np.abs(again - shown).mean() < 0.2 * np.abs(shown - before).mean()


@pytest.fixture
def long_rest(monkeypatch):
    """Let no pause that a busy machine makes during a drag count as rest."""
    for user in (windows, sessions):
        monkeypatch.setattr(user, "REST_SECONDS", 1.0)


def test_no_solver_works_while_a_camera_moves(session, long_rest):
    """While a camera moves no solver pass runs; afterwards the caches improve."""
    session.call(lambda: setattr(session, "target_error", 1e-6))
    screen = Screen()
    window = session.open(screen.show)
    view = View(front(session), SIZE)
    session.look(window, view)
    screen.wait(lambda p: not p.moving)
    before, count, began = session.status.samples, len(screen.pictures), time.monotonic()
    last = drag(session, window, view, lambda: len(screen.pictures) > count + 5)
    assert all(p.moving for p in screen.pictures[count + 1 : count + 6])
    rest = screen.wait(lambda p: not p.moving and p.view == last)
    assert rest.pixels.shape == (*SIZE[::-1], 3)
    while session.status.samples == before:
        assert time.monotonic() - began < PATIENCE, "the caches do not improve any more"
        time.sleep(0.02)
    # A pass that was running when the mouse moved is interrupted, and continues when it rests.
    history, ended = list(session.history), window.moved
    first = min(a for what, a, _ in history if what == "moving" and a > began)
    paused = [(a, b) for what, a, b in history if what == "interruption"]
    for a, b in ((a, b) for what, a, b in history if what == "solver" and b > first and a < ended):
        a, b = max(a, first), min(b, ended)
        inside = sum(max(min(d, b) - max(c, a), 0) for c, d in paused)
        assert b - a <= inside + 1e-3


def test_moving_camera_interrupts_an_image_at_rest(session, long_rest, monkeypatch):
    """An image at rest is rendered in bands and aborted when a camera moves; it is completed
    later.
    """
    monkeypatch.setattr(picture, "BAND", 64)
    traced: list[Camera] = []
    screen, original = Screen(), Samples._trace
    window = session.open(screen.show)
    still = View(front(session), SIZE)

    def trace(samples: Samples, band: range, total: int) -> list:
        if len(band) == 64 and samples.camera == still.camera:
            traced.append(samples.camera)
            session.look(window, View(turned(front(session), len(traced)), SIZE))
        return original(samples, band, total)

    monkeypatch.setattr(Samples, "_trace", trace)
    session.look(window, still)
    last = screen.wait(lambda p: not p.moving)
    assert 1 <= len(traced) < SIZE[0] * SIZE[1] // 64
    assert last.view.camera == turned(front(session), len(traced))
    assert any(p.moving for p in screen.pictures)


def test_moving_pictures_are_smaller_where_time_is_short(session, monkeypatch):
    monkeypatch.setattr(windows, "MOVING_SECONDS", 1e-6)
    screen = Screen()
    window = session.open(screen.show)
    smallest = round(windows.LEVELS[-1][0] * SIZE[0])

    def widths() -> set[int]:
        return {p.pixels.shape[1] for p in screen.pictures if p.moving}

    drag(session, window, View(front(session), SIZE), lambda: smallest in widths())


def test_no_kernel_is_compiled_for_another_camera_or_size(session, kernels):
    screen = Screen()
    window = session.open(screen.show)
    session.look(window, View(front(session), SIZE))
    screen.wait(final)

    def pictures(size, degrees):
        seen = session.light.snapshot(False, False)
        samples = Samples(seen, turned(front(session), degrees), size)
        samples.add(1)
        samples.picture(Look(exposure=degrees), (0, 1))
        dr.sync_thread()

    session.call(lambda: pictures(SIZE, 1))
    used = session.call(lambda: kernels(lambda: [pictures((31, 57), 20), pictures((9, 8), 30)]))
    assert used and all(k["cache_hit"] for k in used)


def test_no_kernel_is_compiled_for_another_edit(session, kernels):
    """Other volumes of the same size and kind are displayed by the kernels that exist."""
    shapes = set()

    def display(top: float) -> None:
        values = np.random.default_rng(1).random((5, 6, 7), np.float32) * np.float32(top)
        session._edit(lambda document: document.set_volumes({"density.vol": values}))
        session._light.refine()
        shapes.add(session._light.parts[0].grid.shape)
        dr.sync_thread()

    # Kernels contain the number of an emitter among all of Mitsuba's objects, which alternates as
    # long as the previous scene exists.
    session.call(lambda: [display(5.0), display(5.5), display(6.0)])
    shapes.clear()
    used = session.call(lambda: kernels(lambda: [display(7.0), display(8.0)]))
    assert len(shapes) == 2
    assert used and all(k["cache_hit"] for k in used)


def test_an_edit_is_displayed_coarsely_first(session):
    """The first image after an edit is a coarse one, for a short delay; then the image at rest."""
    screen = Screen()
    window = session.open(screen.show)
    session.look(window, View(front(session), SIZE))
    screen.wait(final)
    count = len(screen.pictures)
    session.edit(lambda document: document.set_density(0.3))
    screen.wait(lambda p: len(screen.pictures) > count + 1 and p.final)
    first, *others = screen.pictures[count:]
    assert first.moving and first.pixels.size < others[-1].pixels.size
    assert not any(p.moving for p in others)


@pytest.mark.parametrize("compared", ["off", "error"])
def test_other_layers_are_displayed_coarsely_first(session, compared):
    """A view of other layers gets a coarse image at once, and then one at rest.

    The image before, such as an error in false colours, would be mistaken for it.
    """
    screen = Screen()
    window = session.open(screen.show)
    view = View(front(session), SIZE, compared=compared)
    session.look(window, view)
    screen.wait(lambda p: p.final if compared == "off" else p.compared is not None)
    session.look(window, replace(view, look=replace(view.look, kind="depth"), compared="off"))
    screen.wait(lambda p: p.view == window.view and p.final)
    first, *others = [p for p in screen.pictures if p.view == window.view]
    assert first.moving
    assert others and not any(p.moving for p in others)


def test_an_edit_of_many_voxels_computes_only_a_coarse_cache_at_first(session, monkeypatch):
    """Nothing is computed for the voxels of the whole resolution before the first image.

    Optical depths from all voxels to a sun delayed it by seconds.
    """
    monkeypatch.setattr(lights, "MANY_VOXELS", 1000)
    monkeypatch.setattr(lights, "COARSE", 8)
    created, create = [], CachedMedium.start

    def start(part: CachedMedium, *args: object) -> None:
        create(part, *args)
        created.append(part.cache.grid.shape)

    monkeypatch.setattr(CachedMedium, "start", start)

    def edit_and_refine() -> Light:
        session._edit(lambda document: document.set_density(3.0))
        light = session._light
        light.refine()
        assert created == [(8, 8, 8)]
        assert light.parts[0].grid.voxel_count > 1000
        light.refine()
        return light

    light = session.call(edit_and_refine)
    assert created[1:] == [light.parts[0].cache.grid.shape]
    assert light.samples > 0


def test_fine_voxels_precede_further_samples_and_volpath(session, monkeypatch):
    """An image of coarse caches, displayed once, gets neither samples nor a reference: they took
    turns with the solver, which delayed the final voxels by seconds in large windows.
    """
    monkeypatch.setattr(lights, "MANY_VOXELS", 1000)
    monkeypatch.setattr(lights, "COARSE", 8)
    during: list[bool] = []

    def recorded(chore):
        def run() -> bool:
            during.append(session._light.is_preliminary)
            return chore()

        return run

    screen = Screen()
    window = session.open(screen.show)
    session.look(window, View(front(session), SIZE, compared="swipe"))
    screen.wait(lambda picture: picture.samples > 1)
    session._chores = deque(recorded(chore) for chore in session._chores)
    session.edit(lambda document: document.set_density(3.0))
    light = session._light
    screen.wait(lambda picture: picture.samples > 1 and session.light is light)
    assert during and not any(during)


def test_an_image_at_rest_is_antialiased_while_the_solver_continues(session, monkeypatch):
    """A pass of the solver takes seconds in dense media, and its result begins the image anew: with
    one sample after each pass images had a single sample per pixel for a minute.
    """
    monkeypatch.setattr(sessions, "GROWTH", 1.0)
    monkeypatch.setattr(sessions, "PICTURE_SHARE", 1e6)  # passes are short here
    session.target_error = 1e-9
    screen = Screen()
    session.look(session.open(screen.show), View(front(session), SIZE))
    shown = screen.wait(lambda picture: picture.samples == windows.SAMPLES)
    assert not shown.final


def test_an_idle_session_releases_unused_memory_once(session, monkeypatch):
    """Arrays of the solver that Dr.Jit retains for reuse were as large as twice all others."""
    monkeypatch.setattr(sessions, "IDLE_SECONDS", 0.01)
    released: list[Picture] = []
    screen = Screen()

    def release() -> None:
        released.append(screen.pictures[-1])

    session.look(session.open(screen.show), View(front(session), SIZE))
    screen.wait(final)
    deadline = time.monotonic() + PATIENCE
    while session._holds_unused and time.monotonic() < deadline:
        time.sleep(0.01)
    monkeypatch.setattr(session, "_release_memory", release)
    for density in (2.0, 3.0):
        count = len(released)
        session.edit(lambda document, density=density: document.set_density(density))
        deadline = time.monotonic() + PATIENCE
        # The first call follows the first image of the new caches.
        while len(released) < count + 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert released[-1].final
        time.sleep(0.1)
        assert len(released) == count + 2


def test_each_edit_is_displayed_while_others_wait(session, monkeypatch):
    """While the sun is dragged, an edit always waits; nevertheless each one is displayed, coarsely.

    When a waiting edit interrupted the solver, no image appeared before the end of the drag.
    """
    monkeypatch.setattr(sessions, "EDIT_SECONDS", PATIENCE)
    screen = Screen()
    window = session.open(screen.show)
    session.look(window, View(front(session), SIZE))
    screen.wait(final)
    count, done = len(screen.pictures), threading.Semaphore(0)

    def edit(density: float) -> None:
        session.edit(lambda document: document.set_density(density))
        done.release()

    for number in range(8):  # two edits wait at any time
        if number >= 2:
            assert done.acquire(timeout=PATIENCE)
        threading.Thread(target=edit, args=(1 + 0.1 * number,), daemon=True).start()
    screen.wait(lambda p: len(screen.pictures) > count + 8 and p.final)
    assert sum(p.moving for p in screen.pictures[count:]) == 8


def test_edits_display_no_black_images(session):
    """After an edit, every image is as bright as the old or the new scene."""
    screen = Screen()
    window = session.open(screen.show)
    session.look(window, View(front(session), SIZE))
    before = screen.wait(final).pixels.mean()
    count = len(screen.pictures)
    session.edit(lambda document: document.set_density(0.2))
    screen.wait(lambda p: len(screen.pictures) > count + 1 and p.final)
    means = [p.pixels.mean() for p in screen.pictures[count:]]
    low, high = sorted((before, means[-1]))
    assert high - low > 2
    assert min(means) > low - 1 and max(means) < high + 1


def test_removed_emitters_give_a_black_image(path):
    """Without emitters the session has nothing to refine, and displays a black image."""
    sky = '<emitter type="constant"> <rgb name="radiance" value="0.3, 0.4, 0.5"/> </emitter>'
    assert sky in SCENE
    path.write_text(SCENE.replace(sky, ""))
    session = Session(Document.load(path))
    session.target_error = 0.02
    session.start()
    try:
        screen = Screen()
        session.look(session.open(screen.show), View(front(session), SIZE))
        assert screen.wait(final).pixels.mean() > 1
        dark = replace(session.document.lighting, sun=0.0)
        session.edit(lambda document: document.set_lighting(dark))
        assert screen.wait(lambda p: p.final and not p.pixels.any()).pixels.max() == 0
    finally:
        session.stop()


def test_a_refused_edit_changes_nothing(session):
    text = session.document.state()[0]
    with pytest.raises(IrrcacheError, match="density"):
        session.edit(lambda document: document.set_density(-1))
    with pytest.raises(IrrcacheError, match="negative"):
        session.edit(
            lambda document: document.set_volumes(
                {"density.vol": np.full((4, 4, 4), -1, np.float32)}
            )
        )
    assert session.document.state()[0] == text
    screen = Screen()
    session.look(session.open(screen.show), View(front(session), SIZE))
    assert screen.wait(final).pixels.std() > 10


def test_windows_have_cameras_of_their_own(session):
    """Windows have independent cameras on one cache; closing one does not affect the other."""
    screens = Screen(), Screen()
    windows = [session.open(s.show) for s in screens]
    for k, window in enumerate(windows):
        session.look(window, View(turned(front(session), 90 * k), SIZE))
    first, second = (s.wait(final).pixels.astype(float) for s in screens)
    assert np.abs(first - second).mean() > 1
    session.close(windows[0])
    count = len(screens[0].pictures)
    session.look(windows[1], View(front(session), SIZE))
    again = screens[1].wait(lambda p: p.final and p.view.camera == front(session)).pixels
    np.testing.assert_array_equal(again, first)
    assert len(screens[0].pictures) == count


def test_a_closed_window_holds_nothing(session):
    """A closed window releases its arrays, although its controls are part of reference cycles."""
    screen = Screen()
    window = session.open(screen.show)
    session.look(window, View(front(session), SIZE))
    screen.wait(final)
    samples = session.call(lambda: weakref.ref(window.samples))
    assert samples() is not None
    session.close(window)
    session.call(lambda: None)
    assert samples() is None


def test_all_kinds_of_images(session):
    """Every kind of displayed image is nonempty and differs from the others."""
    screen = Screen()
    window = session.open(screen.show)
    found = []
    for kind in KINDS:
        look = Look(kind)
        session.look(window, View(front(session), SIZE, look))
        found.append(screen.wait(lambda p, look=look: p.view.look == look and p.final).pixels)
        assert found[-1].std() > 1, kind
    for i, a in enumerate(found):
        assert all(np.abs(a.astype(float) - b).mean() > 1 for b in found[:i])


@pytest.mark.parametrize("name", ["../up", "a/b", ".hidden", "", "a" * 100, "/etc/passwd", "a\n"])
def test_file_names_outside_the_folder_are_refused(session, tmp_path, name):
    with pytest.raises(IrrcacheError, match="no name"):
        save_view(session, View(front(session), SIZE), tmp_path, name)


def test_unsupported_scenes_raise_errors(path, tmp_path):
    text = path.read_text().replace('<ref name="interior" id="cloud"/>', "")
    (tmp_path / "empty.xml").write_text(text)
    session = Session(Document.load(tmp_path / "empty.xml"))
    with pytest.raises(IrrcacheError, match="no medium"):
        session.start()
    session.stop()


def test_emission_is_displayed(tmp_path):
    """Media emit in the viewer, too, and its exposure is that of what they emit."""
    values = np.zeros((8, 8, 8), np.float32)
    values[2:6, 2:6, 2:6] = 0.1
    red = np.zeros((8, 8, 8, 3), np.float32)
    red[2:6, 2:6, 2:6, 0] = 50
    volume, mapping = VolumeData(values), DensityMapping()
    appearance = Appearance(volume, mapping, colours=Colours("emission", red))
    settings = SceneSettings(integrator="irrcache", radiance=0, hide_emitters=True)
    session = Session(appearance.document(settings))
    session.start()
    try:
        assert session.exposure == pytest.approx(-np.log2(4 * 50), abs=1)
        centre = session.first_look[120, 240]
        assert centre[0] > 200 and not centre[1:].any() and not session.first_look[0, 0].any()
        assert session.light.is_emissive
        screen = Screen()
        window = session.open(screen.show)
        session.look(window, View(front(session), SIZE, Look(exposure=session.exposure)))
        shown = screen.wait(lambda p: not p.moving).pixels[SIZE[1] // 2, SIZE[0] // 2]
        assert shown[0] > 200 and not shown[1:].any()
    finally:
        session.stop()


def test_exposures_suit_bright_and_dark_images():
    image = np.ones((10, 10, 3)) * 8
    assert picture.exposure_of(image) == -3
    assert picture.exposure_of(0 * image) == 0
    assert picture.exposure_of(1e9 * image) == picture.EXPOSURES[0]
