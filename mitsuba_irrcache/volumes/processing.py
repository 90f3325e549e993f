"""Operations on volumes before they become a medium: crop, clip, rescale, resample, bake.

SciPy belongs to an extra and is imported where it is used, so that a command can print its help
without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.transfer import DensityMapping, TransferFunction

Size = tuple[int, int, int]
# Voxels eroded before objects are labelled: thicker than noise, thinner than a mattress.
_BRIDGE = 2
#: Estimated bytes per voxel: of values, smoothed and interpolated values; and of these with
#: extinction, albedo and the temporaries of a transfer function.
RESAMPLED, BAKED = 12, 60


def crop(volume: VolumeData, ranges: Sequence[tuple[int | None, int | None]]) -> VolumeData:
    """Keep the voxels with ``start <= index < stop`` along x, y, z, at their world positions.

    Args:
        volume: the volume to crop; the result shares its memory.
        ranges: three pairs ``(start, stop)``; None means from the first, or to the last voxel.

    Raises:
        IrrcacheError: a range that is empty or reaches outside.
    """
    bounds = []
    for axis, (start, stop), count in zip("xyz", ranges, volume.size, strict=True):
        first, last = 0 if start is None else start, count if stop is None else stop
        if not 0 <= first < last <= count:
            raise IrrcacheError(
                f"crop {first}:{last} along {axis}: give start < stop within 0:{count}"
            )
        bounds.append((first, last))
    (x0, x1), (y0, y1), (z0, z1) = bounds
    origin = volume.index_to_world @ (x0, y0, z0, 1.0)
    return replace(volume, values=volume.values[z0:z1, y0:y1, x0:x1], origin=tuple(origin[:3]))


def clip(volume: VolumeData, low: float, high: float) -> VolumeData:
    """Limit the values to ``[low, high]``.

    Raises:
        IrrcacheError: ``low`` is not below ``high``.
    """
    if not low < high:
        raise IrrcacheError(f"clip {low:g}:{high:g}: give the lower value first")
    values = np.asarray(volume.values)
    if values.dtype.kind in "iu":
        limits = np.iinfo(values.dtype)
        low, high = max(np.ceil(low), limits.min), min(np.floor(high), limits.max)
    return replace(volume, values=np.clip(values, low, high).astype(values.dtype, copy=False))


def rescale(volume: VolumeData, slope: float, intercept: float) -> VolumeData:
    """Return ``slope * value + intercept``, float32, for example to obtain Hounsfield units.

    Raises:
        IrrcacheError: a slope of 0, or either not finite.
    """
    if slope == 0 or not np.isfinite([slope, intercept]).all():
        raise IrrcacheError(f"rescale by {slope}, {intercept}: give finite values, slope not 0")
    values = np.asarray(volume.values, dtype=np.float32) * np.float32(slope)
    return replace(volume, values=values + np.float32(intercept))


def flip(volume: VolumeData, axes: str) -> VolumeData:
    """Mirror the values along the named axes, e.g. ``"xz"``, inside the same box.

    Raw slices have no orientation, so an imported head may be upside down.
    """
    order = tuple(slice(None, None, -1 if axis in axes else 1) for axis in "zyx")
    return replace(volume, values=volume.values[order])


def isolate(volume: VolumeData, threshold: float) -> VolumeData:
    """Keep the largest connected object above ``threshold``; set all else to the minimum value.

    Removes the table and the tubes around a patient. Bridges up to four voxels thick are cut,
    except for stubs of four voxels. Cavities that the object encloses within a slice, such as
    lungs, are preserved, and so is a rim of one voxel, in which the surface is blurred.

    Raises:
        IrrcacheError: nothing thicker than four voxels lies above ``threshold``.
    """
    from scipy import ndimage

    values = np.asarray(volume.values)
    above = values > threshold
    # The object is assumed to continue beyond the border of the volume.
    cores = ndimage.binary_erosion(above, iterations=_BRIDGE, border_value=1)
    labels, count = ndimage.label(cores)
    if count == 0:
        raise IrrcacheError(
            f"isolate {threshold:g}: nothing of {volume.source!r} lies above it (values are "
            f"{values.min():g} .. {values.max():g}); give a lower threshold"
        )
    core = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    # Dilated twice as far as eroded, to restore ears and other edges that the erosion rounded off.
    kept = ndimage.binary_dilation(core, iterations=2 * _BRIDGE, mask=above)
    for part in tqdm(kept, "isolating", delay=1, disable=None):
        ndimage.binary_dilation(ndimage.binary_fill_holes(part), output=part)
    return replace(volume, values=np.where(kept, values, values.min()))


def size_for_voxel(volume: VolumeData, voxel_size: float) -> Size:
    """Return counts along x, y, z for near-cubic voxels of ``voxel_size`` (world units).

    Raises:
        IrrcacheError: a voxel size that is not positive.
    """
    counts = [length / voxel_size if voxel_size else np.inf for length in volume.physical_size]
    if not (np.isfinite([voxel_size, *counts]).all() and voxel_size > 0):
        raise IrrcacheError(f"voxel size {voxel_size}: give a positive length")
    x, y, z = (max(1, round(count)) for count in counts)
    return x, y, z


def size_for_longest(volume: VolumeData, longest: int) -> Size:
    """Return counts along x, y, z with ``longest`` near-cubic voxels along the longest side.

    Raises:
        IrrcacheError: ``longest`` below 1.
    """
    if longest < 1:
        raise IrrcacheError(f"longest side of {longest} voxels: give at least 1")
    return size_for_voxel(volume, max(volume.physical_size) / longest)


def resample(volume: VolumeData, size: Size) -> VolumeData:
    """Interpolate linearly to ``size`` voxels (x, y, z) in the same box, float32.

    Axes that lose resolution are smoothed first, so that thin structures are blurred instead of
    aliased. (Cubic interpolation would ring below zero next to bone.)

    Raises:
        IrrcacheError: a size with a side below 1, or more voxels than fit in memory.
    """
    if min(size) < 1:
        raise IrrcacheError(f"size {size}: give at least 1 voxel along x, y and z")
    _check_memory(size, RESAMPLED)
    smooth = _antialiased(volume.values, size)
    spacing = np.array(volume.physical_size) / size
    # The box is unchanged; the centre of its first voxel is half a new voxel from the corner.
    first_centre = volume.to_world @ (*(0.5 / np.array(size)), 1.0)
    return replace(
        volume,
        values=_sample_slices(smooth, size, 0, size[2]),
        spacing=tuple(spacing),
        origin=tuple(first_centre[:3]),
    )


def bake(
    volume: VolumeData,
    mapping: TransferFunction | DensityMapping,
    size: Size,
    supersample: int = 1,
) -> tuple[VolumeData, np.ndarray, np.ndarray]:
    """Turn a volume into the grids of a medium, of ``size`` voxels (x, y, z).

    A medium's grids hold extinction, so a transfer function acts *before* the renderer
    interpolates. Where it is steep, between soft tissue and bone, the interpolated extinction is
    not that of the interpolated value: thin bone gets blurred and thicker. ``supersample`` = k
    applies it at k times the resolution and averages the results, in blocks of k^3: extinction by
    volume, albedo weighted by extinction.

    Returns:
        the volume resampled to ``size`` (``volume`` itself where nothing changes), extinction
        float32 ``(z, y, x)`` in 1/world unit, and albedo float32 ``(z, y, x, 3)``.

    Raises:
        IrrcacheError: ``supersample`` below 1, or more voxels than fit in memory.
    """
    if supersample < 1:
        raise IrrcacheError(f"supersample {supersample}: give at least 1")
    _check_memory(size, BAKED, supersample)
    resampled = volume if size == volume.size else resample(volume, size)
    if supersample == 1:
        return resampled, *mapping.apply(resampled.values)
    fitted = mapping.fitted_to(resampled.values)
    fine = tuple(n * supersample for n in size)
    smooth = _antialiased(volume.values, fine)
    x, y, z = size
    sigma_t = np.empty((z, y, x), dtype=np.float32)
    albedo = np.empty((z, y, x, 3), dtype=np.float32)
    for k in tqdm(range(z), "supersampling", delay=1, disable=None):
        part = _sample_slices(smooth, fine, k * supersample, (k + 1) * supersample)
        sigma_t[k], albedo[k] = _average_blocks(*fitted.map(part), supersample)
    return resampled, sigma_t, albedo


def _check_memory(size: Size, bytes_per_voxel: int, supersample: int = 1) -> None:
    """Refuse grids that do not fit in memory together with the finer slab."""
    x, y, z = size
    slab = x * y * supersample**3 if supersample > 1 else 0
    finer = f" in blocks of {supersample}^3" if slab else ""
    require_memory(
        (x * y * z + slab) * bytes_per_voxel,
        f"a volume of {x} x {y} x {z} voxels{finer}",
        "ask for fewer (--voxel-size, --longest, --crop" + (", --supersample)" if slab else ")"),
    )


def _antialiased(values: np.ndarray, size: Size) -> np.ndarray:
    """Smooth values along the axes that lose resolution, with half a new voxel as half-width."""
    from scipy import ndimage

    factors = np.array(values.shape) / np.array(size[::-1])
    sigma = np.maximum(0.0, (factors - 1.0) / 2.0)
    if not sigma.any():
        return values
    return ndimage.gaussian_filter(values, sigma, output=np.float32, mode="nearest", truncate=3.0)


def _sample_slices(values: np.ndarray, size: Size, first: int, last: int) -> np.ndarray:
    """Resample slices ``first .. last - 1`` of a grid of ``size`` voxels in the same box.

    Only the source slices that they need are read; float32 ``(last - first, y, x)``.
    """
    from scipy import ndimage

    x, y, z = size
    step = np.array(values.shape) / (z, y, x)
    start = step * (first + 0.5, 0.5, 0.5) - 0.5
    bottom = int(np.clip(np.floor(start[0]), 0, len(values) - 1))
    top = int(np.clip(np.ceil(start[0] + step[0] * (last - first - 1)), 0, len(values) - 1))
    start[0] -= bottom
    source = np.asarray(values[bottom : top + 1], dtype=np.float32)
    return ndimage.affine_transform(
        source, step, start, (last - first, y, x), order=1, mode="nearest"
    )


def _average_blocks(sigma_t: np.ndarray, albedo: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
    """Average blocks of a slab ``k`` thick: extinction ``(y, x)``, albedo ``(y, x, 3)``."""
    y, x = sigma_t.shape[1] // k, sigma_t.shape[2] // k
    blocks = (k, y, k, x, k)
    axes = (0, 2, 4)
    extinction = sigma_t.reshape(blocks).mean(axis=axes)
    scattering = (sigma_t[..., None] * albedo).reshape(*blocks, 3).mean(axis=axes)
    plain = albedo.reshape(*blocks, 3).mean(axis=axes)
    divisor = np.where(extinction > 0, extinction, 1.0)[..., None]
    mean_albedo = np.where(extinction[..., None] > 0, scattering / divisor, plain)
    return extinction, np.minimum(mean_albedo, 1.0)  # rounding errors may slightly exceed 1
