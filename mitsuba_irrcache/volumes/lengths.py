"""Units as data sets of the atmospheric sciences write them."""

from __future__ import annotations

import re

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
}
#: kg per m^3 of units of mass per volume; kg per kg of mixing ratios.
_DENSITY = {"kg m-3": 1.0, "g m-3": 1e-3, "mg m-3": 1e-6, "g cm-3": 1e3}
_RATIO = {"kg kg-1": 1.0, "g kg-1": 1e-3, "mg kg-1": 1e-6, "1": 1.0}


def metres(unit: str) -> float | None:
    """Return the length of a unit in metres; None if it is none of length."""
    return _METRES.get(_plain(unit).lower())


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
