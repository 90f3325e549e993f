"""Views, settings, and results of fits (`fit`), and checkpoints of these."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, reason
from mitsuba_irrcache.gradients.film import LUMINANCE
from mitsuba_irrcache.io.files import atomic_write

#: Radiance below which errors of the loss ``relative`` are absolute.
DARK = 0.1
#: Numbers of colours of images by their numbers of channels, which include alpha.
COLOURS = {1: 1, 2: 1, 3: 3, 4: 3}

LOSSES: dict[str, Callable] = {
    "l2": lambda image, target: dr.square(image - target),
    "l1": lambda image, target: dr.abs(image - target),
    "relative": lambda image, target: (
        dr.square(image - target) / (dr.square(dr.detach(image)) + DARK**2)
    ),
}
METHODS = ("adam", "lbfgs")


@dataclass(frozen=True, eq=False)
class View:
    """A reference image (height, width, channel) of linear radiance, and its sensor.

    Channels are luminance or RGB, and alpha if there is one more; where one of image and film has
    luminance only, luminances are compared. Errors call the image ``name``.
    """

    sensor: mi.Sensor
    image: np.ndarray
    name: str = "an image"


def comparable_colours(film: int, image: int) -> int:
    """Return the number of channels in which images are compared, given those of the ``film`` and
    of the reference ``image``; 0 if they are not comparable.
    """
    if film == image:
        return image
    return min(COLOURS.get(film, 0), COLOURS.get(image, 0))


def in_colours(image: mi.TensorXf, count: int) -> mi.TensorXf:
    """Return the first ``count`` channels of an image, or the luminance of an RGB image."""
    if image.shape[2] == count:
        return image
    if count == 1 and COLOURS[image.shape[2]] == 3:
        return sum(share * image[:, :, i : i + 1] for i, share in enumerate(LUMINANCE))
    return image[:, :, :count]


@dataclass(frozen=True)
class Settings:
    """Settings of a fit.

    Attributes:
        steps: number of steps of Adam; for L-BFGS, the largest number of iterations.
        method: "lbfgs", which needs fewer steps, or "adam", which can use a subset of the ``views``
            in each step.
        loss: "l2", "l1" or "relative" (squared errors relative to the image).
        rate: first step size of Adam, relative to the scale of a parameter.
        scale: value by which extinction, radiance and emission are normalized; 0: the largest
            initial value, but at least that of a medium of a certain optical depth.
        smoothness: weight in the loss of the mean squared difference between neighbouring voxels,
            for images of mean square 1 and a scale of 1. Views leave the finest structure of a
            volume undetermined.
        spp: camera samples per pixel.
        views: number of views in each step of Adam, which takes all in turn; 0: all views.
        seed: seed of camera samples and of the order of views.
    """

    steps: int = 100
    method: str = "lbfgs"
    loss: str = "l2"
    rate: float = 0.1
    scale: float = 0.0
    smoothness: float = 1e-4
    spp: int = 4
    views: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, known in (("method", self.method, METHODS), ("loss", self.loss, LOSSES)):
            if value not in known:
                raise IrrcacheError(f'fit: {name} is "{value}"; it must be one of {[*known]}.')
        if self.steps < 1 or self.spp < 1 or self.views < 0:
            raise IrrcacheError(
                f"fit: steps is {self.steps}, spp {self.spp} and views {self.views}; steps and spp "
                "must be at least 1, views at least 0."
            )
        if self.views and self.method != "adam":
            raise IrrcacheError(f"fit: {self.method} takes all views; set views to 0, or use adam.")
        numbers = {"rate": self.rate, "scale": self.scale, "smoothness": self.smoothness}
        if not (self.rate > 0 and all(0 <= x < math.inf for x in numbers.values())):
            raise IrrcacheError(
                f"fit: {numbers} given; the rate must be above 0, the others not negative."
            )


@dataclass(eq=False)
class Result:
    """The state of a fit after ``step`` steps.

    Attributes:
        values: values of the parameters, by name.
        history: for each step, its number, the loss of its views, and the root mean square error of
            the held-out views relative to their mean (NaN without held-out views, and in steps that
            do not compute it).
        moments: first and second moments of Adam, by name of the parameter.
    """

    step: int
    values: dict[str, np.ndarray]
    history: list[tuple[int, float, float]] = field(default_factory=list)
    moments: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    def save(self, path: str | Path, settings: Settings) -> None:
        """Write a checkpoint from which `load` continues."""
        arrays = {f"value {name}": value for name, value in self.values.items()}
        for name, (first, second) in self.moments.items():
            arrays |= {f"first {name}": first, f"second {name}": second}
        about = json.dumps({"step": self.step, "settings": asdict(settings)})
        history = np.array(self.history, dtype=np.float64).reshape(-1, 3)
        with atomic_write(path) as stream:
            np.savez(stream, about=np.array(about), history=history, **arrays)

    @classmethod
    def load(cls, path: str | Path, settings: Settings) -> Result:
        """Return the result read from a checkpoint.

        Raises IrrcacheError if the file is no checkpoint, or was written with other ``settings``.
        """
        try:
            with np.load(path) as stored:
                arrays = dict(stored)
            about = json.loads(str(arrays.pop("about")))
            history = [(int(s), a, b) for s, a, b in arrays.pop("history").tolist()]
        except (OSError, ValueError, KeyError) as error:
            raise IrrcacheError(f'"{path}" is no checkpoint of a fit: {reason(error)}.') from error
        others = {k: v for k, v in about["settings"].items() if asdict(settings)[k] != v}
        if others:
            raise IrrcacheError(
                f'the checkpoint "{path}" was made with {others}; continue with the same, or '
                "delete it."
            )

        def named(prefix: str) -> dict[str, np.ndarray]:
            return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}

        first, second = named("first "), named("second ")
        moments = {name: (first[name], second[name]) for name in first}
        return cls(about["step"], named("value "), history, moments)
