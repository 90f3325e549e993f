"""Validated access to plugin properties: each must have its type and lie in its range.

`mi.Properties.get` accepts any type, and implicit conversions would hide mistakes: the string
"false" is true in Python, and the name of a folder is a valid string for a file name.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable

import mitsuba as mi

from mitsuba_irrcache.errors import IrrcacheError, suggestion

#: Maximum number of characters of a value that an error message shows.
MAX_SHOWN_LENGTH = 60


class RecordedProperties:
    """Wrapper of ``mi.Properties`` that records each property read and its value or default."""

    def __init__(self, props: mi.Properties) -> None:
        self.wrapped = props
        #: value, or default, of every property read so far, by name
        self.values: dict[str, object] = {}

    def get(self, name: str, default: object) -> object:
        self.values[name] = value = self.wrapped.get(name, default)
        return value


def described(values: dict[str, object]) -> str:
    """Format properties in the style of Mitsuba's plugins, one per line."""
    lines = [f"{name} = {_shown(value)}" for name, value in values.items()]
    return ",\n".join(f"  {line}".replace("\n", "\n  ") for line in lines)


def _shown(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.9g}"
    return f'"{value}"' if value == "" else str(value)


def integer(props: mi.Properties, name: str, default: int, minimum: int, wanted: str) -> int:
    """Read an integer from ``minimum`` to 2^31 - 1."""
    return checked_integer(name, props.get(name, default), minimum, wanted)


def checked_integer(name: str, value: object, minimum: int, wanted: str) -> int:
    """Return ``value`` if it is an integer from ``minimum`` to 2^31 - 1."""
    if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value < 2**31:
        raise _refusal(name, value, wanted)
    return value


def number(
    props: mi.Properties, name: str, default: float, minimum: float, maximum: float, wanted: str
) -> float:
    """Read a finite number from ``minimum`` to ``maximum``."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _refusal(name, value, wanted)
    if not (math.isfinite(value) and minimum <= value <= maximum):
        raise _refusal(name, value, wanted)
    return float(value)


def choice(props: mi.Properties, name: str, default: str, choices: tuple[str, ...]) -> str:
    """Read a string that must be one of ``choices``."""
    value = props.get(name, default)
    if not isinstance(value, str) or value not in choices:
        wanted = f"one of: {', '.join(choices)}"
        raise _refusal(name, value, wanted, suggestion(str(value), choices))
    return value


def flag(props: mi.Properties, name: str, default: bool) -> bool:
    """Read a boolean."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise _refusal(name, value, "true or false (a boolean)")
    return value


def text(props: mi.Properties, name: str) -> str:
    """Read a string; the default is ""."""
    value = props.get(name, "")
    if not isinstance(value, str):
        raise _refusal(name, value, "a string")
    return value


def file_name(props: mi.Properties, name: str) -> str:
    """Read the name of a file, which must not be a folder; the default is ""."""
    value = text(props, name)
    if "\0" in value or os.path.isdir(value):
        raise _refusal(name, value, "the name of a file, not of a folder")
    return value


def refuse_misspelt(props: mi.Properties, known: Iterable[str]) -> None:
    """Raise IrrcacheError for a property that is similar to a known one, but was never read.

    Mitsuba refuses others after the constructor, as unreferenced; derived classes may read them.
    """
    for name in props.unqueried():
        meant = suggestion(name, known)
        if meant:
            raise IrrcacheError(f'irrcache: there is no property "{name}"{meant}.')


def _refusal(name: str, value: object, wanted: str, meant: str = "") -> IrrcacheError:
    shown = " ".join(repr(value).split())
    shown = shown if len(shown) <= MAX_SHOWN_LENGTH else f"{shown[:MAX_SHOWN_LENGTH]}..."
    return IrrcacheError(f"irrcache: {name} is {shown}; it must be {wanted}{meant}.")
