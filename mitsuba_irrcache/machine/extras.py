"""Optional packages: which extra of this package installs them, and the command for it."""

from __future__ import annotations

import importlib.util
import re
import sys

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.versions import DISTRIBUTION, extras, requirements


class MissingPackageError(IrrcacheError):
    """A package that a command needs is not installed; the message says what to install."""


def require(module: str, extra: str, what: str) -> None:
    """Raises MissingPackageError unless ``module`` of this ``extra`` is there; ``what`` needs
    it.
    """
    if importlib.util.find_spec(module) is None:
        raise MissingPackageError(_message(what, module, extra))


def missing_package(error: ModuleNotFoundError, what: str, extra: str = "") -> IrrcacheError | None:
    """What to say of an import that failed: which package ``what`` lacks, and the remedy.

    ``extra`` is the one that has all packages of ``what``, "" if it has none of its own. None where
    the module belongs to no package that this one requires: the error is a mistake in the code.
    """
    module = (error.name or "").partition(".")[0]
    for known in dict.fromkeys((extra, *extras(), "")):
        if any(_module(r.name) == _normal(module) for r in requirements(known)):
            # The extra of the command installs what others of its packages need, too.
            return MissingPackageError(_message(what, module, extra or known))
    return None


def remedy(extra: str) -> str:
    """The command that installs an extra; "" stands for what is always required."""
    wanted = f"{DISTRIBUTION}[{extra}]" if extra else DISTRIBUTION
    return f'{sys.executable} -m pip install "{wanted}"'


def _message(what: str, module: str, extra: str) -> str:
    return f'{what} needs "{module}", which is not installed. Remedy: {remedy(extra)}'


def _normal(name: str) -> str:
    """A name of a distribution or module, as packaging tools compare them."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _module(distribution: str) -> str:
    """The module of a distribution, where its name is another one."""
    return {"colour-science": "colour"}.get(_normal(distribution), _normal(distribution))
