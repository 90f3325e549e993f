"""Consistency check of the element lengths in a DICOM file.

A file of a kilobyte can declare an element of 4 GB, for which GDCM allocates memory before it reads
the data. So lengths are checked before.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

from mitsuba_irrcache.errors import IrrcacheError

_PREAMBLE, _MAGIC = 128, b"DICM"
#: Value representations whose length has 4 bytes, after 2 that are reserved.
_LONG = {b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"}
_IMPLICIT, _BIG, _DEFLATED = (
    "1.2.840.10008.1.2",
    "1.2.840.10008.1.2.2",
    "1.2.840.10008.1.2.1.99",
)
#: Some writers put this in place of a value representation.
_UNKNOWN = {b"??", b"  ", b"\0\0"}
_META, _ITEM = 0x0002, 0xFFFE
_TRANSFER_SYNTAX, _STORAGE_CLASS = (0x0002, 0x0010), (0x0002, 0x0002)
_UNDEFINED = 0xFFFFFFFF


def check_lengths(path: str | os.PathLike) -> str | None:
    """Check all elements of a DICOM file, and return its storage class; None for other files.

    Elements of unknown form, and those after them, are left to the reader.

    Raises:
        IrrcacheError: an element reaches beyond the end of the file, or is malformed.
    """
    path = Path(path)
    size = path.stat().st_size
    with path.open("rb") as stream:
        if stream.read(_PREAMBLE + 4)[_PREAMBLE:] != _MAGIC:
            return None
        syntax, storage_class = "", ""
        while stream.tell() + 8 <= size:
            tag, length = _header(stream, syntax)
            if length is None or (syntax == _DEFLATED and tag[0] != _META):
                break
            if length == _UNDEFINED:
                continue  # the items of a sequence follow, each with a header of its own
            end = stream.tell() + length
            if end > size:
                raise IrrcacheError(
                    f"{path} is truncated or damaged: its element ({tag[0]:04x},{tag[1]:04x}) "
                    f"promises {length} bytes up to byte {end}, but the file has {size}; copy it "
                    "again"
                )
            if tag == _TRANSFER_SYNTAX:
                syntax = _text(stream.read(length))
            elif tag == _STORAGE_CLASS:
                storage_class = _text(stream.read(length))
            stream.seek(end)
    return storage_class


def _text(value: bytes) -> str:
    return value.rstrip(b"\0 ").decode("ascii", "replace")


def _header(stream: BinaryIO, syntax: str) -> tuple[tuple[int, int], int | None]:
    """Return tag and length of the next element; the length is None if its form is unknown."""
    start = stream.read(8)
    # The file meta information is always explicit VR little endian.
    meta = struct.unpack("<H", start[:2])[0] == _META
    order = ">" if syntax == _BIG and not meta else "<"
    tag = struct.unpack(order + "HH", start[:4])
    if tag[0] == _ITEM or (syntax == _IMPLICIT and not meta):
        return tag, struct.unpack(order + "I", start[4:])[0]
    form = start[4:6]
    if form in _UNKNOWN:
        return tag, None
    if not (form.isalpha() and form.isupper()):
        raise IrrcacheError(
            f"{stream.name} is damaged: at byte {stream.tell() - 8} there is no element of a DICOM "
            "file; copy it again"
        )
    if form not in _LONG:
        return tag, struct.unpack(order + "H", start[6:])[0]
    rest = stream.read(4)
    return tag, struct.unpack(order + "I", rest)[0] if len(rest) == 4 else None
