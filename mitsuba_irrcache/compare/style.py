"""The style of figures: fonts, colours and sizes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot

from mitsuba_irrcache.io.files import atomic_write

#: Okabe and Ito's palette, which is distinguishable with colour blindness, and markers for print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
MARKERS = "osD^vPX"
#: Colour map of signed errors: blue is too dark, red is too bright.
SIGNED = "RdBu_r"
GREY = "#777777"

SETTINGS = {
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.titlesize": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "savefig.dpi": 150,
    "savefig.bbox": "tight",
    "svg.fonttype": "none",
    "svg.hashsalt": "irrcache",
    "figure.constrained_layout.use": True,
}


@contextmanager
def figure(path: Path, rows: int = 1, columns: int = 1, **options) -> Iterator[tuple]:
    """Create a figure with axes (rows, columns); the end of the context writes it to ``path``."""
    with pyplot.rc_context(SETTINGS):
        drawn, axes = pyplot.subplots(rows, columns, squeeze=False, **options)
        try:
            yield drawn, axes
            with atomic_write(path) as file:
                drawn.savefig(file, format=path.suffix[1:])
        finally:
            pyplot.close(drawn)


def line(index: int) -> dict[str, str]:
    """Return the colour and marker of the integrator with this number."""
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}
