"""Properties of a plugin as they are given: each of its type and in its range, or refused by name.

`mi.Properties.get` takes what there is, and what Python makes of that is another thing: "false" is
true, and a folder a name of a file.
"""

from __future__ import annotations

import math
import os

import mitsuba as mi

from mitsuba_irrcache.errors import IrrcacheError

#: What a message shows of a value.
SHOWN = 60


class Record:
    """Properties that note what is read of them, and with which value: the list of all properties
    that a plugin has.
    """

    def __init__(self, props: mi.Properties) -> None:
        self._props = props
        #: every property that was read, by its name: as given, or its default
        self.values: dict[str, object] = {}

    def get(self, name: str, default: object) -> object:
        self.values[name] = value = self._props.get(name, default)
        return value


def described(values: dict[str, object]) -> str:
    """Properties as Mitsuba's plugins print theirs: a line each."""
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
