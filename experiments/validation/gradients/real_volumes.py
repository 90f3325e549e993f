"""Real volumes as the truth of optimisations: their scenes, views of them, and images of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support.scenes import DATA
from experiments.validation.gradients.cases import EDGE, SUN
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.volumes.raw import RawLayout
from mitsuba_irrcache.volumes.readers import read_volume

#: A sky much darker than the sun.
SKY = {"type": "constant", "radiance": 0.12}
#: Extinction with which optimisations start, relative to the largest of the truth.
START = 0.1


@dataclass(frozen=True)
class RealVolume:
    """A volume of the folder of real data.

    Attributes:
        files: pattern of its files.
        depth: optical depth of a side of the cube at the largest density.
        albedo: albedo everywhere.
        raw: layout of files without a header.
        density: density as a function of the values.
    """

    files: str
    depth: float
    albedo: float
    raw: RawLayout | None = None
    density: Callable[[np.ndarray], np.ndarray] = lambda values: values


def _of_ct(values: np.ndarray) -> np.ndarray:
    """Return a density that is proportional to the attenuation of X-rays, 0 in air."""
    return np.where(values > 700, values, 0)


VOLUMES = {
    "cloud": RealVolume("wdas_cloud/wdas_cloud_sixteenth.vol", 12.0, 0.99),
    "head": RealVolume(
        "unc_cthead/CThead.*", 8.0, 0.8,
        RawLayout((256, 256, 113), "uint16", "big", (1.0, 1.0, 2.0)), _of_ct,
    ),
}  # fmt: skip


def means(values: np.ndarray, axis: int, share: float, voxels: int) -> np.ndarray:
    """Return means of ``values`` over so many ``voxels`` along an axis, of which the data fill a
    ``share`` in the middle.
    """
    ends = np.linspace(0, 1, voxels + 1)
    places = np.linspace(0.5 - share / 2, 0.5 + share / 2, values.shape[axis] + 1)
    sums = np.concatenate([np.zeros_like(values.take([0], axis)), values.cumsum(axis)], axis)
    integral = np.apply_along_axis(lambda line: np.interp(ends, places, line), axis, sums)
    return np.diff(integral, axis=axis) * (voxels * share / values.shape[axis])


@dataclass(frozen=True)
class Subject:
    """A real volume in a cube, and cameras around it.

    Attributes:
        name: the volume, of `VOLUMES`.
        voxels: number of voxels along each side.
        views, unseen: numbers of views that are fitted, and of further ones that are not.
        pixels: size of an image.
    """

    name: str
    voxels: int
    views: int
    pixels: int
    unseen: int = 2

    @property
    def label(self) -> str:
        return f"{self.name} {self.voxels} {self.views}+{self.unseen} {self.pixels}"

    @property
    def is_available(self) -> bool:
        return any(DATA.glob(VOLUMES[self.name].files))

    def sigma_t(self) -> np.ndarray:
        """Extinction (z, y, x, 1): the density in means over the voxels of a cube."""
        volume = VOLUMES[self.name]
        found = read_volume(str(DATA / volume.files), raw=volume.raw)
        values = volume.density(np.asarray(found.values, dtype=np.float64))
        lengths = np.array(values.shape) * np.array(found.spacing[::-1])
        for axis, length in enumerate(lengths):
            values = means(values, axis, length / lengths.max(), self.voxels)
        return (values / values.max() * volume.depth / EDGE)[..., None].astype(np.float32)

    def load(
        self, integrator: dict, extinction: np.ndarray, albedo_on_grid: bool = False
    ) -> mi.Scene:
        """Load the scene with this ``extinction`` (z, y, x, 1), and an albedo at the same voxels or
        a constant one.
        """
        to_world = mi.ScalarTransform4f().translate([-EDGE / 2] * 3).scale(EDGE)

        def volume(values: np.ndarray) -> dict:
            grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True}
            return grid | {"to_world": to_world}

        albedo = VOLUMES[self.name].albedo
        medium = {
            "type": "heterogeneous",
            "sigma_t": volume(extinction),
            "albedo": volume(np.full_like(extinction, albedo)) if albedo_on_grid else albedo,
        }
        cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}
        own = {"integrator": {"max_depth": -1} | integrator, "sky": SKY, "sun": SUN, "cube": cube}
        return mi.load_dict({"type": "scene"} | own)

    def start(self, integrator: dict) -> mi.Scene:
        """Load the scene with a uniform extinction."""
        truth = self.sigma_t()
        return self.load(integrator, np.full_like(truth, START * truth.max()))

    def sensors(self) -> list[mi.Sensor]:
        """Return the sensors of all views; the last ones are not fitted."""
        found = []
        for number in range(self.views + self.unseen):
            turn, height = 2 * np.pi * (number * 0.618), 0.8 * np.cos(2.4 * number)
            origin = 5 * np.array([np.cos(turn), height, np.sin(turn)]) / np.hypot(1, height)
            look = mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0])
            film = {"type": "hdrfilm", "width": self.pixels, "height": self.pixels}
            film |= {"component_format": "float32", "rfilter": {"type": "box"}}
            own = {"type": "perspective", "fov": 27.0, "to_world": look, "film": film}
            found.append(mi.load_dict(own))
        return found


@dataclass(frozen=True)
class Truth:
    """Images of a subject, (view, height, width, channel).

    Attributes:
        subject: the subject.
        images: images by ``volpath`` of the views that are fitted.
        unseen: images of the other views, by `_exact_images`.
    """

    subject: Subject
    images: np.ndarray
    unseen: np.ndarray

    @classmethod
    def of(cls, subject: Subject, spp: int, folder: Path) -> Truth:
        """Render all views, or read them from ``folder``; ``spp`` are those of ``volpath``."""
        file = folder / f"{subject.label} {spp}.npz".replace(" ", "_")
        if not file.exists():
            truth = subject.sigma_t()
            scene = subject.load({"type": "volpath"}, truth)
            sensors = subject.sensors()[: subject.views]
            images = [
                np.array(mi.render(scene, sensor=sensor, spp=spp, seed=number))
                for number, sensor in enumerate(sensors)
            ]
            with atomic_write(file) as stream:
                np.savez(stream, images=np.stack(images), unseen=_exact_images(subject, truth))
        with np.load(file) as stored:
            return cls(subject, stored["images"], stored["unseen"])

    def error(self, extinction: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the root mean square error of the unseen views of an ``extinction``, relative to
        their mean, and these views.
        """
        images = _exact_images(self.subject, extinction)
        error = np.sqrt(np.mean(np.square(images - self.unseen)))
        return float(error / self.unseen.mean()), images


def _exact_images(subject: Subject, extinction: np.ndarray) -> np.ndarray:
    """Return images of the views that are not fitted, with hardly any noise: by a finer cache and
    with more ordinates than optimisations use. Images by ``volpath`` would have to be of 10^4
    samples to measure errors of 1 %.
    """
    fine = {"type": "irrcache", "solver": "sweep", "resolution": 2 * subject.voxels}
    scene = subject.load(fine | {"cache_spp": 256, "cache_seed": 7}, extinction)
    sensors = subject.sensors()[subject.views :]
    return np.stack([np.array(mi.render(scene, sensor=s, spp=64)) for s in sensors])
