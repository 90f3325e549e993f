"""Draws what run.py left: output/others/others.png, and prints the table.

python -m experiments.validation.others.plot
"""

from __future__ import annotations

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.compare.tables import Table, percent

INTEGRATORS = ("irrcache", "volpath")


def plot(options: Options) -> Section:
    """Plot mean errors against third-party references, with their standard errors."""
    folder = options.folder("others")
    rows = read_json(folder / "results.json")
    table = tabulated(rows)
    print(table.as_text(), table.note, sep="\n  ")
    shown = [name for name, row in rows.items() if "refused" not in row]
    path = folder / "others.png"
    with style.figure(path, figsize=(6.2, 3.4)) as (_, axes):
        ax = axes[0, 0]
        for index, integrator in enumerate(INTEGRATORS):
            found = [rows[name][integrator] for name in shown]
            ax.errorbar(
                [100 * row["mean_error"] for row in found],
                [place + 0.15 * index for place in range(len(shown))],
                xerr=[100 * row["uncertainty"] for row in found],
                label=integrator,
                **style.line(index) | {"linestyle": "none"},
            )
        ax.axvline(0, color=style.GREY, linewidth=0.8)
        ax.set_yticks(range(len(shown)), shown)
        ax.invert_yaxis()
        ax.set_xlabel("mean error against the reference, %")
        ax.legend()
    caption = (
        "Scenes and references by others: of Mitsuba's test suite (the first five), and lajolla's. "
        "The bars are standard errors from the spread over blocks of the image."
    )
    return Section("Scenes of others", [Figure(path, caption), table])


def tabulated(rows: dict) -> Table:
    """Tabulate all rows; for refused scenes the note holds the reason."""
    cells, refused = [], []
    for name, row in rows.items():
        if "refused" in row:
            refused.append(f"{name} is refused: {row['refused']}")
            continue
        for integrator in INTEGRATORS:
            found = row[integrator]
            tested = [f"{found['z']:.2f}", percent(found["passed"])] if "z" in found else ["", ""]
            cells.append(
                [name, integrator, "no" if row["unbiased"] else "", f"{found['mean_error']:+.2%}",
                 percent(found["uncertainty"]), percent(found["rmse"]), percent(found["blocks"]),
                 *tested]
            )  # fmt: skip
    note = (
        "In units of the reference's mean; blocks of 8 x 8 pixels. The references' noise is in all "
        "of the errors, so volpath's, with as many samples, show what can be told. z: root mean "
        "square of the deviations over their standard errors by the suite's variances, at 64 "
        "samples; passed: in Mitsuba's own Z-test, which wants 99.75 %. " + " ".join(refused)
    )
    head = ["scene", "integrator", "cache", "mean error", "±", "RMSE", "blocks", "z", "passed"]
    return Table("Against the references of others", head, cells, note)


if __name__ == "__main__":
    plot(parse(__doc__))
