"""What was measured, as data that goes to JSON and comes back."""

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
        budget: seconds that were asked for.
        seconds: of each stage, with compiled kernels: cache (where there is one), image, filter.
        spp: camera samples per pixel in the image.
        image: name of the EXR file, relative to the report.
        note: how the budget was spent, for people.
    """

    budget: float
    seconds: dict[str, float]
    spp: int
    image: str = ""
    note: str = ""

    @property
    def total(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())

    def read(self, folder: Path) -> np.ndarray:
        """The image (height, width, channel) of linear radiance, from the report's ``folder``."""
        return read_image(folder / self.image)


@dataclass
class Measurement:
    """All that is known of one integrator; ``error`` says why something is missing.

    ``cold``, ``warm`` and ``again`` are seconds by stage up to a first image: in a new process
    without compiled kernels, in a new process with them, and of another view in the same process.
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
        """Reads what `save` wrote."""
        data = json.loads(path.read_text())
        data["snapshots"] = [Snapshot(**s) for s in data["snapshots"]]
        return cls(**data)

    def save(self, path: Path) -> None:
        """Writes JSON, whole or not at all."""
        write_json(path, asdict(self))


def write_json(path: Path, data: object) -> None:
    """Writes JSON, whole or not at all."""
    with atomic_write(path) as file:
        file.write(json.dumps(data, indent=1).encode())


def file_name(index: int, integrator: str) -> str:
    """A name for an integrator's files: number and specification, without odd characters."""
    return f"{index + 1}-{re.sub(r'[^A-Za-z0-9.]+', '-', integrator).strip('-')[:60]}"
