"""Draws figure 1 from what run.py left: output/figure1/figure1.png.

python -m experiments.paper.figure1.plot [--full]
"""

from __future__ import annotations

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from experiments.support.tiles import error_title, read, tiles
from mitsuba_irrcache.compare.report import Figure, Section


def plot(options: Options) -> Section:
    """Draw the images in one row."""
    folder = options.folder("figure1")
    results = read_json(folder / "results.json")
    images = [*map(read, results["methods"]), read({"image": results["reference"]})]
    titles = [*map(error_title, results["methods"]), "reference"]
    path = folder / "figure1.png"
    tiles(path, [images], [""], [titles], width=2.6)
    caption = (
        f"The paper's figure 1: each method after {results['seconds']:.3g} s. Above each picture "
        "the paper's error, the RMSE of the displayed picture, here against an independent "
        "reference."
    )
    return Section("Figure 1: the same time for every method", [Figure(path, caption)])


if __name__ == "__main__":
    plot(parse(__doc__))
