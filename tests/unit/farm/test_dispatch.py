"""Jobs on workers that fail, are slow, or are of another kind, with a cluster that is made up."""

from __future__ import annotations

import threading

import pytest
from distributed import KilledWorker

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm import dispatch
from mitsuba_irrcache.farm.cluster import Connection
from mitsuba_irrcache.farm.dispatch import Dispatch, SchedulerLostError
from mitsuba_irrcache.farm.jobs import Environment, Job, scene_arguments
from mitsuba_irrcache.farm.results import Outcome

ENVIRONMENT = Environment("llvm_ad_rgb")


class Future:
    """An attempt at a job whose answer is known, or never comes."""

    def __init__(self, key: str, answer: object) -> None:
        self.key, self.answer = key, answer

    @property
    def status(self) -> str:
        if isinstance(self.answer, Exception):
            return "error"
        return "finished" if isinstance(self.answer, Outcome) else "cancelled"

    def add_done_callback(self, call) -> None:
        if self.answer != "never":
            threading.Thread(target=call, args=(self,)).start()

    def exception(self) -> Exception:
        return self.answer

    def result(self) -> Outcome:
        if not isinstance(self.answer, Outcome):
            raise RuntimeError("cancelled")
        return self.answer


class Cluster:
    """A client of workers that answer as told: ``answers`` are used up job by job."""

    def __init__(self, answers: dict[str, list], workers: tuple[str, ...] = ("a", "b")) -> None:
        self.answers, self.workers, self.status = answers, workers, "running"
        self.submitted: list[tuple[str, tuple | None]] = []

    def nthreads(self) -> dict[str, int]:
        return dict.fromkeys(self.workers, 1)

    def processing(self) -> dict[str, tuple]:
        return {worker: () for worker in self.workers if worker != "busy"} | {"busy": ("job",)}

    def run(self, function, name, on_error) -> dict:
        return {worker: function(name) for worker in self.workers}

    def submit(self, function, kind, arguments, environment, key, pure, workers) -> Future:
        name = arguments["name"]
        self.submitted.append((name, workers and tuple(workers)))
        left = self.answers.get(name, [])
        return Future(key, left.pop(0) if left else Outcome((workers or self.workers)[0], 0.1))

    def cancel(self, futures) -> None:
        pass


def jobs(*names: str) -> list[Job]:
    """Return jobs of these names."""
    return [Job(name, "frame", {"name": name}, ENVIRONMENT) for name in names]


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    """Look at the cluster often, and take jobs for slow at once."""
    monkeypatch.setattr(dispatch, "INTERVAL", 0.01)
    monkeypatch.setattr(dispatch, "SLOW_SECONDS", 0.02)
    monkeypatch.setattr(dispatch, "SLOW", 0.0)


def dispatched(cluster: Cluster, *names: str) -> tuple[list[str], dict[str, str]]:
    """Run jobs; return the names in the order in which they were stored, and failures."""
    stored: list[str] = []
    failed = Dispatch(
        Connection(cluster), jobs(*names), lambda job, _: stored.append(job.name)
    ).run()
    return stored, failed


def test_each_result_is_stored_once():
    names = [str(n) for n in range(20)]
    stored, failed = dispatched(Cluster({}), *names)
    assert sorted(stored) == sorted(names) and not failed


def test_a_job_whose_workers_die_is_repeated_and_at_last_given_up():
    killed = KilledWorker("x", type("Worker", (), {"address": "a"})(), 3)
    cluster = Cluster({"bad": [killed] * dispatch.ROUNDS, "unlucky": [killed] * 2})
    stored, failed = dispatched(cluster, "bad", "unlucky", "good")
    assert sorted(stored) == ["good", "unlucky"]
    assert list(failed) == ["bad"] and "enough memory" in failed["bad"]


def test_an_error_is_tried_twice_and_others_go_on():
    error = Outcome("a", error="no space left")
    cluster = Cluster({"bad": [error] * dispatch.ATTEMPTS, "unlucky": [error]})
    stored, failed = dispatched(cluster, "good", "bad", "unlucky")
    assert sorted(stored) == ["good", "unlucky"] and failed == {"bad": "no space left"}


def test_the_run_ends_if_the_first_jobs_all_fail():
    names = [str(n) for n in range(9)]
    answers = {name: [Outcome("a", error="no such plugin")] * 2 for name in names}
    with pytest.raises(IrrcacheError, match=r"first 3 jobs failed; .*: no such plugin"):
        dispatched(Cluster(answers), *names)


def test_a_worker_of_another_kind_gets_no_more_jobs(capsys):
    unfit = Outcome("a", unfit="it has mitsuba 3.5, needed is 3.9")
    cluster = Cluster({"first": [unfit]})
    stored, _ = dispatched(cluster, "first", "second", "third", "fourth", "fifth", "sixth")
    assert len(stored) == 6
    assert cluster.submitted[-1] == ("sixth", ("b",))
    assert ("first", ("b",)) in cluster.submitted
    assert "worker a is not used: it has mitsuba 3.5" in capsys.readouterr().out


def test_a_job_whose_files_have_changed_ends_alone(rgb, tmp_path):
    """Workers find other files than those that the job was made for, through no fault of theirs."""
    wanted = []
    for name in ("first", "changed", "lost", "last"):
        scene = tmp_path / f"{name}.xml"
        scene.write_text('<scene version="3.0.0"/>')
        arguments = {"name": name, "scene": scene_arguments(scene, {}, None)}
        wanted.append(Job(name, "frame", arguments, ENVIRONMENT))
    (tmp_path / "changed.xml").write_text('<scene version="3.0.0"> </scene>')
    (tmp_path / "lost.xml").unlink()
    unfit = Outcome("a", unfit="the files differ there from those here")
    cluster, stored = Cluster({"changed": [unfit], "lost": [unfit], "last": [unfit]}), []
    run = Dispatch(Connection(cluster), wanted, lambda job, _: stored.append(job.name))
    failed = run.run()
    assert sorted(stored) == ["first", "last"] and list(run.unfit) == ["a"]
    assert sorted(failed) == ["changed", "lost"]
    assert all("changed since the start" in reason for reason in failed.values())


def test_workers_of_another_version_are_found_before_the_first_job(monkeypatch):
    monkeypatch.setattr(dispatch, "unfit_workers", lambda client: {"a": "it has drjit 1.0"})
    cluster = Cluster({})
    dispatched(cluster, "first")
    assert cluster.submitted == [("first", ("b",))]
    with pytest.raises(IrrcacheError, match="none of the 1 workers can be used; a: it has drjit"):
        dispatched(Cluster({}, ("a",)), "first")


def test_a_slow_job_is_started_once_more_and_counted_once():
    cluster = Cluster({"slow": ["never"]}, ("busy", "idle"))
    stored, _ = dispatched(cluster, "slow", "quick")
    assert sorted(stored) == ["quick", "slow"]
    assert [workers for name, workers in cluster.submitted if name == "slow"] == [None, ("idle",)]


def test_jobs_of_workers_that_left_are_given_to_others(monkeypatch):
    monkeypatch.setattr(dispatch, "unfit_workers", lambda client: {"a": "it is old"})
    cluster = Cluster({"first": ["never"]})

    def leave(job, _):
        cluster.workers = ("a", "c")

    assert Dispatch(Connection(cluster), jobs("first", "second"), leave).run() == {}
    assert cluster.submitted[-1] == ("first", ("c",))


def test_a_lost_scheduler_is_reported():
    cluster = Cluster({"second": ["lost"], "third": ["lost"]})

    def lose(job, _):
        cluster.status = "closed"

    with pytest.raises(SchedulerLostError, match=r"1 of 3 jobs are finished and kept.*--resume"):
        Dispatch(Connection(cluster), jobs("first", "second", "third"), lose).run()


def chain(*names: str) -> list[Job]:
    """Return jobs, each of which needs the one before."""
    before = ((), *((name,) for name in names))
    return [
        Job(name, "frame", {"name": name}, ENVIRONMENT, after)
        for name, after in zip(names, before, strict=False)
    ]


def test_a_job_starts_when_those_that_it_needs_are_stored():
    stored: list[str] = []
    cluster = Cluster({"second": [Outcome("a", error="no space left")]})
    names = ["first", "second", "third", "fourth"]
    wanted = [*reversed(chain(*names)), *jobs("alone")]

    def store(job, _):
        assert [name for name, _ in cluster.submitted if name in names][-1] == job.name or (
            job.name == "alone"
        )
        stored.append(job.name)

    assert Dispatch(Connection(cluster), wanted, store).run() == {}
    assert [name for name in stored if name != "alone"] == names and "alone" in stored


def test_jobs_that_need_a_failed_one_are_given_up_with_it():
    error = Outcome("a", error="no space left")
    cluster, stored = Cluster({"second": [error] * dispatch.ATTEMPTS}), []
    wanted = [*chain("first", "second", "third", "fourth"), *jobs("alone")]
    failed = Dispatch(Connection(cluster), wanted, lambda job, _: stored.append(job.name)).run()
    assert sorted(stored) == ["alone", "first"]
    assert failed == {
        "second": "no space left",
        "third": "it needs second, which failed",
        "fourth": "it needs third, which failed",
    }


def test_a_slow_job_that_others_wait_for_is_started_once_more():
    cluster, stored = Cluster({"slow": ["never"]}, ("busy", "idle")), []
    wanted = [*jobs("quick"), *chain("slow", "after")]
    assert Dispatch(Connection(cluster), wanted, lambda job, _: stored.append(job.name)).run() == {}
    assert sorted(stored) == ["after", "quick", "slow"]
    assert [name for name, _ in cluster.submitted].count("slow") == 2
