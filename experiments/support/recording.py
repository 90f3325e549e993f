"""Recorded runs: every method renders once, and all figures use the recorded images.

A run is a process of its own that writes images at many times up to a horizon
(`compare.processes`). An existing run is not repeated, even if it failed, unless it is forced.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support.methods import STOCK, Method
from experiments.support.options import Options
from experiments.support.scenes import available, scene_file
from mitsuba_irrcache.compare import metrics, perceptual
from mitsuba_irrcache.compare.processes import WorkerError, run_job
from mitsuba_irrcache.compare.reference import Reference, reference
from mitsuba_irrcache.compare.results import Measurement, Snapshot
from mitsuba_irrcache.compare.scene_files import scene_digest
from mitsuba_irrcache.io.images import write_image

#: Single scattering, and half the presets' extinction, so that bone is translucent and a voxel of a
#: coarse volume is not opaque on its own.
APPEARANCE = {"max_depth": "2", "scale": "0.5"}
#: Times of the paper's figure 3 in seconds; the last one is at most the horizon.
STRIP = (0.15, 1.0, 3.0, 12.0, 100.0)
#: Ratio of the times of successive snapshots.
TIME_RATIO = 1.4
#: Factor by which the time of an image may differ from the requested one.
LATE = 1.15


@dataclass(frozen=True)
class Subject:
    """A volume at one size: single scattering under a visible white sky, as in the paper."""

    name: str
    scene: Path
    parameters: dict[str, str]

    @classmethod
    def of(cls, volume: str, options: Options) -> Subject:
        """Return a volume, or its substitute if its data are missing."""
        name, size = available(volume), options.size
        path = scene_file(name, options.output, size.longest)
        parameters = APPEARANCE | {"width": str(size.pixels), "height": str(size.pixels)}
        return cls(f"{name}-{size.longest}-{size.pixels}px", path, parameters)

    def reference(self, output: Path, seconds: float) -> Reference:
        """Render the reference by path tracing once; continue it if it is too noisy."""
        print(f"{self.name}: reference, {seconds:g} s", flush=True)
        return reference(self.scene, self.parameters, STOCK, output / "references", seconds=seconds)


@dataclass(frozen=True)
class Recording:
    """The recorded images of a method."""

    method: Method
    measurement: Measurement
    folder: Path

    def image(self, snapshot: Snapshot) -> np.ndarray:
        """Return linear radiance (height, width, channel), float64, with 0 for values that are
        not finite.
        """
        image = metrics.colours(snapshot.read(self.folder)).astype(np.float64)
        return np.nan_to_num(image, posinf=0, neginf=0)

    def at(self, seconds: float) -> Snapshot | None:
        """Return the latest snapshot at this time; None before the first one."""
        there = [s for s in self.measurement.snapshots if s.total <= LATE * seconds]
        return max(there, key=lambda s: s.total, default=None)


def times(horizon: float) -> list[float]:
    """Return the times of snapshots: those of figure 3, and evenly spaced ones in log time."""
    first = STRIP[0]
    count = 1 + int(np.ceil(np.log(horizon / first) / np.log(TIME_RATIO)))
    spaced = np.geomspace(first, horizon, count)
    return sorted({round(float(t), 3) for t in (*spaced, *strip_times(horizon))})


def strip_times(horizon: float) -> list[float]:
    """Return the times of figure 3 within the horizon."""
    return [min(t, horizon) for t in STRIP]


@dataclass(frozen=True)
class Session:
    """A volume, its reference (``picture`` is its file), and the recordings of all methods.

    Failed measurements are listed separately, with or without images.
    """

    subject: Subject
    truth: Reference
    picture: Path
    recordings: list[Recording]
    failed: list[Measurement]

    @classmethod
    def of(
        cls, volume: str, options: Options, methods: tuple[Method, ...], force: bool = False
    ) -> Session:
        """Render and record missing runs; with ``force`` record all anew."""
        subject, size = Subject.of(volume, options), options.size
        main = volume == "chest"
        horizon = size.horizon if main else size.others
        digest = scene_digest(subject.scene, subject.parameters)[:8]
        folder = options.output / "recordings" / f"{subject.name}-{horizon:g}s-{digest}"
        for name in ("images", "logs"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        truth = subject.reference(options.output, size.reference / (1 if main else 2))
        picture = folder / "reference.exr"
        write_image(picture, metrics.colours(truth.mean), {"spp": 2 * truth.spp})
        recordings = [record(subject, m, horizon, folder, force) for m in methods]
        shown = [r for r in recordings if r.measurement.snapshots]
        failed = [r.measurement for r in recordings if r.measurement.error]
        return cls(subject, truth, picture, shown, failed)

    def picked(self, recording: Recording, seconds: float) -> dict:
        """Return the image of a method after this many seconds, for JSON; None before its first
        one.
        """
        snapshot, label = recording.at(seconds), recording.method.label
        if snapshot is None:
            return {"label": label, "image": "", "seconds": seconds, "display": None}
        error = display_error(recording.image(snapshot), self.truth)
        path = recording.folder / snapshot.image
        return {"label": label, "image": str(path), "seconds": snapshot.total, "display": error}


def record(
    subject: Subject, method: Method, horizon: float, folder: Path, force: bool = False
) -> Recording:
    """Return the recording of a method, made unless it exists."""
    path = folder / f"{method.name}.json"
    measurement = None if force or not path.exists() else Measurement.load(path)
    if measurement is None or measurement.integrator != method.integrator:
        measurement = _measure(subject, method, horizon, path)
    return Recording(method, measurement, folder)


def display_error(image: np.ndarray, truth: Reference) -> float:
    """Return the paper's measure: net RMSE of the sRGB image in [0, 1]."""
    return perceptual.display_rmse(image, *(metrics.colours(half) for half in (truth.a, truth.b)))


def _measure(subject: Subject, method: Method, horizon: float, path: Path) -> Measurement:
    """Run a method; after a failure, return its finished results with the reason."""
    folder, partial = path.parent, path.with_suffix(".partial.json")
    job = {
        "scene": str(subject.scene.resolve()),
        "parameters": subject.parameters,
        "sensor": 0,
        "variant": mi.variant(),
        "modules": [],
        "integrator": method.integrator,
        "name": method.name,
        "budgets": times(horizon),
        "images": str(folder / "images"),
    }
    print(f"{subject.name}: {method.integrator}, {horizon:g} s", flush=True)
    try:
        run_job("measure", job, partial, folder / "logs" / f"{method.name}.txt")
        measurement = Measurement.load(partial)
    except WorkerError as error:
        print(f"{subject.name}: {method.integrator} failed: {error}", flush=True)
        measurement = Measurement(method.integrator, method.name)
        if partial.exists():
            measurement = Measurement.load(partial)
        measurement.error = str(error)
    measurement.save(path)
    partial.unlink(missing_ok=True)
    return measurement
