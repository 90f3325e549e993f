"""Values of parameters by frame, and lists of sensors."""

from __future__ import annotations

import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.frames import rows_of, sensors_of


@pytest.fixture
def folder(tmp_path):
    """Return a folder with files of time steps and a table."""
    for step in (10, 2):
        (tmp_path / f"step_{step:03d}.vol").touch()
    (tmp_path / "path.csv").write_text("x, y\n0,1\n2,3\n")
    return tmp_path


def test_all_kinds_of_values_vary_together(folder):
    rows = rows_of(["t=0:1:2", "file=step_*.vol", "name=a,b"], folder / "path.csv", folder)
    assert rows == [
        {"x": "0", "y": "1", "t": "0", "file": "step_002.vol", "name": "a"},
        {"x": "2", "y": "3", "t": "1", "file": "step_010.vol", "name": "b"},
    ]
    assert rows_of([], None, folder) == [{}]


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        (["t"], 'cannot read --vary "t"'),
        (["t=0:1:0"], "whole one from 1 to"),
        (["t=0:1:1e9"], "whole one from 1 to"),
        (["t=a:b:3"], "two finite numbers"),
        (["t=0:inf:2"], 'cannot read --vary "t=0:inf:2".*finite'),
        (["t=nan:1:2"], "finite"),
        (["t=0:1e999:2"], "finite"),
        (["t=0,nan"], '--vary "t=0,nan" has the value "nan"'),
        (["t=-inf,0"], "finite"),
        (["t=0.9,,0.5"], '--vary "t=0.9,,0.5" has no value for frame 1'),
        (["t=0.9, "], "no value for frame 1"),
        (["t=1,2", "t=3,4"], "given twice"),
        (["x=1,2"], "column of the table"),
        (["t=1,2,3"], "x has 2, y has 2, t has 3 values"),
        (["file=frame_*.vol"], "no file in"),
    ],
)
def test_values_that_cannot_be_meant(folder, vary, said):
    with pytest.raises(IrrcacheError, match=said):
        rows_of(vary, folder / "path.csv", folder)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a first row"),
        ("x\n", "no rows"),
        ("x,y\n1\n", "row 2 .* has 1 values"),
        ("x,y, x\n1,2,3\n", '2 columns called "x"'),
        ("x,y,\n1,2,\n", "a column without name"),
        ("x,y\n1,2\n3, \n", 'row 3 .* has no value for "y"'),
        ("x,y\n1,2\n3,NaN\n", 'row 3 .*t.csv" has the value "NaN"'),
        ("x;y\n1;2\n", "t.csv.* separated by semicolons: save it with commas"),
        ("x;y\n1,5;2,5\n", "separated by semicolons"),
        ("x\ty\n1\t2\n", "separated by tabs"),
        (None, "No"),
    ],
)
def test_tables_that_cannot_be_read(tmp_path, text, said):
    if text is not None:
        (tmp_path / "t.csv").write_text(text)
    with pytest.raises(IrrcacheError, match=said):
        rows_of([], tmp_path / "t.csv", tmp_path)


def test_a_table_of_a_spreadsheet(tmp_path):
    """It begins with a mark of its encoding, or has another one."""
    (tmp_path / "t.csv").write_bytes("\ufeffx,y\r\n1,2\r\n".encode())
    assert rows_of([], tmp_path / "t.csv", tmp_path) == [{"x": "1", "y": "2"}]
    (tmp_path / "t.csv").write_bytes("größe\r\n1\r\n".encode("latin-1"))
    with pytest.raises(IrrcacheError, match="save it as UTF-8"):
        rows_of([], tmp_path / "t.csv", tmp_path)


def test_sensors():
    assert sensors_of("all", 3) == [0, 1, 2] and sensors_of("2,0", 3) == [2, 0]
    for text in ("3", "-1", "a", ""):
        with pytest.raises(IrrcacheError, match="the scene has 3 sensor"):
            sensors_of(text, 3)
    with pytest.raises(IrrcacheError, match='is "2,0,1,0,2", which names 0, 2 more than once'):
        sensors_of("2,0,1,0,2", 3)
