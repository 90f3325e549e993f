"""Measured orders of convergence: each quadrature in ``step``, and the cache in ``resolution``.

    python -m experiments.validation.convergence.run

The medium is smooth, so that orders are visible: a Gaussian ball on a 32^3 grid. *Step*: jitter
off, against the same rule at a 64 times finer step. *Resolution*: voxel values with little noise,
the image against that of the finest cache.
"""

from __future__ import annotations

import argparse

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.analysis import rms
from experiments.support.marching import unjittered
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings
from mitsuba_irrcache.render.quadrature import QUADRATURES
from mitsuba_irrcache.render.raymarch import Projection


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=2048, help="per cache voxel")
    args = parser.parse_args()
    require_llvm()
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(gaussian_ball())
    print(
        "step (voxel edges):     "
        + "".join(f"{s:>12g}" for s in (2, 1, 0.5, 0.25))
        + "       order"
    )
    builder = CacheBuilder(CacheSettings(max_depth=2, resolution=16, samples=64))
    builder.update(scene)
    field = builder.cache.field()
    for quadrature in QUADRATURES:
        exact = image(builder.medium, field, quadrature, 1 / 64)
        errors = [
            rms(image(builder.medium, field, quadrature, s) - exact) for s in (2, 1, 0.5, 0.25)
        ]
        print_orders(quadrature, errors, rms(exact))
    resolutions = (6, 12, 24, 48)
    print(
        "\nresolution:             "
        + "".join(f"{r:>12}" for r in resolutions[:-1])
        + "       order"
    )
    images = []
    for resolution in resolutions:
        builder = CacheBuilder(
            CacheSettings(max_depth=2, resolution=resolution, samples=args.samples)
        )
        builder.update(scene)
        images.append(image(builder.medium, builder.cache.field(), "exponential", 0.25))
    print_orders("cache", [rms(i - images[-1]) for i in images[:-1]], rms(images[-1]))
    print(f"(noise of the caches, projected: about {projected_noise(builder.cache):.1e})")


def gaussian_ball(peak: float = 6.0, falloff: float = 6.0) -> dict:
    """Return a smooth heterogeneous medium under a white sky, by default of optical depth 4.

    The extinction is ``peak`` in the middle and e^-``falloff`` of it one unit away, where its box
    ends.
    """
    c = (np.arange(32) + 0.5) / 32 * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    sigma_t = (peak * np.exp(-falloff * (x**2 + y**2 + z**2))).astype(np.float32)
    to_world = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    return {
        "type": "scene",
        "emitter": {"type": "constant"},
        "ball": {
            "type": "cube",
            "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous",
                "albedo": 0.9,
                "sigma_t": {
                    "type": "gridvolume",
                    "grid": mi.VolumeGrid(sigma_t),
                    "to_world": to_world,
                },
            },
        },
    }


def image(medium, field, quadrature: str, step: float) -> np.ndarray:
    """Return the scattered radiance of `parallel_rays`, without jitter."""
    return unjittered(Projection(medium, field, quadrature, step), parallel_rays())[0]


def parallel_rays() -> mi.Ray3f:
    """Return 48 x 48 parallel, slightly oblique rays through the ball."""
    side = 48
    u = (dr.arange(mi.Float, side) + 0.5) / side * 1.6 - 0.8
    x, y = dr.meshgrid(u, u)
    direction = dr.normalize(mi.Vector3f(0.1, 0.2, 1))
    return mi.Ray3f(mi.Point3f(x, y, 0) - 3 * direction, direction)


def projected_noise(cache: IrradianceCache) -> float:
    """Estimate the standard error of a voxel over the number of voxels that a ray averages."""
    return float(np.nanmean(np.array(cache.standard_error))) / (4 * np.pi) / 4


def print_orders(name: str, errors: list[float], scale: float) -> None:
    """Print relative errors, and the slope between the last two."""
    order = np.log2(errors[-2] / errors[-1])
    print(f"{name:<24}" + "".join(f"{e / scale:>12.2e}" for e in errors) + f"{order:>12.2f}")


if __name__ == "__main__":
    main()
