"""Options that name a cluster, encryption, and workers that lack the right software."""

from __future__ import annotations

import argparse
import socket
import threading
from contextlib import suppress
from dataclasses import replace
from importlib import metadata

import pytest
from distributed import LocalCluster

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm import cluster
from mitsuba_irrcache.farm.cluster import ClusterOptions, add_cluster_options, connected


def options(*arguments: object) -> ClusterOptions:
    """Return the options of a command line."""
    parser = argparse.ArgumentParser()
    add_cluster_options(parser)
    return ClusterOptions.of(parser.parse_args([str(a) for a in arguments]))


@pytest.fixture
def pem(tmp_path):
    """Return a file, which is not read before a connection is made."""
    path = tmp_path / "certificate.pem"
    path.touch()
    return path


def test_cores_are_divided_among_the_workers_of_this_machine(monkeypatch):
    monkeypatch.setattr(cluster, "available_cores", lambda: 10)
    assert (options().workers, options().threads) == (4, 2)
    assert options("--workers", 3).threads == 3 and options("--workers", 20).threads == 1
    assert options("--scheduler", "tcp://host:1").threads == 0
    assert options("--threads", 7).threads == 7


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scheduler", "tcp://h:1", "--workers", "2"], "--workers is for workers on this"),
        (["--scheduler", "tls://h:1"], "is encrypted; add --tls-ca-file"),
        (["--tls-ca-file", "PEM"], "--tls-ca-file is given alone"),
        (["--tls-key", "missing.pem"], '--tls-key: there is no file "missing.pem"'),
    ],
)
def test_options_that_contradict_each_other(arguments, said, pem):
    with pytest.raises(IrrcacheError, match=said):
        options(*(str(pem) if a == "PEM" else a for a in arguments))


def test_certificates_are_those_of_all_roles_and_encryption_is_required(pem):
    given = options("--tls-ca-file", pem, "--tls-cert", pem, "--tls-key", pem)
    security = cluster._security(given)
    assert security.require_encryption and security.tls_ca_file == str(pem)
    for role in ("client", "scheduler", "worker"):
        assert getattr(security, f"tls_{role}_cert") == str(pem)
    assert cluster._security(options()) is None


def test_a_scheduler_that_does_not_answer(monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 0.2)
    with (
        pytest.raises(IrrcacheError, match=r'no scheduler answers at "tcp://127.0.0.1:1".*dask'),
        connected(options("--scheduler", "tcp://127.0.0.1:1")),
    ):
        pytest.fail("it is connected to nothing")
    with (
        pytest.raises(IrrcacheError, match=r'no file "missing.json"'),
        connected(options("--scheduler", "missing.json")),
    ):
        pytest.fail("it is connected to nothing")


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.0 400 Bad Request\r\n\r\n", b"\0" * 64])
def test_another_program_that_answers_is_no_scheduler(monkeypatch, answer):
    """As a web server, which may wait for more, or say what Dask does not understand."""
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def reply() -> None:
            with suppress(OSError):  # closed
                while True:
                    held.append(server.accept()[0])
                    held[-1].sendall(answer)

        held: list[socket.socket] = []
        threading.Thread(target=reply, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with (
            pytest.raises(IrrcacheError, match=rf'no scheduler answers at "{address}" \(\w.*dask'),
            connected(options("--scheduler", address)),
        ):
            pytest.fail("it is connected to nothing")
        server.shutdown(socket.SHUT_RDWR)
        for each in held:
            each.close()


@pytest.mark.parametrize("address", ["ucx://127.0.0.1:1", "no_such://host:1", " "])
def test_an_address_of_no_scheduler_is_named(monkeypatch, address):
    monkeypatch.setattr(cluster, "PATIENCE", 0.2)
    given = replace(options("--scheduler", "tcp://host:1"), scheduler=address)
    with (
        pytest.raises(IrrcacheError, match=rf'no scheduler answers at "{address}" \(\w'),
        connected(given),
    ):
        pytest.fail("it is connected to nothing")


def test_a_scheduler_that_answers_is_used():
    place = {"host": "127.0.0.1", "protocol": "tcp", "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=0, processes=False, **place) as running:
        address = running.scheduler_address
        with connected(options("--scheduler", address)) as connection:
            assert connection.client.scheduler.address == address


@pytest.mark.parametrize("content", ["", "[1]", "null", '{"a": 1}', '{"address": 5}', "\xff"])
def test_a_file_that_names_no_scheduler(tmp_path, content):
    file = tmp_path / "scheduler.json"
    file.write_text(content, encoding="latin-1")
    with (
        pytest.raises(IrrcacheError, match=rf'^--scheduler: "{file}" names no address; name a'),
        connected(options("--scheduler", file)),
    ):
        pytest.fail("it is connected to nothing")


def test_a_worker_that_ends_while_it_is_asked_is_not_said_to_lack_anything():
    class Client:
        def run(self, function, name, on_error) -> dict:
            return {
                "old": "0.0.1",
                "bare": metadata.PackageNotFoundError(name),
                "ended": OSError("connection lost"),
                "good": function(name),
            }

    found = cluster.unfit_workers(Client())
    assert set(found) == {"old", "bare"}
    assert "it has mitsuba 0.0.1, not " in found["old"] and "it lacks drjit" in found["bare"]
