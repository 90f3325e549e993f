"""Render small scenes of all kinds, and compare the results bit by bit with those of another run.

    python -m experiments.robustness.identity.run FOLDER [--against OTHER_FOLDER] [--only PART]

Writes FOLDER/<scene>-<solver>.npy, one image for each solver that supports the scene, and
FOLDER/gradient-<case>-<parameter>.npy, gradients in `experiments.validation.gradients.cases`. With
``--against``, every image is compared with the one of the same name in OTHER_FOLDER; the script
prints the differences, and exits with 1 if there are any. To be run before and after a change that
must not affect results, for instance a refactoring, on the same machine with the same versions of
Mitsuba and Dr.Jit.
"""

from __future__ import annotations

import argparse
import gc
import re
import sys
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.performance.kinds import scenes as kinds
from experiments.support.options import begin
from experiments.validation.gradients.cases import CASES
from experiments.validation.gradients.differences import gradients, pixel_weights
from mitsuba_irrcache.errors import IrrcacheError

SIZE, SPP = 32, 4
SOLVERS = ("path", "sweep")
SMALL = {"resolution": 16, "cache_spp": 32}
#: Enough voxels for several multigrid levels, and for a kernel launch for each pair of ordinates.
FINE = {"resolution": 48, "solver": "sweep", "cache_spp": 32}
#: All AOVs.
AOVS = "colour, illumination, background, transmittance, depth, noise, bias"


def homogeneous(sigma_t: float, **more) -> dict:
    """Return a homogeneous medium in the cube [-1, 1]^3."""
    interior = {"type": "homogeneous", "sigma_t": sigma_t, "albedo": kinds.colour(0.95, 0.9, 0.8)}
    return {"box": kinds.box(interior | more)}


def cloud(*emitters: dict, **more) -> dict:
    """Return a heterogeneous medium with these emitters."""
    lights = {f"light{i}": emitter for i, emitter in enumerate(emitters)}
    return {"box": kinds.box(kinds.smoke(16, **more))} | lights


def apart(scale: float) -> dict:
    """Return two balls at opposite corners of the cube [-1, 1]^3, most of which is empty."""
    places = np.moveaxis(np.indices((48,) * 3) + 0.5, 0, -1) / 24 - 1
    distances = [np.linalg.norm(places - centre, axis=-1) for centre in (-0.6, 0.6)]
    density = np.clip(1.5 - 4 * np.minimum(*distances), 0, 1)[..., None]
    return {"box": kinds.box(kinds.medium(density, scale, (0.95, 0.9, 0.8)))}


def environment() -> dict:
    """Return an environment map that differs in all directions."""
    values = np.random.default_rng(1).uniform(0.1, 2.0, (8, 16, 3)).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(values)}


def spot() -> dict:
    """Return a spot light whose cone intersects the medium."""
    look = mi.ScalarTransform4f().look_at([-2.5, 1.5, -1.0], [0, 0, 0], [0, 1, 0])
    return {"type": "spot", "to_world": look, "cutoff_angle": 18.0, "intensity": 60.0}


def point() -> dict:
    """Return a point light."""
    return {"type": "point", "position": [1.4, 1.6, -0.8], "intensity": kinds.colour(9.0, 7.0, 5.0)}


def lamp() -> dict:
    """Return an area emitter above the medium."""
    area = {"emitter": {"type": "area", "radiance": 12.0}}
    return {"lamp": kinds.wall((0, 1.8, 0), (0, 0, 0.001), 0.5) | area}


def room() -> dict:
    """Return a room full of thin fog, with the camera inside."""
    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.9, "id": "fog"}
    reference = {"type": "ref", "id": "fog"}
    look = mi.ScalarTransform4f().look_at([0.3, 0.4, -1.2], [0, 0, 0.4], [0, 1, 0])
    walls = kinds.kind_room()
    del walls["box"]
    outside = kinds.box(reference, scale=(1.4, 1.4, 1.4))
    camera = kinds.sensor() | {"to_world": look, "fov": 70.0, "medium": reference}
    return {"fog": fog, "box": outside} | walls | {"sensor": camera}


def glass() -> dict:
    """Return a medium within glass, which no cache supports: Mitsuba's own integrator renders
    it.
    """
    inside = homogeneous(2.0)
    inside["box"]["bsdf"] = {"type": "dielectric"}
    return inside | {"sky": kinds.sky()}


def hg(g: float) -> dict:
    """Return a phase function."""
    return {"type": "hg", "g": g}


#: Scenes, and the integrator properties for them; ``spp`` is that of the image.
SCENES: dict[str, tuple[Callable[[], dict], dict]] = {
    "heterogeneous": (lambda: cloud(kinds.sky(), kinds.sun()), {}),
    "homogeneous": (lambda: homogeneous(2.0) | {"sky": kinds.sky()}, {}),
    "opaque": (
        lambda: homogeneous(3000.0) | {"sky": kinds.sky(), "sun": kinds.sun()},
        {"solver": "auto", "resolution": 0, "cache_spp": 0},
    ),
    "opaque_cached": (
        lambda: cloud(kinds.sky(), kinds.sun(), scale=400.0), {"quadrature": "trapezoid"},
    ),
    "chromatic": (lambda: cloud(kinds.sky(), scale=8.0, tint=np.array([0.1, 0.4, 1.0])), {}),
    "hg": (lambda: cloud(kinds.sky(), kinds.sun(), phase=hg(0.5)), {}),
    "sharp_hg": (lambda: cloud(kinds.sky(), kinds.sun(), phase=hg(0.8)), {}),
    "emission": (lambda: cloud(kinds.sky()), {"emission": 0.3, "quadrature": "riemann"}),
    "spot": (lambda: cloud(spot()), {}),
    "spot_hg": (lambda: cloud(spot(), point(), phase=hg(0.3)), {}),
    "point": (lambda: cloud(point()), {"max_depth": 2}),
    "environment": (lambda: cloud(environment()), {}),
    "area": (lambda: cloud() | lamp(), {}),
    "ground": (kinds.kind_ground, {}),
    "ground_hg": (kinds.kind_forward_ground, {}),
    "ground_single": (kinds.kind_ground, {"max_depth": 2}),
    "ground_hg_hidden": (kinds.kind_forward_ground, {"hide_emitters": True}),
    # samples enough for cached irradiance on surfaces
    "ground_cached": (kinds.kind_ground, {"spp": 32}),
    "ground_cached_hidden": (kinds.kind_ground, {"spp": 32, "hide_emitters": True}),
    "room": (room, {}),
    "implant": (kinds.kind_implant, {}),
    "two_media": (kinds.kind_two, {}),
    "glass": (glass, {}),
    "no_medium": (lambda: {"sky": kinds.sky(), "ball": {"type": "sphere"}}, {}),
    "images": (
        lambda: cloud(kinds.sky(), kinds.sun()), {"aovs": AOVS, "filter": "bilateral", "step": 0.5},
    ),
    "images_ground": (kinds.kind_ground, {"aovs": AOVS, "filter": "fixed", "hide_emitters": True}),
    "defaults": (kinds.kind_cloud, {"solver": "auto", "resolution": 0, "cache_spp": 0}),
    "fine": (lambda: cloud(kinds.sky(), kinds.sun()), FINE),
    "fine_chromatic": (lambda: cloud(kinds.sky(), scale=8.0, tint=np.array([0.1, 0.4, 1.0])), FINE),
    "fine_hg": (lambda: cloud(kinds.sky(), point(), phase=hg(0.5)), FINE),
    "fine_ground": (kinds.kind_ground, FINE),
    "fine_ground_hg": (kinds.kind_forward_ground, FINE),
    "fine_sparse": (lambda: apart(20.0) | {"sky": kinds.sky(), "sun": kinds.sun()}, FINE),
    "fine_dense": (lambda: apart(400.0) | {"sky": kinds.sky()}, FINE),
}  # fmt: skip


#: Cases of which gradients are computed.
GRADIENTS = (
    "sky",
    "sun, single",
    "point in the medium",
    "spot",
    "envmap with a bright spot",
    "coloured extinction",
    "empty voxels",
    "hg 0.6, coloured albedo",
    "hg 0.6, emission",
    "hg 0.6, radiance of sky and sun",
    "hg 0.3, intensity of a point",
    "hg 0.65, spot",
    "hg 0.65, coloured albedo",
    "hg 0.85, empty voxels",
)


def images(only: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and image of each scene with ``only`` in its name, for each solver."""
    for name, (build, properties) in SCENES.items():
        for solver in (properties.get("solver"),) if "solver" in properties else SOLVERS:
            title = f"{name}-{solver}"
            if only not in title:
                continue
            gc.collect()
            try:
                yield title, rendered(build(), SMALL | {"solver": solver} | properties)
            except IrrcacheError as error:
                print(f"{title}: not supported ({str(error)[:70]}...)", flush=True)


def derivatives(only: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and gradient of each case and parameter with ``only`` in its name."""
    for name in GRADIENTS:
        title = f"gradient-{re.sub('[^a-z0-9.]+', '_', name)}"
        if only not in title:
            continue
        gc.collect()
        scene = CASES[name].load()
        found = gradients(scene, CASES[name].parameters, pixel_weights(scene))
        for parameter, values in found.items():
            yield f"{title}-{parameter}", values


def rendered(objects: dict, properties: dict) -> np.ndarray:
    """Return an image with all channels."""
    properties = dict(properties)
    spp = properties.pop("spp", SPP)
    scene = {"type": "scene", "sensor": kinds.sensor()} | objects
    scene["sensor"]["film"] |= {"width": SIZE, "height": SIZE}
    scene["integrator"] = {"type": "irrcache", "rr_depth": 50} | properties
    loaded = mi.load_dict(scene)
    loaded.integrator().prepare(loaded)  # raises the original error, which mi.render would wrap
    return np.array(mi.render(loaded, spp=spp, seed=3))


def difference(image: np.ndarray, file: Path) -> str | None:
    """Describe how ``image`` differs from the one in ``file``; None if all bits agree."""
    if not file.exists():
        return "has no counterpart"
    other = np.load(file)
    if (other.shape, other.dtype) != (image.shape, image.dtype):
        return f"is {image.dtype} {image.shape}, not {other.dtype} {other.shape}"
    if image.tobytes() == other.tobytes():
        return None
    changed = np.count_nonzero(image != other)
    return (
        f"differs in {changed} of {image.size} values, by up to {np.abs(image - other).max():.2g}"
    )


def main() -> int:
    """Render, save and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where the images are saved")
    parser.add_argument("--against", type=Path, help="images to compare with")
    parser.add_argument("--only", default="", help="images with this in their names")
    args = parser.parse_args()
    begin()
    args.folder.mkdir(parents=True, exist_ok=True)
    names, changed = set(), 0
    for name, image in chain(images(args.only), derivatives(args.only)):
        names.add(name)
        np.save(args.folder / f"{name}.npy", image)
        found = args.against and difference(image, args.against / f"{name}.npy")
        changed += bool(found)
        print(f"{name}: {found or f'mean {np.nanmean(image):.6g}'}", flush=True)
    if args.against is None:
        return 0
    lost = sorted(
        file.stem
        for file in args.against.glob("*.npy")
        if args.only in file.stem and file.stem not in names
    )
    for name in lost:
        print(f"{name}: is no longer rendered")
    print(f"{len(names)} images, {changed} differ, {len(lost)} are missing")
    return 1 if changed or lost or not names else 0


if __name__ == "__main__":
    sys.exit(main())
