"""The viewer's reference is what ``volpath`` renders of the saved scene."""

from __future__ import annotations

import gc
import re
import weakref
from collections.abc import Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.view import comparison
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.document import Document, sensor_of
from mitsuba_irrcache.view.light import Light
from mitsuba_irrcache.view.reference import ViewReference, between
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import Picture, View
from tests.support.slow import with_slow
from tests.support.viewer_session import SCENE, SIZE, Screen, drag, front

pytestmark = pytest.mark.usefixtures("rgb")

GROUND = """<shape type="rectangle">
        <transform name="to_world"> <scale value="4"/> <translate z="-1.2"/> </transform>
        <bsdf type="diffuse"> <rgb name="reflectance" value="0.6, 0.5, 0.4"/> </bsdf>
    </shape>
</scene>"""
SCENES = {"cloud": SCENE, "cloud over the ground": SCENE.replace("</scene>", GROUND)}
#: Samples per pixel; 16 squares of pixels are compared at 4 standard errors
SAMPLES, SQUARES = 32, 4


@pytest.fixture
def document(request, tmp_path, scenes) -> Document:
    density = np.zeros((16, 16, 16, 1), np.float32)
    density[3:13, 3:13, 3:13] = scenes.texture((10, 10, 10, 1), 0.5, 6, 1)
    mi.VolumeGrid(density).write(str(tmp_path / "density.vol"))
    (tmp_path / "scene.xml").write_text(SCENES[getattr(request, "param", "cloud")])
    return Document.load(tmp_path / "scene.xml")


def front_camera() -> Camera:
    return Camera((0.5, -5.0, 1.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)


def reference_of(document: Document, camera: Camera, samples: int) -> ViewReference:
    light = Light(document.scene(), document.settings, document.march)
    found = ViewReference(light, camera, SIZE)
    while found.samples < samples:
        found.refine()
    return found


def squares(image: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    return image.reshape(SQUARES, height // SQUARES, SQUARES, width // SQUARES, 3).mean((1, 3))


@pytest.mark.parametrize(
    ("document", "position"),
    [
        pytest.param("cloud", (0.5, -5.0, 1.5), marks=pytest.mark.slow),
        ("cloud", (0.1, -0.4, 0.2)),
        ("cloud over the ground", (0.5, -5.0, 1.5)),
    ],
    indirect=["document"],
)
def test_reference_equals_volpath_of_the_saved_scene(document, tmp_path, position):
    """The reference agrees with volpath for cameras outside and inside of the medium."""
    camera = Camera(position, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)
    inside = position[1] > -1
    saved = tmp_path / "saved.xml"
    document.save(saved, sensor_of(camera, SIZE), inside, {}, "")
    scene = mi.load_file(str(saved))
    stock = mi.load_dict({"type": "volpath", "max_depth": document.settings.max_depth})
    several = [
        squares(np.array(mi.render(scene, integrator=stock, spp=SAMPLES // 4, seed=k)))
        for k in range(8)
    ]
    found = squares(reference_of(document, camera, SAMPLES).radiance())
    # The mean of the several images has half the variance of ours; 7 degrees of freedom, 48 values.
    error = np.sqrt(3 * np.var(several, axis=0, ddof=1) / 8)
    assert np.all(np.abs(found - np.mean(several, axis=0)) < 7 * error + 1e-6)
    assert np.abs(found.mean() / np.mean(several) - 1) < 0.02


def test_reported_error_excludes_the_reference_noise(document):
    """The reported error excludes the noise of the reference.

    An image with a known error is compared with few samples.
    """
    camera = front_camera()
    exact = reference_of(document, camera, 96).radiance()
    few = ViewReference(Light(document.scene(), document.settings, document.march), camera, SIZE)
    assert few.error_of(exact) is None
    while few.samples < 2:
        few.refine()
    off = 0.1 * exact.mean() * (-1) ** np.indices(exact.shape[:2]).sum(axis=0)[..., None]
    low, high = few.error_of(exact + off)
    noise = np.sqrt(((few.radiance() - exact) ** 2).mean()) / exact.mean()
    assert 0.06 < low < 0.1 < high < 0.14
    assert few.error_of(exact)[1] < 0.6 * noise


@pytest.mark.parametrize("true", [0.0, 0.3])
def test_noise_is_not_reported_as_an_error(document, true):
    """Bounds of the error hold for noise of few bright paths, whose channels are alike.

    They are two standard errors wide: one trial in forty may exceed each of them.
    """
    camera, rng = front_camera(), np.random.default_rng(1)
    few = ViewReference(Light(document.scene(), document.settings, document.march), camera, SIZE)
    few._passes, few._counts[:] = 2, 1
    image = np.ones((*few.size[::-1], 3)) + true * rng.choice([-1, 1], (*few.size[::-1], 1))
    found = []
    for _ in range(200):
        alike = (*few._sums.shape[:2], 1)
        few._sums[:] = rng.exponential(5, alike) * (rng.random(alike) < 0.2)
        found.append(few.error_of(image))
    low, high = np.array(found).T
    assert np.mean(low > true) < 0.05 and np.mean(high < true) < 0.05
    assert np.mean(high < 2 * low) < 0.05 or true


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (0.0, 0.213, "below 21 %"),
        (0.01, 0.03, "below 3 %"),
        (0.0118, 0.0126, "1.22 ± 0.04 %"),
        (0.12, 0.2, "16 ± 4 %"),
    ],
)
def test_errors_are_described_with_their_uncertainty(low, high, text):
    assert between(low, high) == text


def test_reference_is_displayed_until_something_changes(document, monkeypatch):
    """The reference is shown with the image's error until camera or scene change.

    It is the same image; while a camera moves there is none.
    """
    monkeypatch.setattr(comparison, "PASS_SECONDS", np.inf)  # on a busy machine, too
    session = Session(document)
    session.target_error = 0.02
    session.start()
    try:
        screen = Screen()
        window = session.open(screen.show)
        view = View(front(session), SIZE, compared="swipe")
        session.look(window, view)
        picture = screen.wait(lambda p: "RMSE" in _text(p) and _samples(p) >= 16)
        ours = picture.pixels.astype(float)
        theirs = picture.compared.reference.astype(float)
        assert ours.shape == theirs.shape  # the window is small: pixel by pixel
        assert ours.std() > 20 and np.abs(ours.mean() - theirs.mean()) < 3
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.95
        session.look(window, replace(view, compared="error"))
        picture = screen.wait(lambda p: p.compared is not None and p.compared.error is not None)
        assert _samples(picture) >= 16 and picture.compared.limit < 1
        assert np.array_equal(picture.pixels, picture.compared.error)
        session.look(window, view)
        count = len(screen.pictures)
        drag(session, window, view, lambda: any(p.moving for p in screen.pictures[count:]))
        screen.wait(lambda p: p.view.camera != view.camera and "RMSE" in _text(p))
        assert next(p for p in screen.pictures[count:] if p.moving).compared is None
        other = [p for p in screen.pictures[count:] if p.view.camera != view.camera]
        assert _samples(next(p for p in other if _samples(p))) < 8
        count = len(screen.pictures)
        session.edit(lambda document: document.set_density(0.5))
        screen.wait(lambda p: len(screen.pictures) > count + 3 and "RMSE" in _text(p))
        assert min(_samples(p) for p in screen.pictures[count:] if _samples(p)) < 8
    finally:
        session.stop()
        dr.sync_thread()


def test_coarse_references_are_means_over_pixels(document):
    """A coarse reference is the finer one, averaged over the pixels that it covers."""
    camera = front_camera()
    light = Light(document.scene(), document.settings, document.march)
    fine, coarse = ViewReference(light, camera, SIZE), ViewReference(light, camera, SIZE, 3)
    for reference, samples in ((fine, 24), (coarse, 96)):
        while reference.samples < samples:
            reference.refine()
    assert coarse.size == (SIZE[0] // 3, SIZE[1] // 3)
    assert coarse.error_of(fine.radiance())[0] < 0.03
    assert abs(coarse.signed_error(1.1 * fine.radiance()).mean() - 0.1) < 0.02
    # What is left between two means of the same is their noise.
    spread = coarse.signed_error(fine.radiance()).std()
    assert spread == pytest.approx(np.hypot(coarse.noise, fine.noise / 3), rel=0.2)


@pytest.mark.parametrize(
    "document", with_slow(list(SCENES), "cloud over the ground"), indirect=True
)
def test_previous_caches_are_freed(document, uncollected):
    """Previous caches are freed with their medium after an edit, also in windows with a
    reference.
    """
    session = Session(document)
    session.target_error = 0.05
    session.start()
    try:
        screen = Screen()
        window = session.open(screen.show)
        view = View(front(session), SIZE)
        session.look(window, replace(view, compared="swipe"))
        screen.wait(lambda p: "RMSE" in _text(p))
        session.look(window, view)
        screen.wait(lambda p: p.view == view)
        light = session.call(lambda: weakref.ref(session.light))
        medium = session.call(lambda: weakref.ref(session.light.parts[0].medium))
        assert light() is not None and medium() is not None
        count = len(screen.pictures)
        session.edit(lambda document: document.set_density(0.5))
        screen.wait(lambda p: len(screen.pictures) > count + 1 and p.final)
        assert session.call(lambda: (light(), medium())) == (None, None)
    finally:
        session.stop()
        dr.sync_thread()


@pytest.fixture
def uncollected() -> Iterator[None]:
    """Disable garbage collection, which rarely runs in a large program."""
    gc.disable()
    yield
    gc.enable()


def _text(picture: Picture) -> str:
    """Return what is said about the reference, "" if there is none."""
    return picture.compared.text if picture.compared else ""


def _samples(picture: Picture) -> int:
    """Return the reported samples of the reference, 0 before the first."""
    found = re.search(r"volpath, (\d+) sample", _text(picture))
    return int(found[1]) if found else 0
