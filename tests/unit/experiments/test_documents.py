"""Tables that experiments write into the documentation."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from experiments.support import documents
from mitsuba_irrcache.compare.tables import Table

ROOT = Path(__file__).parents[3]
TABLE = Table(
    "A title", ["scene", "a | b"], [["cloud", "1 x"], ["head", "2 x"]], "A note.", {(1, 1)}
)
BLOCK = re.compile(r"^<!-- table: (\S+) -->$(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)


def test_a_block_is_replaced_and_nothing_else(tmp_path):
    page = tmp_path / "page.md"
    old = "<!-- table: {} -->\nold \\1\n<!-- end -->\n"
    page.write_text(
        "before\n\n" + old.format("mine") + "\nbetween\n\n" + old.format("other") + "after"
    )
    assert documents.replace_tables(page, {"mine": TABLE, "absent": TABLE}) == ["mine"]
    first, second = BLOCK.findall(page.read_text())
    assert "| scene | a \\| b |\n| --- | --- |\n| cloud | 1 x |\n| head | **2 x** |" in first[1]
    assert "A note." in first[1] and "cores" in first[1] and "old" not in first[1]
    assert second == ("other", "\nold \\1\n")
    assert re.sub(BLOCK, "", page.read_text()) == "before\n\n\n\nbetween\n\n\nafter"
    documents.replace_tables(page, {"mine": TABLE})  # again
    assert len(BLOCK.findall(page.read_text())) == 2


def test_two_tables_of_one_name_are_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(2 * "<!-- table: mine -->\n<!-- end -->\n")
    with pytest.raises(ValueError, match="several tables of the name mine"):
        documents.replace_tables(page, {"mine": TABLE})


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda page: page.stem)
def test_tables_of_a_page_have_names_of_their_own(page):
    names = [name for name, _ in BLOCK.findall(page.read_text())]
    assert len(names) == len(set(names))


def test_a_document_without_the_mark_is_refused_and_stays(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- table: other -->\n<!-- end -->\n")
    with pytest.raises(ValueError, match=r"page.md has none of these marks: <!-- table: mine -->"):
        documents.replace_tables(page, {"mine": TABLE})
    assert page.read_text() == "<!-- table: other -->\n<!-- end -->\n"


def test_every_table_of_the_documents_is_written_by_a_script_that_the_page_names():
    found = 0
    for page in (ROOT / "docs").rglob("*.md"):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        assert text.count("<!-- table:") == len(BLOCK.findall(text)) == text.count("<!-- end -->")
        for match in BLOCK.finditer(text):
            before = text[: match.start()]
            command = re.findall(r"python -m (experiments[\w.]+)", before)[-1]
            source = Path(importlib.import_module(command).__file__).read_text()
            assert f'"{match[1]}"' in source, f"{page.name}: {match[1]}, {command}"
            found += 1
    assert found >= 4


@pytest.mark.parametrize("name", ["validation.md", "performance.md"])
def test_tests_and_scripts_that_documents_name_exist(name):
    text = (ROOT / "docs" / name).read_text()
    for path, function in re.findall(r"`((?:\w+/)*test_\w+)(?:::(\w+)[^`]*)?`", text):
        files = [
            f
            for f in (ROOT / "tests" / f"{path}.py", ROOT / "tests/system" / f"{path}.py")
            if f.exists()
        ]
        assert files, path
        assert f"def {function}(" in files[0].read_text() or not function, f"{path}::{function}"
    for module in re.findall(r"(?<=-m )experiments[\w.]+", text):
        assert (ROOT / (module.replace(".", "/") + ".py")).exists(), module


@pytest.mark.parametrize(
    ("value", "text"),
    [(172.4, "170"), (6310, "6300"), (15.2, "15"), (1.62, "1.6"), (0.853, "0.85"), (99.7, "100")],
)
def test_numbers_of_tables_have_no_exponent(value, text):
    assert documents.plain_number(value) == text
