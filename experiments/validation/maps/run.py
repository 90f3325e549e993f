"""Noise of the directions under environment maps with angular detail.

    python -m experiments.validation.maps.run [--document FILE]

Caches with different seeds differ in their directions only. The standard deviation of the images
over several seeds, in means over 4 x 4 pixels, is stated in % of the mean radiance of the body, for
bodies of several optical depths under several maps: with few directions sampled from the map, and
with as many as are sampled for isolated media.
"""

from __future__ import annotations

import time
from unittest import mock

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.solvers.discrete_ordinates import solver
from mitsuba_irrcache.solvers.discrete_ordinates.incident import FEW_SAMPLES

VOXELS, PIXELS, BLOCK, SPP, SEEDS = 48, 32, 4, 64, 6
#: Part of the largest radiance above which a block of pixels belongs to the body.
ON_BODY = 0.2
HEAD = ["map", "body", "few samples: noise [%]", "largest [%]", "time [s]",
        "many: noise", "largest", "time"]  # fmt: skip


def env_map(values: np.ndarray) -> dict:
    """Return an environment map with this grey radiance (row, column)."""
    return {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(np.float32(values)[..., None], 3, 2))}


def region(
    outside: float, inside: float, rows: slice, columns: slice, shape: tuple[int, int] = (8, 16)
) -> dict:
    """Return an environment map of two radiances."""
    values = np.full(shape, outside)
    values[rows, columns] = inside
    return env_map(values)


def maps() -> dict[str, dict]:
    """Return environment maps by name."""
    height = np.cos(np.pi * (np.arange(32) + 0.5) / 32)[:, None] * np.ones(64)
    return {
        "bright block": region(0.1, 4, slice(2, 5), slice(3, 8)),
        "window": region(0.2, 20, slice(3, 4), slice(4, 5)),
        "upper half": region(0.1, 1, slice(0, 4), slice(None)),
        "lobe": env_map(0.3 + np.maximum(height, 0) ** 4),
        "sun and sky": region(0.3, 400, slice(20, 22), slice(30, 33), (64, 128)),
        "texture": env_map(np.random.default_rng(0).uniform(0.5, 1, (64, 128))),
    }


def bodies() -> dict[str, dict]:
    """Return shapes with media by name."""
    place = mi.ScalarTransform4f().translate(-1).scale(2)

    def grid(values: np.ndarray) -> dict:
        volume = mi.VolumeGrid(np.float32(values)[..., None])
        return {"type": "gridvolume", "grid": volume, "to_world": place, "raw": True}

    def body(shape: str, medium: str, sigma_t: object, albedo: float, **more) -> dict:
        interior = {"type": medium, "sigma_t": sigma_t, "albedo": albedo} | more
        return {"type": shape, "bsdf": {"type": "null"}, "interior": interior}

    x = np.linspace(-1, 1, 24) ** 2
    soft = np.clip(1 - (x[:, None, None] + x[:, None] + x), 0, None)
    noise = np.random.default_rng(1).random((12, 12, 12))
    cloud = grid(np.clip(12 * noise - 2, 0, None))
    hg = {"phase": {"type": "hg", "g": 0.6}}
    return {
        "ball of depth 40": body("sphere", "homogeneous", 20.0, 0.97),
        "cube of depth 20": body("cube", "homogeneous", 10.0, 0.8),
        "cloud": body("cube", "heterogeneous", cloud, 0.95),
        "cloud, g 0.6": body("cube", "heterogeneous", cloud, 0.95, **hg),
        "soft ball of depth 12": body("cube", "heterogeneous", grid(10 * soft), 0.99),
        "smoke of depth 2": body("cube", "heterogeneous", grid(2 * soft), 0.9),
    }


def blocks(body: dict, environment: dict, seed: int, max_depth: int = -1) -> np.ndarray:
    """Return means over blocks of the image of a body with a new cache."""
    look = mi.ScalarTransform4f().look_at([2.6, 2.2, -3.6], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    ours = {"type": "irrcache", "max_depth": max_depth, "resolution": VOXELS, "cache_seed": seed}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": ours | {"hide_emitters": True},
        "sensor": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "environment": environment,
        "body": body,
    })  # fmt: skip
    image = np.array(mi.render(scene, spp=SPP), np.float64)[..., 0]
    count = PIXELS // BLOCK
    return image.reshape(count, BLOCK, count, BLOCK).mean(axis=(1, 3))


def noise(body: dict, environment: dict, seeds: int = SEEDS) -> tuple[float, float]:
    """Return the root mean square and the maximum over the body of the standard deviation between
    seeds, in % of its mean radiance.
    """
    images = np.array([blocks(body, environment, seed) for seed in range(seeds)])
    mean = images.mean(axis=0)
    on_body = mean > ON_BODY * mean.max()
    deviation = 100 * images.std(axis=0, ddof=1)[on_body] / mean[on_body].mean()
    return float(np.sqrt(np.square(deviation).mean())), float(deviation.max())


def with_few_samples():
    """Sample as few directions as among surfaces."""
    return mock.patch.object(solver, "samples_in_isolated_media", lambda *_: (FEW_SAMPLES, True))


def cells(body: dict, environment: dict) -> list[str]:
    """Return noise and the time of an image."""
    blocks(body, environment, 0)  # compiles the kernels
    start = time.perf_counter()
    found = noise(body, environment)
    seconds = (time.perf_counter() - start) / SEEDS
    return [f"{found[0]:.2f}", f"{found[1]:.1f}", f"{seconds:.2f}"]


def main() -> None:
    """Measure all maps and bodies."""
    parser = parser_of(__doc__)
    add_document(parser)
    args = parser.parse_args()
    begin()
    rows = []
    for name, environment in maps().items():
        for label, body in bodies().items():
            with with_few_samples():
                before = cells(body, environment)
            rows.append([name, label, *before, *cells(body, environment)])
            print(" | ".join(rows[-1]), flush=True)
    if args.document:
        replace_tables(args.document, {"map-noise": Table("", HEAD, rows)})


if __name__ == "__main__":
    main()
