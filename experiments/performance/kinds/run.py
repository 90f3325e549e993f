"""Time at equal error for each kind of scene, including those where irrcache is slower.

    python -m experiments.performance.kinds.run [--budget 240] [--seconds 12] [--force] [-o output]

Each scene is rendered by ``irrcache`` at default settings, 16 samples per pixel, 64 x 64 pixels,
all orders of scattering. Its error is the RMSE in units of the mean radiance, net of the noise of a
reference of two halves (``--seconds`` each) by the better of volpath and volpathmis. A stock
integrator's time to the same error is its variance over the square of the error, times the duration
of a sample. If surfaces are visible, the error is that of their samples, and a cache is faster
below some error: the last column but one gives it. The last one is the solver that ``auto`` did not
select, where it is supported: its error, and its ratio with a cold cache. Kernels are warm, loading
is excluded. No data are needed: all scenes are procedural.

Rows are saved in output/kinds/results.json; none is started after ``--budget`` seconds: run it
again for the others.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError

SIZE, SPP = 64, 16
STOCK = ("volpath", "volpathmis")
#: Images of a stock integrator for its variance.
STOCK_SPP, STOCK_IMAGES = 64, 4
#: Images by irrcache with independent caches.
RUNS = 3


def colour(*rgb: float) -> dict:
    """Return a colour."""
    return {"type": "rgb", "value": list(rgb)}


def placed(centre, scale, towards=None):
    """Return a ``to_world``."""
    transform = mi.ScalarTransform4f()
    if towards is not None:
        return transform.look_at(list(centre), list(towards), [0.1, 1, 0.2]).scale(list(scale))
    return transform.translate(list(centre)).scale(list(scale))


def smoke(side: int = 48, scale: float = 6.0, albedo=(0.9, 0.9, 0.9), **more) -> dict:
    """Return a heterogeneous medium in the cube [-1, 1]^3: a blob with noise."""
    z, y, x = (np.indices((side,) * 3) + 0.5) / side * 2 - 1
    wisps = 0.6 + 0.4 * np.sin(7 * x + 3 * np.sin(5 * y)) * np.sin(6 * z + 2 * x) * np.sin(
        5 * y - z
    )
    density = np.clip(1.1 - np.sqrt(x**2 + 1.4 * y**2 + z**2), 0, 1) * wisps
    return medium(density[..., None] * more.pop("tint", np.ones(1)), scale, albedo) | more


def medium(density: np.ndarray, scale: float, albedo) -> dict:
    """Return a medium over the cube [-1, 1]^3."""
    place = placed((-1, -1, -1), (2, 2, 2))
    grid = mi.VolumeGrid(density.astype(np.float32))
    sigma_t = {"type": "gridvolume", "grid": grid, "raw": True, "to_world": place}
    uniform = {"type": "constvolume", "value": colour(*albedo)}
    return {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": uniform, "scale": scale}


def box(interior: dict, centre=(0, 0, 0), scale=(1, 1, 1)) -> dict:
    """Return a null boundary."""
    null = {"type": "null"}
    return {"type": "cube", "to_world": placed(centre, scale), "bsdf": null, "interior": interior}


def diffuse(*rgb: float) -> dict:
    """Return a BSDF."""
    return {"type": "diffuse", "reflectance": colour(*rgb)}


def wall(centre, towards, size=2.0, bsdf=None) -> dict:
    """Return a square."""
    place = placed(centre, (size, size, 1), towards)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or diffuse(0.7, 0.7, 0.7)}


def sky() -> dict:
    """Return a constant environment."""
    return {"type": "constant", "radiance": colour(0.6, 0.8, 1.0)}


def sun() -> dict:
    """Return a directional emitter."""
    return {"type": "directional", "direction": [0.4, -1.0, 0.55], "irradiance": 3.0}


def kind_cloud() -> dict:
    """Return a cloud alone under a sky."""
    return {"box": box(smoke(albedo=(0.99,) * 3)), "sky": sky()}


def kind_ground() -> dict:
    """Return the cloud over the ground, with a sun."""
    floor = wall((0, -1.1, 0), (0, 0, 0.001), 5.0, diffuse(0.6, 0.5, 0.4))
    return kind_cloud() | {"ground": floor, "sun": sun()}


def kind_forward_ground() -> dict:
    """Return the same with a strongly forward scattering cloud."""
    return kind_ground() | kind_forward()


def kind_room() -> dict:
    """Return smoke in a room with an area light under its ceiling."""
    red, green = diffuse(0.6, 0.1, 0.1), diffuse(0.1, 0.5, 0.1)
    area = {"type": "area", "radiance": 12.0}
    return {
        "box": box(smoke()),
        "floor": wall((0, -1.5, 0), (0, 0, 0.001)), "ceiling": wall((0, 1.5, 0), (0, 0, 0.001)),
        "left": wall((-1.5, 0, 0), (0, 0, 0), 2.0, red),
        "right": wall((1.5, 0, 0), (0, 0, 0), 2.0, green), "back": wall((0, 0, 1.5), (0, 0, 0)),
        "lamp": wall((0, 1.45, 0), (0, 0, 0.001), 0.4) | {"emitter": area},
    }  # fmt: skip


def kind_implant() -> dict:
    """Return a dense body with an opaque metal rod in it."""
    _, y, x = (np.indices((48,) * 3) + 0.5) / 48 * 2 - 1
    body = 2.0 * (x**2 + y**2 < 0.7) + 8.0 * (np.hypot(x - 0.35, y) < 0.2)
    metal = {"type": "roughconductor", "alpha": 0.2}
    rod = {"type": "cylinder", "p0": [-0.3, 0, -0.8], "p1": [-0.3, 0, 0.8], "radius": 0.12}
    inside = {"exterior": {"type": "ref", "id": "body"}, "bsdf": metal}
    ends = {
        f"end{i}": {
            "type": "disk", "to_world": placed((-0.3, 0, z), (0.12, 0.12, 1), (-0.3, 0, 2 * z)),
        } | inside
        for i, z in enumerate((-0.8, 0.8))
    }  # fmt: skip
    fluid = medium(body[..., None], 1.0, (0.9, 0.8, 0.7)) | {"id": "body"}
    return (
        {"body": fluid, "box": box({"type": "ref", "id": "body"}), "rod": rod | inside}
        | ends
        | {"sky": sky()}
    )


def kind_two() -> dict:
    """Return two media side by side."""
    other = {"type": "homogeneous", "sigma_t": 2.0, "albedo": colour(0.9, 0.6, 0.3)}
    ball = {"type": "sphere", "center": [1.5, 0.2, 0], "radius": 0.45, "bsdf": {"type": "null"}}
    return {"box": box(smoke()), "ball": ball | {"interior": other}, "sky": sky(), "sun": sun()}


def kind_chromatic() -> dict:
    """Return extinction of 1 : 4 : 10."""
    tint = np.array([0.1, 0.4, 1.0])
    return {"box": box(smoke(scale=12.0, tint=tint, albedo=(0.9, 0.9, 0.9))), "sky": sky()}


def kind_fog() -> dict:
    """Return a camera in fog, before a ball."""
    fog = {"type": "homogeneous", "sigma_t": 0.5, "albedo": 0.9, "id": "fog"}
    reference = {"type": "ref", "id": "fog"}
    ball = {"type": "sphere", "radius": 0.5, "bsdf": diffuse(0.8, 0.3, 0.2), "exterior": reference}
    look = mi.ScalarTransform4f().look_at([0.3, 0.4, -1.8], [0, 0, 0], [0, 1, 0])
    camera = {"to_world": look, "fov": 60.0, "medium": reference}
    return {"fog": fog, "box": box(reference, scale=(2, 2, 2)), "ball": ball, "sky": sky()} | {
        "sensor": sensor() | camera
    }


def kind_anisotropic() -> dict:
    """Return a medium with hg, g = 0.5, under a sky and a sun."""
    return {"box": box(smoke(phase={"type": "hg", "g": 0.5})), "sky": sky(), "sun": sun()}


def kind_forward() -> dict:
    """Return a strongly forward scattering cloud under a sky and a sun."""
    cloud = smoke(albedo=(0.99,) * 3, phase={"type": "hg", "g": 0.85})
    return {"box": box(cloud), "sky": sky(), "sun": sun()}


KINDS: dict[str, Callable[[], dict]] = {
    "cloud, sky": kind_cloud,
    "cloud over the ground, sun": kind_ground,
    "room with smoke": kind_room,
    "body with an implant": kind_implant,
    "two media": kind_two,
    "chromatic extinction": kind_chromatic,
    "camera in fog": kind_fog,
    "hg, g = 0.5": kind_anisotropic,
    "hg, g = 0.85": kind_forward,
    "hg, g = 0.85, over the ground": kind_forward_ground,
}


def sensor() -> dict:
    """Return the sensor."""
    look = mi.ScalarTransform4f().look_at([0.8, 0.9, -4.5], [0, 0, 0], [0, 1, 0])
    film = {
        "type": "hdrfilm", "width": SIZE, "height": SIZE, "component_format": "float32",
        "rfilter": {"type": "box"},
    }  # fmt: skip
    return {"type": "perspective", "fov": 36.0, "to_world": look, "film": film}


def load(build: Callable[[], dict], integrator: str, **settings) -> mi.Scene:
    """Load a scene with a cold cache."""
    gc.collect()
    depth = {"type": integrator, "max_depth": -1, "rr_depth": 50} | settings
    return mi.load_dict({"type": "scene", "integrator": depth, "sensor": sensor()} | build())


def picture(scene: mi.Scene, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Render colours, float64, and measure the seconds."""
    started = time.perf_counter()
    image = np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64)
    return image[..., :3], time.perf_counter() - started


def compute(build: Callable[[], dict], seconds: float) -> dict:
    """Return all measurements of a kind of scene."""
    stock = {name: stock_row(build, name) for name in STOCK}
    judge = min(stock, key=lambda name: stock[name]["cost"])
    scene, spp = load(build, judge), STOCK_SPP
    count = max(2, int(seconds / (stock[judge]["seconds"] * spp)))
    a, b = (
        np.mean([picture(scene, spp, 1000 + 2 * i + half)[0] for i in range(count)], axis=0)
        for half in range(2)
    )
    mean = 0.5 * (a + b).mean()
    resolved = float(np.sqrt(((a - b) ** 2).mean() / 4 * np.sqrt(2 / a.size)) / mean)
    chosen = solved(build, "auto", a, b)
    other = solved(build, "path" if chosen["solver"] == "sweep" else "sweep", a, b)
    known = {"judge": judge, "resolved": resolved, "stock": stock, "mean": float(mean)}
    return known | chosen | {"other": other}


def solved(build: Callable[[], dict], solver: str, a: np.ndarray, b: np.ndarray) -> dict | None:
    """Return error and times of a solver against both halves; None if it is refused."""
    ours, mean = load(build, "irrcache", solver=solver), 0.5 * (a + b).mean()
    try:
        ours.integrator().prepare(ours)
    except IrrcacheError:
        return None
    picture(ours, SPP, 0)  # compiles kernels
    runs = [irrcache_run(build, solver, seed) for seed in range(RUNS)]
    squares = [((image - a) * (image - b)).mean() for image, *_ in runs]
    cold, moved = (float(np.median([run[i] for run in runs])) for i in (1, 2))
    return {
        "solver": ours.integrator()._builder.solver, "cold": cold, "moved": moved,
        "rmse": float(np.sqrt(max(np.mean(squares), 0)) / mean),
        "mean_error": float(np.mean([(i - 0.5 * (a + b)).mean() for i, *_ in runs]) / mean),
    }  # fmt: skip


def stock_row(build: Callable[[], dict], name: str) -> dict:
    """Return relative variance and seconds of a sample per pixel, and their product."""
    scene = load(build, name)
    picture(scene, 1, 0)
    images, times = zip(
        *(picture(scene, STOCK_SPP, seed) for seed in range(1, 1 + STOCK_IMAGES)), strict=True
    )
    variance = float(np.var(images, axis=0, ddof=1).mean()) * STOCK_SPP / np.mean(images) ** 2
    each = float(np.median(times)) / STOCK_SPP
    return {"variance": float(variance), "seconds": each, "cost": float(variance * each)}


def irrcache_run(
    build: Callable[[], dict], solver: str, seed: int
) -> tuple[np.ndarray, float, float]:
    """Return an image, its seconds with a cold cache, and those of another image."""
    scene = load(build, "irrcache", solver=solver)
    dr.sync_thread()
    image, cold = picture(scene, SPP, seed)
    return image, cold, picture(scene, SPP, seed + 100)[1]


def table(rows: dict[str, dict]) -> Table:
    """Tabulate the rows; errors below the resolution of the reference count as that."""
    cells = []
    for name, row in rows.items():
        error = max(row["rmse"], row["resolved"])
        stock = row["stock"][row["judge"]]["cost"] / error**2
        bound = "<" if row["rmse"] < row["resolved"] else ""
        cells.append([
            name, row["solver"], f"{bound}{error:.2%}", f"{row['mean_error']:+.2%}",
            f"{row['judge']} {stock:.2f} s", f"{row['cold']:.2f} s ({stock / row['cold']:.2g} x)",
            f"{row['moved']:.2f} s ({stock / row['moved']:.2g} x)", _from(row, error), _other(row),
        ])  # fmt: skip
    head = ["scene", "solver", "RMSE", "mean error", "stock", "irrcache, cold", "camera moved"]
    head += ["faster, cold, below", "other solver"]
    return Table("Time at equal error", head, cells)


def _other(row: dict) -> str:
    """Format the result of the solver that was not selected."""
    other = row["other"]
    if other is None:
        return "refused"
    error = max(other["rmse"], row["resolved"])
    ratio = row["stock"][row["judge"]]["cost"] / error**2 / other["cold"]
    return f"{error:.2%}, {other['cold']:.2f} s ({ratio:.2g} x)"


def _from(row: dict, error: float) -> str:
    """Return the error below which ``irrcache`` is faster with a cold cache.

    It is assumed that its own error decreases with the camera samples.
    """
    saved = row["stock"][row["judge"]]["cost"] - row["moved"] * error**2
    cache = max(row["cold"] - row["moved"], 1e-3)
    return f"{np.sqrt(saved / cache):.2%}" if saved > 0 else "never"


def main() -> None:
    """Compute missing rows within the budget."""
    parser = parser_of(__doc__)
    parser.add_argument("--budget", type=float, default=240, help="no row is begun later")
    parser.add_argument("--seconds", type=float, default=12, help="of half a reference")
    add_document(parser)
    args = parser.parse_args()
    begin()
    folder = args.output / "kinds"
    folder.mkdir(parents=True, exist_ok=True)
    store, started = Store(folder / "results.json", args.force), time.perf_counter()
    for name, build in KINDS.items():
        if name not in store.rows and time.perf_counter() - started > args.budget:
            print(f"{name}: not computed yet; run again")
            continue
        store.row(name, partial(compute, build, args.seconds))
        print(table({name: store.rows[name]}).as_text(), flush=True)
    whole = table({name: store.rows[name] for name in KINDS if name in store.rows})
    print(whole.as_text())
    if args.document:
        replace_tables(args.document, {"kinds": whole})


if __name__ == "__main__":
    main()
