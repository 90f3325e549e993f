"""Detached data files: NRRD and MetaImage headers may name other files that hold the voxels.

A header from an untrusted source could name any file of this machine, whose contents would then be
part of an image or a scene that is passed on. So a header may name files in its own folder only,
and in folders that the user has allowed.
"""

from __future__ import annotations

import mmap
import os
import re
from collections.abc import Sequence
from pathlib import Path

from mitsuba_irrcache.errors import IrrcacheError

OPTION = "--data-folder"
#: Buffer size in bytes of MetaIO for a word of a list or a pattern; longer words overflow it.
_LONGEST_WORD = 79
#: Upper limit of the number of files, larger than the number of slices of any volume.
_MOST_FILES = 1 << 16
_FIELDS = {
    "nrrd": re.compile(rb"^[ \t]*data[ \t]*file[ \t]*:[ \t]*([^\r\n]*)", re.I | re.M),
    # Fields anywhere in a line are matched, because MetaIO does not parse line by line.
    "meta": re.compile(rb"ElementDataFile\s*[=:][ \t]*([^\r\n]*)"),
}
_PATTERN = re.compile(r"(?P<name>.*%0?\d{0,2}d.*?)\s+(?P<numbers>-?\d+(?:\s+-?\d+){2,3})\s*")


def data_files(path: Path, allowed: Sequence[str | os.PathLike] = ()) -> list[Path]:
    """Return the files with the voxels of ``path``, an NRRD or MetaImage.

    This is ``path`` itself if the voxels follow the header.

    Args:
        path: the image file.
        allowed: folders, besides that of ``path``, in which data files may lie, at any depth.

    Raises:
        IrrcacheError: a data file that is missing or, after resolving links and ``..``, lies in
            another folder; or a list or pattern whose words are too long for MetaIO.
    """
    kind = "meta" if path.suffix.lower() in (".mha", ".mhd") else "nrrd"
    files: list[Path] = []
    # All occurrences in the file are checked: one that the reader ignores must not mask another.
    with (
        path.open("rb") as stream,
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as contents,
    ):
        end = contents.find(b"\n\n") if kind == "nrrd" else -1  # where an NRRD's voxels begin
        header = contents[:end] if end >= 0 else contents
        for field in _FIELDS[kind].finditer(header):
            if kind == "meta":
                _check_words(path, field[1].strip())
            following = header[field.end() :]
            for name in _names(path, os.fsdecode(field[1].strip()), following):
                files.append(path if name is None else _checked(path, name, allowed))
    return files or [path]


def _check_words(path: Path, value: bytes) -> None:
    """Refuse words that overflow a buffer of MetaIO, which does not check their length.

    Only fields that MetaIO splits into words are concerned: not single names, and not the lines
    after a list.
    """
    if b"%" not in value and value[:4].upper() != b"LIST":
        return
    if b"\t" in value:  # MetaIO does not split at tabs, lacks a number and divides by 0
        raise IrrcacheError(f"{path} names its data files with a tab; put a space in its place")
    # Spaces do not end a quoted word.
    words = [value] if b'"' in value else value.split(b" ")
    longest = max(words, key=len)
    if len(longest) > _LONGEST_WORD:
        raise IrrcacheError(
            f"{path} names its data files by {os.fsdecode(longest)!r}, which has {len(longest)} "
            f"bytes; no more than {_LONGEST_WORD} can be read. Put the files beside the header and "
            "name them without their folder, or list their names, each in a line of its own"
        )


def _names(path: Path, value: str, following: bytes) -> list[str | None]:
    """Return the names that one field stands for; None for the header's own file."""
    if value.upper() == "LOCAL":
        return [None]
    if value.upper().split(" ")[0] == "LIST":
        lines = os.fsdecode(following).splitlines()
        return [line.strip() for line in lines if line.strip()]
    if "%" not in value:
        return [value]
    found = _PATTERN.fullmatch(value)
    first, last, step, *_ = map(int, found["numbers"].split()) if found else (0, 0, 0)
    if not found or not step or abs(last - first) // abs(step) >= _MOST_FILES:
        raise IrrcacheError(
            f'{path} names its data files by "{value}"; give name%03d.raw FIRST LAST STEP'
        )
    if found["name"].replace("%%", "").count("%") != 1:
        raise IrrcacheError(f'{path} names its data files by "{value}"; give one number to fill in')
    end = last + (1 if step > 0 else -1)
    return [found["name"] % number for number in range(first, end, step)]


def _checked(path: Path, name: str, allowed: Sequence[str | os.PathLike]) -> Path:
    """Return the path of the data file ``name``, which must exist in an accepted folder."""
    file = path.parent / name
    try:
        real = file.resolve()
        folders = [Path(folder).resolve() for folder in (path.parent, *allowed)]
    except (OSError, RuntimeError, ValueError) as error:  # a circular link, or an empty name
        raise IrrcacheError(f"{path} names a data file {name!r}, which is none: {error}") from None
    # MetaIO takes a name that starts with "~" for a full path.
    if name.startswith("~") or not any(real.is_relative_to(folder) for folder in folders):
        raise IrrcacheError(
            f"{path} names a data file {file} outside of its own folder, which is not read; if you "
            f"trust the header, give {OPTION} {real.parent}"
        )
    if not real.is_file():
        raise IrrcacheError(f"{path} names a data file {file} that does not exist; put it there")
    return file
