"""Packages that are new enough: what is installed against the lower bounds that were tested."""

from __future__ import annotations

import sys
from importlib import metadata

from packaging.requirements import Requirement
from packaging.version import Version

from mitsuba_irrcache.errors import IrrcacheError

DISTRIBUTION = "mitsuba_irrcache"


class PackageVersionError(IrrcacheError):
    """An installed package is missing or too old; the message says what to install."""


def requirements(extra: str = "") -> list[Requirement]:
    """What this package requires by its own metadata, with the lower bounds that were tested.

    Args:
        extra: with a name, only what that extra (``volumes``, ``compare``, ``test``) adds.

    Returns:
        The requirements, without those of one extra on another.

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
    """Names of this package's extras, in the order in which it declares them."""
    try:
        return list(metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or [])
    except metadata.PackageNotFoundError:
        return []


def installed_version(name: str) -> str | None:
    """The version of a package, or None where it is not installed.

    A module that is imported already speaks for itself: a Mitsuba built from source has no
    distribution metadata.
    """
    imported = getattr(sys.modules.get(name), "__version__", None)
    if imported:
        return imported
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def is_satisfied(requirement: Requirement) -> bool:
    """Whether the installed package is within the bounds of a requirement."""
    version = installed_version(requirement.name)
    return version is not None and requirement.specifier.contains(
        Version(version), prereleases=True
    )


def check_versions() -> None:
    """Compare the installed packages with the lower bounds that were tested.

    Raises:
        PackageVersionError: some are missing or too old; names them and the command that helps.
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


def _is_wanted(requirement: Requirement, extra: str) -> bool:
    """Whether a requirement holds on this system and, given an extra, only because of it."""
    if requirement.marker is None:
        return not extra
    without = requirement.marker.evaluate({"extra": ""})
    return (requirement.marker.evaluate({"extra": extra}) and not without) if extra else without
