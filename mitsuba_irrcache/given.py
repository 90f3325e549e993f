"""Properties of a plugin as they are given: each of its type and in its range, or refused by name.

`mi.Properties.get` takes what there is, and what Python makes of that is another thing: "false" is
true, and a folder a name of a file.
"""

from __future__ import annotations

import math
import os

import mitsuba as mi

from .errors import IrrcacheError

#: What a message shows of a value.
SHOWN = 60


def integer(props: mi.Properties, name: str, default: int, least: int, wanted: str) -> int:
    """A number of at least ``least``, below 2^31."""
    return checked_integer(name, props.get(name, default), least, wanted)


def checked_integer(name: str, value: object, least: int, wanted: str) -> int:
    """``value``, if it is one."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 2**31:
        raise _refusal(name, value, wanted)
    return value


def number(
    props: mi.Properties, name: str, default: float, least: float, most: float, wanted: str
) -> float:
    """A number between ``least`` and ``most``, in single precision too."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _refusal(name, value, wanted)
    if not (math.isfinite(value) and least <= value <= most):
        raise _refusal(name, value, wanted)
    return float(value)


def choice(props: mi.Properties, name: str, default: str, choices: tuple[str, ...]) -> str:
    """One of ``choices``."""
    value = props.get(name, default)
    if not isinstance(value, str) or value not in choices:
        raise _refusal(name, value, f"one of: {', '.join(choices)}")
    return value


def flag(props: mi.Properties, name: str, default: bool) -> bool:
    """True or false."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise _refusal(name, value, "true or false (a boolean)")
    return value


def text(props: mi.Properties, name: str) -> str:
    """A string; "" if there is none."""
    value = props.get(name, "")
    if not isinstance(value, str):
        raise _refusal(name, value, "a string")
    return value


def file_name(props: mi.Properties, name: str) -> str:
    """What can be the name of a file; "" if there is none."""
    value = text(props, name)
    if "\0" in value or os.path.isdir(value):
        raise _refusal(name, value, "the name of a file, not of a folder")
    return value


def _refusal(name: str, value: object, wanted: str) -> IrrcacheError:
    shown = " ".join(repr(value).split())
    shown = shown if len(shown) <= SHOWN else f"{shown[:SHOWN]}..."
    return IrrcacheError(f"irrcache: {name} is {shown}; it must be {wanted}.")
