"""Random command lines: each succeeds, or prints one error and writes no files.

A case is a JSON list of arguments, so that it is mutated and run like a damaged file, in a folder
of its own. Long-running work is excluded: the runs of ``compare`` and the server of ``view``.
"""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from unittest import mock
from unittest.mock import Mock

import numpy as np

from experiments.robustness.faults.fuzz import files_here, own_folder
from experiments.robustness.faults.kills import SCENE
from mitsuba_irrcache.errors import IrrcacheError

_QUICK = "irrcache{resolution=4,cache_spp=32,timeout=0.5}"
VALID = (
    ["render", "scene.xml", "-o", "out/a.exr", "--spp", "1", "-i", _QUICK],
    ["render", "scene.xml", "-o", "out/a.exr", "--spp", "1", "-i", _QUICK, "--budget", "0.2"],
    ["render", "scene.xml", "-o", "out/a.exr", "-s", "0", "--seed", "3", "-i", _QUICK],
    ["import", "phantom:cloud:32,32,32", "--density", "5", "--albedo", "0.9", "-o", "out/a"],
    ["import", "phantom:thorax:16,16,16", "--preset", "ct-chest", "--longest", "8", "-o", "out/a"],
    ["import", "a.raw", "--raw-shape", "4,4,4", "--raw-type", "uint8", "--density", "-o", "out/a"],
    ["compare", "scene.xml", "-i", _QUICK, "-i", "volpath", "--budget", "0.1", "-o", "out/report"],
    ["view", "scene.xml", "-i", _QUICK, "--port", "8080", "--no-browser"],
    ["doctor", "-m", "llvm_ad_rgb", "--json"],
    ["--help"],
)  # fmt: skip
#: Options that are inserted anywhere, with a value or without.
OPTIONS = [
    "-o", "-i", "-m", "-D", "-s", "--spp", "--seed", "--sensor", "--budget", "--error", "--density",
    "--preset", "--transfer-function", "--albedo", "--flip", "--crop", "--rescale", "--clip",
    "--isolate", "--voxel-size", "--longest", "--supersample", "--raw-shape", "--raw-type",
    "--raw-endian", "--raw-spacing", "--raw-offset", "--series", "--replace-nan", "--max-depth",
    "--up", "--reference", "--reference-spp", "--reference-seconds", "--exposure", "--import",
    "--overwrite", "--host", "--port", "--none-such", "-v", "--json",
]  # fmt: skip
#: Numbers between 10^4 and 2^32 are valid but would take too long.
WRONG = [
    "", " ", "-", "--", "-1", "0", "0.5", "1e400", "-1e400", "nan", "inf", "4294967296", "9" * 30,
    "x", "=", "a=", "=b", "a=b=c", "a=1,b=2", "{", "}", "irrcache{", "irrcache}", "irrcache{}",
    "irrcache{=}", "irrcache{a}", "irrcache{resolution=}", "irrcache{resolution=x}",
    "irrcache{none_such=1}", "none_such", "none_such{a=1}", "irrcache{solver=sweep{}}",
    "volpath{max_depth=nan}", "1,2", "1,2,3", ",,", ":", "::", "1:0", "0:1,0:1,0:1", "-5:-4", "a:b",
    "phantom:", "phantom:x", "phantom:cloud:0,0,0", "phantom:cloud:1,1,1", "phantom:cloud:x",
    "phantom:cloud:99999,99999,99999", "scene.xml", "a.raw", "none.xml", "none.nrrd", "out", ".",
    "/", "/dev/null", "/proc/self/status", "ü", "\udc80", "%s%n", "$x", "`x`", "a\nb", "x" * 5000,
    "llvm_ad_mono", "scalar_rgb", "cuda_ad_rgb", "llvm_ad_spectral", "uint64", "float32", "object",
]  # fmt: skip
#: Values of these options, unless listed, are paths to write to.
_OUTPUTS = ("-o", "--output", "--references")
#: Modules imported on request may have any effect.
_CODE = ("--import",)


class WorkBegins(Exception):  # noqa: N818
    """Raised instead of long-running work after the arguments have been accepted."""


def mutated_command(content: bytes, rng: np.random.Generator) -> bytes:
    """Return arguments of which some are wrong."""

    def one(values) -> str:
        return values[int(rng.integers(0, len(values)))]

    arguments = list(one(VALID))
    for _ in range(rng.integers(1, 4)):
        place = int(rng.integers(0, len(arguments) + 1))
        kind = rng.integers(0, 5)
        if kind == 0 and len(arguments) > 1:
            del arguments[place : place + 1]
        elif kind == 1:
            arguments[place:place] = arguments[max(place - 2, 0) : place]
        elif kind == 2:
            option = one(OPTIONS)
            value = "out/b" if option in _OUTPUTS else "json" if option in _CODE else one(WRONG)
            arguments[place:place] = [option, value]
        elif place < len(arguments) and arguments[max(place - 1, 0)] not in (*_OUTPUTS, *_CODE):
            arguments[place] = one(WRONG)
    return json.dumps(arguments).encode()


def write_valid(path: Path) -> None:
    """Write the valid case."""
    path.write_text(json.dumps(VALID[0]))


def run_case(path: Path) -> None:
    """Run the command line in this file in a folder of its own.

    Raises IrrcacheError if it ends with one message; AssertionError for any other failure.
    """
    arguments = json.loads(path.read_text())
    with own_folder():
        Path("scene.xml").write_text(SCENE)
        Path("a.raw").write_bytes(bytes(64))
        Path("out").mkdir()
        _run(arguments)


def _run(arguments: list[str]) -> None:
    from mitsuba_irrcache.cli.main import main

    there, said = files_here(), io.StringIO()
    with _without_long_work(), contextlib.redirect_stderr(said):
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                status = main(arguments)
            except SystemExit as end:  # argparse, which has printed the error
                status = end.code or 0
            except WorkBegins:
                status = 0
    message, new = said.getvalue(), files_here() - there
    about = f"{arguments}: {message[-300:]!r}"
    assert status in (0, 1, 2), f"ends with {status}: {about}"
    assert "Traceback" not in message, about
    written = {file for file in new if not file.startswith("out/")}
    assert not {f for f in written if not f.startswith("scene.")}, f"left {written}: {about}"
    if status == 0 or (status == 1 and arguments[:1] == ["doctor"]):
        return
    assert message.count("error: ") >= 1 and message.strip(), f"says nothing: {about}"
    assert not new, f"left {new}: {about}"
    raise IrrcacheError(message)


@contextlib.contextmanager
def _without_long_work():
    """Make long-running commands end where their work begins."""
    from mitsuba_irrcache.compare import command as compare
    from mitsuba_irrcache.view import command as view

    def show(args) -> None:
        view._document(args, Mock())  # no page is shown
        raise WorkBegins

    def end(*_, **__) -> None:
        raise WorkBegins

    with (
        mock.patch.object(compare, "run_job", end),
        mock.patch.object(view, "_show", show),
        mock.patch("importlib.util.find_spec", lambda name: name),
    ):
        yield
