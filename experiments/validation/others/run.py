"""Third-party scenes with their own references.

These are scenes of Mitsuba's test suite, with its images and variances, and those of lajolla, with
images of other renderers.

    python -m experiments.validation.others.run [--force]

The scenes are looked up in the data folder of ``experiments.support.scenes``, in
scenes/mitsuba-data and scenes/lajolla. volpath is measured with equal samples as a control: it has
the same errors due to the reference and the samples. Prints a table and writes
output/others/results.json.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support.methods import specify
from experiments.support.options import Options, parse
from experiments.support.scenes import DATA
from experiments.support.store import Store
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.errors import IrrcacheError, origin, original_message
from mitsuba_irrcache.io.scene_files import load_scene

SUITE = DATA / "scenes" / "mitsuba-data" / "tests" / "scenes" / "participating_media"
LAJOLLA = DATA / "scenes" / "lajolla"
#: Factor by which lajolla's and our images are downsampled.
SMALLER = 4
#: Samples per pixel of the Z-test: few, for the reference has noise of its own.
SUITE_SPP = 64
#: Bytes before the voxels of a .vol file, including the bounding box of its grid.
HEADER = 48
#: Where no ray can meet a cache, irrcache renders as volpath does.
BY_PATHS = ("surf_area_light", "homo_dielectric_envmap")


@dataclass(frozen=True)
class Scene:
    """A third-party scene.

    Attributes:
        max_depth: of its own integrator.
        spp: samples per pixel that are rendered here.
        source: the file that exists if the data are available.
        prepare: returns the file to load, which may be edited first.
        reference: returns the image, and the variance of one sample if it is known.
    """

    max_depth: int
    spp: int
    source: Path
    prepare: Callable[[Path], Path]
    reference: Callable[[], tuple[np.ndarray, np.ndarray | None]]


def of_the_suite(name: str, max_depth: int) -> Scene:
    """Return one of Mitsuba's scenes, unchanged."""
    source = SUITE / f"test_{name}_volpath.xml"
    return Scene(max_depth, 1024, source, lambda _: source, lambda: _of_the_suite(name))


def of_lajolla(name: str, repaired: bool = False) -> Scene:
    """Return one of lajolla's scenes, converted to Mitsuba 3."""
    return Scene(
        -1,
        64,
        LAJOLLA / f"{name}.xml",
        lambda folder: modernised(name, repaired, folder),
        lambda: (_smaller(_read(LAJOLLA / "refs_student_exr" / f"{name}.exr")), None),
    )


SCENES = {
    "surf_area_light": of_the_suite("surf_area_light", 6),
    "homo_dielectric_envmap": of_the_suite("homo_dielectric_envmap", 16),
    "homo_null_envmap": of_the_suite("homo_null_envmap", 6),
    "hetero_sigmat": of_the_suite("hetero_sigmat", 6),
    "hetero_sigmat_albedo": of_the_suite("hetero_sigmat_albedo", 6),
    "hetvol": of_lajolla("hetvol"),
    "hetvol_colored": of_lajolla("hetvol_colored"),
    "hetvol_colored, repaired": of_lajolla("hetvol_colored", repaired=True),
}


def run(options: Options) -> None:
    """Compute missing rows and print all."""
    store = Store(options.folder("others") / "results.json", options.force)
    for name, scene in SCENES.items():
        if not scene.source.exists():
            print(f"{name}: skipped, for {scene.source.name} is not in {DATA}")
            continue
        print_row(name, store.row(name, partial(compute, name, scene, options)))


def compute(name: str, scene: Scene, options: Options) -> dict:
    """Return errors of irrcache and of volpath in units of the reference's mean, or the reason.

    ``z`` is the root mean square of the deviations over their standard errors, about 1 without
    bias, and ``passed`` the share of pixels and channels that pass Mitsuba's own Z-test.
    """
    path = scene.prepare(options.folder("others"))
    target, variance = scene.reference()
    row: dict = {"unbiased": name in BY_PATHS, "spp": scene.spp}
    for integrator in ("irrcache", "volpath"):
        specification = specify(integrator, max_depth=scene.max_depth, rr_depth=50)
        try:
            row[integrator] = measured(path, specification, scene.spp, target, variance)
        except (IrrcacheError, RuntimeError) as error:
            if not isinstance(origin(error), IrrcacheError):
                raise
            return {"refused": original_message(error)}
    return row


def measured(
    path: Path, integrator: str, spp: int, target: np.ndarray, variance: np.ndarray | None
) -> dict[str, float]:
    """Measure one image against the target."""
    loaded = load_scene(path, None, integrator)
    started = time.perf_counter()
    image = np.array(mi.render(loaded, spp=spp, seed=1), dtype=np.float64)
    seconds = time.perf_counter() - started
    image, mean = metrics.colours(image), target.mean()
    found = {
        "mean_error": metrics.mean_error(image, target, target) / mean,
        "uncertainty": metrics.mean_error_uncertainty(image, target, target) / mean,
        "rmse": metrics.net_rmse(image, target, target) / mean,
        "blocks": metrics.block_error(image, target, target) / mean,
        "seconds": seconds,
    }
    if variance is not None:
        image = metrics.colours(np.array(mi.render(loaded, spp=SUITE_SPP, seed=2)))
        found |= z_test(image, target, variance)
    return found


def z_test(image: np.ndarray, target: np.ndarray, variance: np.ndarray) -> dict[str, float]:
    """Apply the Z-test of Mitsuba's src/render/tests/test_renders.py.

    It requires 99.75 % to pass, and a variance of at least 1e-4. It is designed for volpath's
    variance: images with less of it pass more easily.
    """
    z = (image - target) * np.sqrt(SUITE_SPP / np.maximum(variance, 1e-4))
    significance = 1 - (1 - 0.01) ** (1 / z[..., 0].size)  # Sidak's, of each pixel
    p = np.vectorize(math.erfc)(np.abs(z) / 2**0.5)
    return {"z": float(np.sqrt(np.mean(z**2))), "passed": float(np.mean(p > significance))}


def print_row(name: str, row: dict) -> None:
    """Print one line for each integrator."""
    if "refused" in row:
        print(f"{name:25} refused: {row['refused']}")
        return
    for integrator in ("irrcache", "volpath"):
        found = row[integrator]
        z = f"z {found['z']:.2f}, {found['passed']:.2%} pass  " if "z" in found else ""
        print(
            f"{name:25} {integrator:8} mean error {found['mean_error']:+.2%} "
            f"(+- {found['uncertainty']:.2%})  RMSE {found['rmse']:.2%}  blocks "
            f"{found['blocks']:.2%}  {z}{found['seconds']:.1f} s",
            flush=True,
        )


def _of_the_suite(name: str) -> tuple[np.ndarray, np.ndarray]:
    return tuple(_read(SUITE / "refs" / f"test_{name}_ref_rgb{end}.exr") for end in ("", "_var"))


def _read(path: Path) -> np.ndarray:
    image = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    return np.array(image, dtype=np.float64)


def _smaller(image: np.ndarray) -> np.ndarray:
    return metrics.block_means(image, SMALLER)


#: Substitutions from the dialect of Mitsuba 0.5, in addition to Mitsuba's own; hg with g = 0 is
#: isotropic, and volumes had the positions given in their files.
EDITS = (
    (r'\s*<(integer|string|float|boolean) name="(version|method|stepSize|banner)"[^>]*/>', ""),
    (r'(?s)<phase type="hg">.*?</phase>', '<phase type="isotropic"/>'),
    (r'name="density"', 'name="sigma_t"'),
    (r"(?s)(<shape (?:(?!</shape>).)*?)(<ref name=\"interior\")", r'\1<bsdf type="null"/>\2'),
    (r'(type="gridvolume">)', r'\1<boolean name="use_grid_bbox" value="true"/>'),
    (r'<spectrum name="radiance"', '<rgb name="radiance"'),
    (r'<rfilter type="gaussian"/>', '<rfilter type="box"/>'),
)


def modernised(name: str, repaired: bool, folder: Path) -> Path:
    """Return the scene ``name`` for Mitsuba 3 with absolute file names.

    ``repaired``: with an extinction whose negative voxels are 0.
    """
    text = (LAJOLLA / f"{name}.xml").read_text()
    for pattern, replacement in EDITS:
        text = re.sub(pattern, replacement, text)
    for side, size in (("width", 768), ("height", 576)):
        text = text.replace(f'"{side}" value="{size}"', f'"{side}" value="{size // SMALLER}"')
    text = re.sub(r'(name="filename" value=")', lambda m: f"{m[1]}{LAJOLLA.resolve()}/", text)
    if repaired:
        source = LAJOLLA / "colored_density.vol"
        data = source.read_bytes()
        voxels = np.maximum(np.frombuffer(data, "<f4", offset=HEADER), 0)
        (folder / source.name).write_bytes(data[:HEADER] + voxels.tobytes())
        text = text.replace(str(source.resolve()), str((folder / source.name).resolve()))
    path = folder / f"{name}{'-repaired' if repaired else ''}.xml"
    path.write_text(text)
    return path


if __name__ == "__main__":
    run(parse(__doc__))
