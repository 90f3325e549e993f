"""Coverage of the error bars given by the AOVs ``noise`` and ``bias``, and the ratio of actual
to predicted errors.

    python -m experiments.validation.error_bars.run [--full] [--force]

Single scattering, a coarse cache of few samples and a finer one, against a volpath reference of two
halves. Writes output/error_bars/results.json.
"""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from experiments.support.analysis import rms
from experiments.support.methods import STOCK, specify
from experiments.support.options import Options, parse
from experiments.support.scenes import scene_file
from experiments.support.store import Store
from mitsuba_irrcache.compare.reference import Reference, reference
from mitsuba_irrcache.io.scene_files import load_scene

SCENES = ("phantom", "cloud", "head")
CACHES = ((32, 16), (64, 16), (64, 64), (128, 16))  # resolution, samples per voxel
PIXELS = 96
REFERENCE_SPP = 256
#: Samples per pixel of the image, so many that only the cache's errors remain.
SPP = 64
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
BINS = 8


def run(options: Options) -> None:
    """Compute missing rows and print all."""
    store = Store(options.folder("error_bars") / "results.json", options.force)
    for name in SCENES:
        path = scene_file(name, options.output)
        if path is None:
            continue
        sides = {"max_depth": "2", "width": str(PIXELS), "height": str(PIXELS)}
        truth = reference(path, sides, STOCK, options.output / "references", REFERENCE_SPP)
        for resolution, samples in CACHES:
            key = f"{name} {resolution} {samples}"
            row = store.row(key, partial(measure, path, sides, truth, resolution, samples))
            inside = ", ".join(f"{share:.0%}" for share in row["inside"])
            print(
                f"{key:16}: noise {row['noise']:.2%} predicted {row['noise_predicted']:.2%}, "
                f"bias {row['bias']:+.2%} predicted {row['bias_predicted']:+.2%}, RMS error "
                f"{row['error']:.2%} predicted {row['error_predicted']:.2%}; within 1, 2, 3 "
                f"error bars: {inside}",
                flush=True,
            )


def measure(path, parameters: dict, truth: Reference, resolution: int, samples: int) -> dict:
    """Return errors of the luminance in units of its mean, of pixels that see the medium."""
    images, layers = [], {}
    for seed in (1, 2):
        integrator = specify(
            "irrcache{solver=path}",
            resolution=resolution,
            cache_spp=samples,
            cache_seed=seed,
            aovs="noise,bias,transmittance",
        )
        scene = load_scene(path, parameters, integrator)
        values = np.array(mi.render(scene, spp=SPP, seed=seed), dtype=np.float64)
        names = scene.integrator().aov_names()
        images.append(values[..., : -len(names)] @ LUMINANCE)
        layers = dict(zip(names, np.moveaxis(values[..., -len(names) :], -1, 0), strict=True))
    a, b = (half @ LUMINANCE for half in (truth.a, truth.b))
    seen = layers["transmittance.G"] < 0.999
    mean = 0.5 * (a + b).mean()
    first, x = images
    error = x - 0.5 * (a + b)
    # The reference's own variance, known to a few degrees of freedom per pixel: smoothed.
    unsure = np.maximum(uniform_filter(np.square(a - b) / 4, 5), 0)
    noise, bias = layers["noise.Y"], layers["bias.Y"]
    predicted = np.hypot(noise, bias)
    bar = np.sqrt(np.square(predicted) + unsure)
    net = (x - a) * (x - b)
    return {
        "noise": rms((x - first)[seen]) / np.sqrt(2) / mean,
        "noise_predicted": rms(noise[seen]) / mean,
        "bias": float((0.5 * (x + first) - 0.5 * (a + b))[seen].mean() / mean),
        "bias_predicted": float(bias[seen].mean() / mean),
        "error": float(np.sqrt(max(net[seen].mean(), 0)) / mean),
        "error_predicted": rms(predicted[seen]) / mean,
        "inside": [float(np.mean(np.abs(error) <= k * bar, where=seen)) for k in (1, 2, 3)],
        "bins": bins(predicted[seen] / mean, net[seen] / mean**2),
    }


def bins(predicted: np.ndarray, squared: np.ndarray) -> list[tuple[float, float]]:
    """Return the RMS of prediction and of error in groups of pixels of increasing prediction."""
    groups = np.array_split(np.argsort(predicted), BINS)
    return [
        (rms(predicted[g]), float(np.sqrt(max(squared[g].mean(), 0)))) for g in groups if g.size
    ]


if __name__ == "__main__":
    run(parse(__doc__))
