"""Draws figure 4 from what run.py left: output/figure4/figure4.png.

python -m experiments.paper.figure4.plot [--full]
"""

from __future__ import annotations

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from experiments.support.tiles import error_title, read, tiles
from mitsuba_irrcache.compare.report import Figure, Section


def plot(options: Options) -> Section:
    """Draw a row for each volume and a column for each method, with the reference at the end."""
    folder = options.folder("figure4")
    results = read_json(folder / "results.json")
    rows = results["rows"]
    images = [[*map(read, row["methods"]), read({"image": row["reference"]})] for row in rows]
    titles = [[*map(error_title, row["methods"]), "reference"] for row in rows]
    path = folder / "figure4.png"
    tiles(path, images, [row["volume"] for row in rows], titles, width=2.3)
    caption = (
        f"The paper's figure 4: three volumes after {results['seconds']:g} s "
        f"({'; '.join(row['about'] for row in rows)}), with the RMSE of the displayed picture."
    )
    return Section("Figure 4: other volumes", [Figure(path, caption)])


if __name__ == "__main__":
    plot(parse(__doc__))
