"""Streaks due to directions that all voxels share: the spectrum of the noise of `sweep`.

    python -m experiments.validation.streaks.run [--full] [--force]

Differences of images from caches of different seeds, 32 directions each, single scattering: their
power by direction in the image (24 sectors) and by frequency. A set of few directions would give
peaks across them; noise without structure has the same power in every sector. Writes
output/streaks/results.json.
"""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support.methods import specify
from experiments.support.options import Options, parse
from experiments.support.scenes import scene_file
from experiments.support.store import Store
from mitsuba_irrcache.io.scene_files import load_scene

SCENES = ("procedural", "cloud", "head")
PIXELS, SPP, DIRECTIONS = 128, 32, 32
SEEDS = (1, 2, 3, 4)
SECTORS = 24
#: Frequencies in cycles per image: lower ones contain too few values to distinguish directions.
RINGS = (4, 8, 16, 32, 64)


def run(options: Options) -> None:
    """Compute missing rows and print all."""
    store = Store(options.folder("streaks") / "results.json", options.force)
    for name in SCENES:
        path = scene_file(name, options.output)
        if path is None:
            continue
        row = store.row(name, partial(measure, path))
        sectors = np.array(row["sectors"]) / np.median(row["sectors"])
        print(
            f"{name:12}: noise {row['noise']:.2%} of the mean; power by sector, over the median: "
            f"{sectors.min():.2f} to {sectors.max():.2f}; by frequency "
            + ", ".join(f"{p / sum(row['rings']):.1%}" for p in row["rings"]),
            flush=True,
        )


def measure(path: Path) -> dict:
    """Return the noise in units of the mean, and the mean power of all pairs' differences."""
    sides = {"max_depth": "2", "width": str(PIXELS), "height": str(PIXELS)}
    images = []
    for seed in SEEDS:
        integrator = specify("irrcache", solver="sweep", cache_spp=DIRECTIONS, cache_seed=seed)
        scene = load_scene(path, sides, integrator)
        image = np.array(mi.render(scene, spp=SPP), dtype=np.float64)
        images.append(image.reshape(PIXELS, PIXELS, -1).mean(axis=-1))
    differences = [a - b for a, b in itertools.combinations(images, 2)]
    spectrum = np.mean([power(d) for d in differences], axis=0)
    y, x = np.indices(spectrum.shape) - PIXELS // 2
    radius, angle = np.hypot(x, y), np.arctan2(y, x) % np.pi
    inside = (radius >= RINGS[0]) & (radius < RINGS[-1])
    sector = np.minimum(angle / np.pi * SECTORS, SECTORS - 1).astype(int)
    return {
        "noise": float(np.std(differences) / np.sqrt(2) / np.mean(images)),
        "sectors": [float(spectrum[inside & (sector == k)].mean()) for k in range(SECTORS)],
        "rings": [
            float(spectrum[(radius >= a) & (radius < b)].sum())
            for a, b in itertools.pairwise((0, *RINGS))
        ],
    }


def power(difference: np.ndarray) -> np.ndarray:
    """Return the power spectrum with frequency 0 in the middle, windowed against border effects."""
    window = np.outer(np.hanning(PIXELS), np.hanning(PIXELS))
    transformed = np.fft.fftshift(np.fft.fft2((difference - difference.mean()) * window))
    return np.abs(transformed) ** 2


if __name__ == "__main__":
    run(parse(__doc__))
