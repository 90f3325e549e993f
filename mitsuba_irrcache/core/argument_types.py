"""Converters for command-line arguments whose error messages show the value and the valid range."""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable
from typing import Any

#: Maximum number of characters of a value that an error message shows.
MAX_SHOWN_LENGTH = 60


def argument(wanted: str) -> Callable[[Callable[[str], Any]], Callable[[str], Any]]:
    """Turn a converter that raises ValueError into an argparse type.

    The error message states what is ``wanted``; argparse itself would print the function's name.
    """

    def decorate(convert: Callable[[str], Any]) -> Callable[[str], Any]:
        @functools.wraps(convert)
        def converted(text: str) -> Any:
            try:
                return convert(text)
            except ValueError:
                shown = text if len(text) <= MAX_SHOWN_LENGTH else f"{text[:MAX_SHOWN_LENGTH]}..."
                raise argparse.ArgumentTypeError(f"{shown!r} given; it must be {wanted}") from None

        return converted

    return decorate


def finite_number(text: str) -> float:
    """Convert to float; raise ValueError for infinity and NaN as well."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


finite = argument("a finite number")(finite_number)


def whole(minimum: int, maximum: int = 2**31 - 1) -> Callable[[str], int]:
    """Return an argparse type for integers from ``minimum`` to ``maximum``."""

    @argument(f"a whole number from {minimum} to {maximum}")
    def number(text: str) -> int:
        value = int(text)
        if not minimum <= value <= maximum:
            raise ValueError
        return value

    return number


@argument("a number of seconds, above 0")
def seconds(text: str) -> float:
    """Convert to a finite, positive duration in seconds."""
    value = finite_number(text)
    if not value > 0:
        raise ValueError
    return value


@argument("a share of the mean radiance such as 0.5% or 0.005, above 0 and at most 100%")
def share(text: str) -> float:
    """Convert a percentage or a fraction above 0 and at most 1."""
    number, percent, rest = text.strip().partition("%")
    value = finite_number(number) / (100 if percent else 1)
    if rest or not 0 < value <= 1:
        raise ValueError
    return value
