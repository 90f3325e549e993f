"""Many frames of one scene file: values of its parameters, and sensors, to images."""

from __future__ import annotations

import argparse
import csv
import glob
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsuba_irrcache.cli.render import chosen_integrator
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.jobs import Environment, Job, caches_of, scene_arguments
from mitsuba_irrcache.farm.results import Results
from mitsuba_irrcache.io.scene_files import load_scene, sensor_count

#: Largest number of frames of one run; more are most likely a mistake, such as 0:1:1e9.
MOST_FRAMES = 1_000_000


def rows_of(variations: list[str], table: Path | None, folder: Path) -> list[dict[str, str]]:
    """Return the values of the varying parameters of each frame; one row without any if nothing
    varies.

    ``variations`` are texts KEY=VALUES, where VALUES are first:last:count, a list a,b,c, or a
    pattern of file names in the ``folder`` of the scene; all have to have the same length.
    ``table`` is a CSV file with one column per parameter and one row per frame.
    """
    columns = {} if table is None else _columns(table)
    for text in variations:
        key, equals, values = text.partition("=")
        if not equals or not key or not values:
            raise IrrcacheError(f'cannot read --vary "{text}"; write KEY=0:1:24 or KEY=a,b,c.')
        if key in columns:
            raise IrrcacheError(f"--vary {key} is given twice, or is a column of the table, too.")
        columns[key] = _values(text, values, folder)
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        counts = ", ".join(f"{key} has {len(values)}" for key, values in columns.items())
        raise IrrcacheError(f"parameters vary together, frame by frame, but {counts} values.")
    count = lengths.pop() if lengths else 1
    return [{key: values[i] for key, values in columns.items()} for i in range(count)]


def _values(text: str, values: str, folder: Path) -> list[str]:
    parts = values.split(":")
    if len(parts) == 3:
        try:
            first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
        except ValueError:
            count = 0
        if not 1 <= count <= MOST_FRAMES or not (math.isfinite(first) and math.isfinite(last)):
            raise IrrcacheError(
                f'cannot read --vary "{text}"; first:last:count are two finite numbers and a whole '
                f"one from 1 to {MOST_FRAMES}."
            )
        return [f"{value:.9g}" for value in np.linspace(first, last, count)]
    if any(character in values for character in "*?["):
        found = sorted(glob.glob(values, root_dir=folder))
        if not found:
            raise IrrcacheError(f'--vary "{text}": no file in "{folder}" has such a name.')
        return found
    found = [value.strip() for value in values.split(",")]
    if "" in found:
        raise IrrcacheError(
            f'--vary "{text}" has no value for frame {found.index("")}, counted from 0; write one '
            "between each two commas."
        )
    _check_finite(found, f'--vary "{text}"')
    return found


def _check_finite(values: list[str], place: str) -> None:
    """Raise IrrcacheError if one of the values is an infinity or not a number, as programs write
    them where a computation has failed.
    """
    for value in values:
        try:
            is_finite = math.isfinite(float(value))
        except ValueError:  # a name
            continue
        if not is_finite:
            raise IrrcacheError(f'{place} has the value "{value}"; numbers have to be finite.')


def _columns(table: Path) -> dict[str, list[str]]:
    try:
        # Spreadsheets write a mark of the encoding before the first name.
        with open(table, newline="", encoding="utf-8-sig") as file:
            lines = [[cell.strip() for cell in row] for row in csv.reader(file) if row]
        head, *rows = lines
    except UnicodeDecodeError:
        raise IrrcacheError(f'cannot read the table "{table}": save it as UTF-8.') from None
    except (OSError, ValueError, csv.Error) as error:
        why = getattr(error, "strerror", None) or "a first row with names is needed"
        raise IrrcacheError(f'cannot read the table "{table}": {why}.') from error
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if len(head) == 1 and separator in head[0]:
            raise IrrcacheError(
                f'"{table}" has one column "{head[0]}"; its values seem to be separated by '
                f"{called}: save it with commas between them."
            )
    for name in head:
        if not name or head.count(name) > 1:
            found = (
                f'{head.count(name)} columns called "{name}"' if name else "a column without name"
            )
            raise IrrcacheError(
                f'"{table}" has {found}; the first row has to name each column once.'
            )
    for number, row in enumerate(rows, 2):
        if len(row) != len(head):
            raise IrrcacheError(
                f'row {number} of "{table}" has {len(row)} values, but the first row names '
                f"{len(head)}."
            )
        if "" in row:
            raise IrrcacheError(
                f'row {number} of "{table}" has no value for "{head[row.index("")]}"; each row '
                "needs a value in every column."
            )
        _check_finite(row, f'row {number} of "{table}"')
    if not rows:
        raise IrrcacheError(f'"{table}" has no rows of values below the names.')
    return {name: [row[i] for row in rows] for i, name in enumerate(head)}


def sensors_of(text: str, available: int) -> list[int]:
    """Return the indices of sensors in a list such as ``0,2``, or of ``all``."""
    if text == "all":
        return list(range(available))
    try:
        chosen = [int(part) for part in text.split(",")]
    except ValueError:
        chosen = [-1]
    repeated = sorted({index for index in chosen if chosen.count(index) > 1})
    if repeated:
        raise IrrcacheError(
            f'--sensors is "{text}", which names {", ".join(map(str, repeated))} more than once; '
            "write each index once."
        )
    if any(not 0 <= index < available for index in chosen):
        raise IrrcacheError(
            f'--sensors is "{text}", but the scene has {available} sensor(s), counted from 0; '
            'write a list such as 0,2, or "all".'
        )
    return chosen


def frame_jobs(
    args: argparse.Namespace,
    scene: Path,
    parameters: dict[str, str],
    integrator: str | None,
    environment: Environment,
) -> Iterator[Job]:
    """Yield a job for each frame and sensor, of the parsed arguments of ``irrcache farm frames``.

    The scene of the first frame is loaded here, so that errors in it are found at once.
    """
    rows = rows_of(args.vary, args.table, scene.parent)
    for name in sorted(parameters.keys() & rows[0].keys()):
        raise IrrcacheError(
            f'the parameter "{name}" has the value "{parameters[name]}" by -D, but also one for '
            "each frame (--vary or the table); remove one of them."
        )
    chosen = chosen_integrator(scene, parameters | rows[0], integrator)
    loaded = load_scene(scene, parameters | rows[0], chosen)
    sensors = sensors_of(args.sensors, sensor_count(loaded))
    digits = max(4, len(str(len(rows) - 1)))
    for number, row in enumerate(rows):
        chosen = chosen_integrator(scene, parameters | row, integrator)
        arguments = scene_arguments(scene, parameters | row, chosen)
        for sensor in sensors:
            name = f"frame-{number:0{digits}d}"
            name += f"-sensor-{sensor}" if len(sensors) > 1 else ""
            own = {
                "scene": arguments,
                "sensor": sensor,
                "seed": args.seed,
                "spp": args.spp,
                "file": f"{name}.exr",
            }
            yield Job(name, "frame", own, environment)


def begin_frames(jobs: list[Job], results: Results) -> list[Job]:
    """Return the jobs of the frames that have to be rendered, and remove what an earlier run has
    left of these: where one fails, no image of other inputs stays beside the others.

    A frame is finished if its inputs are the same, and each cache file that it names is missing, or
    is as it was after the frame had been rendered.
    """
    missing = [job for job in jobs if not (results.has(job) and _has_same_caches(job, results))]
    for job in missing:
        results.remove(job)
        image = results.folder / job.arguments["file"]
        for file in (image, image.with_suffix(".png")):  # the record may be damaged
            file.unlink(missing_ok=True)
    return missing


def _has_same_caches(job: Job, results: Results) -> bool:
    then, now = results.digests(job), caches_of(job.arguments["scene"])
    return all(then.get(name) == digest for name, digest in now.items())
