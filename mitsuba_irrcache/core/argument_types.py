"""Types of command-line arguments: a value that is refused is shown with what it must be."""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable
from typing import Any

#: What a message shows of a value.
SHOWN = 60


def argument(wanted: str) -> Callable[[Callable[[str], Any]], Callable[[str], Any]]:
    """Makes a converter of text, which raises ValueError, a type for argparse: its message says
    what is ``wanted``. That of argparse itself would show the name of the function.
    """

    def decorate(convert: Callable[[str], Any]) -> Callable[[str], Any]:
        @functools.wraps(convert)
        def converted(text: str) -> Any:
            try:
                return convert(text)
            except ValueError:
                shown = text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
                raise argparse.ArgumentTypeError(f"{shown!r} given; it must be {wanted}") from None

        return converted

    return decorate


def finite_number(text: str) -> float:
    """A number; raises ValueError for infinity and NaN, too."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


finite = argument("a finite number")(finite_number)


def whole(least: int, most: int = 2**31 - 1) -> Callable[[str], int]:
    """The type of a whole number between ``least`` and ``most``."""

    @argument(f"a whole number from {least} to {most}")
    def number(text: str) -> int:
        value = int(text)
        if not least <= value <= most:
            raise ValueError
        return value

    return number


@argument("a number of seconds, above 0")
def seconds(text: str) -> float:
    """A finite duration."""
    value = finite_number(text)
    if not value > 0:
        raise ValueError
    return value
