"""Properties of the integrator for volumes larger than memory, and their valid combinations."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.core import properties
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.files import check_folder_of
from mitsuba_irrcache.pipeline.cached_medium import CacheSettings


@dataclass(frozen=True)
class VolumeSettings:
    """Properties of the integrator for volumes larger than memory; see the plugin's documentation.

    ``max_memory`` is in bytes, 0: half of what is free.
    """

    sigma_t: str = ""
    albedo: str = ""
    max_memory: int = 0
    work_folder: str = ""
    irradiance: str = ""

    @staticmethod
    def of(props: properties.RecordedProperties) -> VolumeSettings | None:
        """Read the properties; None if none is set.

        Files are searched for as those of Mitsuba's plugins are: beside the scene, too.
        """
        names = "sigma_t_file", "albedo_file", "max_memory", "work_folder", "irradiance_file"
        given = [properties.text(props, name) for name in names]
        if not any(given):
            return None
        sigma_t, albedo, memory, folder, irradiance = given
        found = [
            str(mi.file_resolver().resolve(name)) if name else "" for name in (sigma_t, albedo)
        ]
        return VolumeSettings(*found, parse_memory(memory), folder, irradiance)


def check_settings(settings: CacheSettings, files: VolumeSettings, whole: bool) -> None:
    """Raise IrrcacheError for combinations of settings that are not supported."""
    if not files.sigma_t:
        raise IrrcacheError(
            "irrcache: albedo_file, max_memory, work_folder or irradiance_file is set, but not "
            "sigma_t_file; set it, too, or remove them."
        )
    if files.irradiance and not files.irradiance.endswith(".npy"):
        raise IrrcacheError(
            f'irrcache: irradiance_file is "{files.irradiance}"; its name must end with .npy.'
        )
    if files.irradiance and not os.path.exists(files.irradiance):
        check_folder_of(Path(files.irradiance), "irradiance_file")
    wrong = ""
    if settings.max_depth not in (-1, 2):
        wrong = (
            f"max_depth {settings.max_depth}; set max_depth to -1 (all orders of scattering) or 2 "
            "(single scattering)"
        )
    elif settings.solver not in ("auto", "sweep"):
        wrong = f'the solver "{settings.solver}"; remove it, or set solver to "sweep"'
    elif settings.resolution:
        wrong = "another resolution than that of the file; remove resolution"
    elif settings.file:
        wrong = "cache_file; remove it"
    elif not whole:
        wrong = "aovs, filter, tolerance and emission; remove them"
    if wrong:
        raise IrrcacheError(f"irrcache: a medium in sigma_t_file does not support {wrong}.")


def work_folder(files: VolumeSettings) -> tempfile.TemporaryDirectory:
    """Create a folder for working files, which is deleted with the integrator."""
    parent = files.work_folder or Path(files.sigma_t).resolve().parent
    try:
        return tempfile.TemporaryDirectory(prefix=".irrcache-", dir=parent)
    except OSError as error:
        raise IrrcacheError(
            f'irrcache: cannot create working files in "{parent}" ({error.strerror}); set '
            "work_folder to a folder with 10 to 62 bytes of free space per voxel."
        ) from None


def parse_memory(text: str) -> int:
    """Convert a text such as ``8GB`` or ``500 MB`` to bytes; "" is 0.

    Raises IrrcacheError for any other text.
    """
    units = {"": 1, "KB": 1 << 10, "MB": 1 << 20, "GB": 1 << 30, "TB": 1 << 40}
    number = text.upper().replace("IB", "B").rstrip("KMGTB ")
    unit = text.upper().replace("IB", "B")[len(number) :].strip()
    try:
        size = int(float(number) * units[unit]) if text else 0
    except (ValueError, KeyError, OverflowError):
        size = -1
    if size < 0 or (text and not size):
        raise IrrcacheError(
            f'irrcache: max_memory is "{text}"; it must be a size such as 8GB or 500MB.'
        )
    return size
