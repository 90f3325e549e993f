"""Draws the figures of docs/primer: ``python -m experiments.docs.figures [-o docs/images]``.

Tracks are those of `Tracks.table`; the multigrid cycle and the segments of a ray are drawn by the
rules of `MultigridLevel.corrected` and `Projection.march`.
"""

from __future__ import annotations

import argparse
import os
from itertools import pairwise
from pathlib import Path

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np

from experiments.support.options import begin
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.render.raymarch import COARSER, COARSEST
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

SIDE = 8
#: What is drawn beside lines: text, arrows.
TEXT = {"fontsize": 8, "ha": "center", "va": "center"}


def main() -> None:
    """Draws all figures into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    parser.add_argument("--format", choices=("svg", "png"), default="svg")
    args = parser.parse_args()
    begin()
    # The same file each time: neither a date nor random identifiers.
    os.environ["SOURCE_DATE_EPOCH"] = "0"
    matplotlib.rcParams["svg.hashsalt"] = "irrcache"
    args.output.mkdir(parents=True, exist_ok=True)
    for draw in (tracks, multigrid, march):
        path = args.output / f"{draw.__name__}.{args.format}"
        draw(path)
        print(path)


def tracks(path: Path) -> None:
    """Tracks of one direction through a slice of 8 x 8 voxels."""
    grid = Grid((1, SIDE, SIDE), np.eye(4))
    sigma_t = dr.full(mi.Float, 1.0, grid.voxel_count)
    lattice = Tracks(grid, sigma_t, np.zeros(3, int), grid.resolution)
    direction = np.array([[0.9, 0.405, 0.0]])
    direction /= np.linalg.norm(direction)
    geometry = lattice.table(direction, np.zeros((1, 2)), np.ones(1), np.full((1, 2), 0.3)).geometry
    slope, start = geometry.slopes[0, 0], geometry.starts[0, 0]
    with style.figure(path, figsize=(4.6, 4.6)) as (_, axes):
        ax = axes[0, 0]
        for k in range(SIDE + 1):
            ax.plot([0, SIDE], [k, k], color="#d8d8d8", linewidth=0.8)
            ax.plot([k, k], [0, SIDE], color="#d8d8d8", linewidth=0.8)
        for number in range(SIDE):
            colour = style.COLOURS[0] if number != 5 else style.COLOURS[1]
            width = 1.0 if number != 5 else 1.8
            for begin_, end in _pieces(number + start, slope):
                x, y = zip(begin_, end, strict=True)
                ax.plot(x, y, color=colour, linewidth=width)
                if begin_[0] > 0:
                    ax.plot(*begin_, "s", color=colour, markersize=4)
            middles = np.arange(SIDE)
            y = (number + start + slope * middles) % SIDE
            ax.plot(middles + 0.5, y, "o", color=colour, markersize=3)
        ax.annotate("", (SIDE + 0.9, 5.55), (SIDE + 0.1, 5.19), arrowprops={"arrowstyle": "->"})
        ax.text(SIDE + 0.55, 4.9, "ω", **TEXT)
        ax.text(SIDE / 2, -0.6, "slices along the dominant axis", **TEXT)
        ax.set_aspect("equal")
        ax.set_xlim(-0.2, SIDE + 1.1)
        ax.set_ylim(-0.9, SIDE + 0.2)
        ax.axis("off")


def _pieces(position: float, slope: float) -> list[tuple]:
    """Parts of a track between the sides; it passes the middle of slice 0 at ``position``."""
    x, y, found = 0.0, position - 0.5 * slope, []
    while x < SIDE - 1e-9:
        y = y % SIDE
        length = min((SIDE - y) / slope, SIDE - x)
        found.append(((x, y), (x + length, y + slope * length)))
        x, y = x + length, y + slope * length
        if y >= SIDE - 1e-9:
            y = 0.0
    return found


def multigrid(path: Path) -> None:
    """The cycle of one correction on three levels."""
    places = [(0, 2), (1.6, 1), (3.2, 0), (4.8, 1), (6.4, 2)]
    labels = (
        "sweep on the finest level\n$\\tilde\\phi = A\\phi + b$,  $r = \\tilde\\phi - \\phi$",
        "$b_1 = A_1 R\\,r$\nsweep, next residual",
        "$b_2 = A_2 R\\,r_1$\nAnderson acceleration\nuntil converged",
        "$e_1 = \\tilde e_1 + P e_2$",
        "$g(\\phi) = \\tilde\\phi + P e_1$",
    )
    offsets = ((0.2, 0.42), (-1.25, -0.12), (0, -0.5), (1.1, -0.12), (0.1, 0.4))
    with style.figure(path, figsize=(6.4, 3.2)) as (_, axes):
        ax = axes[0, 0]
        for level, name in enumerate(("h", "2h", "4h")):
            y = 2 - level
            ax.plot([-1.9, 8.2], [y, y], color="#e4e4e4", linewidth=1, zorder=0)
            ax.text(-2.2, y, name, color=style.GREY, **TEXT)
        arrow = {"arrowstyle": "->", "shrinkA": 6, "shrinkB": 6}
        for number, (a, b) in enumerate(pairwise(places)):
            ax.annotate("", b, a, arrowprops=arrow)
            middle = (np.array(a) + b) / 2 + (0.27 if number < 2 else -0.27, 0.12)
            ax.text(*middle, "R" if number < 2 else "P", color=style.COLOURS[1], **TEXT)
        for number, (place, label, offset) in enumerate(zip(places, labels, offsets, strict=True)):
            ax.plot(*place, "o", color=style.COLOURS[0 if number < 3 else 2], markersize=8)
            ax.text(place[0] + offset[0], place[1] + offset[1], label, **TEXT)
        back = {"arrowstyle": "->", "connectionstyle": "arc3,rad=0.32", "color": style.GREY}
        ax.annotate("", (0.35, 2.68), (6.1, 2.62), arrowprops=back)
        ax.text(3.2, 3.65, "Anderson step, eq. (4.11), until converged", color=style.GREY, **TEXT)
        ax.set_xlim(-2.4, 8.4)
        ax.set_ylim(-0.9, 3.85)
        ax.axis("off")


def march(path: Path) -> None:
    """Extinction along a camera ray, its transmittance, and the segments that are marched."""
    t = np.linspace(0, 10, 401)
    sigma = _extinction(t)
    through = np.exp(-np.concatenate([[0], np.cumsum(0.5 * (sigma[1:] + sigma[:-1]) * t[1])]))
    points = _marched(step=0.5, offset=0.35, length=10.0)
    with style.figure(path, figsize=(6.4, 2.8)) as (_, axes):
        ax = axes[0, 0]
        ax.fill_between(t, sigma, color="#cfe2f0", label="extinction")
        ax.plot(t, through, color=style.COLOURS[1], label="transmittance T")
        for p in points:
            ax.plot([p, p], [0, 1.35], color=style.GREY, linewidth=0.6)
        ax.plot(points, np.zeros(len(points)), "o", color=style.COLOURS[0], markersize=3)
        for x, text in (
            (0.1, "random\nfirst step"), (4.42, "empty macrocells:\none segment"),
            (1.95, "steps of\none voxel"), (8.7, "longer steps where little\ncan still be added"),
        ):  # fmt: skip
            ax.text(x, 1.5, text, **TEXT)
        ax.set_xlabel("distance along the ray")
        ax.set_ylim(-0.04, 1.68)
        ax.set_yticks([])
        ax.grid(False)
        ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _extinction(t: np.ndarray) -> np.ndarray:
    """A thin cloud, nothing, and a dense one."""
    thin = 0.55 * np.clip(np.sin((t - 0.4) / 2.8 * np.pi), 0, None) * (t < 3.2)
    return thin + 1.15 * np.clip(1 - np.abs(t - 8.0) / 2.5, 0, None)


def _marched(step: float, offset: float, length: float) -> list[float]:
    """Ends of segments: as `Projection.march` has them, for macrocells of four steps."""
    points, t, k, through = [0.0], 0.0, 0, 1.0
    lattice = offset * step
    while t < length - 1e-9 and through > 1e-3:
        stride = 1 if through > COARSER else 2 if through > COARSEST else 4
        end = lattice + k * step if t else lattice
        if t and _extinction(np.linspace(t, end + step, 9)).max() == 0:
            while _extinction(np.array([lattice + (k + 1) * step])).max() == 0:
                k += 1
            end = lattice + k * step
        elif t:
            end = t + stride * step
            k = round((end - lattice) / step)
        end = min(end, length)
        through *= np.exp(-float(_extinction(np.array([0.5 * (t + end)]))[0]) * (end - t))
        points.append(end)
        t, k = end, k + 1
    return points


if __name__ == "__main__":
    main()
