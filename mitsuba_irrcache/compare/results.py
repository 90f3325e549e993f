"""The measurements as data classes that are stored as JSON."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.io.images import read_image


@dataclass
class Snapshot:
    """The image of an integrator after a time budget.

    Attributes:
        budget: requested seconds.
        seconds: by stage, with compiled kernels: cache (if there is one), image, filter.
        spp: camera samples per pixel in the image.
        image: name of the EXR file, relative to the report.
        note: a description of how the budget was spent.
        estimate: RMSE that the integrator itself estimates, in units of the mean radiance.
    """

    budget: float
    seconds: dict[str, float]
    spp: int
    image: str = ""
    note: str = ""
    estimate: float | None = None

    @property
    def total(self) -> float:
        """Return the seconds of all stages."""
        return sum(self.seconds.values())

    def read(self, folder: Path) -> np.ndarray:
        """Read the image (height, width, channel), linear radiance, in the report's ``folder``."""
        return read_image(folder / self.image)


@dataclass
class Measurement:
    """All measurements of one integrator; ``error`` says why some are missing.

    ``cold``, ``warm`` and ``again`` are seconds by stage up to a first image: in a new process
    without compiled kernels, in a new process with them, and for another view in the same process.
    ``memory`` is in bytes.
    """

    integrator: str
    name: str
    snapshots: list[Snapshot] = field(default_factory=list)
    cold: dict[str, float] = field(default_factory=dict)
    warm: dict[str, float] = field(default_factory=dict)
    again: dict[str, float] = field(default_factory=dict)
    first_spp: int = 0
    memory: dict[str, int] = field(default_factory=dict)
    error: str = ""

    @classmethod
    def load(cls, path: Path) -> Measurement:
        """Read measurements that `save` wrote."""
        data = json.loads(path.read_text())
        data["snapshots"] = [Snapshot(**s) for s in data["snapshots"]]
        return cls(**data)

    def save(self, path: Path) -> None:
        """Write the measurements as JSON, atomically."""
        write_json(path, asdict(self))


def write_json(path: Path, data: object) -> None:
    """Write JSON atomically."""
    with atomic_write(path) as file:
        file.write(json.dumps(data, indent=1).encode())


def file_name(index: int, integrator: str) -> str:
    """Return the name of an integrator's files: number and specification in safe characters."""
    return f"{index + 1}-{re.sub(r'[^A-Za-z0-9.]+', '-', integrator).strip('-')[:60]}"
