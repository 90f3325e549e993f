"""The dark side of dense media: radiance that has diffused through them, by voxel size.

    python -m experiments.validation.dark_side.run [--document FILE]

A soft cloud of 16^3 values (a Gaussian of the albedo 0.99), and a white homogeneous cube, under a
sun behind them. Images of 32 x 32 pixels with all orders of scattering, with and without the
compensation of numerical diffusion (docs/primer, eq. (4.13)), are compared with those of five times
as many voxels along each axis, with it. The table has the differences of the mean of the 8 x 8
pixels in the middle, and of the whole image (RMSE), in %.
"""

from __future__ import annotations

from dataclasses import dataclass
from unittest import mock

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.solvers.discrete_ordinates import antidiffusion

PIXELS, SPP, FINER, DIRECTIONS = 32, 16, 5, 256
MIDDLE = np.s_[12:20, 12:20]
HEAD = ["scene", "voxels", "without: middle", "RMSE", "with: middle", "RMSE"]


@dataclass(frozen=True)
class DarkSide:
    """A medium in the cube [-1, 1]^3; a cloud if ``is_soft``."""

    is_soft: bool
    depth: float  #: along the axis through the middle
    g: float
    voxels: int

    @property
    def name(self) -> str:
        """What it is."""
        kind = "soft cloud" if self.is_soft else "white cube"
        return f"{kind}, depth {self.depth:.0f}" + (f", hg {self.g}" if self.g else "")

    def medium(self) -> dict:
        """Return the medium."""
        phase = {"type": "hg", "g": self.g} if self.g else {"type": "isotropic"}
        if not self.is_soft:
            sigma_t = self.depth / 2
            return {"type": "homogeneous", "sigma_t": sigma_t, "albedo": 1.0, "phase": phase}
        place = (np.arange(16) + 0.5) / 8 - 1
        squares = np.square(np.meshgrid(place, place, place)).sum(axis=0)
        density = np.exp(-4 * squares)
        density[density < 0.03] = 0
        scale = self.depth / (density[8, 8].sum() / 8)
        to_world = mi.ScalarTransform4f().translate(-1).scale(2)
        grid = mi.VolumeGrid(density.astype(np.float32)[..., None])
        sigma_t = {"type": "gridvolume", "grid": grid, "to_world": to_world}
        values = {"sigma_t": sigma_t, "albedo": 0.99, "scale": float(scale), "phase": phase}
        return {"type": "heterogeneous"} | values

    def image(self, voxels: int) -> np.ndarray:
        """Render with this number of voxels along each axis."""
        look = mi.ScalarTransform4f().look_at([0.1, 0.2, 5], [0, 0, 0], [0, 1, 0])
        film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
        solver = {"type": "irrcache", "solver": "sweep", "max_depth": -1}
        scene = mi.load_dict({
            "type": "scene",
            "integrator": solver | {"resolution": voxels, "cache_spp": DIRECTIONS},
            "boundary": {"type": "cube", "bsdf": {"type": "null"}, "interior": self.medium()},
            "sun": {"type": "directional", "direction": [0, 0, 1], "irradiance": 1.0},
            "sensor": {"type": "perspective", "fov": 30, "to_world": look, "film": film},
        })  # fmt: skip
        return np.array(mi.render(scene, spp=SPP), dtype=np.float64)[..., 0]


CASES = [
    *(DarkSide(True, depth, g, 16) for g in (0.0, 0.5) for depth in (17.0, 34.0)),
    DarkSide(False, 20.0, 0.0, 16),
]


def uncompensated():
    """Neglect numerical diffusion."""
    return mock.patch.object(antidiffusion, "NEGLIGIBLE_DEPTH", np.inf)


def row(case: DarkSide) -> list[str]:
    """Return the cells of a case."""
    reference, found = case.image(FINER * case.voxels), case.image(case.voxels)
    with uncompensated():
        before = case.image(case.voxels)
    cells = []
    for image in (before, found):
        middle = image[MIDDLE].mean() / reference[MIDDLE].mean() - 1
        rmse = np.sqrt(np.square(image - reference).mean()) / reference.mean()
        cells += [f"{100 * middle:+.1f}", f"{100 * rmse:.1f}"]
    return [case.name, f"{case.voxels}^3", *cells]


def main() -> None:
    """Measure all cases."""
    parser = parser_of(__doc__)
    add_document(parser)
    args = parser.parse_args()
    begin()
    mi.set_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    rows = []
    for case in CASES:
        rows.append(row(case))
        print(" | ".join(rows[-1]), flush=True)
    if args.document:
        replace_tables(args.document, {"dark-side": Table("", HEAD, rows)})


if __name__ == "__main__":
    main()
