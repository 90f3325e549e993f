"""Units as data sets of the atmospheric sciences write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mitsuba_irrcache.errors import IrrcacheError

#: Metres per unit of length.
_METRES = {
    "m": 1.0,
    "meter": 1.0,
    "meters": 1.0,
    "metre": 1.0,
    "metres": 1.0,
    "km": 1e3,
    "kilometer": 1e3,
    "kilometers": 1e3,
    "kilometre": 1e3,
    "kilometres": 1e3,
    "cm": 1e-2,
    "mm": 1e-3,
    "millimeter": 1e-3,
    "millimetre": 1e-3,
    "um": 1e-6,
    "micron": 1e-6,
    "microns": 1e-6,
    "micrometer": 1e-6,
    "micrometers": 1e-6,
    "micrometre": 1e-6,
    "micrometres": 1e-6,
    "nm": 1e-9,
    "nanometer": 1e-9,
    "nanometers": 1e-9,
    "nanometre": 1e-9,
    "centimeter": 1e-2,
    "centimetre": 1e-2,
}
#: kg per m^3 of units of mass per volume; kg per kg of mixing ratios.
_DENSITY = {"kg m-3": 1.0, "g m-3": 1e-3, "mg m-3": 1e-6, "g cm-3": 1e3}
_RATIO = {"kg kg-1": 1.0, "g kg-1": 1e-3, "mg kg-1": 1e-6, "1": 1.0}


def metres(unit: str) -> float | None:
    """Return the length of a unit in metres; None if it is none of length."""
    return _METRES.get(_plain(unit).lower())


def factors_to_first(source: str, units: Sequence[str]) -> list[float]:
    """Return the factors that convert lengths along x, y, z, in these ``units``, to the first unit.
    A missing one ("") is that of the others.

    Raises:
        IrrcacheError: different units of which one is none of length; ``source`` is named.
    """
    given = {unit for unit in units if unit}
    if len(given) < 2:
        return [1.0] * len(units)
    known = [metres(unit or units[0]) for unit in units]
    if None in known:
        raise IrrcacheError(
            f"{source} has voxel sizes in {', '.join(map(repr, units))} along x, y, z, and "
            f"{units[known.index(None)]!r} is no unit of length that is known; give --spacing X,Y,Z"
        )
    return [metre / known[0] for metre in known]


def mass_density(unit: str) -> float | None:
    """Return a unit of mass per volume in kg/m^3, or None."""
    return _DENSITY.get(_plain(unit).lower())


def mixing_ratio(unit: str) -> float | None:
    """Return a unit of mass per mass of air in kg/kg, or None."""
    return _RATIO.get(_plain(unit).lower())


def _plain(unit: str) -> str:
    """Write ``g/m**3``, ``g.m^-3`` and the like as ``g m-3``."""
    text = re.sub(r"[µμ]", "u", unit.strip())
    text = re.sub(r"\*\*|\^|\{|\}", "", text)
    text = re.sub(r"\s*/\s*([A-Za-z]+)(\d*)", lambda m: f" {m[1]}-{m[2] or 1}", text)
    return re.sub(r"[\s.*]+", " ", text).strip()
