"""A procedural cumulus cloud for use without data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.phantom.shape import check_memory, checked_shape
from mitsuba_irrcache.volumes.phantom.texture import interpolate

SMALLEST_SIDE = 32

# Positions and lengths refer to a cubic box, [-1, 1]^3. Nothing lies beyond LIMIT along any axis,
# so that the outermost two voxels are empty at the lowest resolution, too.
LIMIT = 1 - 4 / SMALLEST_SIDE

# Centres (x, y, z) and radii of the spheres that form the cloud, and the height of its flat base.
BALLS = (
    ((0.04, 0.04, -0.08), 0.52),
    ((-0.42, -0.14, -0.46), 0.36),
    ((0.42, -0.22, -0.44), 0.34),
    ((0.03, -0.42, -0.50), 0.34),
    ((-0.05, 0.42, -0.40), 0.34),
    ((-0.14, 0.00, 0.38), 0.34),
    ((0.28, 0.12, 0.24), 0.32),
    ((-0.38, 0.35, -0.50), 0.34),
    ((0.40, 0.34, -0.48), 0.34),
)
BASE = -0.68

# Lattice spacing of the noise octaves whose folds form the billows, and their amplitudes.
OCTAVES = ((0.45, 0.14), (0.23, 0.10), (0.12, 0.06), (0.063, 0.03))
# Amplitude of the billows at the base, as a share.
BASE_BILLOWS = 0.3

# Distance from the surface over which the density increases.
EDGE = 0.09
# Density between the billows, and its slope with their amplitude; it is clamped to 1.
CREVICE, RISE = 0.5, 3.0

# Peak memory in bytes per voxel, except for small volumes, and voxels computed at a time.
BYTES_PER_VOXEL = 6
_AT_A_TIME = 1 << 17


def cloud(shape: Sequence[int] = (128, 128, 128), memory_limit: int = 8 * 2**30) -> VolumeData:
    """Create a cumulus with a flat base and billows of several sizes, as densities of 0 to 1.

    The voxels are cubes, and the box, whose longest side is 2, is centred at the origin with +z up;
    the cloud is stretched to its sides. Equal shapes give equal volumes, and a position relative to
    the sides has the same density at every resolution. Two voxels at least are empty (exactly 0)
    along every side.

    Args:
        shape: voxel counts ``(z, y, x)``, each at least 32.
        memory_limit: maximum memory in bytes.

    Returns:
        Values float32, shape ``shape``.

    Raises:
        IrrcacheError: a shape of other than three integers, a side below 32, or a volume that needs
            more than ``memory_limit``.
    """
    shape = checked_shape(shape, SMALLEST_SIDE)
    check_memory(shape, shape, BYTES_PER_VOXEL, memory_limit)
    z, y, x = (((np.arange(n) + 0.5) * (2 / n) - 1).astype(np.float32) for n in shape)
    lattices = _lattices()
    values = np.empty(shape, dtype=np.float32)
    step = max(1, _AT_A_TIME // (y.size * x.size))
    for start in range(0, z.size, step):
        part = slice(start, start + step)
        values[part] = _density((x, y, z[part]), lattices)
    spacing = 2 / max(shape)
    return VolumeData(
        values=values,
        spacing=(spacing,) * 3,
        origin=tuple(spacing * (1 - n) / 2 for n in shape[::-1]),
        source="phantom:cloud",
    )


def _density(coordinates: Sequence[np.ndarray], lattices: Sequence[np.ndarray]) -> np.ndarray:
    """Return the density (z, y, x) at a grid's x, y and z."""
    x, y, z = _open_grid(coordinates)
    billows = np.zeros((z.size, y.size, x.size), dtype=np.float32)
    for lattice, (pitch, reach) in zip(lattices, OCTAVES, strict=True):
        billows += np.float32(reach) * np.abs(_noise(lattice, coordinates, pitch))
    depth = billows - _distance(x, y, z)
    np.minimum(depth, z - np.float32(BASE) + np.float32(BASE_BILLOWS) * billows, out=depth)
    for axis in (x, y, z):
        np.minimum(depth, np.float32(LIMIT) - np.abs(axis), out=depth)
    depth *= np.float32(1 / EDGE)
    density = np.clip(depth, 0, 1, out=depth)
    billows *= np.float32(RISE)
    billows += np.float32(CREVICE)
    density *= np.minimum(billows, 1, out=billows)
    return density


def _distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the signed distance to the union of the spheres, negative inside."""
    nearest = np.full((z.size, y.size, x.size), np.inf, dtype=np.float32)
    for centre, radius in BALLS:
        cx, cy, cz = np.float32(centre)
        distance = (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2
        np.sqrt(distance, out=distance)
        distance -= np.float32(radius)
        np.minimum(nearest, distance, out=nearest)
    return nearest


def _lattices(seed: int = 28) -> list[np.ndarray]:
    """Return random linear functions at the lattice points of each octave, (4, z, y, x).

    The first three are the gradient along x, y and z, the last the value at the box's lower corner.
    Only uniform deviates of a fixed bit generator are drawn, whose stream NumPy guarantees.
    """
    generator = np.random.Generator(np.random.PCG64(seed))
    lattices = []
    for pitch, _ in OCTAVES:
        count = int(np.ceil(2 / pitch)) + 1
        lattice = 2 * generator.random((4, count, count, count), dtype=np.float32) - 1
        # Values are drawn at the lattice points, then extrapolated to the corner of the box.
        for gradient, index in zip(
            lattice[:3], _open_grid([np.arange(count, dtype=np.float32)] * 3), strict=True
        ):
            lattice[3] -= gradient * index
        lattices.append(lattice)
    return lattices


def _noise(lattice: np.ndarray, coordinates: Sequence[np.ndarray], pitch: float) -> np.ndarray:
    """Return smooth noise (z, y, x): the linear functions, blended with quintic weights."""
    positions = [(axis + 1) / np.float32(pitch) for axis in coordinates]
    total = _blend(lattice[3], positions)
    for gradient, position in zip(lattice[:3], _open_grid(positions), strict=True):
        total += _blend(gradient, positions) * position
    return total


def _blend(lattice: np.ndarray, positions: Sequence[np.ndarray]) -> np.ndarray:
    """Interpolate with quintic weights at fractional indices along x, y and z."""
    # Along z first, where the grid has the fewest points.
    for axis, position in enumerate(positions[::-1]):
        index = np.floor(position)
        t = position - index
        weight = t * t * t * (t * (6 * t - 15) + 10)
        lattice = interpolate(lattice, index + weight, axis)
    return lattice


def _open_grid(axes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y, z = axes
    return x[None, None, :], y[None, :, None], z[:, None, None]
