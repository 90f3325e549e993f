"""Legacy VTK files (``.vtk``) of structured points, as text or binary.

The package ``vtk`` installs half a gigabyte, and ITK reads these files without noticing that they
are truncated, hence a reader of our own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import ReadOptions, chosen_field, scalar_volume

_TYPES = {
    "unsigned_char": "u1",
    "char": "i1",
    "unsigned_short": "u2",
    "short": "i2",
    "unsigned_int": "u4",
    "int": "i4",
    "unsigned_long": "u8",
    "long": "i8",
    "float": "f4",
    "double": "f8",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
}
_COMPONENTS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9}


@dataclass
class PointArray:
    """An array of a VTK data set: values ``(tuple, component)`` at points or at cell centres."""

    values: np.ndarray
    at_cells: bool


@dataclass
class PointGrid:
    """A VTK image: ``dimensions`` points along x, y, z, and arrays by name."""

    dimensions: tuple[int, int, int] = (0, 0, 0)
    spacing: np.ndarray = field(default_factory=lambda: np.ones(3))
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    direction: np.ndarray = field(default_factory=lambda: np.eye(3))
    arrays: dict[str, PointArray] = field(default_factory=dict)

    def volume(self, path: Path, options: ReadOptions) -> VolumeData:
        """Return one array as a volume; values at cells lie half a spacing beyond the origin."""
        name = chosen_field(str(path), self.arrays, options.field, "array")
        array = self.arrays[name]
        source = f"{path}[{name}]"
        size = np.array(self.dimensions) - array.at_cells
        origin = self.origin + self.direction @ (0.5 * array.at_cells * self.spacing)
        if min(size) < 2:
            raise IrrcacheError(
                f"{source} is one slice of {' x '.join(map(str, size))} values; give a volume"
            )
        if int(np.prod(size, dtype=object)) != len(array.values):
            raise IrrcacheError(
                f"{source} has {len(array.values)} values, but its dimensions are {size.tolist()}; "
                "export it again"
            )
        values = array.values.reshape(*size[::-1], array.values.shape[1])
        return VolumeData(
            scalar_volume(source, values, "zyxc", options),
            tuple(self.spacing),
            tuple(origin),
            self.direction,
            source=source,
        )


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one array of a data set of structured points.

    Raises:
        IrrcacheError: a damaged file, another kind of data set, or several arrays or components
            and none chosen.
    """
    return _Parser(path).grid().volume(path, options)


class _Parser:
    """Read a file from beginning to end, since it has no table of contents."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._content = path.read_bytes()
        self._position = 0
        self._at_cells, self._tuples = False, 0
        self._grid = PointGrid()

    def grid(self) -> PointGrid:
        magic = self._line()
        if not magic.startswith("# vtk DataFile Version"):
            raise IrrcacheError(
                f'{self._path} is no legacy VTK file: it begins with {magic[:30]!r}, not "# vtk '
                'DataFile Version"'
            )
        self._line()  # the title
        encoding = self._line().upper()
        if encoding not in ("ASCII", "BINARY"):
            raise IrrcacheError(
                f"{self._path} is encoded as {encoding[:30]!r}; write ASCII or BINARY"
            )
        self._is_text = encoding == "ASCII"
        for words in self._keywords():
            self._read_entry(words)
        if min(self._grid.dimensions) < 1:
            raise self._damaged(f"has dimensions {self._grid.dimensions}")
        return self._grid

    def _keywords(self) -> Iterator[list[str]]:
        while self._position < len(self._content):
            words = self._line().split()
            if words:
                yield words

    def _read_entry(self, words: list[str]) -> None:
        keyword, values = words[0].upper(), words[1:]
        if keyword == "DATASET":
            if values[0].upper() != "STRUCTURED_POINTS":
                raise IrrcacheError(
                    f"{self._path} holds a data set of the kind {values[0]}; resample it to "
                    "STRUCTURED_POINTS (image data), e.g. by ParaView's Resample To Image"
                )
        elif keyword == "DIMENSIONS":
            x, y, z = (int(value) for value in values)
            self._grid.dimensions = x, y, z
        elif keyword in ("SPACING", "ASPECT_RATIO"):
            self._grid.spacing = np.array([float(v) for v in values])
        elif keyword == "ORIGIN":
            self._grid.origin = np.array([float(v) for v in values])
        elif keyword in ("POINT_DATA", "CELL_DATA"):
            self._at_cells, self._tuples = keyword == "CELL_DATA", int(values[0])
        elif keyword == "SCALARS":
            name, kind, *components = values
            self._line()  # its lookup table
            self._add(name, kind, int(components[0]) if components else 1, self._tuples)
        elif keyword in _COMPONENTS:
            self._add(values[0], values[1], _COMPONENTS[keyword], self._tuples)
        elif keyword == "LOOKUP_TABLE":
            self._values("unsigned_char" if not self._is_text else "float", 4 * int(values[1]))
        elif keyword == "FIELD":
            self._read_field(int(values[1]))
        elif keyword == "METADATA":
            while self._position < len(self._content) and self._line():
                pass
        else:
            raise self._damaged(f"has the line {' '.join(words)[:60]!r} where a keyword is due")

    def _read_field(self, count: int) -> None:
        read = 0
        for words in self._keywords():
            if words[0].upper() == "METADATA":
                self._read_entry(words)
                continue
            name, components, tuples, kind = words
            self._add(name, kind, int(components), int(tuples))
            read += 1
            if read == count:
                return

    def _add(self, name: str, kind: str, components: int, tuples: int) -> None:
        values = self._values(kind, components * tuples)
        # Arrays of a field that are not of the grid (the time, for example) are no volumes.
        if values is not None and self._tuples == tuples:
            array = PointArray(values.reshape(tuples, components), self._at_cells)
            self._grid.arrays[name] = array

    def _values(self, kind: str, count: int) -> np.ndarray | None:
        kind = kind.lower()
        if kind not in _TYPES:
            raise IrrcacheError(
                f"{self._path} has values of type {kind!r}; write one of {', '.join(_TYPES)}"
            )
        if self._is_text:
            return self._text_values(_TYPES[kind], count)
        dtype = np.dtype(_TYPES[kind]).newbyteorder(">")
        self._check_left(len(self._content) - self._position, count * dtype.itemsize, count)
        values = np.frombuffer(self._content, dtype, count, self._position)
        self._position += count * dtype.itemsize
        return values

    def _text_values(self, dtype: str, count: int) -> np.ndarray:
        left = len(self._content) - self._position
        self._check_left(left, 2 * count - 1, count)  # a digit each, and what separates them
        *words, rest = [*self._content[self._position :].split(None, count), b""][: count + 1]
        if len(words) < count:
            raise self._damaged(f"ends after {len(words)} of {count} values: it is truncated")
        self._position = len(self._content) - len(rest)
        return np.array(words).astype(np.float64).astype(dtype)

    def _check_left(self, left: int, needed: int, count: int) -> None:
        if count < 0 or left < needed:
            raise self._damaged(
                f"is truncated: {left} bytes are left, but its header promises {count} values"
            )

    def _line(self) -> str:
        end = self._content.find(b"\n", self._position)
        end = len(self._content) if end < 0 else end
        line = self._content[self._position : end]
        self._position = end + 1
        return line[:256].decode("latin-1").strip()

    def _damaged(self, what: str) -> IrrcacheError:
        return IrrcacheError(f"{self._path} {what}; copy or export it again")
