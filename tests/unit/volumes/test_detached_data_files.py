"""A header may name data files in its own folder and in those that the user allows, no others."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.options import ReadOptions
from mitsuba_irrcache.volumes.readers import read_volume

LONG = "x" * 3000000
VALUES = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)

NRRD = """NRRD0004
type: uint8
dimension: 3
sizes: 4 3 2
encoding: raw
{}
"""
META = """ObjectType = Image
NDims = 3
DimSize = 4 3 2
ElementType = MET_UCHAR
ElementSpacing = 1 1 1
{}
"""
#: Header and the lines that name a file, for each format that has such lines.
ONE = {
    "nhdr": (NRRD, "data file: {}"),
    "nhdr, one word": (NRRD, "datafile: {}"),
    "nhdr, capitals": (NRRD, "Data File: {}"),
    "nrrd": (NRRD, "data file: {}"),
    "mhd": (META, "ElementDataFile = {}"),
    "mhd, colon": (META, "ElementDataFile : {}"),
    "mha": (META, "ElementDataFile = {}"),
}
SLICES = {
    "nhdr, list": (NRRD, "data file: LIST\n{0}\n{1}"),
    "nhdr, pattern": (NRRD, "data file: {pattern} 0 1 1"),
    "mhd, list": (META, "ElementDataFile = LIST\n{0}\n{1}"),
    "mhd, pattern": (META, "ElementDataFile = {pattern} 0 1 1"),
}


@pytest.fixture
def folders():
    """Return a folder for a header, and one beside it, with data in both and in a subfolder.

    They are not in ``tmp_path``, whose full names are too long for patterns in a MetaImage.
    """
    with tempfile.TemporaryDirectory() as short:
        yield filled(Path(short).resolve())


def filled(top: Path) -> tuple[Path, Path]:
    """Create the folders of `folders` in ``top``."""
    own, other = top / "own", top / "other"
    for folder in (own, own / "below", other):
        folder.mkdir()
        (folder / "voxels.raw").write_bytes(VALUES.tobytes())
        for k in range(2):
            (folder / f"slice{k}.raw").write_bytes(VALUES[k].tobytes())
    os.symlink(other / "voxels.raw", own / "link.raw")
    os.symlink(other, own / "linked")
    for k in range(2):
        os.symlink(other / f"slice{k}.raw", own / f"alias{k}.raw")
    return own, other


def written(own, case: str, names: list[str], cases=ONE):
    """Write a header that names these files."""
    header, lines = cases[case]
    path = own / f"ct.{case.partition(',')[0]}"
    pattern = names[0].replace("0.raw", "%d.raw")
    path.write_text(header.format(lines.format(*names, pattern=pattern)))
    return path


def elsewhere(other) -> dict[str, str]:
    """Return names of the same file in another folder."""
    return {
        "absolute": str(other / "voxels.raw"),
        "upwards": "../other/voxels.raw",
        "upwards from below": "below/../../other/voxels.raw",
        "link": "link.raw",
        "in a linked folder": "linked/voxels.raw",
        "home": "~/voxels.raw",
    }


@pytest.mark.parametrize("case", ONE)
def test_one_data_file(folders, case):
    own, other = folders
    for name in ("voxels.raw", "below/voxels.raw", "./voxels.raw", "../own/voxels.raw"):
        np.testing.assert_array_equal(read_volume(written(own, case, [name])).values, VALUES)
    for name in elsewhere(other).values():
        path = written(own, case, [name])
        with pytest.raises(IrrcacheError, match=r"outside of its own folder.*--data-folder"):
            read_volume(path)
        if not name.startswith("~"):
            found = read_volume(path, options=ReadOptions(data_folders=[other]))
            np.testing.assert_array_equal(found.values, VALUES)
    with pytest.raises(IrrcacheError, match="does not exist"):
        read_volume(written(own, case, ["absent.raw"]))


@pytest.mark.parametrize("case", SLICES)
def test_data_files_of_slices(folders, case):
    """All files of a list or a pattern are checked."""
    own, other = folders
    good = written(own, case, ["slice0.raw", "slice1.raw"], SLICES)
    np.testing.assert_array_equal(read_volume(good).values, VALUES)
    for folder in (str(other), "../other", "linked"):
        names = [f"{folder}/slice{k}.raw" for k in range(2)]
        path = written(own, case, names, SLICES)
        with pytest.raises(IrrcacheError, match="outside of its own folder"):
            read_volume(path)
        np.testing.assert_array_equal(
            read_volume(path, options=ReadOptions(data_folders=[other])).values, VALUES
        )
    with pytest.raises(IrrcacheError, match="outside of its own folder"):
        read_volume(written(own, case, ["alias0.raw", "alias1.raw"], SLICES))
    if "list" in case:
        path = written(own, case, ["slice0.raw", "../other/slice1.raw"], SLICES)
        with pytest.raises(IrrcacheError, match="outside of its own folder"):
            read_volume(path)


@pytest.mark.parametrize("case", ["nhdr", "mhd"])
def test_names_in_comments_do_not_hide_data_files(folders, case):
    """A harmless name before the actual one, in a comment or far behind the start, is no bypass."""
    own, other = folders
    header, line = ONE[case]
    real = line.format(other / "voxels.raw")
    comments = {
        "nhdr": ["# data file: voxels.raw\n", "data file: voxels.raw\n", f"#{LONG}\n", "\r\n"],
        "mhd": [
            *("Comment = ElementDataFile = LOCAL\n", "Comment =\nElementDataFile = LOCAL\n"),
            f"Comment = {LONG}\n",
        ],
    }
    for comment in comments[case]:
        path = own / f"decoy.{case}"
        path.write_text(header.format(comment + real))
        with pytest.raises(IrrcacheError):
            read_volume(path)
        with pytest.raises(IrrcacheError):
            path.write_text(header.format(real).replace("\n", "\r\n"))
            read_volume(path)


@pytest.mark.parametrize(
    "pattern", ["%s.raw 0 1 1", "a%d%d.raw 0 1 1", "a%d 0 1 0", "a%d 0 9999999 1"]
)
def test_patterns_that_name_no_files(folders, pattern):
    own, _ = folders
    path = own / "ct.nhdr"
    path.write_text(NRRD.format(f"data file: {pattern}"))
    with pytest.raises(IrrcacheError, match="names its data files by"):
        read_volume(path)


@pytest.mark.parametrize("extension", ["nrrd", "mha", "nii", "nii.gz"])
def test_format_is_that_of_the_extension(folders, extension):
    """The extension determines the format: a header of another format is refused."""
    own, other = folders
    path = own / f"ct.{extension}"
    for header, line in (ONE["nhdr"], ONE["mhd"]):
        path.write_text(header.format(line.format(other / "voxels.raw")))
        with pytest.raises(IrrcacheError):
            read_volume(path)


@pytest.mark.parametrize("extension", ["nrrd", "nhdr", "mha", "mhd"])
def test_attached_and_detached_files_are_read(tmp_path, extension):
    """Files with the voxels after the header, and detached files by SimpleITK, are read."""
    path = tmp_path / f"ct.{extension}"
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(VALUES), str(path))
    np.testing.assert_array_equal(read_volume(path).values, VALUES)


def test_import_command_refuses_and_allows_folders(folders, capsys, monkeypatch):
    """The command refuses such a file with the name of the option, and imports it with the
    option.
    """
    own, _ = folders
    monkeypatch.chdir(own)
    written(own, "nhdr", ["../other/voxels.raw"])
    command = ["import", "ct.nhdr", "--density", "-o", "scene"]
    assert main(command) == 1
    assert "--data-folder" in capsys.readouterr().err
    assert main([*command, "--data-folder", "../other"]) == 0
