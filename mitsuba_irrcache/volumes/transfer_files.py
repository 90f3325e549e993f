"""Transfer functions of other programs: volume properties of 3D Slicer, and bumps of VPT.

*3D Slicer*: ``.vp`` files, and the elements ``VolumeProperty`` of MRML, among them the file
``presets.xml`` of the program. Opacities are taken per mm, which they are in Slicer unless its unit
distance is changed, and colours for the albedo. Shading and gradient opacity have no equivalent in
a participating medium; gradient opacity that is not constant is mentioned in the description.

*VPT* (the volumetric path tracing framework of the University of Ljubljana): a JSON list of bumps
``{"position", "size", "color"}`` over value (x) and gradient (y), each a Gaussian, composited in
their order. Values 0 and 1 stand for the least and the largest of the volume. As VPT does for
volumes without gradients, the bumps are evaluated at y = 0. Alpha is taken for the opacity per mm.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.options import chosen_field
from mitsuba_irrcache.volumes.transfer import TransferFunction, load_transfer_function

#: The largest opacity per length: 1 would be an infinite extinction.
LARGEST_OPACITY = 0.99
#: Distance, relative to the range of values, between the two ends of a step.
_STEP = 1e-6
#: Number of points at which the bumps of VPT are sampled; the display has 256.
_SAMPLES = 129
_VP_LINES = 9


def load(name: str | os.PathLike) -> TransferFunction:
    """Read a transfer function: our JSON, Slicer's ``.vp`` or MRML (``.xml``), or VPT's JSON.

    A file with several is followed by the name of one: ``presets.xml:CT-Bone``.

    Raises:
        IrrcacheError: the file is missing or damaged, or has several functions and none is named.
    """
    path, wanted = Path(name), None
    if not path.exists() and ":" in str(name):
        file, _, wanted = str(name).rpartition(":")
        path = Path(file)
    suffix = path.suffix.lower()
    if not path.is_file() or (suffix not in (".vp", ".xml", ".mrml") and not _is_list(path)):
        return load_transfer_function(path if path.exists() else name)
    try:
        if suffix == ".vp":
            return _of_lines(path.read_text(encoding="utf-8"))
        if suffix in (".xml", ".mrml"):
            return _of_mrml(path, wanted)
        return _of_bumps(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, ElementTree.ParseError) as error:
        raise IrrcacheError(f"transfer function {path}: {error}") from error


def _is_list(path: Path) -> bool:
    """Return whether the file is JSON whose outermost value is a list, as VPT writes."""
    with path.open("rb") as stream:
        return stream.read(256).lstrip()[:1] == b"["


def _of_lines(text: str) -> TransferFunction:
    """Read a ``.vp`` file: six lines on shading, then opacity, gradient opacity and colour."""
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < _VP_LINES:
        raise IrrcacheError(
            f"{len(lines)} lines; a volume property of 3D Slicer has {_VP_LINES}. Save it anew as "
            ".vp (not .vp.json)"
        )
    opacity, gradient, colour = lines[6:9]
    return _slicer_function("volume property of 3D Slicer", opacity, gradient, colour)


def _of_mrml(path: Path, wanted: str | None) -> TransferFunction:
    elements = {
        element.get("name", str(number)): element
        for number, element in enumerate(ElementTree.parse(path).iter("VolumeProperty"))
    }
    if wanted is None and len(elements) > 1:
        raise IrrcacheError(
            f"{len(elements)} volume properties, {', '.join(elements)}; choose one with "
            f"{path.name}:NAME"
        )
    name = chosen_field("the file", elements, wanted, "volume property")
    attributes = elements[name].attrib
    for key in ("scalarOpacity", "colorTransfer"):
        if key not in attributes:
            raise IrrcacheError(f"volume property {name!r} has no {key}; save it again")
    return _slicer_function(
        f"3D Slicer: {name}",
        attributes["scalarOpacity"],
        attributes.get("gradientOpacity", "4 0 1 1 1"),
        attributes["colorTransfer"],
    )


def _slicer_function(name: str, opacity: str, gradient: str, colour: str) -> TransferFunction:
    opacities = _table("the scalar opacity", opacity, 2)
    colours = _table("the colour", colour, 4)
    if not np.all(_table("the gradient opacity", gradient, 2)[:, 1] == 1):
        name += "; its gradient opacity is left out"
    opacities[:, 1] = np.clip(opacities[:, 1], 0, LARGEST_OPACITY)
    # Values of CT reach below 0, of MR they do not.
    unit = "HU" if opacities[0, 0] < 0 else ""
    return TransferFunction(
        opacities[:, 0],
        opacities[:, 1],
        colours[:, 0],
        np.clip(colours[:, 1:], 0, 1),
        unit=unit,
        description=name,
    )


def _table(what: str, text: str, columns: int) -> np.ndarray:
    """Parse a count followed by that many numbers, in rows of ``columns``: a value and what it
    maps to. Of equal values, which form a step, the later one is moved up.
    """
    try:
        count, *numbers = (float(word) for word in text.split())
    except ValueError:
        raise IrrcacheError(f"{what} is {text[:60]!r}; give a count and numbers") from None
    if count != len(numbers) or not numbers or len(numbers) % columns:
        raise IrrcacheError(
            f"{what} has {len(numbers)} numbers after the count {count:g}; give as many, in groups "
            f"of {columns}"
        )
    table = np.array(numbers).reshape(-1, columns)
    keep = np.ones(len(table), dtype=bool)
    keep[1:] = (np.diff(table, axis=0) != 0).any(axis=1)
    table = table[keep]
    reach = float(np.ptp(table[:, 0])) or 1.0
    for row in range(1, len(table)):
        if table[row, 0] <= table[row - 1, 0] < table[row, 0] + _STEP * reach:
            table[row, 0] = table[row - 1, 0] + _STEP * reach
    if len(table) == 1:  # a constant
        table = np.concatenate([table, table])
        table[1, 0] += 1.0
    return table


def _of_bumps(bumps: list) -> TransferFunction:
    values = np.linspace(0, 1, _SAMPLES)
    colour, alpha = np.zeros((_SAMPLES, 3)), np.zeros((_SAMPLES, 1))
    if not bumps:
        raise IrrcacheError("the list has no bumps; add one in VPT and save it again")
    for number, bump in enumerate(bumps):
        try:
            x, y = (float(bump["position"][axis]) for axis in "xy")
            width, height = (float(bump["size"][axis]) for axis in "xy")
            rgba = np.array([float(bump["color"][channel]) for channel in "rgba"])
        except (KeyError, TypeError, ValueError) as error:
            raise IrrcacheError(
                f"bump {number} is {str(bump)[:60]}; give position (x, y), size (x, y) and color "
                "(r, g, b, a) in numbers"
            ) from error
        if not (width > 0 and height > 0 and np.isfinite([x, y, width, height, *rgba]).all()):
            raise IrrcacheError(f"bump {number} has size {width:g}, {height:g}; give sizes above 0")
        weight = np.exp(-np.square((x - values) / width) - np.square(y / height))[:, None]
        colour = rgba[:3] * weight + colour * (1 - rgba[3] * weight)
        alpha = rgba[3] * weight + alpha * (1 - rgba[3] * weight)
    return TransferFunction(
        values,
        np.clip(alpha[:, 0], 0, LARGEST_OPACITY),
        values,
        np.clip(colour, 0, 1),
        percentiles=(0.0, 100.0),
        description="transfer function of VPT",
    )
