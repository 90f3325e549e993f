"""Lower bounds are read from the package's metadata and compared as versions."""

from __future__ import annotations

import pytest
from packaging.requirements import Requirement

from mitsuba_irrcache.machine import versions


def test_requirements_are_installed():
    versions.check_versions()


def test_requirements_are_those_of_pyproject():
    core = {requirement.name for requirement in versions.requirements()}
    assert {"mitsuba", "drjit", "numpy", "OpenImageIO"} <= core
    assert {requirement.name for requirement in versions.requirements("volumes")} == {
        "SimpleITK",
        "scipy",
    }
    assert all(requirement.specifier for requirement in versions.requirements())


@pytest.mark.parametrize(
    ("installed", "bound", "satisfied"),
    [
        ("3.10.0", ">=3.9.1", True),  # as strings, 3.10 is less than 3.9
        ("3.9.0", ">=3.9.1", False),
        ("3.10.0.dev1", ">=3.9.1", True),
        (None, ">=3.9.1", False),
    ],
)
def test_versions_are_compared_as_versions(monkeypatch, installed, bound, satisfied):
    monkeypatch.setattr(versions, "installed_version", lambda name: installed)
    assert versions.is_satisfied(Requirement(f"mitsuba{bound}")) is satisfied


def test_error_names_package_versions_and_command(monkeypatch):
    installed = versions.installed_version
    monkeypatch.setattr(
        versions,
        "installed_version",
        lambda name: "3.1.0" if name == "mitsuba" else installed(name),
    )
    with pytest.raises(versions.PackageVersionError) as raised:
        versions.check_versions()
    message = str(raised.value)
    assert "mitsuba>=" in message
    assert "3.1.0 is installed" in message
    assert "pip install --upgrade" in message
    assert "drjit" not in message
