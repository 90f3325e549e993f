"""Errors that a user can act on: each names the thing, its value and the remedy."""

from __future__ import annotations

import re


class IrrcacheError(ValueError):
    """Input that cannot be used, with the remedy in the message."""


class UnsupportedSceneError(IrrcacheError):
    """A scene contains something that ``irrcache`` would render wrongly; the object is named."""


class CacheFileError(IrrcacheError):
    """A cache file that is damaged, foreign, or belongs to another scene."""


def origin(error: BaseException) -> BaseException:
    """The first cause: Mitsuba and Dr.Jit wrap what Python raises below them, even an interrupt."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def essence(error: BaseException) -> str:
    """What went wrong, for a reader: Mitsuba wraps what a Python plugin raises, as text or as a
    cause.
    """
    error = origin(error)
    raised = re.findall(r"^(?:\w+\.)*\w*Error: (.+)$", str(error), re.MULTILINE)
    return raised[-1] if raised else str(error).strip()


def explained(error: RuntimeError) -> None:
    """Puts the cause of an error that Dr.Jit has wrapped into its own message: ours as it is, which
    names the remedy, others behind the message.
    """
    cause = origin(error)
    if cause is error or not isinstance(cause, Exception):
        return
    if isinstance(cause, IrrcacheError):
        error.args = (str(cause),)
    elif str(cause) not in str(error):
        error.args = (f"{error} The cause: {type(cause).__name__}: {cause}",)
