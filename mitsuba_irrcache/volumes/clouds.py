"""Clouds of large-eddy simulations: liquid water content and effective radius to extinction.

In the geometric limit (droplets much larger than the wavelength) a droplet removes twice its cross
section from a beam, so ``sigma_t = 3 LWC / (2 rho_w r_eff)``, where the liquid water content is
mass per volume of air, ``rho_w`` is the density of water and ``r_eff`` the ratio of the third to
the second moment of the radii (Stephens 1978; Hansen and Travis 1974).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.lengths import mass_density, metres, mixing_ratio
from mitsuba_irrcache.volumes.netcdf_files import (
    open_dataset,
    read_variable,
    spatial_axes,
    values_at_levels,
)
from mitsuba_irrcache.volumes.options import CloudVariables, ReadOptions, chosen_field

#: Density of water [kg/m^3].
WATER = 1000.0
_WATER_NAMES = (
    "lwc",
    "liquid_water_content",
    "mass_concentration_of_cloud_liquid_water_in_air",
    "cloud_liquid_water_mixing_ratio",
    "mass_fraction_of_cloud_liquid_water_in_air",
    "ql",
    "qc",
    "qcloud",
    "clw",
    "ql_cloud",
    "cloud_water",
)
_RADIUS_NAMES = (
    "reff",
    "r_eff",
    "re",
    "rel",
    "effective_radius",
    "re_cloud",
    "effective_radius_of_cloud_liquid_water_particles",
    "effective_radius_of_cloud_liquid_water_particle",
)
_AIR_NAMES = ("rho", "rho_air", "air_density", "rhoa", "density", "rhobar")


def read_cloud(path: Path, options: ReadOptions, variables: CloudVariables) -> VolumeData:
    """Read the extinction of a cloud, per unit of length of the coordinates.

    Units are taken from the attributes ``units``. Where there is no water, the effective radius may
    be zero or missing.

    Raises:
        IrrcacheError: a damaged file; a variable that is not found, or whose unit is missing or
            unknown; coordinates without a unit; water without a positive radius.
    """
    with open_dataset(path) as dataset:
        options = replace(options, field=None)
        name = _found(path, dataset, variables.water, _WATER_NAMES, "liquid water content")
        content = np.nan_to_num(values_at_levels(path, dataset, name, options), nan=0.0)
        content *= _water_unit(path, dataset, name, options, variables)
        if content.min() < 0:
            raise IrrcacheError(
                f"{path}[{name}] is negative, {content.min():.3g} kg/m^3 at least; clip it at 0"
            )
        radius = _radius(path, dataset, options, variables, content > 0)
        sigma_t = np.where(content > 0, 1.5 * content / (WATER * radius), 0.0)
        found = read_variable(path, dataset, name, options, lambda _: sigma_t.astype(np.float32))
    length = metres(found.length_unit)
    if length is None:
        raise IrrcacheError(
            f"{path}: the coordinates of {name!r} have no unit of length, which the extinction "
            "refers to; add the attribute units (m or km) to them"
        )
    values = (found.values * length).astype(np.float32)
    return replace(found, values=values, unit=f"1/{found.length_unit}", source=str(path))


def _found(
    path: Path, dataset: xarray.Dataset, wanted: str | None, known: tuple[str, ...], what: str
) -> str:
    """Return the variable that is named, or the one whose name or standard name is known."""
    volumes = [str(n) for n in dataset.data_vars if len(spatial_axes(dataset[n])) == 3]
    if wanted is not None:
        return chosen_field(str(path), volumes, wanted, "variable")
    for candidate in known:
        for name in volumes:
            standard = str(dataset[name].attrs.get("standard_name", ""))
            if candidate in (name.lower(), standard):
                return name
    option = "--" + what.replace(" content", "").replace(" ", "-")
    raise IrrcacheError(
        f"{path} has no variable that is recognised as the {what}; name it with {option}: one of "
        f"{', '.join(map(repr, volumes)) or 'none with three axes'}"
    )


def _water_unit(
    path: Path,
    dataset: xarray.Dataset,
    name: str,
    options: ReadOptions,
    variables: CloudVariables,
) -> float | np.ndarray:
    """Return the factor that converts the liquid water content to kg/m^3."""
    unit = str(dataset[name].attrs.get("units", ""))
    factor = mass_density(unit)
    if factor is not None:
        return factor
    ratio = mixing_ratio(unit)
    if ratio is None:
        raise IrrcacheError(
            f"{path}[{name}] has the unit {unit!r}; give it the attribute units, g m-3 or kg m-3, "
            "or kg kg-1 for a mixing ratio"
        )
    if variables.air_density is not None:
        return ratio * variables.air_density
    for candidate in _AIR_NAMES:
        if candidate in dataset.data_vars and dataset[candidate].dims == dataset[name].dims:
            density = mass_density(str(dataset[candidate].attrs.get("units", "")))
            if density is not None:
                air = values_at_levels(path, dataset, candidate, options)
                return ratio * density * air
    raise IrrcacheError(
        f"{path}[{name}] is a mixing ratio ({unit}), and the file has no density of air; give "
        "--air-density KG_PER_M3, about 1.1 in low clouds"
    )


def _radius(
    path: Path,
    dataset: xarray.Dataset,
    options: ReadOptions,
    variables: CloudVariables,
    has_water: np.ndarray,
) -> np.ndarray:
    """Return the effective radius [m] of each voxel, 1 where there is no water."""
    if isinstance(variables.radius, float):
        return np.full(has_water.shape, variables.radius * 1e-6)
    name = _found(
        path, dataset, variables.radius, _RADIUS_NAMES, "effective radius (or a number of um)"
    )
    factor = metres(str(dataset[name].attrs.get("units", "")))
    if factor is None:
        unit = dataset[name].attrs.get("units", "")
        raise IrrcacheError(
            f"{path}[{name}] has the unit {unit!r}; give it the attribute units, um"
        )
    radius = values_at_levels(path, dataset, name, options) * factor
    if radius.shape != has_water.shape:
        raise IrrcacheError(
            f"{path}[{name}] has shape {radius.shape}, but the water {has_water.shape}; "
            "interpolate one to the grid of the other"
        )
    wrong = has_water & ~(radius > 0)
    if wrong.any():
        z, y, x = (int(i) for i in np.argwhere(wrong)[0])
        raise IrrcacheError(
            f"{path}[{name}] is {radius[z, y, x] * 1e6:g} um at voxel (x, y, z) = ({x}, {y}, {z}), "
            f"where there is water ({int(wrong.sum())} voxels in all); correct it, or give one "
            "radius by --effective-radius UM"
        )
    return np.where(has_water, radius, 1.0)
