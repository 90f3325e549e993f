"""volpath and irrcache against the half-space in closed form, where a dense boundary is seen.

    python -m experiments.validation.dense_references.run [--document FILE]

Mitsuba continues rays at a surface from an origin that is shifted along the normal by 8.9e-5 (1 +
|p|) for the coordinates p. At the boundary of a dense medium what this layer would scatter is lost.
The first table has the differences from the half-space in the middle of a face of the cube
[-1, 1]^3, in %, with the standard error of volpath; the second one those of cubes of other sizes
and places, for single scattering at the normal, with 25 mean free paths in half an edge.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.validation.dense_faces.run import COSINES, face, radiance, scattering
from mitsuba_irrcache.compare.tables import Table

SPP, STOCK_SPP = 256, 16384
#: Albedo, and ``max_depth`` of the rows; optical depths of half an edge.
ALBEDO, ORDERS, DEPTHS = 0.8, (2, -1), (25.0, 50.0, 100.0)
#: Half an edge of the cube, and the coordinate x of its centre.
PLACES = ((1.0, 0.0), (1.0, 5.0), (1.0, 50.0), (0.1, 0.0), (10.0, 0.0))
HEAD = ["scattering", "cosine", *(f"{d:g} mean free paths in half an edge" for d in DEPTHS)]
PLACE_HEAD = ["half an edge", "x of the centre", "volpath", "irrcache"]


def cube(depth: float, half: float, shift: float) -> dict:
    """Return a homogeneous cube with this optical ``depth`` of ``half`` an edge, whose centre has
    the coordinate x ``shift``.
    """
    medium = {"type": "homogeneous", "sigma_t": depth / half, "albedo": ALBEDO}
    place = mi.ScalarTransform4f().translate([shift, 0, 0]).scale(half)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}


def differences(
    max_depth: int, depth: float, mu: float, half: float = 1.0, shift: float = 0.0
) -> list[str]:
    """Return the differences of volpath, with its standard error, and of irrcache [%]."""
    expected, cells = radiance(ALBEDO, max_depth, mu), []
    for name, spp in (("volpath", STOCK_SPP), ("irrcache", SPP)):
        integrator, body = {"type": name, "max_depth": max_depth}, cube(depth, half, shift)
        image = face(integrator, body, mu, spp, half=half, shift=shift)
        cells.append(f"{100 * (image.mean() / expected - 1):+.2f}")
        if name == "volpath":
            cells[-1] += f" ± {100 * image.std() / np.sqrt(image.size) / expected:.2f}"
    return cells


def main() -> None:
    """Measure all cases."""
    parser = parser_of(__doc__)
    add_document(parser)
    args = parser.parse_args()
    begin()
    mi.set_variant("llvm_ad_mono")
    rows, places = [], []
    for max_depth in ORDERS:
        for mu in COSINES:
            found = [", ".join(differences(max_depth, depth, mu)) for depth in DEPTHS]
            rows.append([scattering(max_depth), f"{mu:g}", *found])
            print(" | ".join(rows[-1]), flush=True)
    for half, shift in PLACES:
        places.append([f"{half:g}", f"{shift:g}", *differences(2, DEPTHS[0], 1.0, half, shift)])
        print(" | ".join(places[-1]), flush=True)
    if args.document:
        tables = {
            "dense-references": Table("", HEAD, rows),
            "moved-references": Table("", PLACE_HEAD, places),
        }
        replace_tables(args.document, tables)


if __name__ == "__main__":
    main()
