"""The tables of the structure in the documentation are those of the code."""

from __future__ import annotations

import shutil

import pytest

from experiments.docs import structure
from experiments.support.documents import replace_tables


@pytest.mark.parametrize("document", structure.DOCUMENTS, ids=lambda path: path.name)
def test_the_tables_are_up_to_date(document, tmp_path):
    copy = tmp_path / document.name
    shutil.copy(document, copy)
    replace_tables(copy, structure.tables(), origin="")
    if copy.read_text() != document.read_text():
        pytest.fail("run: python -m experiments.docs.structure", pytrace=False)


def test_every_folder_and_module_says_what_it_holds():
    for table in (structure.folders(), structure.modules()):
        assert [row for row in table.rows if not row[-1].strip()] == []


@pytest.mark.parametrize(
    ("docstring", "expected"),
    [
        ("Voxels.", "Voxels"),
        ("A file ``a.b`` of\nvoxels. More\n\nStill more.", "A file `a.b` of voxels"),
        ("Numbers: 1.5 of `x`", "Numbers: 1.5 of `x`"),
    ],
)
def test_summary(docstring, expected):
    assert structure.summary(docstring) == expected
