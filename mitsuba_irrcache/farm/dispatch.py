"""Run jobs on the workers of a cluster, and store the result of each once.

Workers may die, be slow, leave, join, or be of another kind. Jobs are pure functions, so that
another worker can repeat any of them, and the first result of a job counts.
"""

from __future__ import annotations

import asyncio
import queue
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import median
from threading import current_thread, main_thread
from typing import TYPE_CHECKING
from uuid import uuid4

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.cluster import Connection, unfit_workers
from mitsuba_irrcache.farm.jobs import Job
from mitsuba_irrcache.farm.results import Outcome
from mitsuba_irrcache.farm.work import run_job

if TYPE_CHECKING:
    from distributed import Future

#: Number of submitted jobs per worker: one that runs and one that waits.
JOBS_PER_WORKER = 2
#: Number of attempts of a job that raises an error; number of submissions of a job whose workers
#: die, each of which Dask ends after `distributed.scheduler.allowed-failures` workers.
ATTEMPTS, ROUNDS = 2, 5
#: Number of failed jobs after which a run ends if no job has succeeded.
FAILURES = 3
#: Time between checks of the cluster, between attempts to restart workers that died during their
#: start, and between messages that there is no worker [s].
INTERVAL, REFILL, REMINDER = 1.0, 5.0, 30.0
#: A job that takes longer than this multiple of the median, and than this time [s], is also given
#: to a second worker if one is idle.
SLOW, SLOW_SECONDS = 4.0, 5.0


class SchedulerLostError(IrrcacheError):
    """The connection to the scheduler is lost for good."""


@dataclass(eq=False)
class _Attempt:
    job: Job
    future: Future
    workers: list[str] | None  # those that may run it; None: all
    started: float = field(default_factory=time.monotonic)


@contextmanager
def _interrupt_put_into(answers: queue.SimpleQueue) -> Iterator[None]:
    """Put None into a queue at the first interrupt by the user, instead of raising
    KeyboardInterrupt, which would be lost if Python happens to run a destructor. A second one is
    raised.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or current_thread() is not main_thread():
        yield
        return

    def handle(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        answers.put(None)

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class Dispatch:
    """The jobs of one run. ``store`` is called with each finished job, once, in this thread."""

    def __init__(
        self, connection: Connection, jobs: Sequence[Job], store: Callable[[Job, Outcome], None]
    ) -> None:
        self._client, self._refill, self._patience = (
            connection.client,
            connection.refill,
            connection.patience,
        )
        self._store = store
        self._waiting = deque(jobs)
        self._open = {job.name: job for job in jobs}
        self._total, self._run = len(jobs), uuid4().hex[:8]
        self._attempts: dict[str, _Attempt] = {}  # by key of the future
        #: keys of finished futures; None: the user has interrupted the command
        self._answered: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._counts: dict[str, Counter] = {"error": Counter(), "killed": Counter()}
        self._durations: list[float] = []
        self._failures = 0
        self._workers: list[str] = []
        self._looked, self._refilled = 0.0, time.monotonic()
        self._seen = self._reminded = time.monotonic()
        self._reconnecting = False
        #: why workers cannot run these jobs, by address
        self.unfit: dict[str, str] = {}
        #: why jobs failed, by name
        self.failed: dict[str, str] = {}

    def run(self) -> dict[str, str]:
        """Run all jobs; return why some failed, by name.

        Raises:
            SchedulerLostError: finished jobs are stored; the others are not.
            IrrcacheError: no worker can run the jobs, or the first ones all fail.
        """
        if not self._open:
            return {}
        started = time.monotonic()
        try:
            with _interrupt_put_into(self._answered):
                for address, reason in unfit_workers(self._client).items():
                    self._exclude(address, reason)
                while self._open:
                    self._look()
                    self._submit_more()
                    try:
                        key = self._answered.get(timeout=INTERVAL)
                    except queue.Empty:
                        continue
                    if key is None:
                        raise KeyboardInterrupt
                    self._take(key)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{self._progress}; --resume continues") from None
        finally:
            self._cancel(list(self._attempts))
        took, work = time.monotonic() - started, sum(self._durations)
        print(f"{len(self._durations)} jobs in {took:.2f} s, {work:.2f} s of work", flush=True)
        return self.failed

    @property
    def _progress(self) -> str:
        return f"{self._total - len(self._open)} of {self._total} jobs are finished and kept"

    # The cluster

    def _look(self) -> None:
        """Check the state of the cluster every `INTERVAL` seconds."""
        now = time.monotonic()
        if now - self._looked < INTERVAL:
            return
        self._looked = now
        if self._client.status == "closed":
            raise SchedulerLostError(
                f"the scheduler is lost; {self._progress}. Start the command again with --resume."
            )
        if self._client.status != "running":
            if not self._reconnecting:
                print("the connection to the scheduler is lost; trying again", flush=True)
            self._reconnecting = True
            return
        self._reconnecting = False
        if now - self._refilled > REFILL:
            self._refilled = now
            self._refill()
        try:
            self._workers = list(self._client.nthreads())
            self._wait_for_workers(now)
            self._release_stranded()
            self._repeat_slow()
        except (OSError, asyncio.TimeoutError):  # the connection is being lost
            return

    def _wait_for_workers(self, now: float) -> None:
        if self._fit:
            self._seen = self._reminded = now
        elif now - self._seen > self._patience:
            others = f" ({len(self._workers)} are excluded)" if self._workers else ""
            raise IrrcacheError(
                f"no worker{others} has started for {now - self._seen:.0f} s; {self._progress}. "
                "See whether there is enough memory, and lower --workers."
            )
        elif now - self._reminded > REMINDER:
            self._reminded = now
            print(f"waiting for workers, {len(self._open)} jobs are left", flush=True)

    @property
    def _fit(self) -> list[str]:
        return [address for address in self._workers if address not in self.unfit]

    def _exclude(self, address: str, reason: str) -> None:
        if address in self.unfit:
            return
        self.unfit[address] = reason
        print(f"worker {address} is not used: {reason}", flush=True)
        self._workers = list(self._client.nthreads())
        if self._workers and not self._fit:
            raise IrrcacheError(
                f"none of the {len(self._workers)} workers can be used; {address}: {reason}."
            )

    def _release_stranded(self) -> None:
        """Withdraw jobs whose admissible workers have all left."""
        for key, attempt in list(self._attempts.items()):
            if attempt.workers is not None and not set(attempt.workers) & set(self._workers):
                self._cancel([key])
                self._again(attempt.job)

    def _repeat_slow(self) -> None:
        """Submit jobs that take unusually long to idle workers as well."""
        if self._next_ready() is not None or not self._durations:
            return
        jobs_by_worker = self._client.processing()
        idle = [address for address in self._fit if not jobs_by_worker.get(address)]
        limit = max(SLOW * median(self._durations), SLOW_SECONDS)
        copies = Counter(attempt.job.name for attempt in self._attempts.values())
        for attempt in sorted(self._attempts.values(), key=lambda a: a.started)[: len(idle)]:
            took = time.monotonic() - attempt.started
            if took > limit and copies[attempt.job.name] == 1:
                print(f"{attempt.job.name} takes {took:.0f} s: started once more", flush=True)
                self._submit(attempt.job, idle)

    # Jobs

    def _submit_more(self) -> None:
        if self._client.status != "running" or (self.unfit and not self._fit):
            return
        room = JOBS_PER_WORKER * max(len(self._fit), 1) - len(self._attempts)
        while room > 0 and (job := self._next_ready()) is not None:
            self._waiting.remove(job)
            self._submit(job)
            room -= 1

    def _next_ready(self) -> Job | None:
        """Return the first job that waits for no other."""
        ready = (job for job in self._waiting if not any(n in self._open for n in job.after))
        return next(ready, None)

    def _submit(self, job: Job, workers: list[str] | None = None) -> None:
        """Submit a job, only for ``workers`` if these are given or if others are unfit."""
        workers = workers or (self._fit if self.unfit else None)
        key = f"irrcache-{self._run}-{job.name}-{uuid4().hex[:8]}"
        future = self._client.submit(
            run_job, job.kind, job.arguments, job.environment,
            key=key, pure=False, workers=workers,
        )  # fmt: skip
        self._attempts[key] = _Attempt(job, future, workers)
        future.add_done_callback(lambda done: self._answered.put(done.key))

    def _again(self, job: Job) -> None:
        if job.name in self._open and all(a.job is not job for a in self._attempts.values()):
            self._waiting.appendleft(job)

    def _cancel(self, keys: list[str]) -> None:
        futures = [self._attempts.pop(key).future for key in keys]
        if futures and self._client.status == "running":
            self._client.cancel(futures)

    def _take(self, key: str) -> None:
        """Handle the answer to an attempt, unless another one was faster."""
        from distributed import KilledWorker

        attempt = self._attempts.pop(key, None)
        if attempt is None:
            return
        job, future = attempt.job, attempt.future
        try:
            if future.status == "error":
                error = future.exception()
                if isinstance(error, KilledWorker):
                    self._note_killed(job, str(error.last_worker.address))
                else:
                    self._note_error(job, f"{type(error).__name__}: {error}")
                return
            outcome = future.result()
        except IrrcacheError:
            raise
        except Exception:  # cancelled, since the connection was lost
            self._again(job)
            return
        if job.name not in self._open:
            return
        if outcome.unfit and not job.is_current:
            self._fail(
                job,
                "files of its scene were changed since the start; when they are complete, start "
                "the command again with --resume",
            )
        elif outcome.unfit:
            self._exclude(outcome.worker, outcome.unfit)
            self._again(job)
        elif outcome.error:
            self._note_error(job, outcome.error)
        else:
            self._finish(job, outcome)

    def _finish(self, job: Job, outcome: Outcome) -> None:
        self._store(job, outcome)
        del self._open[job.name]
        self._durations.append(outcome.seconds)
        self._cancel([k for k, a in self._attempts.items() if a.job is job])
        done = self._total - len(self._open)
        where = f"{outcome.seconds:.2f} s on {outcome.worker}"
        print(f"[{done}/{self._total}] {job.name}: {where}", flush=True)

    def _note_error(self, job: Job, message: str) -> None:
        self._counts["error"][job.name] += 1
        if self._counts["error"][job.name] < ATTEMPTS:
            self._again(job)
        else:
            self._fail(job, message)

    def _note_killed(self, job: Job, last: str) -> None:
        self._counts["killed"][job.name] += 1
        rounds = self._counts["killed"][job.name]
        print(f"{job.name}: several workers ended while they ran it, {last} last", flush=True)
        if rounds < ROUNDS:
            self._again(job)
            return
        self._fail(
            job,
            f"its workers ended each time it was tried, {last} last; see the worker's log, and "
            "whether there is enough memory",
        )

    def _give_up(self, job: Job, message: str) -> None:
        """Leave out a job, and all that need it."""
        self.failed[job.name] = message
        self._open.pop(job.name, None)
        lost = [job.name]
        while lost:
            name = lost.pop()
            for other in [other for other in self._waiting if name in other.after]:
                self._waiting.remove(other)
                self._open.pop(other.name, None)
                self.failed[other.name] = f"it needs {name}, which failed"
                lost.append(other.name)

    def _fail(self, job: Job, message: str) -> None:
        print(f"{job.name} failed: {message}", flush=True)
        self._give_up(job, message)
        self._failures += 1
        if self._failures >= FAILURES and not self._durations:
            raise IrrcacheError(f"the first {FAILURES} jobs failed; {job.name}: {message}")
