"""Draws figure 3 from what run.py left: output/figure3/figure3.png.

python -m experiments.paper.figure3.plot [--full]
"""

from __future__ import annotations

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from experiments.support.tiles import crop, read, tiles
from mitsuba_irrcache.compare.report import Figure, Section

#: The upper ribs as fractions of width and height, and the fraction of the height that is shown.
CENTRE, SHARE = (0.42, 0.38), 0.34


def plot(options: Options) -> Section:
    """Draw a row for each method and a column for each time, with the reference at the end."""
    folder = options.folder("figure3")
    results = read_json(folder / "results.json")
    reference = _detail({"image": results["reference"]})
    rows = [[*map(_detail, row), reference] for row in results["methods"].values()]
    titles = [f"{t:g} s" for t in results["times"]] + ["reference"]
    path = folder / "figure3.png"
    tiles(path, rows, list(results["methods"]), [titles] * len(rows), width=1.5)
    caption = (
        "The paper's figure 3: a detail after the paper's times (the last one at most the "
        "horizon). A tile is empty where a method has no image yet: the cache first needs a pass "
        "over all its voxels, which took the paper's GPU less than 0.15 s."
    )
    return Section("Figure 3: convergence", [Figure(path, caption)])


def _detail(picked: dict):
    image = read(picked)
    return None if image is None else crop(image, CENTRE, SHARE)


if __name__ == "__main__":
    plot(parse(__doc__))
