"""Draws what run.py left: output/fading/fading.png, and prints the verdict.

python -m experiments.paper.fading.plot [--full]
"""

from __future__ import annotations

from experiments.support.analysis import NOISE
from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.compare.tables import Table, percent

LABELS = {"unfiltered": "no filter", "fixed": "fixed strength", "fading": "fading"}


def plot(options: Options) -> Section:
    """Plot three curves, and tabulate a row for each number of samples."""
    folder = options.folder("fading")
    rows = read_json(folder / "results.json")["chest"]["rows"]
    table = verdict(rows)
    print(table.as_text(), table.note, sep="\n  ")
    path = folder / "fading.png"
    with style.figure(path, figsize=(6.2, 3.8)) as (_, axes):
        ax = axes[0, 0]
        samples = [row["samples"] for row in rows]
        for index, (key, label) in enumerate(LABELS.items()):
            ax.plot(samples, [row[key] for row in rows], label=label, **style.line(index))
        ax.set_xscale("log", base=2)
        ax.set_yscale("log")
        ax.set_xlabel("samples per cache voxel")
        ax.set_ylabel("RMSE, units of the mean radiance")
        ax.legend()
    caption = (
        "What the paper leaves undone: a filter whose strength follows the noise of the cache. It "
        "should start where the fixed filter does and end where no filter does. All three show the "
        "same cache and the same samples of the pixels; at equal time, where the filter's own cost "
        "counts too, they are in figure 2."
    )
    return Section("The fading filter", [Figure(path, caption), table])


def verdict(rows: list[dict]) -> Table:
    """Tabulate the errors of the same cache and the verdict."""
    cells = [
        [str(row["samples"]), *(percent(row[key]) for key in LABELS),
         f"{row['difference'] / row['uncertainty']:+.1f} σ", f"{row['ratio']:.2f}",
         "worse" if row["worse"] else "no worse", "yes" if row["close"] else "no"]
        for row in rows
    ]  # fmt: skip
    worse, far = sum(row["worse"] for row in rows), sum(not row["close"] for row in rows)
    note = (
        f"In {worse} of {len(rows)} rows the fading filter is worse than none beyond {NOISE:g} σ, "
        f"and in {far} more than 10 % above the better of the two others. σ: its square error less "
        "that without filter, over the standard error of this difference from the spread over "
        "blocks of the image."
    )
    head = ["samples", *LABELS.values(), "to none", "to better", "than none", "within 10 %"]
    return Table("Verdict on the fading filter", head, cells, note)


if __name__ == "__main__":
    plot(parse(__doc__))
