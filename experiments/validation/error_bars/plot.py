"""Draws what run.py left: output/error_bars/error_bars.png.

python -m experiments.validation.error_bars.plot [--full]
"""

from __future__ import annotations

import numpy as np

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.compare.tables import Table, percent

#: Shares within 1, 2, 3 standard errors of a normal distribution.
NORMAL = (0.683, 0.954, 0.997)


def plot(options: Options) -> Section:
    """Plot measured against predicted errors, and the coverage of the error bars."""
    folder = options.folder("error_bars")
    rows = read_json(folder / "results.json")
    path = folder / "error_bars.png"
    with style.figure(path, figsize=(4.8, 4.2)) as (_, axes):
        ax = axes[0, 0]
        limits = np.array([0.05, 30])
        ax.plot(limits, limits, "--", color=style.GREY, linewidth=0.8)
        for index, scene in enumerate(dict.fromkeys(key.split()[0] for key in rows)):
            points = [pair for key, row in rows.items() if key.split()[0] == scene
                      for pair in row["bins"]]  # fmt: skip
            predicted, measured = 100 * np.array(points).T
            ax.plot(predicted, measured, linestyle="none", label=scene, **style.line(index))
        ax.set(xscale="log", yscale="log", xlim=limits, ylim=limits)
        ax.set_xlabel("error bar, % of the mean radiance")
        ax.set_ylabel("RMS error against volpath, %")
        ax.legend()
    caption = (
        "Are the error bars true? Pixels grouped by their error bar (noise and bias together), "
        "and the errors that they have; on the dashed line they are as large as predicted."
    )
    return Section("Error bars", [Figure(path, caption), _table(rows)])


def _table(rows: dict) -> Table:
    cells = [
        [*key.split(), percent(row["noise"]), percent(row["noise_predicted"]),
         percent(row["error"]), percent(row["error_predicted"]),
         *(f"{share:.0%}" for share in row["inside"])]
        for key, row in rows.items()
    ]  # fmt: skip
    head = ["scene", "cache", "samples", "noise", "predicted", "error", "predicted"]
    note = (
        "RMS over the pixels that see the medium, in units of the mean luminance of the image; the "
        "error net of the reference's noise. Right: shares of pixels within 1, 2, 3 error bars; "
        f"of normal errors {', '.join(f'{share:.1%}' for share in NORMAL)}."
    )
    return Table("Predicted and measured errors", [*head, "1", "2", "3"], cells, note)


if __name__ == "__main__":
    plot(parse(__doc__))
