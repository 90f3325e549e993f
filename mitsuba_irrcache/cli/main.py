"""The command ``irrcache``: render, view, compare, farm, fit, import, doctor."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from mitsuba_irrcache import __version__
from mitsuba_irrcache.cli.parser import SuggestingParser
from mitsuba_irrcache.errors import IrrcacheError, origin, original_message
from mitsuba_irrcache.machine.extras import missing_package


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    The status is 1 if an error was printed, and 130 after an interrupt.
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
    except IrrcacheError as error:
        message = str(error)
    except (KeyboardInterrupt, RuntimeError, OSError) as error:
        # Mitsuba reports interrupts as errors.
        if isinstance(origin(error), KeyboardInterrupt):
            what_is_left = f"; {origin(error)}" if str(origin(error)) else ""
            print(f"irrcache: interrupted{what_is_left}", file=sys.stderr)
            return 130
        message = original_message(error)
    print(f"irrcache: error: {message.removeprefix('irrcache: ')}", file=sys.stderr)
    return 1


def command() -> NoReturn:
    """Run `main` as a process that ends at once.

    Python's finalisation is skipped: searching for garbage takes a tenth of a second, and the
    operating system frees all memory anyway.
    """
    status = main()
    with suppress(OSError):  # errors while flushing are reported by Python's regular finalisation
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        os._exit(status)
    sys.exit(status)


#: Name, module, description and extra of each command; the extra installs all packages it needs.
COMMANDS = (
    ("render", "cli.render", "render a scene with irrcache", ""),
    ("view", "view.command", "display a scene or a volume in the browser", "view"),
    ("compare", "compare.command", "compare integrators: error against time", "compare"),
    ("farm", "farm.command", "render on many machines, or processes of this one", "farm"),
    ("fit", "cli.fit", "fit a volume to images of it", "volumes"),
    ("import", "volumes.importer", "convert a CT, MR or other volume to a scene", "volumes"),
    ("doctor", "machine.doctor", "check this machine and say what to install", ""),
)


def _missing_package(error: ModuleNotFoundError, arguments: Sequence[str]) -> Exception | None:
    """Return a message about a missing package, or None if no extra provides it."""
    extra = {name: extra for name, _, _, extra in COMMANDS}
    name = arguments[0] if arguments and arguments[0] in extra else ""
    return missing_package(error, f"irrcache {name}".strip(), extra.get(name, ""))


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of these arguments.

    Only the command that they name is imported, since each takes time to import.
    """
    parser = SuggestingParser(
        prog="irrcache", description="Irradiance caching for participating media in Mitsuba 3."
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, path, text, _ in COMMANDS:
        command = commands.add_parser(name, help=text)
        if arguments and arguments[0] == name:
            module = import_module(f"mitsuba_irrcache.{path}")
            command.description = (module.__doc__ or "").replace("``", '"')
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser
