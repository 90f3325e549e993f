"""Records of finished jobs, and results that are added in their order."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.jobs import Environment, Job
from mitsuba_irrcache.farm.results import OrderedParts, Outcome, Results

ENVIRONMENT = Environment("llvm_ad_rgb", (), (("mitsuba", "3.9.1"),), 1)


def job(number: int) -> Job:
    """Return a job with one file."""
    return Job(f"job-{number}", "frame", {"file": f"{number}.part"}, ENVIRONMENT)


def outcome(number: int) -> Outcome:
    """Return the result of a job."""
    return Outcome("tcp://worker", 1.0, {f"{number}.part": b"%d" % number})


@pytest.fixture
def results(tmp_path):
    """Return the results of a new folder."""
    made = Results(tmp_path / "results")
    made.begin(resume=False)
    return made


def test_a_job_is_finished_while_its_inputs_and_files_are_the_same(results):
    results.store(job(1), outcome(1))
    assert results.has(job(1)) and not results.has(job(2))
    assert results.has(replace(job(1), environment=replace(ENVIRONMENT, threads=8)))
    for changed in ("variant", "modules", "software", "sources"):
        other = replace(ENVIRONMENT, **{changed: ("other",)})
        assert not results.has(replace(job(1), environment=other))
    assert not results.has(replace(job(1), arguments={"file": "1.part", "seed": 1}))
    (results.folder / "1.part").write_bytes(b"damaged")
    assert not results.has(job(1))


@pytest.mark.parametrize(
    "content", ["", "[]", "null", "5", '"a"', "{}", '{"digest": 1, "files": []}', '{"files": 5}']
)
def test_a_job_with_a_damaged_record_is_not_finished(results, content):
    results.store(job(1), outcome(1))
    (record,) = (results.folder / ".farm").iterdir()
    record.write_text(content)
    assert not results.has(job(1))
    results.remove(job(1))
    results.store(job(1), outcome(1))
    assert results.has(job(1))


def test_results_are_continued_on_request_only(results):
    Results(results.folder).begin(resume=False)  # nothing is finished yet
    results.store(job(1), outcome(1))
    with pytest.raises(IrrcacheError, match="add --resume"):
        Results(results.folder).begin(resume=False)
    Results(results.folder).begin(resume=True)


def test_other_folders_are_refused(tmp_path):
    (tmp_path / "mine.txt").touch()
    for folder, said in (
        (tmp_path, "holds no results"),
        (tmp_path / "mine.txt", "is a file"),
        (tmp_path / "missing" / "new", "does not exist"),
    ):
        with pytest.raises(IrrcacheError, match=said):
            Results(folder).begin(resume=True)


def test_parts_are_added_in_their_order_and_once(results):
    added = []

    def add(job, file):
        added.append(int(file.read_bytes()))

    results.store(job(2), outcome(2))  # left by an earlier run
    parts = OrderedParts(results, [job(n) for n in range(4)], add)
    parts.advance()
    assert added == [] and [j.name for j in parts.missing] == ["job-0", "job-1", "job-3"]
    for number in (3, 0, 1):
        parts.store(job(number), outcome(number))
    assert added == [0, 1, 2, 3] and parts.is_complete
    parts.forget()
    assert not any(results.folder.glob("*.part")) and not results.has_any


def test_a_part_that_does_not_fit_is_computed_again(results):
    def refuse(job, file):
        raise IrrcacheError("another scene")

    parts = OrderedParts(results, [job(0)], refuse)
    with pytest.raises(IrrcacheError, match="another scene"):
        parts.store(job(0), outcome(0))
    assert not results.has(job(0))
