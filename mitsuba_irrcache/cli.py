"""The command ``irrcache``: render, compare, import, doctor."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from .errors import IrrcacheError, essence, origin


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status (1: an error was printed, 130:
    interrupted).
    """
    args = _parser().parse_args(arguments)
    try:
        return args.run(args)
    except (IrrcacheError, OSError) as error:
        message = str(error)
    except (KeyboardInterrupt, RuntimeError) as error:  # the latter is how Mitsuba reports both
        if isinstance(origin(error), KeyboardInterrupt):
            what_is_left = f"; {origin(error)}" if str(origin(error)) else ""
            print(f"irrcache: interrupted{what_is_left}", file=sys.stderr)
            return 130
        message = essence(error)
    print(f"irrcache: error: {message.removeprefix('irrcache: ')}", file=sys.stderr)
    return 1


def _parser() -> argparse.ArgumentParser:
    from . import doctor, render
    from .compare import command as compare
    from .volumes import importer

    parser = argparse.ArgumentParser(
        prog="irrcache", description="Irradiance caching for participating media in Mitsuba 3."
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, module, text in (
        ("render", render, "render a scene with irrcache"),
        ("compare", compare, "measure error against time of any integrators"),
        ("import", importer, "make a scene of a CT, MR or other volume"),
        ("doctor", doctor, "check this machine and say what to install"),
    ):
        command = commands.add_parser(name, help=text, description=module.__doc__)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser
