"""Loops and conditions of Dr.Jit in Python's own words."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps

import drjit as dr

from mitsuba_irrcache.errors import IrrcacheError


def symbolic(function: Callable) -> Callable:
    """``dr.syntax``, applied when the function is called for the first time.

    Each costs some milliseconds, and most programs call a few of the many that they import.
    ``dr.syntax`` reads the function's source from its file, by line numbers: in a file that was
    changed after it was imported, these are lines of something else. So that is an error.
    """
    transformed, file = None, function.__code__.co_filename
    imported = _modification_time(file)

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        nonlocal transformed
        if transformed is None:
            if _modification_time(file) != imported:
                raise IrrcacheError(
                    f'irrcache: "{file}" was changed after it was imported; restart Python.'
                )
            transformed = dr.syntax(function)
        return transformed(*args, **kwargs)

    return call


def _modification_time(file: str) -> int | None:
    """When ``file`` was last changed [ns]; None where there is no such file."""
    try:
        return os.stat(file).st_mtime_ns
    except OSError:
        return None
