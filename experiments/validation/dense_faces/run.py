"""Dense cubes under a uniform environment: faces against a half-space, and whole images.

    python -m experiments.validation.dense_faces.run [--document FILE]

The middle of a face is seen at two cosines to its normal, with voxels of several optical depths,
with and without the profile of the irradiance at dense faces (docs/primer, eq. (2.13)). Radiance
emerges from a half-space, in units of the environment's, as (a / 2) (1 - mu ln(1 + 1 / mu)) with
single scattering, and as 1 - sqrt(1 - a) H(mu) with all orders (Chandrasekhar, *Radiative
Transfer*, 1950). The first table has the differences in %, without and with the profile.

The second table has images of whole cubes at default settings, without the environment in view,
against single scattering that is sampled along camera rays without a cache, or (all orders) a cache
of 192 voxels along each axis, in means over 4 x 4 pixels.
"""

from __future__ import annotations

from unittest import mock

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.pipeline import cached_medium, defaults

VOXELS, PIXELS, SPP = 48, 16, 256
UNIFORM = {"type": "constant", "radiance": 1.0}
DEPTHS, COSINES = (0.5, 1.0, 2.0), (1.0, 0.5)
#: Albedo and ``max_depth``.
CASES = ((0.8, 2), (0.5, -1), (0.8, -1), (0.95, -1))
CUBE_CASES = ((0.8, 2), (0.5, -1), (0.95, -1))
HEAD = ["scattering", "albedo", "cosine", *(f"depth {d:g} per voxel" for d in DEPTHS)]
#: Optical depths of cubes, pixels of their images and of an edge of a block; samples per pixel of
#: irrcache and volpath, and voxels along an edge of the fine cache.
CUBES, CUBE_PIXELS, BLOCK = (10.0, 30.0, 100.0), 32, 4
CUBE_SPP, REFERENCE_SPP, FINE = 256, 4096, 192
CUBE_HEAD = [
    "scattering", "albedo", "depth", "voxels", "without: mean [%]", "RMSE [%]", "largest block [%]",
    "with: mean", "RMSE", "largest block",
]  # fmt: skip


def half_space_h(albedo: float, mu: float) -> float:
    """Return Chandrasekhar's H function, by iteration of its integral equation."""
    x, w = np.polynomial.legendre.leggauss(200)
    x, w = 0.5 * (x + 1), 0.5 * w
    h, lost = np.ones_like(x), np.sqrt(1 - albedo)
    for _ in range(500):
        h = 1 / (lost + 0.5 * albedo * (w * x * h / (x[:, None] + x)).sum(axis=1))
    return float(1 / (lost + 0.5 * albedo * (w * x * h / (mu + x)).sum()))


def radiance(albedo: float, max_depth: int, mu: float) -> float:
    """Return the radiance of the half-space at the cosine ``mu``, in units of the environment's."""
    if max_depth == 2:
        return float(0.5 * albedo * (1 - mu * np.log(1 + 1 / mu)))
    return float(1 - np.sqrt(1 - albedo) * half_space_h(albedo, mu))


def cube(depth: float, albedo: float, homogeneous: bool = False, shape: str = "cube") -> dict:
    """Return the cube [-1, 1]^3 with this optical depth along an edge, with a grid of equal values
    or ``homogeneous``; or another ``shape`` of the same size.
    """
    if homogeneous:
        medium = {"type": "homogeneous", "sigma_t": 0.5 * depth, "albedo": albedo}
        return {"type": shape, "bsdf": {"type": "null"}, "interior": medium}
    values = np.full((2, 2, 2, 1), 0.5 * depth, np.float32)
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "to_world": place, "raw": True}
    medium = {"type": "heterogeneous", "sigma_t": volume, "albedo": albedo}
    return {"type": shape, "bsdf": {"type": "null"}, "interior": medium}


def rendered(depth: float, albedo: float, max_depth: int, mu: float) -> float:
    """Return the mean radiance of the middle of a face of a cube whose voxels have this depth."""
    solver = {"type": "irrcache", "solver": "sweep", "resolution": VOXELS}
    image = face(solver | {"max_depth": max_depth}, cube(depth * VOXELS, albedo), mu, SPP)
    return float(image.mean())


def face(
    integrator: dict,
    body: dict,
    mu: float,
    spp: int,
    environment: dict | None = None,
    half: float = 1.0,
    shift: float = 0.0,
) -> np.ndarray:
    """Return an image of the middle of a face of a cube, seen at a cosine, in an ``environment``
    (None: uniform radiance).

    ``half`` is half an edge of the cube, ``shift`` the coordinate x of its centre.
    """
    middle = np.array([shift, 0.0, -half])
    origin = middle + 4 * half * np.array([np.sqrt(1 - mu * mu), 0, -mu])
    camera = mi.ScalarTransform4f().look_at(list(origin), list(middle), [0, 1, 0])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": integrator | {"hide_emitters": True},
        "sensor": {"type": "orthographic", "to_world": camera.scale(0.4 * half), "film": film},
        "environment": environment or UNIFORM,
        "cube": body,
    })  # fmt: skip
    return np.array(mi.render(scene, spp=spp), np.float64)


def cube_image(
    body: dict, spp: int, environment: dict | None = None, **integrator
) -> tuple[np.ndarray, mi.Scene]:
    """Return means over blocks of the image of a whole cube in an ``environment`` (None: uniform
    radiance), and the scene.
    """
    look = mi.ScalarTransform4f().look_at([2.6, 2.2, -3.6], [0, 0, 0], [0, 1, 0])
    size = {"width": CUBE_PIXELS, "height": CUBE_PIXELS}
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}} | size
    scene = mi.load_dict({
        "type": "scene",
        "integrator": integrator | {"hide_emitters": True},
        "sensor": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "environment": environment or UNIFORM,
        "cube": body,
    })  # fmt: skip
    image, count = np.array(mi.render(scene, spp=spp), np.float64)[..., 0], CUBE_PIXELS // BLOCK
    return image.reshape(count, BLOCK, count, BLOCK).mean(axis=(1, 3)), scene


def single_scattering(body: dict) -> np.ndarray:
    """Return means over blocks of an image of a homogeneous body, sampled along camera rays."""
    with mock.patch.object(defaults, "TARGET_ERROR", -1.0):  # whatever error a cache would have
        image, _ = cube_image(body, REFERENCE_SPP, type="irrcache", max_depth=2)
    return image


def cube_row(depth: float, albedo: float, max_depth: int) -> list[str]:
    """Return the cells of a whole cube at default settings."""
    ours, body = {"type": "irrcache", "max_depth": max_depth}, cube(depth, albedo)
    if max_depth == 2:
        fine = single_scattering(cube(depth, albedo, homogeneous=True))
    else:
        fine, _ = cube_image(body, CUBE_SPP, **ours, resolution=FINE)
    with without_profile():
        before, _ = cube_image(body, CUBE_SPP, **ours)
    found, scene = cube_image(body, CUBE_SPP, **ours)
    (medium,) = scene.integrator().cached_media(scene)
    cells = []
    for image in (before, found):
        error = 100 * (image - fine) / fine.mean()
        rmse = np.sqrt(np.square(error).mean())
        cells += [f"{error.mean():+.2f}", f"{rmse:.2f}", f"{np.abs(error).max():.1f}"]
    return [
        scattering(max_depth),
        f"{albedo:g}",
        f"{depth:g}",
        f"{max(medium.cache.grid.shape)}",
        *cells,
    ]


def without_profile():
    """Extrapolate to the faces by the ratio of the two outermost values, as in thin media."""
    return mock.patch.object(cached_medium, "THIN", np.inf)


def scattering(max_depth: int) -> str:
    """Return the first cell of a row."""
    return "single" if max_depth == 2 else "all orders"


def row(albedo: float, max_depth: int, mu: float) -> list[str]:
    """Return the cells of a case."""
    expected, cells = radiance(albedo, max_depth, mu), []
    for depth in DEPTHS:
        with without_profile():
            before = rendered(depth, albedo, max_depth, mu) / expected - 1
        found = rendered(depth, albedo, max_depth, mu) / expected - 1
        cells.append(f"{100 * before:+.1f}, {100 * found:+.1f}")
    return [scattering(max_depth), f"{albedo:g}", f"{mu:g}", *cells]


def main() -> None:
    """Measure all cases."""
    parser = parser_of(__doc__)
    add_document(parser)
    args = parser.parse_args()
    begin()
    mi.set_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    rows = []
    for albedo, max_depth in CASES:
        for mu in COSINES:
            rows.append(row(albedo, max_depth, mu))
            print(" | ".join(rows[-1]), flush=True)
    cubes = []
    for albedo, max_depth in CUBE_CASES:
        for depth in CUBES:
            cubes.append(cube_row(depth, albedo, max_depth))
            print(" | ".join(cubes[-1]), flush=True)
    if args.document:
        tables = {
            "dense-faces": Table("", HEAD, rows),
            "dense-cubes": Table("", CUBE_HEAD, cubes),
        }
        replace_tables(args.document, tables)


if __name__ == "__main__":
    main()
