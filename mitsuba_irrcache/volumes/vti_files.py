"""VTK image data (``.vti``): XML with arrays as text, in base64, or appended, compressed or not."""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import ReadOptions, chosen_field
from mitsuba_irrcache.volumes.vtk_files import PointArray, PointGrid

_COMPRESSORS = {
    "vtkZLibDataCompressor": zlib.decompressobj,
    "vtkLZMADataCompressor": lzma.LZMADecompressor,
}
_TYPE = re.compile(r"(U?Int(?:8|16|32|64)|Float(?:32|64))")
_APPENDED = re.compile(rb"<AppendedData[^>]*>\s*_")


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one array of the only piece of an image.

    Raises:
        IrrcacheError: a damaged file, another kind of VTK file, several pieces, or several arrays
            or components and none chosen.
    """
    content = path.read_bytes()
    if not content.rstrip().endswith(b"</VTKFile>"):
        raise IrrcacheError(
            f"{path} is truncated: it does not end with </VTKFile>; copy or export it again"
        )
    appended = _APPENDED.search(content)
    # Appended data may be binary, which is not XML.
    text = content[: appended.start()] + b"</VTKFile>" if appended else content
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise IrrcacheError(
            f"{path} is no complete XML file ({error}); copy or export it again"
        ) from error
    image = root.find("ImageData")
    if root.tag != "VTKFile" or image is None:
        raise IrrcacheError(
            f"{path} holds {root.get('type', root.tag)}, not ImageData; resample it to an image, "
            "e.g. by ParaView's Resample To Image"
        )
    pieces = image.findall("Piece")
    if len(pieces) != 1:
        raise IrrcacheError(f"{path} has {len(pieces)} pieces; write the image in one piece")
    extent = np.array([int(n) for n in pieces[0].get("Extent", "").split()]).reshape(3, 2)
    grid = PointGrid(
        dimensions=tuple(int(n) for n in extent[:, 1] - extent[:, 0] + 1),
        spacing=_numbers(image, "Spacing", "1 1 1"),
        direction=_numbers(image, "Direction", "1 0 0 0 1 0 0 0 1").reshape(3, 3),
    )
    # The origin is the position of index 0, which the extent need not contain.
    first = grid.direction @ (grid.spacing * extent[:, 0])
    grid.origin = _numbers(image, "Origin", "0 0 0") + first
    elements = {}
    for section, at_cells in (("PointData", False), ("CellData", True)):
        for element in pieces[0].iterfind(f"{section}/DataArray"):
            elements[element.get("Name", "")] = element, at_cells
    name = chosen_field(str(path), elements, options.field, "array")
    element, at_cells = elements[name]
    decoder = _Decoder(path, root, content, appended.end() if appended else None)
    count = int(np.prod(np.array(grid.dimensions) - at_cells, dtype=object))
    components = int(element.get("NumberOfComponents", 1))
    values = decoder.values(element, count * components)
    grid.arrays[name] = PointArray(values.reshape(count, components), at_cells)
    return grid.volume(path, options)


def _numbers(element: ElementTree.Element, name: str, default: str) -> np.ndarray:
    return np.array([float(number) for number in element.get(name, default).split()])


class _Decoder:
    """Decodes the arrays of one file."""

    def __init__(
        self, path: Path, root: ElementTree.Element, content: bytes, appended: int | None
    ) -> None:
        self._path, self._content, self._appended = path, content, appended
        self._order = "<" if root.get("byte_order") == "LittleEndian" else ">"
        self._header = np.dtype(self._order + {"UInt64": "u8"}.get(root.get("header_type"), "u4"))
        compressor = root.get("compressor")
        if compressor not in (None, *_COMPRESSORS):
            raise IrrcacheError(
                f"{path} is compressed by {compressor}; write it with ZLib, or not compressed"
            )
        self._decompressor = _COMPRESSORS.get(compressor)
        encoding = re.search(rb'encoding="(\w+)"', content[max(0, (appended or 0) - 80) : appended])
        self._is_raw = encoding is not None and encoding[1] == b"raw"

    def values(self, element: ElementTree.Element, count: int) -> np.ndarray:
        """Return the ``count`` values of an array."""
        found = _TYPE.fullmatch(element.get("type", ""))
        if found is None:
            raise IrrcacheError(
                f"{self._path} has values of type {element.get('type')!r}; write integers or floats"
            )
        dtype = np.dtype(found[0].lower()).newbyteorder(self._order)
        require_memory(2 * count * dtype.itemsize, f"reading {self._path}", "crop it first")
        form = element.get("format", "ascii")
        if form == "ascii":
            words = (element.text or "").split()
            self._check(len(words), count, "values")
            return np.array(words, dtype=np.float64).astype(dtype)
        if form == "appended":
            if self._appended is None:
                raise IrrcacheError(f"{self._path} is truncated: its appended data are missing")
            stream, is_raw = self._content, self._is_raw
            position = self._appended + int(element.get("offset", 0))
        else:
            stream, position, is_raw = (element.text or "").strip().encode(), 0, False
        data = self._data(stream, position, is_raw, count * dtype.itemsize)
        self._check(len(data), count * dtype.itemsize, "bytes")
        return np.frombuffer(data, dtype)

    def _data(self, stream: bytes, position: int, is_raw: bool, expected: int) -> bytes:
        """Return the decoded bytes of an array that begins at ``position``.

        At most ``expected`` bytes of a compressed array are decompressed.
        """
        size = self._header.itemsize

        def take(begin: int, length: int) -> tuple[bytes, int]:
            """Return ``length`` bytes from ``begin``, and where the next unit begins."""
            stored = length if is_raw else 4 * -(-length // 3)
            part = stream[begin : begin + stored]
            if len(part) < stored:
                raise IrrcacheError(
                    f"{self._path} is truncated: an array of {stored} bytes begins at byte "
                    f"{begin} of {len(stream)}; copy or export it again"
                )
            return (part if is_raw else base64.b64decode(part))[:length], begin + stored

        if self._decompressor is None:
            length = int(np.frombuffer(take(position, size)[0], self._header)[0])
            # VTK encodes the length and the values together, others one after the other.
            together = is_raw or b"=" not in stream[position : position + 4 * -(-size // 3)]
            if together:
                return take(position, size + length)[0][size:]
            return take(take(position, size)[1], length)[0]
        # Number of blocks, size of a block and of the last one, compressed size of each.
        blocks = int(np.frombuffer(take(position, size)[0], self._header)[0])
        header, position = take(position, (3 + blocks) * size)
        sizes = np.frombuffer(header, self._header)[3:].tolist()
        packed, _ = take(position, sum(sizes))
        unpacked = bytearray()
        begin = 0
        for length in sizes:
            left = expected + 1 - len(unpacked)
            unpacked += self._decompressor().decompress(packed[begin : begin + length], left)
            begin += length
        return bytes(unpacked)

    def _check(self, found: int, expected: int, what: str) -> None:
        if found != expected:
            raise IrrcacheError(
                f"{self._path} is damaged: an array has {found} {what}, but its extent asks for "
                f"{expected}; copy or export it again"
            )
