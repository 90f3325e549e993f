"""Writes table 1 from what run.py left: output/table1/table1.txt.

python -m experiments.paper.table1.plot [--full] [--document docs/validation.md]
"""

from __future__ import annotations

from experiments.support.documents import replace_tables
from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare.report import Section
from mitsuba_irrcache.compare.tables import Table, seconds


def plot(options: Options) -> Section:
    """Write two tables: the paper's criterion, and equal error."""
    folder = options.folder("table1")
    results = read_json(folder / "results.json")
    tables = [converged(results), equal_error(results)]
    text = "\n\n".join(f"{table.as_text()}\n  {table.note}" for table in tables)
    (folder / "table1.txt").write_text(text + "\n")
    print(text)
    if options.document:
        replace_tables(options.document, {"paper-table-1": tables[0]})
    return Section("Table 1: time to convergence", tables)


def converged(results: dict) -> Table:
    """Tabulate the seconds until the image equals that of the horizon, and those of the paper."""
    rows = [
        [label, _time(row), _times(row["speed_up"], row["how"]),
         f"{row['paper_seconds']:.2f} s" if row["paper_seconds"] else "—",
         _times(row["paper_speed_up"])]
        for label, row in results["converged"].items()
    ]  # fmt: skip
    voxels = results["voxels"]
    note = (
        "The paper's criterion: the RMSE of the displayed picture to the method's own after "
        f"{results['horizon']:g} s is below {results['level']:g}. It cannot see bias, and depends "
        f"on the horizon. Here {results['pixels']} pixels and {voxels['all']} cache voxels, of "
        f"which {voxels['active']} see the medium; in the paper 1048576 and 26880000, on a GPU, "
        "with a horizon of 300 s."
    )
    head = ["method", "time", "speed-up", "paper: time", "paper: speed-up"]
    return Table("Time to the method's own last image", head, rows, note)


def equal_error(results: dict) -> Table:
    """Tabulate seconds to errors against the independent reference, with speed-ups."""
    labels = list(results["converged"])
    rows = [
        [level, *(_with_speed_up(row[label]) for label in labels)]
        for level, row in results["equal_error"].items()
    ]
    note = (
        "Against an independent reference, net of its noise, so that bias counts; in brackets how "
        "many times sooner than path tracing. “≤”: the first image was better already; “≈”: "
        "extrapolated as noise; a dash: not reached, or nothing can be said."
    )
    return Table("Time to equal error of the displayed picture", ["RMSE", *labels], rows, note)


def _with_speed_up(row: dict) -> str:
    return _time(row) + (f" ({_times(row['speed_up'], row['how'])})" if row["speed_up"] else "")


def _time(row: dict) -> str:
    sign = {"at most": "≤ ", "extrapolated": "≈ "}.get(row["how"], "")
    return f"{sign}{seconds(row['seconds'])} s" if "seconds" in row else "—"


def _times(ratio: float | None, how: str = "") -> str:
    at_least = "≥ " if how == "at most" else ""
    return "—" if ratio is None else f"{at_least}{ratio:.3g} ×"


if __name__ == "__main__":
    plot(parse(__doc__, documented=True))
