"""Shapes that disagree about which medium is where are refused, and no others."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.consistency import check_media_agree

pytestmark = pytest.mark.usefixtures("rgb")

NULL, GLASS = {"type": "null"}, {"type": "dielectric"}


def fog(extinction: float = 1.0) -> dict:
    """Return a homogeneous medium; Mitsuba would merge equal ones."""
    return {"type": "homogeneous", "sigma_t": extinction}


def bound(kind: str, place: np.ndarray, interior: dict, **more) -> dict:
    to_world = mi.ScalarTransform4f(place)
    return {"type": kind, "to_world": to_world, "bsdf": NULL, "interior": interior} | more


def scaled(center=(0, 0, 0), size: float = 1.0) -> np.ndarray:
    place = np.diag([size, size, size, 1.0])
    place[:3, 3] = center
    return place


def load(**objects) -> mi.Scene:
    look = mi.ScalarTransform4f().look_at([1, 1.5, -7], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "to_world": look}
    return mi.load_dict({"type": "scene", "sensor": sensor} | objects)


def refusal(scene: mi.Scene) -> str:
    """Return the message with which a scene is refused; empty if it is accepted."""
    try:
        check_media_agree(scene)
    except UnsupportedSceneError as error:
        return str(error)
    return ""


class Body:
    """A cube or a sphere at a random position."""

    def __init__(self, rng: np.random.Generator, size: float, reach: float) -> None:
        self.kind = rng.choice(["cube", "sphere"])
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.linalg.det(rotation)
        scale = size * rng.uniform(0.4, 1.0, 3 if self.kind == "cube" else 1)
        self.place = np.eye(4)
        self.place[:3, :3] = rotation * scale
        self.place[:3, 3] = rng.uniform(-reach, reach, 3)

    def local(self, points: np.ndarray) -> np.ndarray:
        return (points - self.place[:3, 3]) @ np.linalg.inv(self.place[:3, :3]).T

    def inside(self, points: np.ndarray, size: float = 1.0) -> np.ndarray:
        """Return whether points are in the body enlarged by this factor."""
        order = np.inf if self.kind == "cube" else 2
        return np.linalg.norm(self.local(points), ord=order, axis=1) < size

    def points(self, rng: np.random.Generator, count: int = 20000) -> np.ndarray:
        """Return points evenly distributed in the body."""
        local = rng.uniform(-1, 1, (4 * count, 3))
        points = local @ self.place[:3, :3].T + self.place[:3, 3]
        return points[self.inside(points)][:count]


@pytest.mark.parametrize("seed", range(24))
def test_random_pairs(seed):
    """Random pairs of bodies are accepted or refused according to their overlap.

    Disjoint ones are accepted; overlapping ones are refused with both media by name; one inside the
    other is accepted if and only if its exterior is the outer medium.
    """
    rng = np.random.default_rng(seed)
    share = np.nan
    while np.isnan(share):  # until their relation is clear from the points
        a, b = Body(rng, 1.2, 0.0), Body(rng, [0.15, 0.5, 1.2][seed % 3], [0.4, 1.6][seed % 2])
        points = b.points(rng)
        least, share, most = (a.inside(points, size).mean() for size in (0.97, 1.0, 1.03))
        if not (most == 0 or least == 1 or 0.002 < share < 0.98):
            share = np.nan
    media = {"A": fog(1.0), "B": fog(2.0)}
    refs = {name: {"type": "ref", "id": name} for name in media}
    bodies = {
        "a": bound(a.kind, a.place, refs["A"]), "b": bound(b.kind, b.place, refs["B"]),
    }  # fmt: skip
    message = refusal(load(**media, **bodies))
    if share == 0:
        assert not message
        return
    assert '"A"' in message and '"B"' in message and "exterior" in message, message
    bodies["b"]["exterior"] = refs["A"]
    declared = refusal(load(**media, **bodies))
    assert (declared == "") == (share == 1), (share, declared)


def tin(bsdf: dict, **more) -> dict:
    """Return a cylinder and two disks, which only together bound the medium "A"."""
    lid = np.diag([1.0, -1.0, -1.0, 1.0])
    top, base, side = scaled((0, 0, 1)), scaled((0, 0, -1)) @ lid, np.diag([1.0, 1.0, 2.0, 1.0])
    side[2, 3] = -1
    parts = {"side": ("cylinder", side), "top": ("disk", top), "base": ("disk", base)}
    medium = {"type": "ref", "id": "A"}
    return {"A": fog()} | {
        name: bound(kind, place, medium, **more) | {"bsdf": bsdf}
        for name, (kind, place) in parts.items()
    }


def wall(height: float) -> dict:
    turned = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(5)
    return {"type": "rectangle", "to_world": turned}


ACCEPTED = {
    "glass tin of three shapes": lambda: tin(GLASS),
    "null tin of three shapes": lambda: tin(NULL),
    "cube 1e-4 above the ground": lambda: {
        "a": bound("cube", scaled(), fog()), "ground": wall(-1.0001)},
    "cube through the ground": lambda: {
        "a": bound("cube", scaled(), fog()), "ground": wall(-0.4)},
    "another shape at the centre": lambda: {
        "a": bound("cube", scaled(), fog()), "b": {"type": "sphere", "radius": 0.3}},
    "opaque balls that overlap, with the fog as their exterior": lambda: {
        "A": fog(), "a": bound("cube", scaled(size=2), {"type": "ref", "id": "A"}),
        "b": {"type": "sphere", "exterior": {"type": "ref", "id": "A"}},
        "c": {"type": "sphere", "center": [0.7, 0, 0], "exterior": {"type": "ref", "id": "A"}}},
    "glass ball in fog": lambda: {
        "a": bound("cube", scaled(size=2), fog()), "b": {"type": "sphere", "bsdf": GLASS}},
    "sphere that touches its cube from within": lambda: {
        "A": fog(), "a": bound("cube", scaled(), {"type": "ref", "id": "A"}),
        "b": bound("sphere", scaled(), fog(2.0), exterior={"type": "ref", "id": "A"})},
    "gap of a thousandth": lambda: {
        "a": bound("cube", scaled(), fog()), "b": bound("cube", scaled((2.002, 0, 0)), fog(2.0))},
}  # fmt: skip


@pytest.mark.parametrize("build", ACCEPTED.values(), ids=ACCEPTED)
def test_consistent_scenes_are_accepted(build):
    check_media_agree(load(**build()))


def without(objects: dict, name: str) -> dict:
    return {k: v for k, v in objects.items() if k != name}


REFUSED = {
    "tin without its base": (lambda: without(tin(NULL), "base"), "disagree|not closed"),
    "glass tin without its top": (lambda: without(tin(GLASS), "top"), "disagree|not closed"),
    "cylinder": (lambda: without(without(tin(NULL), "base"), "top"), '"side".*not closed'),
    "mirrored cube": (
        lambda: {"box": bound("cube", np.diag([-1.0, 1, 1, 1]), fog())}, 'normals.*"box".*inwards',
    ),
    "mirrored cube with a ball at its centre": (
        lambda: {"box": bound("cube", np.diag([-1.0, 1, 1, 1]), fog()),
                 "ball": {"type": "sphere", "radius": 0.3}}, 'normals.*"box".*inwards',
    ),
    "mirrored cube near walls": (
        lambda: {"box": bound("cube", np.diag([-1.0, 1, 1, 1]), fog()), "g": wall(-1.0001)},
        'normals.*"box".*inwards',
    ),
    "common face": (
        lambda: {"a": bound("cube", scaled(), fog()),
                 "b": bound("cube", scaled((2, 0, 0)), fog(2.0))}, '"a".*"b".*|"b".*"a".*',
    ),
    "gap below the offset of rays": (
        lambda: {"a": bound("cube", scaled(), fog()),
                 "b": bound("cube", scaled((2.0001, 0, 0)), fog(2.0))}, "closer.*Move",
    ),
    "tiny body within a large one": (
        lambda: {"a": bound("cube", scaled(), fog()),
                 "b": bound("cube", scaled(size=0.02), fog(2.0))}, "exterior",
    ),
    "glass with a medium in fog, no exterior": (
        lambda: {"a": bound("cube", scaled(size=2), fog()),
                 "b": {"type": "sphere", "bsdf": GLASS, "interior": fog(2.0)}}, "exterior",
    ),
    "exterior that is bounded elsewhere": (
        lambda: {"A": fog(), "a": bound("cube", scaled((4, 0, 0)), {"type": "ref", "id": "A"}),
                 "b": {"type": "sphere", "exterior": {"type": "ref", "id": "A"}}}, '"b".*exterior',
    ),
}  # fmt: skip


@pytest.mark.parametrize(("build", "message"), REFUSED.values(), ids=REFUSED)
def test_contradictions_are_refused(build, message):
    """Contradictions are refused with a remedy: to move, close, mirror or declare something."""
    with pytest.raises(UnsupportedSceneError, match=f"(?s){message}") as caught:
        check_media_agree(load(**build()))
    assert "volpath" in str(caught.value)


@pytest.mark.parametrize(("place", "named", "warns"), [(0, False, 1), (0, True, 0), (5, False, 0)])
def test_sensors_in_media_that_they_do_not_name_are_noted(scenes, monkeypatch, place, named, warns):
    """Their images lacked the medium in front of surfaces, without a word."""
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5, "id": "fog"}
    to_world = mi.ScalarTransform4f().look_at([0, 0, -place], [0, 0.1, 1], [0, 1, 0])
    sensor = {"type": "perspective", "to_world": to_world, "id": "eye"}
    if named:
        sensor["medium"] = {"type": "ref", "id": "fog"}
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "fog"}}
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.2}
    compile_scene(
        mi.load_dict({"type": "scene", "fog": fog, "eye": sensor, "box": box, "ball": ball})
    )
    assert sum('"eye" is located in medium "fog"' in text for text in messages) == warns


def cut_by_a_near_plane(near: float, named: bool) -> dict:
    """A cube of fog that the plane of a sensor at distance ``near`` may cut."""
    to_world = mi.ScalarTransform4f().look_at([0, 0, -5], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "to_world": to_world, "near_clip": near, "fov": 30.0}
    sensor["id"] = "eye"
    if named:
        sensor["medium"] = {"type": "ref", "id": "fog"}
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 45)
    box = bound("cube", turned.matrix, {"type": "ref", "id": "fog"})
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.2}
    return {"medium": fog() | {"id": "fog"}, "box": box, "eye": sensor, "ball": ball}


@pytest.mark.parametrize(("near", "warns"), [(4.0, 1), (3.0, 0)])
def test_near_planes_that_cut_a_medium_are_noted(scenes, monkeypatch, near, warns):
    """A part of the image lacked the medium between near plane and surfaces, without a word."""
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    compile_scene(load(**cut_by_a_near_plane(near, named=False)))
    assert sum('near plane of sensor "eye" lies in medium "fog"' in m for m in messages) == warns


def test_near_planes_that_leave_the_medium_of_the_sensor_are_refused():
    with pytest.raises(UnsupportedSceneError, match=r'"eye".*of its rays begin outside.*near_clip'):
        compile_scene(load(**cut_by_a_near_plane(4.7, named=True)))
