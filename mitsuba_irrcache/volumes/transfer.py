"""Transfer functions: from voxel values to extinction and albedo.

The JSON format, with every key::

    {
      "format": "irrcache transfer function",
      "version": 1,
      "description": "what it shows",            optional
      "unit": "HU",                              what the values measure; "" where that is open
      "value_range": "absolute",                 or "percentile", see below
      "percentiles": [1.0, 99.5],                only with "percentile"
      "length": 1.0,                             mm over which an opacity is stated
      "opacity": [[-300, 0.0], [300, 0.4]],      points [value, opacity in [0, 1)]
      "colour": [[-300, [0.9, 0.7, 0.6]], ...]   points [value, [r, g, b]] in 0..1
    }

Points are sorted by value, linear in between and constant outside. An opacity is the share of the
radiance that is lost over ``length``: ``sigma_t = -ln(1 - opacity) / length``. The colour *is* the
albedo. With ``"value_range": "percentile"`` the data have no unit (as in MR): point values 0 and 1
stand for the two ``percentiles`` of all voxels of the imported volume.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mitsuba_irrcache.errors import IrrcacheError, suggestion
from mitsuba_irrcache.io.files import atomic_write

FORMAT = "irrcache transfer function"
VERSION = 1
_REQUIRED = {"format", "version", "opacity", "colour"}
_KEYS = _REQUIRED | {"description", "unit", "value_range", "percentiles", "length"}
_PRESETS = Path(__file__).parent / "presets"
_MAX_TABLE = 1 << 16
_MAX_PERCENTILE_SAMPLES = 10_000_000


@dataclass(frozen=True)
class TransferFunction:
    """Piecewise-linear opacity and colour over voxel values.

    Attributes:
        opacity_values: shape ``(n,)``, increasing.
        opacities: shape ``(n,)``, in ``[0, 1)``, per ``length``.
        colour_values: shape ``(m,)``, increasing.
        colours: shape ``(m, 3)``, in ``[0, 1]``: the albedo.
        length: mm to which the opacities refer.
        unit: the unit of the values, e.g. ``"HU"``.
        percentiles: for values relative to the data, the percentiles that 0 and 1 stand for.
        description: free text.

    Raises:
        IrrcacheError: points that define no medium; the first invalid one is named.
    """

    opacity_values: np.ndarray
    opacities: np.ndarray
    colour_values: np.ndarray
    colours: np.ndarray
    length: float = 1.0
    unit: str = ""
    percentiles: tuple[float, float] | None = None
    description: str = ""

    def __post_init__(self) -> None:
        for name in ("opacity_values", "opacities", "colour_values", "colours"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        _check_values("opacity", self.opacity_values)
        _check_values("colour", self.colour_values)
        _check_opacities(self.opacities)
        _check_colours(self.colours)
        if not (np.isfinite(self.length) and self.length > 0):
            raise IrrcacheError(f'"length" is {self.length}; give a positive length in mm')
        if self.percentiles is not None:
            low, high = self.percentiles
            if not 0 <= low < high <= 100:
                raise IrrcacheError(
                    f'"percentiles" is {[low, high]}; give two of 0..100, the lower one first'
                )

    def fitted_to(self, values: np.ndarray) -> TransferFunction:
        """Return the function with absolute point values, given the percentiles of ``values``.

        Of large volumes every n-th slice is read, about ten million voxels in all.

        Raises:
            IrrcacheError: the percentiles coincide, so the values cannot be scaled by them.
        """
        if self.percentiles is None:
            return self
        stride = min(values.size // _MAX_PERCENTILE_SAMPLES, len(values) // 8)
        sample = values[:: max(1, stride)]
        low, high = (float(p) for p in np.percentile(sample, self.percentiles))
        if not high > low:
            raise IrrcacheError(
                f"percentiles {list(self.percentiles)} of the data are both {low}; crop the empty "
                'space, or use a transfer function with "value_range": "absolute"'
            )
        return replace(
            self,
            opacity_values=low + self.opacity_values * (high - low),
            colour_values=low + self.colour_values * (high - low),
            percentiles=None,
        )

    def sigma_t(self, values: np.ndarray) -> np.ndarray:
        """Return the extinction in 1/mm, float32, for absolute values of any shape."""
        opacity = np.interp(values, self.opacity_values, self.opacities)
        return (-np.log1p(-opacity) / self.length).astype(np.float32)

    def albedo(self, values: np.ndarray) -> np.ndarray:
        """Return the albedo, float32 ``(..., 3)``, for absolute values of any shape."""
        albedo = np.empty((*values.shape, 3), dtype=np.float32)
        for channel in range(3):
            albedo[..., channel] = np.interp(values, self.colour_values, self.colours[:, channel])
        return albedo

    def apply(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map a volume ``(z, y, x)``, slice by slice so that temporaries stay small.

        Returns:
            extinction in 1/mm, float32 ``(z, y, x)``, and albedo, float32 ``(z, y, x, 3)``.
        """
        function = self.fitted_to(values)
        sigma_t = np.empty(values.shape, dtype=np.float32)
        albedo = np.empty((*values.shape, 3), dtype=np.float32)
        table = _IntegerTable.of(function, values)
        for z in tqdm(range(len(values)), "transfer function", delay=1, disable=None):
            sigma_t[z], albedo[z] = table.look_up(values[z]) if table else function.map(values[z])
        return sigma_t, albedo

    def map(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return extinction and albedo of absolute values of any shape, see ``apply``."""
        return self.sigma_t(values), self.albedo(values)

    def to_json(self) -> str:
        """Return the function in the format of this module."""
        document = {"format": FORMAT, "version": VERSION}
        if self.description:
            document["description"] = self.description
        document["unit"] = self.unit
        document["value_range"] = "absolute" if self.percentiles is None else "percentile"
        if self.percentiles is not None:
            document["percentiles"] = list(self.percentiles)
        document["length"] = self.length
        points = zip(self.opacity_values.tolist(), self.opacities.tolist(), strict=True)
        document["opacity"] = [list(point) for point in points]
        points = zip(self.colour_values.tolist(), self.colours.tolist(), strict=True)
        document["colour"] = [list(point) for point in points]
        return json.dumps(document, indent=2) + "\n"

    def save(self, path: str | os.PathLike) -> None:
        """Write the JSON file atomically."""
        with atomic_write(path) as stream:
            stream.write(self.to_json().encode())


@dataclass(frozen=True)
class _IntegerTable:
    """A transfer function tabulated over all integers that a volume contains; exact and fast."""

    first: int
    sigma_t: np.ndarray
    albedo: np.ndarray

    @classmethod
    def of(cls, function: TransferFunction, values: np.ndarray) -> _IntegerTable | None:
        """Create the table; None for real values and for ranges wider than the table may be."""
        if values.dtype.kind not in "iu":
            return None
        first, last = int(values.min()), int(values.max())
        if last - first >= _MAX_TABLE:
            return None
        return cls(first, *function.map(np.arange(first, last + 1)))

    def look_up(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        index = values.astype(np.int64) - self.first
        return self.sigma_t[index], self.albedo[index]


@dataclass(frozen=True)
class DensityMapping:
    """The mapping for volumes of densities: ``sigma_t = scale * density``, constant albedo.

    Attributes:
        scale: extinction per unit of density, in 1/scene unit.
        albedo: three values in ``[0, 1]``.

    Raises:
        IrrcacheError: a negative scale, or an albedo outside ``[0, 1]``.
    """

    scale: float = 1.0
    albedo: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale >= 0):
            raise IrrcacheError(f"density scale {self.scale}: give a finite value of at least 0")
        if len(self.albedo) != 3 or not all(0 <= a <= 1 for a in self.albedo):
            raise IrrcacheError(f"albedo {self.albedo}: give 1 or 3 values between 0 and 1")

    def fitted_to(self, values: np.ndarray) -> DensityMapping:
        """Return this mapping after checking that ``values`` has no negative densities.

        Raises:
            IrrcacheError: negative densities; their number and the least one are named.
        """
        negative = int(np.count_nonzero(values < 0))
        if negative:
            raise IrrcacheError(
                f"{negative} densities are negative, the least {float(values.min()):g}; "
                "clip them, e.g. --clip 0:inf"
            )
        return self

    def map(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return extinction, float32 like ``values``, and read-only albedo ``(..., 3)``."""
        albedo = np.broadcast_to(np.float32(self.albedo), (*values.shape, 3))
        return np.asarray(values * np.float32(self.scale), dtype=np.float32), albedo

    def apply(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map a volume ``(z, y, x)``; see ``map``."""
        return self.fitted_to(values).map(values)

    def to_json(self) -> str:
        """Return a record of the mapping, which is saved with the scene."""
        document = {
            "format": "irrcache density mapping",
            "version": VERSION,
            "scale": self.scale,
            "albedo": list(self.albedo),
        }
        return json.dumps(document, indent=2) + "\n"


def load_transfer_function(path: str | os.PathLike) -> TransferFunction:
    """Read a JSON file in the format of this module.

    Raises:
        IrrcacheError: the file is missing, no JSON, or describes no transfer function.
    """
    path = Path(path)
    if path.is_dir():
        raise IrrcacheError(f"transfer function {path} is a folder; name a JSON file")
    if not path.is_file():
        raise IrrcacheError(f"transfer function {path} does not exist")
    try:
        return parse_transfer_function(path.read_text(encoding="utf-8"))
    except (IrrcacheError, UnicodeDecodeError) as error:
        raise IrrcacheError(f"transfer function {path}: {error}") from error


def parse_transfer_function(text: str) -> TransferFunction:
    """Parse the JSON text of a transfer function.

    Raises:
        IrrcacheError: the invalid key and index are named.
    """
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        raise IrrcacheError(
            f"not JSON ({error}); the documentation describes the format under volume formats"
        ) from error
    _check_keys(document)
    opacity_values, opacities = _points(document, "opacity", 1)
    colour_values, colours = _points(document, "colour", 3)
    return TransferFunction(
        opacity_values,
        opacities[:, 0],
        colour_values,
        colours,
        length=_number(document.get("length", 1.0), '"length"'),
        unit=str(document.get("unit", "")),
        percentiles=_percentiles(document),
        description=str(document.get("description", "")),
    )


def preset_names() -> list[str]:
    """Return the sorted names of the presets that the package contains."""
    return sorted(p.stem for p in _PRESETS.glob("*.json"))


def load_preset(name: str) -> TransferFunction:
    """Return a preset by name.

    Raises:
        IrrcacheError: no preset of that name; the names are listed.
    """
    if name not in preset_names():
        raise IrrcacheError(
            f"no preset {name!r}{suggestion(name, preset_names())}; choose one of "
            f"{', '.join(preset_names())}"
        )
    return parse_transfer_function((_PRESETS / f"{name}.json").read_text(encoding="utf-8"))


def _check_keys(document: object) -> None:
    if not isinstance(document, dict):
        raise IrrcacheError(f"the document is a {type(document).__name__}; give an object {{...}}")
    unknown = sorted(set(document) - _KEYS)
    if unknown:
        raise IrrcacheError(
            f'unknown key "{unknown[0]}"{suggestion(unknown[0], _KEYS)}; known are '
            f"{', '.join(sorted(_KEYS))}"
        )
    missing = sorted(_REQUIRED - set(document))
    if missing:
        raise IrrcacheError(f'the key "{missing[0]}" is missing; add it')
    if document["format"] != FORMAT or document["version"] != VERSION:
        raise IrrcacheError(
            f"format {document['format']!r} version {document['version']!r}; "
            f"this is read: {FORMAT!r} version {VERSION}"
        )


def _points(document: dict, key: str, components: int) -> tuple[np.ndarray, np.ndarray]:
    """Return values ``(n,)`` and the components at them ``(n, components)``."""
    points = document[key]
    if not isinstance(points, list):
        raise IrrcacheError(f'"{key}" is {points!r}; give a list of points [value, {key}]')
    values, given = np.empty(len(points)), np.empty((len(points), components))
    for index, point in enumerate(points):
        where = f'"{key}" point {index}'
        if not isinstance(point, list) or len(point) != 2:
            raise IrrcacheError(f"{where} is {point!r}; give [value, {key}]")
        numbers = point[1] if components > 1 else [point[1]]
        if not isinstance(numbers, list) or len(numbers) != components:
            raise IrrcacheError(f"{where} has {numbers!r}; give {components} numbers [r, g, b]")
        values[index] = _number(point[0], where)
        given[index] = [_number(number, where) for number in numbers]
    return values, given


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise IrrcacheError(f"{where} has {value!r}; give a number")
    return float(value)


def _percentiles(document: dict) -> tuple[float, float] | None:
    kind = document.get("value_range", "absolute")
    given = document.get("percentiles")
    if kind == "absolute" and given is None:
        return None
    if kind == "absolute":
        raise IrrcacheError('"percentiles" needs "value_range": "percentile"; add it')
    if kind != "percentile":
        raise IrrcacheError(f'"value_range" is {kind!r}; give "absolute" or "percentile"')
    if not isinstance(given, list) or len(given) != 2:
        raise IrrcacheError(f'"percentiles" is {given!r}; give two, e.g. [1, 99.5]')
    low, high = (_number(p, '"percentiles"') for p in given)
    return low, high


def _check_values(key: str, values: np.ndarray) -> None:
    """Check that there are at least two points, finite and strictly increasing."""
    if len(values) < 2:
        raise IrrcacheError(f'"{key}" has {len(values)} point(s); give at least two')
    if not np.isfinite(values).all():
        index = int(np.flatnonzero(~np.isfinite(values))[0])
        raise IrrcacheError(f'"{key}" point {index} has value {values[index]}; give a finite one')
    unsorted = np.flatnonzero(np.diff(values) <= 0)
    if unsorted.size:
        index = int(unsorted[0]) + 1
        raise IrrcacheError(
            f'"{key}" point {index} has value {values[index]:g}, not above '
            f"{values[index - 1]:g} before it; sort the points by value, each value once"
        )


def _check_opacities(opacities: np.ndarray) -> None:
    bad = np.flatnonzero(~((opacities >= 0) & (opacities < 1)))
    if not bad.size:
        return
    index, opacity = int(bad[0]), float(opacities[bad[0]])
    if opacity == 1:
        raise IrrcacheError(
            f'"opacity" point {index} is 1, an infinite extinction; give less than 1, e.g. 0.99, '
            "or state the opacity over a longer length"
        )
    raise IrrcacheError(f'"opacity" point {index} is {opacity:g}; give a value in [0, 1)')


def _check_colours(colours: np.ndarray) -> None:
    bad = np.argwhere(~((colours >= 0) & (colours <= 1)))
    if bad.size:
        index = int(bad[0, 0])
        raise IrrcacheError(
            f'"colour" point {index} is {colours[index].tolist()}; give three values in [0, 1]'
        )
