"""References in two independent halves, rendered once and stored on disk."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from mitsuba_irrcache.core.clear_channels import warn_of_clear_channel
from mitsuba_irrcache.errors import IrrcacheError, reason
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.io.scene_files import load_scene, loses_emission, parse_integrator

from .scene_files import scene_digest

#: Samples per pixel of one launch.
CHUNK = 32
#: Interval in seconds at which an unfinished reference is saved.
SAVE_INTERVAL = 20.0


@dataclass
class Reference:
    """Two independent images a and b (height, width, channel), float64.

    Each has ``spp`` samples per pixel; both together took ``seconds``.
    """

    a: np.ndarray
    b: np.ndarray
    spp: int
    seconds: float

    @property
    def mean(self) -> np.ndarray:
        """Return the mean of both halves."""
        return 0.5 * (self.a + self.b)

    @classmethod
    def load(cls, path: Path) -> Reference:
        """Read a reference that `save` wrote; raise IrrcacheError, naming the file, for any other
        file.
        """
        try:
            with np.load(path, allow_pickle=False) as stored:
                a, b, spp, seconds = (stored[name] for name in ("a", "b", "spp", "seconds"))
                return cls(a, b, int(spp), float(seconds))
        except Exception as error:  # a damaged file may cause any exception
            raise IrrcacheError(
                f'"{path}" is not a readable reference ({reason(error)}); delete it, so that it is '
                "rendered anew."
            ) from error

    def save(self, path: Path) -> None:
        """Write an .npz atomically."""
        with atomic_write(path) as file:
            np.savez(file, a=self.a, b=self.b, spp=self.spp, seconds=self.seconds)


def default_folder() -> Path:
    """Return the default folder: irrcache/references in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return Path(base or Path.home() / ".cache") / "irrcache" / "references"


def reference_path(
    scene_file: Path, parameters: dict[str, str], integrator: str, sensor: int, folder: Path
) -> Path:
    """Return the file of a reference, named by a digest of everything that determines the image.

    These are all files of the scene, the parameters, the integrator, the sensor, the variant and
    Mitsuba's version.
    """
    inputs = scene_digest(scene_file, parameters, integrator)
    parts = (inputs, integrator, sensor, mi.variant(), mi.__version__)
    digest = hashlib.sha256(repr(parts).encode()).hexdigest()
    return folder / f"{scene_file.stem}-{digest[:16]}.npz"


def reference(
    scene_file: Path,
    parameters: dict[str, str],
    integrator: str,
    folder: Path,
    spp: int = 0,
    seconds: float = 0.0,
    sensor: int = 0,
    advance: Callable[[int, float], None] | None = None,
) -> Reference:
    """Return a reference with at least ``spp`` samples per half or ``seconds`` of rendering.

    A sufficient one in ``folder`` is reused, an insufficient one is continued; a changed scene has
    a different file. ``advance`` is called with (samples, seconds).
    """
    scene_file = Path(scene_file)
    require_emission(scene_file, parameters, integrator)
    folder.mkdir(parents=True, exist_ok=True)
    path = reference_path(scene_file, parameters, integrator, sensor, folder)
    found = Reference.load(path) if path.exists() else None
    if found is not None and found.spp >= spp and found.seconds >= seconds:
        return found
    scene = load_scene(scene_file, parameters, integrator)
    name = parse_integrator(integrator)[0]
    if "volpath" in name:
        warn_of_clear_channel(scene, name)
    saved = time.perf_counter()
    with tqdm(
        desc=f"reference {path.stem}", unit="spp", delay=1.0, leave=False, disable=None
    ) as bar:
        while found is None or found.spp < spp or found.seconds < seconds:
            done = 0 if found is None else found.spp
            chunk = min(CHUNK, spp) if spp else CHUNK
            found = joined(found, render_halves(scene, sensor, done, chunk))
            bar.update(found.spp - bar.n)
            if advance is not None:
                advance(found.spp, found.seconds)
            if time.perf_counter() - saved > SAVE_INTERVAL:
                found.save(path)
                saved = time.perf_counter()
    found.save(path)
    return found


def require_emission(scene_file: Path, parameters: dict[str, str], integrator: str) -> None:
    """Raise IrrcacheError if a reference of the scene would lack the emission of its media."""
    if loses_emission(scene_file, parameters, integrator):
        raise IrrcacheError(
            f'the media of "{scene_file}" emit, but the reference "{integrator}" would be without '
            "emission: a comparison needs another --reference, or emission_scale 0 in the scene."
        )


def render_halves(scene: mi.Scene, sensor: int, first: int, spp: int) -> Reference:
    """Render ``spp`` samples per pixel of both halves that follow the ``first`` ones.

    Each half has a sequence of seeds of its own.
    """
    started = time.perf_counter()
    a, b = [
        np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed + first), dtype=np.float64)
        for seed in (1_000_000_000, 2_000_000_000)
    ]
    return Reference(a, b, spp, time.perf_counter() - started)


def joined(old: Reference | None, new: Reference) -> Reference:
    """Return the reference with all samples of both."""
    if old is None:
        return new
    share = new.spp / (old.spp + new.spp)
    a, b = (o + (n - o) * share for o, n in ((old.a, new.a), (old.b, new.b)))
    return Reference(a, b, old.spp + new.spp, old.seconds + new.seconds)
