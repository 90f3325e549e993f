"""TIFF stacks: one file with many pages (OME-TIFF, ImageJ, plain), or one file per slice."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import tifffile

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.extras import remedy
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.lengths import factors_to_first
from mitsuba_irrcache.volumes.options import ReadOptions, chosen_field, readable_type, scalar_volume
from mitsuba_irrcache.volumes.raw import check_numbering, natural_order

# The axes of tifffile: S are samples of a pixel, Q and I are pages of unknown meaning.
_AXES = {"S": "c", "Q": "z", "I": "z"}


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one series of a file, with the voxel size of OME or ImageJ metadata (otherwise 1).

    Raises:
        IrrcacheError: a truncated file, a single slice, or several series, channels or frames and
            none chosen.
    """
    with _complete(path) as tiff:
        if options.field is None and _are_slices(tiff.series):
            return _read_pages(path, tiff, options)
        names = [series.name or str(i) for i, series in enumerate(tiff.series)]
        name = chosen_field(str(path), dict.fromkeys(names), options.field, "series")
        number = names.index(name)
        series = tiff.series[number]
        readable_type(str(path), series.dtype)
        _check_segments(path, series)
        needed = int(np.prod(series.shape, dtype=object)) * series.dtype.itemsize
        require_memory(needed, f"reading {path}", "crop or resample it first")
        axes = "".join(_AXES.get(axis, axis.lower()) for axis in series.axes)
        if len(set(axes)) < len(axes) or set(axes) - set("xyzct"):
            raise IrrcacheError(
                f"{path} has axes {series.axes}; save it as a stack with the axes Z, Y, X, and at "
                "most channels and frames besides"
            )
        values = scalar_volume(str(path), _decoded(path, series), axes, options)
        spacing, unit = _voxel_size(path, tiff, number)
    return VolumeData(values, spacing, length_unit=unit, source=str(path))


def _are_slices(series: Sequence[tifffile.TiffPageSeries]) -> bool:
    """Return whether a file has several series, which are slices of equal shape and type.

    Some writers that compress each page by itself produce such files.
    """
    kinds = {(part.shape, part.dtype, part.axes) for part in series}
    return len(series) > 1 and len(kinds) == 1 and series[0].axes in ("YX", "YXS")


def _read_pages(path: Path, tiff: tifffile.TiffFile, options: ReadOptions) -> VolumeData:
    needed = sum(int(np.prod(part.shape)) * part.dtype.itemsize for part in tiff.series)
    require_memory(2 * needed, f"reading {path}", "crop or resample it first")
    for part in tiff.series:
        _check_segments(path, part)
    slices = np.stack([_decoded(path, part) for part in tiff.series])
    axes = "zyx" if slices.ndim == 3 else "zyxc"
    spacing, unit = _voxel_size(path, tiff)
    values = scalar_volume(str(path), slices, axes, options)
    return VolumeData(values, spacing, length_unit=unit, source=str(path))


def read_slices(paths: Sequence[Path], options: ReadOptions) -> VolumeData:
    """Stack files of one slice each, in the order of the numbers in their names.

    Raises:
        IrrcacheError: a missing number, slices of different shape or type, or a damaged file.
    """
    ordered = natural_order(paths)
    check_numbering(ordered)
    slices = []
    for index, path in enumerate(ordered):
        try:
            with _complete(path) as tiff:
                _check_segments(path, tiff.series[0])
                part = tiff.series[0]
                if index == 0:
                    needed = len(ordered) * int(np.prod(part.shape)) * part.dtype.itemsize
                    require_memory(2 * needed, f"reading {len(ordered)} slices", "crop them first")
                slices.append(_decoded(path, part))
        except IrrcacheError:
            raise
        except Exception as error:  # decoders raise exceptions of any type for damaged files
            raise IrrcacheError(
                f"cannot read {path} as TIFF: {error}; copy or export it again"
            ) from error
        if slices[-1].shape != slices[0].shape or slices[-1].dtype != slices[0].dtype:
            raise IrrcacheError(
                f"{path} has shape {slices[-1].shape} and type {slices[-1].dtype}, but "
                f"{ordered[0]} has {slices[0].shape} and {slices[0].dtype}; give slices of one "
                "series"
            )
    if slices[0].ndim not in (2, 3):
        raise IrrcacheError(f"{ordered[0]} has shape {slices[0].shape}; give one slice per file")
    source = f"{ordered[0]} ... {ordered[-1].name}"
    axes = "zyx" if slices[0].ndim == 2 else "zyxc"
    return VolumeData(scalar_volume(source, np.stack(slices), axes, options), source=source)


class _Log(logging.Handler):
    """Collects the errors that tifffile logs, and does not raise, for data that are missing."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


@contextmanager
def _complete(path: Path) -> Iterator[tifffile.TiffFile]:
    """Open a file whose tags are all inside of it; they hold the voxel size, among other things."""
    log, logger = _Log(), logging.getLogger("tifffile")
    logger.addHandler(log)
    propagated, logger.propagate = logger.propagate, False
    try:
        with tifffile.TiffFile(path) as tiff:
            lost = [message for message in log.messages if "offset" in message]
            if lost:
                raise IrrcacheError(
                    f"{path} is truncated or damaged ({lost[0]}); copy or export it again"
                )
            yield tiff
    finally:
        logger.removeHandler(log)
        logger.propagate = propagated


def _check_segments(path: Path, series: tifffile.TiffPageSeries) -> None:
    """Refuse a truncated file: tifffile would fill what is missing with zeros."""
    size = path.stat().st_size
    ends = [
        begin + count
        for page in series.pages
        if page is not None
        for begin, count in zip(page.dataoffsets, page.databytecounts, strict=True)
    ]
    if series.dataoffset is not None:
        ends.append(series.dataoffset + series.nbytes)
    if not ends or max(ends) > size:
        raise IrrcacheError(
            f"{path} is truncated: {size} bytes, but its pages end at byte {max(ends, default=0)}; "
            "copy or export it again"
        )


def _decoded(path: Path, series: tifffile.TiffPageSeries) -> np.ndarray:
    try:
        return series.asarray()
    except (KeyError, ValueError) as error:
        if "imagecodecs" not in str(error):
            raise
        kind = series.keyframe.compression.name
        raise IrrcacheError(
            f'{path} is compressed by {kind}, which needs "imagecodecs", which is not installed. '
            f"Remedy: {remedy('microscopy')}, or save the file without compression"
        ) from error


def _voxel_size(
    path: Path, tiff: tifffile.TiffFile, number: int = 0
) -> tuple[tuple[float, float, float], str]:
    """Return the voxel size along x, y, z of the series with this ``number``, and its unit; 1 where
    the file states none.

    The resolution of plain TIFF files is that of a printer, and is ignored.
    """
    if tiff.ome_metadata:
        images = [e for e in ElementTree.fromstring(tiff.ome_metadata).iter() if _is_pixels(e)]
        pixels = images[number] if number < len(images) else None
        if pixels is not None and "PhysicalSizeX" in pixels.attrib:
            sizes = [float(pixels.get(f"PhysicalSize{axis}", 1.0)) for axis in "XYZ"]
            units = [pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"]
            factors = factors_to_first(str(path), units)
            return tuple(s * f for s, f in zip(sizes, factors, strict=True)), units[0]
    if tiff.imagej_metadata is not None:
        tags = tiff.pages[0].tags
        sizes = [_edge(tags, "XResolution"), _edge(tags, "YResolution")]
        depth = float(tiff.imagej_metadata.get("spacing", 1.0))
        unit = str(tiff.imagej_metadata.get("unit", "")).replace("\\u00B5", "µ")
        return (*sizes, depth), "" if unit == "pixel" else unit
    return (1.0, 1.0, 1.0), ""


def _is_pixels(element: ElementTree.Element) -> bool:
    return element.tag.rpartition("}")[2] == "Pixels"


def _edge(tags: tifffile.TiffTags, name: str) -> float:
    """Return the edge of a pixel in ImageJ's unit."""
    if name not in tags:
        return 1.0
    pixels, length = tags[name].value
    return length / pixels if pixels else 1.0
