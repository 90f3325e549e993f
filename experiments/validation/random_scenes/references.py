"""References for random scenes: batches of volpath until the standard error is small enough."""

from __future__ import annotations

import gc
import json
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.validation.random_scenes.generate import RandomScene
from mitsuba_irrcache.compare.metrics import colours

#: Pixels of an image, per side: the standard error of the mean depends on samples in all alone.
PIXELS = 24
#: Standard error of the mean radiance, in units of the mean. Together with that of images by
#: irrcache, at most `MEAN_NOISE`, so that 1 % are three standard errors.
TARGET, MEAN_NOISE = 0.0025, 0.01 / 3
#: Samples per pixel of the pilot's images, and their number.
PILOT_SPP, PILOTS = 16, 4
#: Least and largest samples per pixel of a batch (the latter bounds memory), and least batches.
BATCH_SPP, BATCHES = (32, 2048), 24
#: `rr_depth` of references; the first one also where the other is not tried. In white media it is
#: NO_ROULETTE: a path survives Russian roulette with a probability of .95 at most, so that the
#: weights of long paths grow, and a few of large weight can be missing from the mean and its noise.
ROULETTE, NO_ROULETTE = (50, 5), 1000


def load(case: RandomScene, integrator: str, folder: Path, **settings) -> mi.Scene:
    """Load the scene with a cold cache."""
    gc.collect()
    plugin = {"type": integrator} | case.properties | settings
    return mi.load_dict(case.build(plugin, folder, PIXELS))


def picture(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """Render colours, float64."""
    return colours(np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64))


def pilot(scene: mi.Scene) -> tuple[float, float, float]:
    """Return the variance of a sample, averaged over pixels, its CPU seconds, and the mean."""
    picture(scene, 1, 0)  # compiles kernels
    dr.sync_thread()
    started = process_time()
    images = [picture(scene, PILOT_SPP, seed) for seed in range(1, 1 + PILOTS)]
    each = (process_time() - started) / (PILOTS * PILOT_SPP)
    return float(np.var(images, axis=0, ddof=1).mean()) * PILOT_SPP, each, float(np.mean(images))


@dataclass
class Reference:
    """Independent batches of one integrator; two sums of images, of even and of odd batches."""

    judge: str
    rr_depth: int
    spp: int  #: of a batch
    seconds: float = 0.0  #: of the processor
    means: list[float] = field(default_factory=list)  #: of the image, by batch
    sums: list[np.ndarray] = field(default_factory=lambda: [np.zeros(()), np.zeros(())])
    unscattered: np.ndarray = field(default_factory=lambda: np.zeros(()))

    @property
    def noise(self) -> float:
        """Return the standard error of the mean radiance in units of the mean; 0: all are 0."""
        mean = np.mean(self.means)
        error = np.std(self.means, ddof=1) / len(self.means) ** 0.5
        return float(error / mean) if mean > 0 else 0.0

    @property
    def is_enough(self) -> bool:
        """Return whether the standard error is small enough."""
        return len(self.means) >= BATCHES and self.noise <= TARGET

    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the images of even and of odd batches."""
        count = len(self.means)
        return self.sums[0] / ((count + 1) // 2), self.sums[1] / (count // 2)

    def refine(self, scene: mi.Scene, seconds: float) -> None:
        """Add batches until the standard error is small enough or the time is spent."""
        while not self.is_enough and (self.seconds < seconds or len(self.means) < 2):
            started, number = process_time(), len(self.means)
            image = picture(scene, self.spp, 1000 + number)
            self.sums[number % 2] = self.sums[number % 2] + image
            self.means.append(float(image.mean()))
            self.seconds += process_time() - started

    def save(self, file: Path, drawn: str) -> None:
        """Save everything, with the properties of the scene."""
        np.savez_compressed(
            file, drawn=drawn, judge=self.judge, rr_depth=self.rr_depth, spp=self.spp,
            seconds=self.seconds, means=self.means, even=self.sums[0], odd=self.sums[1],
            unscattered=self.unscattered,
        )  # fmt: skip

    @classmethod
    def read(cls, file: Path, drawn: str) -> Reference | None:
        """Read what `save` has written; None if there is none of this scene."""
        if not file.exists():
            return None
        with np.load(file) as f:
            if str(f["drawn"]) != drawn:
                return None
            return cls(
                str(f["judge"]), int(f["rr_depth"]), int(f["spp"]), float(f["seconds"]),
                f["means"].tolist(), [f["even"], f["odd"]], f["unscattered"],
            )  # fmt: skip


def reference(case: RandomScene, seconds: float, folder: Path) -> Reference:
    """Return the reference of a scene; one that is stored is refined."""
    file, drawn = folder / f"{case.seed}-{case.index}-reference.npz", json.dumps(case.as_dict())
    found = Reference.read(file, drawn)
    if found is None:
        found = _begin(case, folder)
        found.unscattered = picture(load(case, found.judge, folder, max_depth=1), 256, 7)
    if not found.is_enough and found.seconds < seconds:
        found.refine(load(case, found.judge, folder, rr_depth=found.rr_depth), seconds)
        found.save(file, drawn)
    return found


def _begin(case: RandomScene, folder: Path) -> Reference:
    """Choose the integrator, its `rr_depth` of least variance times time, and samples of a batch.

    It is volpathmis where the extinction is chromatic: the weights of volpath's paths grow with
    each collision there, and a few of large weight can be missing from its mean and its noise.
    """
    names = ("volpathmis",) if case.is_chromatic else ("volpath",)
    is_white = case.albedo in ("1", "0.99")
    candidates = [(name, NO_ROULETTE if is_white else ROULETTE[0]) for name in names]
    if case.max_depth < 0 and case.depth >= 5 and not is_white:
        candidates += [(name, ROULETTE[1]) for name in names]
    pilots = {(name, rr): pilot(load(case, name, folder, rr_depth=rr)) for name, rr in candidates}
    # Relative to the mean, which is small where paths of large weight are missing.
    judge, rr_depth = min(
        pilots, key=lambda k: pilots[k][0] * pilots[k][1] / max(pilots[k][2], 1e-30) ** 2
    )
    variance, _, mean = pilots[judge, rr_depth]
    wanted = variance / max(TARGET * mean, 1e-12) ** 2 / PIXELS**2
    return Reference(judge, rr_depth, int(np.clip(wanted / BATCHES, *BATCH_SPP)))
