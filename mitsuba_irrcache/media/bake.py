"""Convert Mitsuba's media to grids."""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import (
    ConstantField,
    Field,
    GridField,
    error_of_texture_units,
    positions_between_voxels,
)
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import phase_of

MEDIA = ("HeterogeneousMedium", "HomogeneousMedium")
#: Number of points at which converted fields are compared with the medium; largest error relative
#: to the extinction there, which counts as at least this part of the maximum; and number of points
#: at which it may be larger.
VERIFIED, MOST_LOCAL_ERROR, SMALL_EXTINCTION, MOST_WRONG = 4096, 0.05, 1e-3, 16


def bake(medium: mi.Medium, boundary: Boundary) -> MediumGrid:
    """Convert a ``heterogeneous`` or ``homogeneous`` medium to fields on the medium's own grids.

    Raises UnsupportedSceneError for other media, volume plugins and phase functions, and
    IrrcacheError for invalid values (NaN, negative extinction, albedo outside [0, 1]).
    """
    name = f'medium "{medium.id()}" ({medium.class_name()})'
    if medium.class_name() not in MEDIA:
        raise UnsupportedSceneError(
            f'irrcache: {name} is not supported, only "heterogeneous" and "homogeneous" are; use '
            '"volpath".'
        )
    phase = phase_of(medium, boundary, name)
    volumes = children(medium)
    scale = float(mi.traverse(medium)["scale"])
    if not np.isfinite(scale) or scale < 0:
        raise IrrcacheError(
            f"irrcache: {name} has scale {scale}; it must be finite and not negative."
        )
    sigma_t = baked_field(volumes["sigma_t"], f"sigma_t of {name}", scale)
    albedo = baked_field(volumes["albedo"], f"albedo of {name}", 1.0)
    if sigma_t.grid is not None and albedo.grid is not None:
        albedo.grid = albedo.grid.shared(sigma_t.grid)
    if albedo.maximum > 1.0 + 1e-6:
        raise IrrcacheError(
            f"irrcache: the albedo of {name} reaches {albedo.maximum:g}; above 1 a medium creates "
            "energy. Clip it to [0, 1]."
        )
    bounded = medium.class_name() == "HeterogeneousMedium"
    bbox = _clipping_box(volumes["sigma_t"], boundary) if bounded else None
    grid = MediumGrid(sigma_t, albedo, boundary, bbox, phase=phase, name=medium.id())
    _verify(medium, grid, name)
    return grid


def children(node: mi.Object) -> dict[str, mi.Object]:
    """Return the Mitsuba objects that ``node`` exposes to a traversal, by name."""

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.found: dict[str, mi.Object] = {}

        def put(self, name, value, flags, cpptype=None) -> None:
            if isinstance(value, mi.Object):
                self.found[name] = value

    callback = Children()
    node.traverse(callback)
    return callback.found


def baked_field(volume: mi.Volume, name: str, scale: float) -> Field:
    """Convert a ``constvolume`` or ``gridvolume``, times ``scale``; errors call it ``name``."""
    if volume.class_name() == "ConstVolume":
        return _constant(volume, name, scale)
    if volume.class_name() != "GridVolume":
        raise UnsupportedSceneError(
            f'irrcache: the {name} is a {volume.class_name()}; only "gridvolume" and "constvolume" '
            'are supported. Resample it to a gridvolume or use "volpath".'
        )
    tensor = dr.detach(mi.traverse(volume)["data"])
    channels = tensor.shape[3]
    data = mi.Float(tensor.array)
    if channels not in (1, 3):
        raise UnsupportedSceneError(
            f"irrcache: the {name} has {channels} channels; 1 or 3 are supported."
        )
    _check_values(data, tensor.shape, name)
    if channels == 3 and mi.is_monochromatic:
        rgb = dr.unravel(mi.Color3f, data)
        data, channels = mi.luminance(rgb), 1
        dr.eval(data)
    return GridField(Grid(tensor.shape[:3], _placement(volume)), data, channels, scale)


def _constant(volume: mi.Volume, name: str, scale: float) -> ConstantField:
    values = np.array(volume.eval(dr.zeros(mi.Interaction3f, 1)), dtype=np.float64).reshape(-1)
    if not np.isfinite(values).all() or values.min() < 0:
        raise IrrcacheError(
            f"irrcache: the {name} is {values}; it must be finite and not negative."
        )
    return ConstantField(values[:1] if np.ptp(values) == 0 else values, scale)


def _check_values(data: mi.Float, shape: tuple[int, ...], name: str) -> None:
    bad = ~(data >= 0) | ~dr.isfinite(data)
    count = int(dr.count(bad)[0])
    if not count:
        return
    where = int(dr.min(dr.select(bad, dr.arange(mi.UInt32, dr.width(data)), 0xFFFFFFFF))[0])
    z, y, x, _ = (int(i) for i in np.unravel_index(where, shape))
    value = float(dr.slice(data, where))
    raise IrrcacheError(
        f"irrcache: the {name} has {count} values that are negative or not finite, the first at "
        f"voxel (z, y, x) = ({z}, {y}, {x}): {value:g}. Clean the data first (numpy.nan_to_num, "
        'numpy.clip, or "irrcache import --clip ... --replace-nan ...").'
    )


def _placement(volume: mi.Volume) -> np.ndarray:
    """Return ``to_world`` of a volume's unit cube.

    Mitsuba exposes it only as text with six digits. Position and size are therefore corrected with
    the bounding box, which makes axis-aligned placements exact, and rotated ones accurate to 1e-6
    of the size of the grid.
    """
    number = r"[-+0-9.einfa]+"
    row = rf"\[({number}), ({number}), ({number}), ({number})\]"
    match = re.search(r"matrix=\[" + r",\s*".join([row] * 4) + r"\]", str(volume))
    if match is None:
        raise UnsupportedSceneError(
            f"irrcache: cannot read the placement of {volume.class_name()} from its description; "
            'this version of Mitsuba is not supported. Use "volpath" and report this.'
        )
    to_world = np.linalg.inv(np.array([float(v) for v in match.groups()]).reshape(4, 4))
    lower, upper = (np.array(p, dtype=np.float64) for p in (volume.bbox().min, volume.bbox().max))
    linear = to_world[:3, :3]
    linear *= ((upper - lower) / np.abs(linear).sum(axis=1))[:, None]
    linear[np.abs(linear) < 1e-9 * np.abs(linear).max()] = 0.0
    to_world[:3, 3] = 0.5 * (lower + upper) - 0.5 * linear.sum(axis=1)
    return to_world


def _clipping_box(volume: mi.Volume, boundary: Boundary) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the world box, as (lower, upper), to which Mitsuba clips a heterogeneous medium.

    Returns None if the boundary lies inside of that box.
    """
    lower, upper = (np.array(p, dtype=np.float64) for p in (volume.bbox().min, volume.bbox().max))
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
    world = boundary.frame[:3, :3] @ corners + boundary.frame[:3, 3:]
    slack = 1e-5 * (upper - lower).max()
    if (world.min(axis=1) >= lower - slack).all() and (world.max(axis=1) <= upper + slack).all():
        return None
    return lower, upper


def _verify(medium: mi.Medium, grid: MediumGrid, name: str) -> None:
    """Compare the converted fields with the coefficients that Mitsuba evaluates at random points,
    anywhere in the medium and between voxels that differ.

    This detects properties of volumes that cannot be queried, such as the filter type "nearest" and
    the wrap mode "repeat", which would otherwise be rendered wrongly.
    """
    rng = mi.PCG32(VERIFIED)
    frame = Grid((1, 1, 1), grid.frame)
    u = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    _compare(medium, grid, name, frame.world.point(u))
    for field in (grid.sigma_t, grid.albedo):
        p = positions_between_voxels(field, VERIFIED)
        if p is not None:
            _compare(medium, grid, name, p)


def _compare(medium: mi.Medium, grid: MediumGrid, name: str, p: mi.Point3f) -> None:
    """Raise UnsupportedSceneError if Mitsuba evaluates other coefficients at positions ``p``."""
    interaction = dr.zeros(mi.MediumInteraction3f, VERIFIED)
    interaction.p = p
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(interaction, True)
    own_sigma_t = mi.Spectrum(grid.sigma_t.at_world(p))
    own_albedo = grid.albedo.at_world(p)
    own_sigma_s = own_sigma_t * own_albedo
    scale = max(grid.sigma_t.maximum, 1e-30)
    inexact_sigma_t = error_of_texture_units(grid.sigma_t, p)
    inexact_albedo = error_of_texture_units(grid.albedo, p)
    inexact_sigma_s = own_sigma_t * inexact_albedo + own_albedo * inexact_sigma_t
    error_sigma_t = dr.max(dr.abs(mi.Spectrum(sigma_t) - own_sigma_t) - inexact_sigma_t)
    error = dr.maximum(
        error_sigma_t, dr.max(dr.abs(mi.Spectrum(sigma_s) - own_sigma_s) - inexact_sigma_s)
    )
    worst, worst_sigma_t = (float(dr.max(e)[0]) / scale for e in (error, error_sigma_t))
    if worst > 0.02:
        what = "sigma_t" if worst_sigma_t > 0.02 else "albedo"
        raise volume_error(f"{what} of {name}, off by {worst:.1%} of its maximum,")
    # A few dense voxels hide errors elsewhere: compare with the extinction at each point, too, but
    # for single points that rounding puts on the other side of a face.
    least = dr.opaque(mi.Float, SMALL_EXTINCTION * scale)
    local = dr.maximum(dr.max(mi.Spectrum(sigma_t)), least)
    wrong, wrong_sigma_t = (
        int(dr.count(e > MOST_LOCAL_ERROR * local)[0]) for e in (error, error_sigma_t)
    )
    if wrong > MOST_WRONG:
        what = "sigma_t" if wrong_sigma_t > MOST_WRONG else "albedo"
        raise volume_error(
            f"{what} of {name}, off by more than {MOST_LOCAL_ERROR:.0%} at {wrong} of {VERIFIED} "
            "points,"
        )


def volume_error(name: str) -> UnsupportedSceneError:
    """Return the error for a volume that does not interpolate as expected."""
    return UnsupportedSceneError(
        f"irrcache: {name} does not interpolate as expected. Only trilinear, clamped volumes are "
        'supported: use filter_type "trilinear" and wrap_mode "clamp", or render with "volpath". '
        "A rotation in its to_world needs an axis of length 1, which Mitsuba does not normalise. "
        "If its data were edited in place, as through a NumPy view, Mitsuba still evaluates a copy "
        'of the old data: call params.set_dirty("....data") with their key, and params.update().'
    )
