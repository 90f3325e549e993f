"""Options that name a cluster, encryption, and workers that lack the right software."""

from __future__ import annotations

import argparse
from importlib import metadata

import pytest

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
