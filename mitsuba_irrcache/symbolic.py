"""Loops and conditions of Dr.Jit in Python's own words."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import drjit as dr


def symbolic(function: Callable) -> Callable:
    """``dr.syntax``, applied when the function is called for the first time.

    Each costs some milliseconds, and most programs call a few of the many that they import.
    """
    transformed = None

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        nonlocal transformed
        if transformed is None:
            transformed = dr.syntax(function)
        return transformed(*args, **kwargs)

    return call
