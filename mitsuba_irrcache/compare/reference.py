"""References in two independent halves, rendered once and kept on disk."""

from __future__ import annotations

import hashlib
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from mitsuba_irrcache.files import atomic_write
from mitsuba_irrcache.loading import load_scene

#: Samples per pixel of one launch.
CHUNK = 32


def reference(
    scene_file: Path,
    parameters: dict[str, str],
    integrator: str,
    spp: int,
    folder: Path,
) -> tuple[np.ndarray, np.ndarray]:
    """Two independent images (height, width, channel) of ``spp`` samples per pixel each.

    Kept in ``folder`` under a digest of the scene folder's files, the parameters, the integrator
    and ``spp``: a changed scene never reuses one, a finished one is never rendered again.
    """
    sha = hashlib.sha256(repr((sorted(parameters.items()), integrator, spp, mi.variant())).encode())
    for file in sorted(Path(scene_file).parent.iterdir()):
        if file.suffix in (".xml", ".vol", ".exr", ".obj", ".ply"):
            sha.update(file.name.encode())
            sha.update(file.read_bytes())
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{Path(scene_file).parent.name}-{sha.hexdigest()[:16]}.npz"
    if path.exists():
        with np.load(path, allow_pickle=False) as stored:
            return stored["a"], stored["b"]
    scene = load_scene(scene_file, parameters, integrator)
    launches = max(1, spp // CHUNK)
    halves = []
    with tqdm(total=2 * launches, desc=f"reference {path.stem}", delay=1.0, disable=None) as bar:
        for half in range(2):
            total = 0.0
            for i in range(launches):
                image = mi.render(scene, spp=min(CHUNK, spp), seed=1_000_000 * (half + 1) + i)
                total = total + np.array(image, dtype=np.float64)
                bar.update()
            halves.append(total / launches)
    with atomic_write(path) as file:
        np.savez(file, a=halves[0], b=halves[1])
    return halves[0], halves[1]
