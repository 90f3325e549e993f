"""The cluster: a running scheduler, or one that this command starts on this machine."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

from mitsuba_irrcache.core.argument_types import whole
from mitsuba_irrcache.errors import IrrcacheError, reason
from mitsuba_irrcache.farm.jobs import SOFTWARE, difference
from mitsuba_irrcache.machine.doctor import available_cores
from mitsuba_irrcache.machine.memory import total_memory
from mitsuba_irrcache.machine.versions import installed_version

if TYPE_CHECKING:  # importing it takes a second
    from distributed import Client, LocalCluster, Security

#: Largest default number of workers on this machine.
MOST_WORKERS = 4
#: Time to wait for a scheduler, and for its first worker [s].
PATIENCE = 30
#: Settings of workers on this machine: results are not spilled to disk, and a job is not abandoned
#: as soon as its process dies.
_SETTINGS = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.deploy.lost-worker-timeout": "5s",
}
#: Raised on workers without a package.
MISSING = metadata.PackageNotFoundError
#: Time without a worker on this machine after which the run is given up [s].
LONGEST_START = 300.0


def add_cluster_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options that name a cluster."""
    add = parser.add_argument_group("cluster").add_argument
    add(
        "--scheduler", metavar="ADDRESS",
        help="scheduler that runs already: tcp://HOST:PORT, tls://HOST:PORT, or its JSON file "
        "(default: one on this machine, for this run, which no other machine can reach)",
    )  # fmt: skip
    add(
        "--workers", type=whole(1, 4096), metavar="N",
        help=f"workers on this machine (default: one per core, at most {MOST_WORKERS})",
    )  # fmt: skip
    add(
        "--threads", type=whole(1, 4096), metavar="N",
        help="threads of Dr.Jit in each worker (default: the cores of this machine are divided "
        "among its workers; with --scheduler all that a worker may use)",
    )  # fmt: skip
    for name, text in (("ca-file", "certificates"), ("cert", "certificate"), ("key", "its key")):
        add(
            f"--tls-{name}", type=Path, metavar="FILE",
            help=f"{text} for encrypted connections (PEM; see dask.distributed.Security)",
        )  # fmt: skip


@dataclass(frozen=True)
class ClusterOptions:
    """Checked options of `add_cluster_options`."""

    scheduler: str
    workers: int
    threads: int
    certificates: dict[str, str]

    @classmethod
    def of(cls, args: argparse.Namespace, most_workers: int = MOST_WORKERS) -> ClusterOptions:
        """Check the options; without --workers there are at most ``most_workers`` here."""
        if args.scheduler and args.workers:
            raise IrrcacheError(
                "--workers is for workers on this machine; with --scheduler, start workers there."
            )
        cores = available_cores()
        workers = args.workers or min(cores, most_workers)
        threads = args.threads or (0 if args.scheduler else max(1, cores // workers))
        return cls(args.scheduler or "", workers, threads, _certificates(args))


def _certificates(args: argparse.Namespace) -> dict[str, str]:
    found = {
        name: getattr(args, f"tls_{name}")
        for name in ("ca_file", "cert", "key")
        if getattr(args, f"tls_{name}") is not None
    }
    for name, path in found.items():
        if not path.is_file():
            raise IrrcacheError(f'--tls-{name.replace("_", "-")}: there is no file "{path}".')
    if found and len(found) < 3:
        given = ", ".join(f"--tls-{name.replace('_', '-')}" for name in found)
        raise IrrcacheError(
            f"{given} is given alone; encrypted connections need --tls-ca-file, --tls-cert and "
            "--tls-key."
        )
    if args.scheduler and args.scheduler.startswith("tls://") and not found:
        raise IrrcacheError(
            f'--scheduler "{args.scheduler}" is encrypted; add --tls-ca-file, --tls-cert and '
            "--tls-key."
        )
    return {name: str(path) for name, path in found.items()}


@dataclass
class Connection:
    """A client and its workers.

    Attributes:
        client: connected to the scheduler.
        refill: starts workers of this machine again that died while they started.
        patience: seconds to wait for a worker if there is none; a cluster may have a queue.
    """

    client: Client
    refill: Callable[[], None] = lambda: None
    patience: float = math.inf


@contextmanager
def connected(options: ClusterOptions) -> Iterator[Connection]:
    """Connect to the scheduler, or start one; print where its state is displayed."""
    import dask
    from distributed import Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    security = _security(options)
    with dask.config.set(_SETTINGS):
        if options.scheduler:
            address = _address(options.scheduler)
            try:
                asyncio.run(_greeted(address, security))
                client = Client(address, security=security, timeout=PATIENCE)
            except Exception as error:  # Dask raises exceptions of any type
                why = reason(error) or f"nothing that it understands within {PATIENCE:g} s"
                raise IrrcacheError(
                    f'no scheduler answers at "{options.scheduler}" ({why}); start one '
                    'with "dask scheduler", or leave --scheduler out.'
                ) from error
            with client:
                _announce(client)
                yield Connection(client)
            return
        with _local(options, security) as cluster, Client(cluster, security=security) as client:
            _announce(client)
            _refill(cluster, options.workers)
            yield Connection(client, lambda: _refill(cluster, options.workers), LONGEST_START)


async def _greeted(address: str, security: Security | None) -> None:
    """Exchange greetings with a scheduler, within `PATIENCE`.

    A client would wait for ever for those of another program, as of a web server.
    """
    from distributed import Security
    from distributed.comm import connect

    arguments = (security or Security()).get_connection_args("client")
    greeting = connect(address, timeout=PATIENCE, **arguments)
    # A little longer than the connection, whose own error says more.
    comm = await asyncio.wait_for(greeting, 1.05 * PATIENCE)
    comm.abort()


def _local(options: ClusterOptions, security: Security | None) -> LocalCluster:
    """Start a scheduler for workers on this machine, which no other machine can reach."""
    from distributed import LocalCluster

    encryption = {"security": security} if security else {}
    cluster = LocalCluster(
        n_workers=0,  # `_refill` starts them, each by itself: one may be killed while it starts
        threads_per_worker=1,
        processes=True,
        memory_limit=total_memory() // options.workers,
        host="127.0.0.1",
        protocol="tls" if security else "tcp",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
        **encryption,
    )
    cluster.sync(_block_interrupts)
    return cluster


async def _block_interrupts() -> None:
    """Leave Ctrl-C to the command: processes started by this thread inherit what it blocks, and
    would otherwise print tracebacks of their own.
    """
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        resource_tracker.ensure_running()  # which would end the blocking when the first one starts
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _refill(cluster: LocalCluster, count: int) -> None:
    """Start workers again up to ``count``: Dask does not if they died while they started."""
    from distributed.core import Status

    for name, worker in list(cluster.workers.items()):
        if worker.status in (Status.closed, Status.failed):
            cluster.workers.pop(name, None)
    cluster.scale(count)


def _address(scheduler: str) -> str:
    """Return the address of a scheduler, which a JSON file may contain."""
    if not scheduler.endswith(".json"):
        return scheduler
    if not Path(scheduler).is_file():
        raise IrrcacheError(f'--scheduler: there is no file "{scheduler}".')
    try:
        address = json.loads(Path(scheduler).read_text())["address"]
    except (OSError, ValueError, KeyError, TypeError):
        address = None
    if not isinstance(address, str):
        raise IrrcacheError(
            f'--scheduler: "{scheduler}" names no address; name a file that '
            '"dask scheduler --scheduler-file" has written, or the address itself.'
        )
    return address


def _security(options: ClusterOptions) -> Security | None:
    if not options.certificates:
        return None
    from distributed import Security

    files = options.certificates
    roles = {
        f"tls_{role}_{part}": files[part]
        for role in ("client", "scheduler", "worker")
        for part in ("cert", "key")
    }
    return Security(tls_ca_file=files["ca_file"], require_encryption=True, **roles)


def _announce(client: Client) -> None:
    print(f"scheduler {client.scheduler.address}, dashboard {client.dashboard_link}", flush=True)


def unfit_workers(client: Client) -> dict[str, str]:
    """Return, by address, why connected workers cannot run jobs: other versions of software.

    Only Python's own library is used on them, so that any worker can answer.
    """
    reasons: dict[str, list[str]] = {}
    for name in SOFTWARE:
        wanted = installed_version(name)
        answers = client.run(metadata.version, name, on_error="return")
        for address, answer in answers.items():
            if isinstance(answer, Exception) and not isinstance(answer, MISSING):
                continue  # the worker ended meanwhile
            if answer != wanted:
                found = None if isinstance(answer, MISSING) else answer
                reasons.setdefault(address, []).append(difference(name, found, wanted))
    return {address: "; ".join(texts) for address, texts in reasons.items()}
