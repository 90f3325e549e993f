"""The command ``irrcache``: render, view, compare, import, doctor."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from mitsuba_irrcache.errors import IrrcacheError, essence, origin
from mitsuba_irrcache.machine.extras import missing_package


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status (1: an error was printed, 130:
    interrupted).
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if any("\0" in argument for argument in arguments):
        print("irrcache: error: an argument contains a null character.", file=sys.stderr)
        return 1
    try:
        args = _parser(arguments).parse_args(arguments)
        return args.run(args)
    except ModuleNotFoundError as error:
        missing = _missing_package(error, arguments)
        if missing is None:
            raise
        message = str(missing)
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


def command() -> NoReturn:
    """`main` as a process, which ends at once: all that it has goes back to the system, and to look
    for garbage in it first takes a tenth of a second.
    """
    status = main()
    with suppress(OSError):  # what cannot be written is reported by the usual end
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        os._exit(status)
    sys.exit(status)


#: Name, module, description and extra of each command; the extra has all packages that it needs.
COMMANDS = (
    ("render", "cli.render", "render a scene with irrcache", ""),
    ("view", "view.command", "look at a scene or a volume in the browser", "view"),
    ("compare", "compare.command", "measure error against time of any integrators", "compare"),
    ("import", "volumes.importer", "make a scene of a CT, MR or other volume", "volumes"),
    ("doctor", "machine.doctor", "check this machine and say what to install", ""),
)


def _missing_package(error: ModuleNotFoundError, arguments: Sequence[str]) -> Exception | None:
    """What to say where an import failed below a command; None if no package is to be installed."""
    extra = {name: extra for name, _, _, extra in COMMANDS}
    name = arguments[0] if arguments and arguments[0] in extra else ""
    return missing_package(error, f"irrcache {name}".strip(), extra.get(name, ""))


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of these arguments: it imports no command but the one they name, since what each
    needs takes a while.
    """
    parser = argparse.ArgumentParser(
        prog="irrcache", description="Irradiance caching for participating media in Mitsuba 3."
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, path, text, _ in COMMANDS:
        command = commands.add_parser(name, help=text)
        if arguments and arguments[0] == name:
            module = import_module(f"mitsuba_irrcache.{path}")
            command.description = module.__doc__
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser
