"""Optional packages: which extra of this package installs them, and by which command."""

from __future__ import annotations

import importlib.util
import re
import sys

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.versions import DISTRIBUTION, extras, requirements


class MissingPackageError(IrrcacheError):
    """A package required by a command is not installed; the message says what to install."""


def require(module: str, extra: str, what: str) -> None:
    """Raise MissingPackageError, on behalf of the feature ``what``, if ``module`` is not installed.

    ``extra`` is the extra of this package that installs the module.
    """
    if importlib.util.find_spec(module) is None:
        raise MissingPackageError(_message(what, module, extra))


def missing_package(error: ModuleNotFoundError, what: str, extra: str = "") -> IrrcacheError | None:
    """Convert a failed import in the feature ``what`` into an error that names package and remedy.

    ``extra`` is the extra with all packages of the feature, or "". Returns None if no requirement
    of this package provides the module: the import error is then a programming error.
    """
    module = (error.name or "").partition(".")[0]
    for known in dict.fromkeys((extra, *extras(), "")):
        if any(_module(r.name) == _normal(module) for r in requirements(known)):
            # Prefer the extra of the command: it installs the other packages the command needs,
            # too.
            return MissingPackageError(_message(what, module, extra or known))
    return None


def remedy(extra: str) -> str:
    """Return the command that installs an extra; "" stands for the required packages."""
    wanted = f"{DISTRIBUTION}[{extra}]" if extra else DISTRIBUTION
    return f'{sys.executable} -m pip install "{wanted}"'


def _message(what: str, module: str, extra: str) -> str:
    return f'{what} needs "{module}", which is not installed. Remedy: {remedy(extra)}'


def _normal(name: str) -> str:
    """Normalise the name of a distribution or module for comparison (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _module(distribution: str) -> str:
    """Return the module name of a distribution, which may differ from the distribution's name."""
    return {"colour-science": "colour"}.get(_normal(distribution), _normal(distribution))
