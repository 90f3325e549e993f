"""Each property of each plugin that can change the radiance changes the scene's digest."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import CacheFileError
from mitsuba_irrcache.scene.fingerprint import (
    BEAMS,
    RESPONSES,
    beams,
    differing,
    digest_of_emitters,
    digest_of_surfaces,
    responses,
)

pytestmark = pytest.mark.usefixtures("rgb")


def turn():
    return mi.ScalarTransform4f().rotate([0.3, 1, 0.2], 40)


def unplaced():
    return mi.ScalarTransform4f()


def uv():
    return mi.ScalarTransform3f().scale([2, 3])


def pixels(seed: int = 1):
    values = np.random.default_rng(seed).uniform(0.1, 0.9, (4, 8, 3))
    return mi.Bitmap(values.astype(np.float32))


def bitmap(**properties):
    return {"type": "bitmap", "bitmap": pixels()} | properties


RED = {"type": "rgb", "value": [0.5, 0.2, 0.1]}
EMITTERS = {
    "constant": ({}, {"radiance": RED}),
    "directional": (
        {"direction": [0.2, -1, 0.1]},
        {"direction": [0.3, -1, 0.1], "irradiance": RED},
    ),
    "directional placed": (lambda: {"to_world": unplaced()}, {"to_world": turn}),
    "envmap": (
        lambda: {"bitmap": pixels()},
        {"bitmap": lambda: pixels(2), "scale": 2.0, "to_world": turn},
    ),
    "point": ({"position": [0, 0, 3]}, {"position": [0, 0, 4], "intensity": RED}),
    "spot": (
        {},
        {
            "intensity": RED,
            "cutoff_angle": 30.0,
            "beam_width": 10.0,
            "texture": bitmap,
            "to_world": turn,
        },
    ),
    "projector": (
        lambda: {"irradiance": bitmap()},
        {
            "irradiance": lambda: bitmap(bitmap=pixels(2)),
            "scale": 2.0,
            "fov": 20.0,
            "to_world": turn,
        },
    ),
    "sunsky": (
        {},
        {
            "turbidity": 5.0,
            "albedo": 0.7,
            "sun_direction": [0.5, 0.5, 0.5],
            "hour": 10.0,
            "day": 3,
            "month": 2,
            "year": 2020,
            "latitude": 10.0,
            "longitude": 10.0,
            "timezone": 3.0,
            "minute": 20.0,
            "second": 50.0,
            "sun_scale": 0.5,
            "sky_scale": 0.5,
            "sun_aperture": 2.0,
            "complex_sun": True,
            "to_world": turn,
        },
    ),
}

SURFACE_EMITTERS = {
    "area": ({}, {"radiance": RED}),
    "directionalarea": ({}, {"radiance": RED}),
}

_ROUGHNESS = {"alpha": 0.35, "distribution": "ggx", "sample_visible": False}
_ANISOTROPY = ({"alpha_u": 0.1, "alpha_v": 0.1}, {"alpha_u": 0.3, "alpha_v": 0.3})
_METAL = {"material": "Au", "eta": 1.7, "k": 2.5, "specular_reflectance": RED}
_GLASS = {
    "int_ior": 1.8,
    "ext_ior": 1.2,
    "specular_reflectance": RED,
    "specular_transmittance": RED,
}
_PLASTIC = {
    "diffuse_reflectance": RED,
    "nonlinear": True,
    "int_ior": 1.8,
    "ext_ior": 1.2,
    "specular_reflectance": RED,
}
_BLEND = {"weight": 0.3, "a": {"type": "diffuse"}, "b": {"type": "conductor"}}
_NESTED = {"nested": {"type": "diffuse"}}

BSDFS = {
    "diffuse": ({}, {"reflectance": RED}),
    "dielectric": ({}, _GLASS),
    "thindielectric": ({}, _GLASS),
    "roughdielectric": ({}, _GLASS | _ROUGHNESS),
    "conductor": ({}, _METAL),
    "roughconductor": ({}, _METAL | _ROUGHNESS),
    "roughconductor anisotropic": _ANISOTROPY,
    "roughdielectric anisotropic": _ANISOTROPY,
    "plastic": ({}, _PLASTIC),
    "roughplastic": ({}, _PLASTIC | _ROUGHNESS),
    "principled": (
        {},
        {
            "base_color": RED,
            "roughness": 0.2,
            "anisotropic": 0.3,
            "metallic": 0.3,
            "spec_trans": 0.3,
            "eta": 1.8,
            "specular": 0.9,
            "spec_tint": 0.3,
            "sheen": 0.3,
            "sheen_tint": 0.3,
            "flatness": 0.3,
            "clearcoat": 0.3,
            "clearcoat_gloss": 0.3,
        },
    ),
    "principledthin": (
        {},
        {
            "base_color": RED,
            "roughness": 0.2,
            "anisotropic": 0.3,
            "spec_trans": 0.3,
            "eta": 1.8,
            "spec_tint": 0.3,
            "sheen": 0.3,
            "sheen_tint": 0.3,
            "flatness": 0.3,
            "diff_trans": 0.7,
        },
    ),
    "hair": (
        {},
        {
            "eumelanin": 2.0,
            "pheomelanin": 2.0,
            "longitudinal_roughness": 0.5,
            "azimuthal_roughness": 0.5,
            "scale_tilt": 5.0,
            "int_ior": 1.8,
            "ext_ior": 1.2,
        },
    ),
    "twosided": (
        _NESTED,
        {"nested": {"type": "diffuse", "reflectance": RED}, "back": {"type": "conductor"}},
    ),
    "mask": (_NESTED, {"opacity": 0.7, "nested": {"type": "conductor"}}),
    "blendbsdf": (_BLEND, {"weight": 0.6, "a": {"type": "conductor"}, "b": {"type": "diffuse"}}),
    "bumpmap": (
        lambda: _NESTED | {"map": bitmap(raw=True)},
        {
            "map": lambda: bitmap(raw=True, bitmap=pixels(2)),
            "scale": 2.0,
            "flip_invalid_normals": False,
            "use_shadowing_function": False,
        },
    ),
    "normalmap": (
        lambda: _NESTED | {"normalmap": bitmap(raw=True)},
        {
            "normalmap": lambda: bitmap(raw=True, bitmap=pixels(2)),
            "flip_invalid_normals": False,
            "use_shadowing_function": False,
        },
    ),
    "null": ({}, {}),
}

TEXTURES = {
    "bitmap": (
        lambda: {"bitmap": pixels()},
        {
            "bitmap": lambda: pixels(2),
            "filter_type": "nearest",
            "wrap_mode": "clamp",
            "raw": True,
            "to_uv": uv,
        },
    ),
    "checkerboard": ({}, {"color0": RED, "color1": RED, "to_uv": uv}),
    "uniform": ({"value": 0.2}, {"value": 0.3}),
    "mesh_attribute": ({"name": "vertex_color"}, {"name": "vertex_other", "scale": 2.0}),
    "volume": (
        lambda: {"volume": {"type": "constvolume", "value": 0.5}},
        {"volume": {"type": "constvolume", "value": 0.6}},
    ),
}

_PLACED = {"to_world": turn, "flip_normals": True}
SHAPES = {
    "cube": ({}, _PLACED),
    "rectangle": ({}, _PLACED),
    "disk": ({}, _PLACED),
    "sphere": ({}, _PLACED | {"center": [0.1, 0, 0], "radius": 0.7}),
    "cylinder": ({}, _PLACED | {"p0": [0, 0, -1], "p1": [0, 0, 2], "radius": 0.7}),
    "sdfgrid": (
        lambda: {"grid": mi.TensorXf(np.random.default_rng(1).uniform(-1, 1, (4, 4, 4, 1)))},
        {
            "grid": lambda: mi.TensorXf(np.random.default_rng(2).uniform(-1, 1, (4, 4, 4, 1))),
            "normals": "analytic",
            "to_world": turn,
        },
    ),
}


MESHES = {
    "ply": ({"filename": "a.ply"}, {"filename": "b.ply", "flip_tex_coords": True}),
    "obj": ({"filename": "a.obj"}, {"filename": "b.obj", "flip_tex_coords": False}),
}
_MESH = _PLACED | {"face_normals": True}
SHAPES |= {name: (base, _MESH | own) for name, (base, own) in MESHES.items()}

GROUPS = {
    "emitter": EMITTERS,
    "surface emitter": SURFACE_EMITTERS,
    "bsdf": BSDFS,
    "texture": TEXTURES,
    "shape": SHAPES,
}
CASES = [
    (group, plugin, name)
    for group, plugins in GROUPS.items()
    for plugin, (_, properties) in plugins.items()
    for name in properties
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with two meshes with vertex normals and texture coordinates, in two
    formats.
    """
    path = tmp_path_factory.mktemp("meshes")
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    for name, size in (("a", 1), ("b", 2)):
        (path / f"{name}.obj").write_text(
            f"v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nvt 0 0\nvt 1 0\nvt 0 0.5\n"
            "vn 0 0.2 1\nvn 0.1 0 1\nvn 0 0 1\nf 1/1/1 2/2/2 3/3/3\n"
        )
        mi.load_dict({"type": "obj", "filename": str(path / f"{name}.obj")}).write_ply(
            str(path / f"{name}.ply")
        )
    return path


def called(value):
    return value() if callable(value) else value


def loaded(folder, group: str, plugin: str, changes: dict) -> mi.Scene:
    """Load a scene with this plugin, its initial properties and the ``changes``."""
    base, _ = GROUPS[group][plugin]
    properties = called(base) | {name: called(value) for name, value in changes.items()}
    if "filename" in properties:
        properties |= {"filename": str(folder / properties["filename"])}
    node = {"type": plugin.split()[0]} | properties
    if group == "texture":
        node = {"type": "diffuse", "reflectance": node}
    if group in ("texture", "bsdf"):
        node = {"type": "rectangle", "bsdf": node}
    if group == "surface emitter":
        node = {"type": "rectangle", "emitter": node}
    return mi.load_dict({"type": "scene", "object": node})


def digest(scene: mi.Scene) -> dict[str, str]:
    """Return the digest of the parts that need no kernel."""
    return {"emitters": digest_of_emitters(scene), "surfaces": digest_of_surfaces(scene)}


@pytest.mark.parametrize(("group", "plugin", "name"), CASES, ids=[" ".join(case) for case in CASES])
def test_every_property_changes_a_digest(folder, group, plugin, name):
    _, properties = GROUPS[group][plugin]
    changes = {}, {name: properties[name]}
    before, after = (loaded(folder, group, plugin, c) for c in changes)
    if digest(before) == digest(after):
        assert differing({RESPONSES: responses(before)}, {RESPONSES: responses(after)})


@pytest.mark.parametrize("group", GROUPS)
def test_the_same_scene_has_the_same_digests(folder, group):
    for plugin in GROUPS[group]:
        first, second = (digest(loaded(folder, group, plugin, {})) for _ in range(2))
        assert first == second, plugin


@pytest.mark.parametrize("change", [{"filter_type": "nearest"}, {"wrap_mode": "mirror"}])
@pytest.mark.parametrize(("plugin", "name"), [("spot", "texture"), ("projector", "irradiance")])
def test_options_of_the_texture_of_a_beam_change_a_digest(plugin, name, change):
    """They change the light in isolated media, too, where no ray hits a surface."""
    texels = np.random.default_rng(2).random((4, 4, 3), np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    bitmap["to_uv"] = mi.ScalarTransform4f().scale([1.5, 1.5, 1])
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    found = []
    for texture in (bitmap, bitmap, bitmap | change):
        emitter = {"type": plugin, "to_world": look, name: texture}
        scene = mi.load_dict({"type": "scene", "shape": {"type": "cube"}, "emitter": emitter})
        found.append({BEAMS: beams(scene)})
    assert differing(found[0], found[1]) == []
    assert differing(found[0], found[2]) == [BEAMS]


def test_digests_ignore_names_and_order():
    objects = [
        {"type": "cube", "to_world": mi.ScalarTransform4f().translate([4, 0, 0])},
        {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": RED}},
        {"type": "point", "position": [0, 0, 3]},
        {"type": "point", "position": [0, 0, 4]},
    ]
    one = {f"{n}": o for n, o in enumerate(objects)}
    other = {f"other_{n}": o for n, o in enumerate(reversed(objects))}
    first, second = (mi.load_dict({"type": "scene"} | o) for o in (one, other))
    assert digest(first) == digest(second)
    assert differing({RESPONSES: responses(first)}, {RESPONSES: responses(second)}) == []


LIT_BY_A_LAMP = {
    "type": "rectangle",
    "to_world": [[1, 0, 0, 0], [0, 0, -1, 3], [0, 1, 0, 0], [0, 0, 0, 1]],
    "bsdf": {"type": "diffuse"},
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}},
}


@pytest.mark.parametrize(
    "change",
    [
        {"flip_normals": True},
        {"bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
        {"bsdf": {"type": "diffuse", "reflectance": 0.1}},
        {"emitter": {"type": "area", "radiance": 2.0}},
    ],
    ids=["flipped", "two-sided", "another BSDF", "another radiance"],
)
def test_cache_files_of_other_scenes_are_refused(scenes, tmp_path_factory, change):
    """The cache file of a scene is refused after its emitter was turned around.

    Such an emitter does not illuminate the medium, so the image with the old file would be too
    bright.
    """
    lamp = LIT_BY_A_LAMP | {"to_world": mi.ScalarTransform4f(LIT_BY_A_LAMP["to_world"])}
    file = tmp_path_factory.getbasetemp() / "lamp.cache"
    settings = {"type": "irrcache", "resolution": 2, "cache_spp": 8, "cache_file": str(file)}
    shape = scenes.boundary(scenes.medium(1.0, 0.8))
    if not file.exists():
        first = scenes.load(settings, shape, emitter=lamp, default_solver="path")
        first.integrator().prepare(first)
    same = scenes.load(settings | {"cache_spp": 16}, shape, emitter=lamp, default_solver="path")
    same.integrator().prepare(same)  # continues the file
    assert same.integrator().cache.streams == {0: 16}
    other = scenes.load(settings, shape, emitter=lamp | change, default_solver="path")
    with pytest.raises(CacheFileError, match=r"surfaces|emitters"):
        other.integrator().prepare(other)


@pytest.mark.parametrize("position", [[0, 0, 4], [0, 3, 0]], ids=str)
def test_digests_include_the_position_of_a_point_light(scenes, tmp_path, position):
    """The digest depends on the position of a point light.

    Mitsuba's points have an attribute ``matrix``, a swizzle that is zero for all positions.
    """
    file = tmp_path / "light.cache"
    settings = {"type": "irrcache", "resolution": 2, "cache_spp": 8, "cache_file": str(file)}
    shape = scenes.boundary(scenes.medium(1.0, 0.8))

    def prepare(place):
        scene = scenes.load(
            settings, shape, emitter={"type": "point", "position": place}, default_solver="path"
        )
        scene.integrator().prepare(scene)

    prepare([0, 0, 3])
    with pytest.raises(CacheFileError, match="emitters"):
        prepare(position)
