"""The tables of a comparison as text in cells, for both the terminal and the report."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .results import Measurement
from .scores import METRICS
from .summary import Curve, Reached, equal_error, equal_time, nearest, targets

STAGES = ("import", "load", "kernels", "cache", "image", "filter")


@dataclass
class Table:
    """Cells of text under a heading; ``best`` holds the (row, column) of the cells to emphasise."""

    title: str
    head: list[str]
    rows: list[list[str]]
    note: str = ""
    best: set[tuple[int, int]] = field(default_factory=set)

    def as_text(self) -> str:
        """Format columns aligned with spaces; the best cells have a star."""
        cells = [self.head] + [
            [f"{cell} *" if (r, c) in self.best else cell for c, cell in enumerate(row)]
            for r, row in enumerate(self.rows)
        ]
        widths = [max(len(row[c]) for row in cells) for c in range(len(self.head))]
        lines = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
            for row in cells
        ]
        return "\n".join([self.title, *("  " + line for line in lines)])


def equal_time_table(curves: list[Curve], budgets: list[float]) -> Table:
    """Return the table of the RMSE after each budget."""
    rows, best = [], set()
    for r, (budget, errors) in enumerate(
        zip(sorted(budgets), equal_time(curves, budgets), strict=True)
    ):
        cells = [_at(c, e, budget) for c, e in zip(curves, errors, strict=True)]
        rows.append([f"{budget:g} s", *cells])
        known = [e for e in errors if e is not None]
        best |= {(r, c + 1) for c, e in enumerate(errors) if len(known) > 1 and e == min(known)}
    note = (
        "RMSE in units of the mean radiance of the reference, whose own noise is removed. "
        "Interpolated between snapshots. In brackets: the time of the nearest image, if there is "
        "none at this time; such values are no candidates for the best one. A dash: no image at "
        "all. Kernels are compiled beforehand."
    )
    return Table("Error after equal time", ["budget", *_names(curves)], rows, note, best)


def equal_error_table(curves: list[Curve]) -> Table:
    """Return the table of the times to round errors."""
    goals, best, rows = targets(curves), set(), []
    for r, (goal, reached) in enumerate(zip(goals, equal_error(curves, goals), strict=True)):
        rows.append([percent(goal), *map(_reached, reached)])
        least = min(reached, key=lambda x: x.seconds).seconds
        known = sum(np.isfinite(x.seconds) for x in reached)
        best |= {(r, c + 1) for c, x in enumerate(reached) if known > 1 and x.seconds == least}
    note = (
        "Interpolated between snapshots. “≤”: the first snapshot was better already. “≈”: beyond "
        "the measurement, extrapolated as noise (variance over time). A dash: not reached, and the "
        "error does not fall like noise, so nothing can be said."
    )
    return Table("Time to equal error", ["RMSE", *_names(curves)], rows, note, best)


def estimates_table(rows: list[dict]) -> list[Table]:
    """Return the table of the errors that integrators estimate themselves, beside the true ones;
    nothing if none does.
    """
    cells = [
        [
            row["integrator"], f"{seconds(row['seconds'])} s", percent(row["estimate"]),
            _metric(row, "rmse"),
        ]
        for row in rows
        if row["estimate"] is not None
    ]  # fmt: skip
    head = ["integrator", "time", "estimated RMSE", "true RMSE"]
    note = (
        "Images with a stated error (property tolerance of irrcache): the RMSE that the integrator "
        "estimates, and the measured one, whose reference's noise is removed."
    )
    return [Table("Estimated and true error", head, cells, note)] if cells else []


def stages_table(measurements: list[Measurement]) -> Table:
    """Return the table of memory and of the seconds by stage to a first image."""
    rows = []
    for m in measurements:
        for label, stages in (("cold", m.cold), ("warm kernels", m.warm), ("next view", m.again)):
            if stages:
                total = sum(stages.get(s, 0.0) for s in STAGES)
                cells = [seconds(stages[s]) if s in stages else "—" for s in STAGES]
                memory = (
                    f"{m.memory['peak'] / 2**20:.0f} MiB" if label == "cold" and m.memory else ""
                )
                rows.append([m.integrator, label, *cells, seconds(total), memory])
    note = (
        "Seconds to a first, noisy image (a few samples per pixel; the smallest cache where there "
        "is one). Cold: new process, no compiled kernel on disk. Warm kernels: new process that "
        "finds them. Next view: same process, next sensor, or another seed where there is "
        "only one. “Kernels” is what the first image takes longer than the second: tracing, code "
        "generation and compilation. Memory: peak of the whole run, of the process on the CPU side."
    )
    head = ["integrator", "start", *STAGES, "total", "peak memory"]
    return Table("Time by stage", head, rows, note)


def metrics_table(rows: list[dict]) -> Table:
    """Return the table of all errors of all snapshots."""
    cells = []
    for row in rows:
        values = [_metric(row, name) for name in METRICS]
        spent = [row["integrator"], f"{row['seconds']:.3g} s", _spent(row), str(row["spp"])]
        cells.append(spent + values)
    head = ["integrator", "time", "stages", "spp", *(label for label, _, _ in METRICS.values())]
    note = "; ".join(f"{label}: {meaning}" for label, _, meaning in METRICS.values())
    unit = "%: of the mean radiance of the reference. "
    missing = (
        "" if all(r["flip"] is not None for r in rows)
        else " FLIP is not installed: pip install flip-evaluator."
    )  # fmt: skip
    return Table("All errors", head, cells, f"{unit}{note}.{missing}")


def percent(value: float) -> str:
    """Format in percent with three digits."""
    return f"{100 * value:.3g} %"


def with_uncertainty(value: float, uncertainty: float) -> str:
    """Format in percent up to the first uncertain digit."""
    digits = int(np.clip(-np.floor(np.log10(max(100 * uncertainty, 1e-9))), 0, 6))
    return f"{100 * value:+.{digits}f} ± {100 * uncertainty:.{digits}f} %"


def seconds(value: float) -> str:
    """Format in seconds with at most three digits."""
    return f"{value:.0f}" if value >= 99.95 else f"{value:.3g}" if value >= 0.1 else f"{value:.2f}"


def _names(curves: list[Curve]) -> list[str]:
    return [curve.integrator for curve in curves]


def _at(curve: Curve, error: float | None, budget: float) -> str:
    """Format the error after a budget, or that of the nearest image with its actual time."""
    if error is not None:
        return percent(error)
    found = nearest(curve, budget)
    return "—" if found is None else f"{percent(found[0])} ({seconds(found[1])} s)"


def _reached(reached: Reached) -> str:
    if reached.how == "never":
        return "—"
    sign = {"at most": "≤ ", "extrapolated": "≈ "}.get(reached.how, "")
    return f"{sign}{seconds(reached.seconds)} s"


def _spent(row: dict) -> str:
    """Describe the stages of a snapshot if there are several, and how the budget was spent."""
    stages = {k.removeprefix("seconds_"): v for k, v in row.items() if k.startswith("seconds_")}
    parts = [f"{stage} {seconds(value)}" for stage, value in stages.items()]
    return ", ".join((parts if len(parts) > 1 else []) + [row["note"]] * bool(row["note"]))


def _metric(row: dict, name: str) -> str:
    value, unit = row[name], METRICS[name][1]
    if value is None:
        return "not installed"
    if not np.isfinite(value):
        return "—"
    if name == "rmse" and value < row["rmse_resolved"]:
        return f"< {percent(row['rmse_resolved'])}"
    if name == "bias":
        return with_uncertainty(value, row["bias_uncertainty"])
    return percent(value) if unit == "%" else f"{value:.3g}{unit}"
