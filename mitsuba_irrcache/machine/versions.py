"""Check installed packages against the tested lower bounds."""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib import metadata

from packaging.requirements import Requirement
from packaging.version import Version

from mitsuba_irrcache.errors import IrrcacheError

DISTRIBUTION = "mitsuba_irrcache"


class PackageVersionError(IrrcacheError):
    """An installed package is missing or too old; the message says what to install."""


def requirements(extra: str = "") -> list[Requirement]:
    """Return the requirements declared in this package's metadata, with the tested lower bounds.

    Args:
        extra: if given, only the requirements of this extra (``volumes``, ``compare``, ``test``).

    Returns:
        The requirements, without references from one extra to another.

    Raises:
        PackageVersionError: this package itself is not installed.
    """
    try:
        declared = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        raise PackageVersionError(
            f"{DISTRIBUTION} is not installed. Remedy: {sys.executable} -m pip install -e . "
            "in the folder that has its pyproject.toml"
        ) from None
    parsed = [Requirement(text) for text in declared]
    return [
        requirement
        for requirement in parsed
        if requirement.name != DISTRIBUTION and _is_wanted(requirement, extra)
    ]


def extras() -> list[str]:
    """Return the names of this package's extras in the order of declaration."""
    try:
        return list(metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or [])
    except metadata.PackageNotFoundError:
        return []


def installed_version(name: str) -> str | None:
    """Return the version of a package, or None if it is not installed.

    Prefer ``__version__`` of an imported module: a Mitsuba built from source has no distribution
    metadata.
    """
    imported = getattr(sys.modules.get(name), "__version__", None)
    if imported:
        return imported
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def is_satisfied(requirement: Requirement) -> bool:
    """Return whether the installed package fulfils a requirement."""
    version = installed_version(requirement.name)
    return version is not None and requirement.specifier.contains(
        Version(version), prereleases=True
    )


def check_versions() -> None:
    """Compare the installed packages with the tested lower bounds.

    Raises:
        PackageVersionError: some are missing or too old; the message names them and the remedy.
    """
    wrong = [requirement for requirement in requirements() if not is_satisfied(requirement)]
    if wrong:
        found = "; ".join(
            f"{requirement} is needed, {installed_version(requirement.name) or 'none'} is installed"
            for requirement in wrong
        )
        wanted = " ".join(f'"{requirement}"' for requirement in wrong)
        raise PackageVersionError(
            f"{found}. Remedy: {sys.executable} -m pip install --upgrade {wanted}"
        )


@lru_cache(maxsize=1)
def require_versions() -> None:
    """Call `check_versions`, which takes 10 ms, unless it succeeded in this process before."""
    check_versions()


def _is_wanted(requirement: Requirement, extra: str) -> bool:
    """Return whether a requirement applies on this system.

    If ``extra`` is given, only requirements of that extra count.
    """
    if requirement.marker is None:
        return not extra
    without = requirement.marker.evaluate({"extra": ""})
    return (requirement.marker.evaluate({"extra": extra}) and not without) if extra else without
