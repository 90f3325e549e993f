"""Rows of experiments on many cases: chosen by name, computed once, within a budget."""

from __future__ import annotations

import json

from experiments.support.case_rows import CaseRows, with_budget, with_reference
from mitsuba_irrcache.compare.tables import Table

CASES = [("grey sky", 2), ("grey sun", 3), ("red sun", 5)]


def run(tmp_path, *arguments: str, declare=None) -> tuple[CaseRows, list, list]:
    """Return the rows of an experiment, what it yields, and the cases that it measures."""
    measured = []

    def measure(case: int) -> dict:
        measured.append(case)
        return {"square": case**2}

    declare = declare or with_budget(100.0)
    rows = CaseRows("", "squares", declare, arguments=["-o", str(tmp_path), *arguments])
    found = list(rows.rows(CASES, measure, lambda title, case, row: f"{title}: {row['square']}"))
    return rows, found, measured


def test_rows_are_computed_once_and_printed(tmp_path, capsys):
    _, found, measured = run(tmp_path)
    assert found == [(2, {"square": 4}), (3, {"square": 9}), (5, {"square": 25})]
    assert measured == [2, 3, 5]
    assert capsys.readouterr().out.splitlines() == ["grey sky: 4", "grey sun: 9", "red sun: 25"]
    _, again, measured = run(tmp_path)
    assert again == found and measured == []
    assert set(json.loads((tmp_path / "squares/results.json").read_text())) == dict(CASES).keys()
    assert run(tmp_path, "--force")[2] == [2, 3, 5]


def test_cases_are_chosen_by_name(tmp_path):
    assert [case for case, _ in run(tmp_path, "--only", "sun")[1]] == [3, 5]


def test_no_case_is_begun_after_the_budget(tmp_path, capsys):
    run(tmp_path, "--only", "red")
    _, found, measured = run(tmp_path, "--budget", "-1")
    assert found == [(5, {"square": 25})] and measured == []
    assert capsys.readouterr().out.count("not computed yet") == 2


def test_files_of_titles(tmp_path):
    rows, *_ = run(tmp_path, declare=with_reference(4.0))
    assert rows.args.seconds == 4.0
    assert rows.file("near: box, 0.1") == tmp_path / "squares" / "near-box-0-1.npy"


def test_tables_are_written_to_the_document(tmp_path):
    document = tmp_path / "page.md"
    document.write_text("<!-- table: squares -->\n<!-- end -->\n")
    rows, *_ = run(tmp_path, "--document", str(document))
    rows.write({"squares": Table("", ["case"], [["grey"]])})
    assert "| grey |" in document.read_text()
