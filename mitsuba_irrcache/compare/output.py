"""Output of the measurements as JSON, CSV, figures, images and a report."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.io.images import write_image

from . import pictures, plots
from .embedded import images
from .metrics import colours
from .reference import Reference
from .report import Figure, Section, findings, write_report
from .results import Measurement, write_json
from .scores import reference_noise, score_all
from .summary import curves
from .tables import (
    Table,
    equal_error_table,
    equal_time_table,
    estimates_table,
    metrics_table,
    stages_table,
)


@dataclass
class Comparison:
    """All measurements on one scene."""

    title: str
    budgets: list[float]
    measurements: list[Measurement]
    reference: Reference
    facts: dict[str, str]
    depths: dict[str, int]
    exposure: float = 0.0


def write_output(comparison: Comparison, folder: Path) -> list[Table]:
    """Write results.json, results.csv, report.html, figures/ and images/ to ``folder``.

    Returns the tables for the terminal.
    """
    rows = score_all(comparison.measurements, comparison.reference, folder, comparison.exposure)
    write_json(folder / "results.json", _record(comparison, rows))
    _write_csv(folder / "results.csv", rows)
    truth = comparison.reference
    write_image(folder / "images" / "reference.exr", colours(truth.mean), {"spp": 2 * truth.spp})
    drawn = curves(rows)
    tables = [
        equal_time_table(drawn, comparison.budgets),
        equal_error_table(drawn),
        stages_table(comparison.measurements),
        *estimates_table(rows),
    ]
    sections = _sections(comparison, rows, tables, folder) if rows else []
    write_report(
        folder / "report.html",
        comparison.title,
        findings(drawn, comparison.budgets, rows, comparison.depths),
        sections,
        [m for m in comparison.measurements if m.error],
        comparison.facts,
    )
    return tables if rows else tables[2:]


def _sections(
    comparison: Comparison, rows: list[dict], tables: list[Table], folder: Path
) -> list[Section]:
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    curve, bars, multiples = (figures / f"{name}.svg" for name in ("error", "stages", "metrics"))
    measured, truth = comparison.measurements, comparison.reference
    # Strips for papers and talks; the page shows the same images interactively.
    pictures.strip(figures / "strip.png", measured, truth, folder, comparison.exposure)
    pictures.differences(figures / "differences.png", measured, truth, folder)
    pictures.differences(figures / "blocks.png", measured, truth, folder, block=8)
    equal_time, equal_error, stages, *estimates = tables
    error = Figure(
        curve,
        "Error against time. Hollow: below the resolution of the reference.",
        plots.error_over_time(curve, curves(rows), reference_noise(truth)),
    )
    first = Figure(
        bars, "Seconds to a first image, by stage.", plots.stages(bars, comparison.measurements)
    )
    others = Figure(
        multiples,
        "Other measures of error against seconds.",
        plots.small_multiples(multiples, rows),
    )
    shown = images(measured, rows, truth, folder, comparison.exposure)
    return [
        Section("Error against time", [error]),
        Section("Images and their errors", [shown]),
        Section("Error after equal time", [equal_time]),
        Section("Time to equal error", [equal_error]),
        *(Section(table.title, [table]) for table in estimates),
        Section("Time by stage", [first, stages]),
        Section("All errors", [others, metrics_table(rows)]),
    ]


def _record(comparison: Comparison, rows: list[dict]) -> dict:
    errors = {(row["integrator"], row["budget"]): row for row in rows}
    measurements = []
    for measurement in comparison.measurements:
        record = asdict(measurement)
        for snapshot in record["snapshots"]:
            row = errors[measurement.integrator, snapshot["budget"]]
            snapshot["errors"] = {k: _plain(v) for k, v in row.items() if k not in _OWN_COLUMNS}
        measurements.append(record)
    reference = comparison.reference
    return {
        "title": comparison.title,
        "facts": comparison.facts,
        "budgets": comparison.budgets,
        "reference": {
            "spp": 2 * reference.spp,
            "seconds": reference.seconds,
            "mean_radiance": float(colours(reference.mean).mean()),
            "noise": reference_noise(reference),
        },
        "measurements": measurements,
    }


#: Columns of a row that describe the measurement; the others are errors.
_OWN_COLUMNS = ("integrator", "budget", "spp", "note", "estimate", "image")


def _plain(value: object) -> object:
    """Replace NaN and infinity, which JSON does not have, by None."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _write_csv(path: Path, rows: list[dict]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())
