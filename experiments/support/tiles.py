"""Grids of images with labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.perceptual import display
from mitsuba_irrcache.io.images import read_image


def tiles(
    path: Path,
    rows: list[list[np.ndarray | None]],
    row_labels: list[str],
    titles: list[list[str]],
    width: float = 1.9,
) -> None:
    """Draw ``rows`` of tone-mapped images of linear radiance, each with a title.

    None leaves an empty tile. ``width`` is that of an image in inches.
    """
    shape = next(image.shape for row in rows for image in row if image is not None)
    size = (len(rows[0]) * (width + 0.1) + 0.4, len(rows) * (width * shape[0] / shape[1] + 0.3))
    with style.figure(path, len(rows), len(rows[0]), figsize=size) as (_, axes):
        for line, images, label, above in zip(axes, rows, row_labels, titles, strict=True):
            line[0].set_ylabel(label)
            for ax, image, title in zip(line, images, above, strict=True):
                _bare(ax)
                if image is None:
                    ax.imshow(np.ones((*shape[:2], 3)))  # occupies the space of an image
                    ax.text(
                        0.5, 0.5, "no image\nyet", transform=ax.transAxes, ha="center",
                        va="center", color=style.GREY,
                    )  # fmt: skip
                else:
                    ax.imshow(display(image), interpolation="nearest")
                ax.set_title(title)


def read(picked: dict) -> np.ndarray | None:
    """Read the image that `recording.Session.picked` selected, if there is one."""
    if not picked["image"]:
        return None
    return read_image(picked["image"])


def error_title(picked: dict) -> str:
    """Return label and error of the tone-mapped image."""
    error = picked["display"]
    return picked["label"] if error is None else f"{picked['label']}: {error:.4f}"


def crop(image: np.ndarray, centre: tuple[float, float], share: float) -> np.ndarray:
    """Return a square part of an image: ``share`` of its height, centred at a relative position."""
    side = max(8, round(share * image.shape[0]))
    x, y = (round(c * n) - side // 2 for c, n in zip(centre, image.shape[1::-1], strict=True))
    y, x = np.clip((y, x), 0, (image.shape[0] - side, image.shape[1] - side))
    return image[y : y + side, x : x + side]


def _bare(ax: Axes) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set_visible(False)
