"""A parser of the command line that suggests the names which were probably meant."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import NoReturn

from mitsuba_irrcache.errors import suggestion

_CHOICE = re.compile(r"invalid choice: '(?P<given>[^']*)' \(choose from (?P<choices>.*)\)")


class SuggestingParser(argparse.ArgumentParser):
    """An `argparse.ArgumentParser` whose errors suggest similar options and choices.

    Commands of it are parsed by the same class.
    """

    def parse_known_args(self, args: Sequence[str] | None = None, namespace=None):
        """Parse arguments; report unknown options before required ones that they may stand for."""
        if args is not None and self._subparsers is None:
            self._check_options(args)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, with a suggestion, and exit with the status 2."""
        found = _CHOICE.search(message)
        if found:
            choices = [choice.strip("' ") for choice in found["choices"].split(",")]
            message += suggestion(found["given"], choices)
        super().error(message)

    def _check_options(self, args: Sequence[str]) -> None:
        options = list(self._option_string_actions)
        for argument in args:
            if argument == "--":  # positional arguments follow
                return
            name = argument.partition("=")[0]
            if name.startswith("--") and not any(option.startswith(name) for option in options):
                self.error(f"unrecognized argument {name}{suggestion(name, options)}")
