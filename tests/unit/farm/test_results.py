"""Records of finished jobs, and results that are added in their order."""

from __future__ import annotations

import shutil
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


def test_a_folder_is_used_by_one_command_at_a_time(tmp_path):
    """Another one is refused until the first has ended, and nothing empty is left of either."""
    folder = tmp_path / "results"
    with Results(folder).alone(resume=False):
        with pytest.raises(IrrcacheError, match=r'another command is using ".*results"; when'):
            with Results(folder).alone(resume=True):
                pass
    assert not folder.exists()
    folder.mkdir()
    with pytest.raises(KeyError), Results(folder).alone(resume=False):
        raise KeyError
    assert folder.is_dir() and not any(folder.iterdir())  # was there before
    with Results(folder).alone(resume=False):
        Results(folder).store(job(1), outcome(1))
    assert [path.name for path in (folder / ".farm").iterdir()] == ["job-1.json"]
    with pytest.raises(IrrcacheError, match="add --resume"), Results(folder).alone(resume=False):
        pass
    # A killed command leaves the file that it had locked.
    (folder / ".farm" / "lock").touch()
    with Results(folder).alone(resume=True):
        pass


def test_the_next_command_does_not_lose_its_lock(tmp_path):
    """The first one removes the folder, and the next one begins before the first has ended."""
    folder = tmp_path / "results"
    first, second, third = (Results(folder, names=["*.part"]) for _ in range(3))
    with first.alone(resume=True):
        first.store(job(1), outcome(1))
        first.remove_all()
        assert not folder.exists()
        context = second.alone(resume=True)
        context.__enter__()
    with pytest.raises(IrrcacheError, match="another command"), third.alone(resume=True):
        pass
    context.__exit__(None, None, None)
    assert not folder.exists()


def test_only_files_of_runs_are_removed(tmp_path):
    folder = tmp_path / "results"
    results = Results(folder, names=["[0-9].part", "[a-f]"])
    results.begin(resume=True)
    results.store(job(1), outcome(1))
    (folder / ".1.part.x8s.tmp").touch()
    (folder / "a").mkdir()
    (folder / "a" / "working").touch()
    for name in ("mine.txt", "my.part"):
        (folder / name).write_text("precious")
    results.remove_all()
    assert sorted(path.name for path in folder.iterdir()) == ["mine.txt", "my.part"]
    with pytest.raises(IrrcacheError, match=r'but "mine\.txt"'):
        results.begin(resume=True)


def test_what_is_left_without_records_is_continued(tmp_path):
    """As where a command is killed while it removes them."""
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "1.part").write_text("of an unknown job")
    results = Results(folder, names=["[0-9].part"])
    results.begin(resume=True)
    assert not results.has(job(1))
    results.store(job(1), outcome(1))
    assert results.has(job(1))
    results.remove_all()
    assert not folder.exists()


def test_a_folder_that_another_command_removes_is_named(results):
    """Nothing is written to it: files without records would be refused by the next command."""
    shutil.rmtree(results.folder)
    with pytest.raises(IrrcacheError, match=r"results.* was removed .*as by another command"):
        results.store(job(1), outcome(1))
    assert not results.folder.exists()


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
