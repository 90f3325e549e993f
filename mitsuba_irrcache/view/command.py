"""``irrcache view``: display a scene or a volume in the browser."""

from __future__ import annotations

import argparse
import gc
import signal
import threading
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi

from mitsuba_irrcache.cli.render import REPLACED, add_scene_options
from mitsuba_irrcache.core.argument_types import whole
from mitsuba_irrcache.errors import IrrcacheError, original_message
from mitsuba_irrcache.io.scene_files import integrator_of, parse_parameters
from mitsuba_irrcache.machine.extras import require
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.machine.memory import free_at_once
from mitsuba_irrcache.machine.variants import select_variant
from mitsuba_irrcache.volumes import importer
from mitsuba_irrcache.volumes.options import MissingItemError, UnchosenItemError

if TYPE_CHECKING:
    from mitsuba_irrcache.view.appearance import Appearance
    from mitsuba_irrcache.view.document import Document
    from mitsuba_irrcache.view.server import Server
    from mitsuba_irrcache.view.session import Session
    from mitsuba_irrcache.view.time_panel import TimeSteps
    from mitsuba_irrcache.volumes.colours import Colours
    from mitsuba_irrcache.volumes.data import VolumeData

#: Volumes with more voxels than this are preceded by an image of a part of their voxels.
MANY_VOXELS = 96**3
#: A number of a time step that no file has.
MOST_STEPS = 1 << 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options: those of ``render`` for a scene and of ``import`` for a volume."""
    importer.add_input(parser, "scene XML, or any volume that irrcache import reads: ")
    add_scene_options(parser)
    parser.add_argument(
        "-i", "--integrator", metavar="irrcache{KEY=VALUE,...}", help="properties of irrcache"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER",
        help="folder for saved files, created if missing (default: download)",
    )  # fmt: skip
    parser.add_argument(
        "--host", default="127.0.0.1",
        help="address to listen on; any other lets other machines in, with the token in the "
        "address that is printed (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--port",
        type=whole(1, 65535),
        default=8080,
        help="port; the next free one is used if it is taken",
    )
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    parser.add_argument("-v", "--verbose", action="store_true", help="show Mitsuba's log")
    importer.add_options(parser, required=False)


def run(args: argparse.Namespace) -> int:
    """Run the viewer until Ctrl-C."""
    require("viser", "view", "irrcache view")
    if args.mode.startswith("llvm"):
        require_llvm()
    if args.output is not None and not args.output.absolute().parent.is_dir():
        raise IrrcacheError(f'--output is "{args.output}", whose parent folder does not exist.')
    _show(args)
    return 0


def _show(args: argparse.Namespace) -> None:
    from mitsuba_irrcache.view.access import is_local
    from mitsuba_irrcache.view.server import Server

    name = Path(args.input[0]).name or args.input[0]
    server, session = Server(args.host, args.port, args.output, f"{name} - irrcache"), None
    try:
        print(f"irrcache view: {server.address} (Ctrl-C ends it)", flush=True)
        if not is_local(args.host):
            print(
                "irrcache view: whoever knows the address can connect and change what is seen; on "
                f"other machines: {server.address_from_elsewhere}",
                flush=True,
            )
        if not args.no_browser:
            webbrowser.open(server.address)
        try:
            session = _fill(server, args, name)
        except Exception as error:
            server.show_failure(original_message(error))
            raise
        _wait()
    finally:
        server.stop()
        if session is not None:
            session.stop()
        gc.unfreeze()  # so that the libraries report no leaked objects at exit


def _fill(server: Server, args: argparse.Namespace, name: str) -> Session:
    """Load the input, state progress on the page, display it, and return the running session."""
    from mitsuba_irrcache.view.session import Session

    server.show_message(f"reading {name} ...")
    select_variant(args.mode)
    mi.set_log_level(mi.LogLevel.Info if args.verbose else mi.LogLevel.Warn)
    free_at_once()
    document, appearance = _document(args, server)
    server.show_message("computing the illumination ...")
    session = Session(document)
    gc.freeze()  # collections then scan the objects created below only
    session.start()
    server.show(session, appearance, _time_steps(args))
    return session


def _time_steps(args: argparse.Namespace) -> TimeSteps | None:
    """Return the time steps of the file if there are several."""
    from mitsuba_irrcache.view.time_panel import TimeSteps

    if args.frame is None:
        return None

    def read(frame: int) -> tuple[VolumeData, Colours | None]:
        volume, _, colours = importer.read(argparse.Namespace(**vars(args) | {"frame": frame}))
        return volume, colours

    try:
        read(MOST_STEPS)
    except MissingItemError as error:
        return TimeSteps(error.count, args.frame, read) if error.count > 1 else None
    return None


def _document(args: argparse.Namespace, server: Server) -> tuple[Document, Appearance | None]:
    """Return the scene as a document and, if it is made from a volume, the volume's appearance.

    A coarse image of a volume is displayed as soon as there are values to show.
    """
    from mitsuba_irrcache.view.appearance import Appearance, coarse_appearance
    from mitsuba_irrcache.view.document import Document

    path, parameters = Path(args.input[0]), parse_parameters(args.define)
    if path.suffix.lower() == ".xml":
        if importer.has_appearance(args):
            raise IrrcacheError(
                "--preset, --transfer-function and --density are for volumes, not for scenes."
            )
        integrator = args.integrator
        if integrator is None and integrator_of(path, parameters) in REPLACED:
            integrator = "irrcache"
        return Document.load(path, parameters, integrator), None

    def document(appearance: Appearance) -> Document:
        settings = importer.scene_settings(args, "irrcache")
        if appearance.is_editable or appearance.is_emissive:  # CT, MR, flames: on a dark background
            settings = replace(settings, hide_emitters=True)
        return appearance.document(settings, parameters, args.integrator)

    small = importer.read_small(args)
    if small is not None:
        _preview(server, document, Appearance(*small))
    volume, mapping, colours = _read(args)
    described = volume, mapping, args.preset or "", colours
    if small is None and volume.values.size > MANY_VOXELS:
        _preview(server, document, coarse_appearance(*described))
    appearance = Appearance(*described)
    return document(appearance), appearance


def _read(args: argparse.Namespace) -> tuple:
    """Read the input; of several time steps the first one is meant, unless another is chosen."""
    try:
        return importer.read(args)
    except UnchosenItemError as error:
        if error.what != "frame":
            raise
    args.frame = 0
    return importer.read(args)


def _preview(
    server: Server, document: Callable[[Appearance], Document], appearance: Appearance
) -> None:
    """Display an image of a volume of few voxels, if any of them is visible."""
    from mitsuba_irrcache.view.session import Session

    with suppress(IrrcacheError):  # thin objects may lie between the voxels that were chosen
        session = Session(document(appearance))
        session.start()
        server.send_preview(session)
        session.stop()


def _wait() -> None:
    """Wait for Ctrl-C or a request to terminate."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    while not ended.wait(0.5):
        pass
