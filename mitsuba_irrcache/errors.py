"""Exceptions whose messages name the offending object, its value and a remedy."""

from __future__ import annotations

import re
from collections.abc import Iterable


class IrrcacheError(ValueError):
    """Invalid input; the message contains the remedy."""


class UnsupportedSceneError(IrrcacheError):
    """The scene contains an object that ``irrcache`` would render incorrectly; the message names
    it.
    """


class CacheFileError(IrrcacheError):
    """The cache file is damaged, of another format, or computed for a different scene."""


def suggestion(wanted: str, names: Iterable[str]) -> str:
    """Return ``' (did you mean "..."?)'`` for the name most similar to ``wanted``, or ``""`` if
    none is, or if it is one of them, which has no meaning where it stands.
    """
    import difflib  # imported here because only misspelt names need it

    by_lower_case = {name.lower(): name for name in names}
    if by_lower_case.get(wanted.lower()) == wanted:
        return ""
    close = difflib.get_close_matches(wanted.lower(), by_lower_case, n=1)
    return f' (did you mean "{by_lower_case[close[0]]}"?)' if close else ""


def origin(error: BaseException) -> BaseException:
    """Return the first exception of the chain of causes, or the last IrrcacheError, whose message
    is complete.

    Mitsuba and Dr.Jit wrap every exception raised by a Python plugin, including KeyboardInterrupt.
    """
    while error.__cause__ is not None and not isinstance(error, IrrcacheError):
        error = error.__cause__
    return error


def reason(error: BaseException) -> str:
    """Return the message of an exception, without number and file name of one of the operating
    system.
    """
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def original_message(error: BaseException) -> str:
    """Return the message of the original exception, without the text that Mitsuba adds."""
    error = origin(error)
    if isinstance(error, OSError):
        return f'"{error.filename}": {reason(error)}' if error.filename else reason(error)
    raised = re.findall(r"^(?:\w+\.)*\w*Error: (.+)$", str(error), re.MULTILINE)
    return raised[-1] if raised else str(error).strip()


def add_cause(error: RuntimeError) -> None:
    """Insert the message of the original exception into an exception raised by Dr.Jit.

    An IrrcacheError replaces the message; for other exceptions the cause is appended.
    """
    cause = origin(error)
    if cause is error or not isinstance(cause, Exception):
        return
    if isinstance(cause, IrrcacheError):
        error.args = (str(cause),)
    elif str(cause) not in str(error):
        error.args = (f"{error} The cause: {type(cause).__name__}: {cause}",)
