"""Random scenes against volpath, at default settings.

    python -m experiments.validation.random_scenes.run [--count 60] [--seed 1] [--only K ...]
        [--seconds 12]
        [--budget 480] [--force] [--document FILE]

Each scene (see generate.py) is loaded by `mi.load_dict`, with the integrator ``irrcache`` at
default settings except ``max_depth`` and ``hide_emitters``, and rendered with two values of
``cache_seed``, which separates the noise of the cache from its bias. The reference is rendered by
volpath (volpathmis if it is cheaper) in two independent halves. A pilot run selects the samples for
a noise of 4 % of the mean radiance per pixel in each half, with which that of the mean is much less
than a third of a percent, within about ``--seconds`` for the whole reference. A scene whose mean is
not known to a third of a percent then counts as undecided; the table marks scenes for which only
the mean of the volume alone is uncertain.

The table has the difference of the means; the RMSE, net of the reference's noise, by
mean((x - a)(x - b)); its bias, by mean((x - a)(y - b)), with a lower bound of three standard
errors; the largest error of a block of 4 x 4 pixels. All in % of the mean radiance of the image
and, in brackets, of that of the volume alone: of the image without the
unscattered radiance (volpath at depth 1). A scene *disagrees* if one of these, in both
renderings, is beyond three standard errors (4.5 for the worst of 64 blocks) and beyond LIMITS.

Rows are stored in output/random_scenes/<seed>.json, images and references as .npz files;
``--force`` discards the rows and renders with irrcache again, against the stored references.
``--document`` writes the counts, and the scenes that do not agree, to a Markdown file. No
scene is started after ``--budget`` seconds: run it again for the others, and with more
``--seconds`` for those that are undecided.
"""

from __future__ import annotations

import gc
import json
import time
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from experiments.validation.random_scenes.generate import RandomScene
from mitsuba_irrcache.compare.metrics import block_means, colours, net_rmse
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError, origin, original_message

#: Samples per pixel of an image by irrcache, of the pilot's images, and their number.
SPP, PILOT_SPP, PILOTS = 128, 16, 4
#: Most samples per pixel of one image of the reference: bounds memory.
LARGEST_SPP = 1024
BLOCK = 4
#: Noise of a pixel of half a reference, and of the mean radiance, in units of the mean.
PIXEL_NOISE, MEAN_NOISE = 0.04, 0.01 / 3
#: Thresholds of errors in units of the mean, and in standard errors.
LIMITS = {"mean": 0.01, "bias": 0.01, "block": 0.03}
SIGMAS = {"mean": 3.0, "bias": 3.0, "block": 4.5}


def compute(case: RandomScene, seconds: float, folder: Path) -> dict:
    """Measure a scene."""
    row = {"about": case.describe(), "drawn": case.as_dict(), "seconds_granted": seconds}
    ours = ours_of(case, folder)
    if "failed" in ours:
        return row | ours
    reference = stored_reference(case, seconds, folder)
    images = {name: reference.pop(name) for name in ("a", "b", "unscattered")}
    images |= {name: ours.pop(name) for name in ("x", "y")}
    np.savez_compressed(folder / f"{case.seed}-{case.index}.npz", **images)
    return row | ours | reference | compare(**images)


def load(case: RandomScene, integrator: str, folder: Path, **settings) -> mi.Scene:
    """Load the scene with a cold cache."""
    gc.collect()
    plugin = {"type": integrator} | case.properties | settings
    return mi.load_dict(case.build(plugin, folder))


def picture(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """Render colours, float64."""
    return colours(np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64))


def ours_of(case: RandomScene, folder: Path) -> dict:
    """Return images with two seeds, the solver, and the seconds of the first image.

    If there are none, ``refused`` says whether irrcache refused the scene with a message.
    """
    found: dict = {}
    try:
        for name, seed in (("x", 0), ("y", 1)):
            started = time.perf_counter()
            scene = load(case, "irrcache", folder, **({"cache_seed": seed} if seed else {}))
            found[name] = picture(scene, SPP, seed)
            found.setdefault("seconds", time.perf_counter() - started)
    except Exception as error:  # any exception that a user would see
        refused = isinstance(origin(error), IrrcacheError)
        return {
            "failed": original_message(error),
            "refused": refused,
            "kind": type(origin(error)).__name__,
        }
    builder = scene.integrator()._builder
    solved = any(part.cache is not None for part in builder.parts)
    return found | {"solver": builder.solver if solved else "none"}


def reference_of(case: RandomScene, seconds: float, folder: Path) -> dict:
    """Render two halves with the cheaper stock integrator, and their unscattered part."""
    candidates = ("volpath", "volpathmis") if case.is_chromatic else ("volpath",)
    pilots = {name: pilot(load(case, name, folder, rr_depth=50)) for name in candidates}
    judge = min(pilots, key=lambda name: pilots[name][0] * pilots[name][1])
    variance, each, mean = pilots[judge]
    wanted = variance / max(PIXEL_NOISE * mean, 1e-12) ** 2  # samples of a half
    affordable = seconds / 2 / each
    samples = float(np.clip(min(wanted, affordable), PILOT_SPP, 2**20))
    count = int(np.ceil(samples / LARGEST_SPP))
    spp = int(np.ceil(samples / count))
    scene = load(case, judge, folder, rr_depth=50)
    a, b = (
        np.mean([picture(scene, spp, 1000 + 2 * i + half) for i in range(count)], axis=0)
        for half in range(2)
    )
    unscattered = picture(load(case, judge, folder, max_depth=1), 256, 7)
    return {"a": a, "b": b, "unscattered": unscattered, "judge": judge, "spp": 2 * spp * count}


def stored_reference(case: RandomScene, seconds: float, folder: Path) -> dict:
    """Return `reference_of`, from its file if that is of the same scene and ``seconds``."""
    file, drawn = folder / f"{case.seed}-{case.index}-reference.npz", json.dumps(case.as_dict())
    if file.exists():
        with np.load(file) as stored:
            if str(stored["drawn"]) == drawn and stored["seconds"] >= seconds:
                found = {name: stored[name] for name in ("a", "b", "unscattered")}
                return found | {"judge": str(stored["judge"]), "spp": int(stored["spp"])}
    found = reference_of(case, seconds, folder)
    np.savez_compressed(file, drawn=drawn, seconds=seconds, **found)
    return found


def pilot(scene: mi.Scene) -> tuple[float, float, float]:
    """Return the variance of a sample, averaged over pixels, its seconds, and the mean radiance."""
    picture(scene, 1, 0)  # compiles kernels
    dr.sync_thread()
    started = time.perf_counter()
    images = [picture(scene, PILOT_SPP, seed) for seed in range(1, 1 + PILOTS)]
    each = (time.perf_counter() - started) / (PILOTS * PILOT_SPP)
    return float(np.var(images, axis=0, ddof=1).mean()) * PILOT_SPP, each, float(np.mean(images))


def compare(a, b, unscattered, x, y) -> dict:
    """Return the errors of images ``x`` and ``y`` with separate caches against ``a`` and ``b``.

    They are in units of the mean of the reference, whose ratio to the mean radiance of the volume
    is returned, too. Channels of a pixel share their paths and count as one for standard errors.
    """
    r = 0.5 * (a + b)
    mean = r.mean()
    volume = mean - unscattered.mean()
    found = {"mean": float(mean), "volume": float(volume), "finite": bool(np.isfinite(x + y).all())}
    if not found["finite"] or mean <= 0:
        return found | {"dark_difference": float(np.abs(np.nan_to_num(x) - r).max())}
    grey = 0.25 * ((a - b).mean(axis=-1) ** 2)  # variance of the reference's grey pixels
    own = 0.5 * (x - y).mean(axis=-1) ** 2  # likewise of an image of ours, camera and cache
    found["noise"] = float(np.sqrt(grey.mean() / grey.size) / mean)
    # One sample of the difference of two means, each with noise of its own.
    found["own_noise"] = float(abs(x.mean() - y.mean()) / 2**0.5 / mean)
    blocks, block_noise = (
        [],
        np.sqrt((block_means((grey + own)[..., None], BLOCK)[..., 0]) / BLOCK**2),
    )
    floor = np.sqrt((grey + own).mean()) / BLOCK  # of pixels without a sample that hit anything
    block_noise = np.maximum(block_noise, floor)
    for name, image in (("x", x), ("y", y)):
        signed = block_means((image - r).mean(axis=-1)[..., None], BLOCK)[..., 0]
        blocks.append(signed)
        found[name] = {
            "mean": float((image - r).mean() / mean),
            "rmse": float(net_rmse(image, a, b) / mean),
        }
    shared = ((x - a) * (y - b)).mean(axis=-1)
    found["bias"] = _root(shared.mean() / mean**2)
    found["bias_at_least"] = _root(
        (shared.mean() - SIGMAS["bias"] * shared.std() / shared.size**0.5) / mean**2
    )
    # The block with the largest significance in both.
    least = np.where(np.sign(blocks[0]) == np.sign(blocks[1]), np.abs(blocks).min(axis=0), 0)
    significant = least > SIGMAS["block"] * block_noise
    worst = np.unravel_index(np.argmax(np.where(significant, least, 0) + 1e-9 * least), least.shape)
    local = block_means(r.mean(axis=-1)[..., None], BLOCK)[..., 0][worst]
    found["block"] = {
        "at": [int(n) * BLOCK for n in worst],
        "error": float(blocks[0][worst] / mean),
        "noise": float(block_noise[worst] / mean),
        "of_itself": float(blocks[0][worst] / local) if local > 0 else None,
    }
    return found


def _root(value: float) -> float:
    """Return the square root with the sign of the argument."""
    return float(np.copysign(np.sqrt(abs(value)), value))


def verdict(row: dict) -> str:
    """Return whether a scene agrees, is refused or undecided, or how it disagrees."""
    if "failed" in row:
        return "refused" if row["refused"] else "ERROR"
    if not row["finite"]:
        return "NOT FINITE"
    if "x" not in row:
        # No path reached an emitter.
        return "agrees" if row["dark_difference"] == 0 else "undecided"
    found = []
    volume = row["volume"] / row["mean"]
    for suffix, unit in (("", 1.0), (" of volume", volume)):
        if suffix and not 0.01 < unit < 0.95:
            continue
        mean = min((row[k]["mean"] for k in "xy"), key=abs)
        if abs(mean) > max(LIMITS["mean"] * unit, SIGMAS["mean"] * total_noise(row)):
            found.append(f"mean{suffix}")
        if row["bias_at_least"] > LIMITS["bias"] * unit:
            found.append(f"RMSE{suffix}")
        block = row["block"]
        if abs(block["error"]) > max(LIMITS["block"] * unit, SIGMAS["block"] * block["noise"]):
            found.append(f"block{suffix}")
    if found:
        kinds = [f for f in found if f.removesuffix(" of volume") == f or f.split()[0] not in found]
        return "DISAGREES: " + ", ".join(kinds)
    if total_noise(row) > MEAN_NOISE:
        return "undecided"
    if volume > 0.01 and total_noise(row) > MEAN_NOISE * volume:
        return "agrees, volume undecided"
    return "agrees"


def total_noise(row: dict) -> float:
    """Return the standard error of the difference of the means, without the bias of our image."""
    return float(np.hypot(row["noise"], row["own_noise"]))


def line(key: str, row: dict) -> list[str]:
    """Return the cells of a table row."""
    if "failed" in row:
        kind = "" if row["refused"] else f"{row['kind']}: "
        return [key, verdict(row), "-", "-", "-", "-", "-", "-", kind + row["failed"][:150]]
    if "x" not in row:
        return [key, verdict(row), row["solver"], *["-"] * 4, f"{row['seconds']:.1f}", row["about"]]
    unit = row["mean"] / row["volume"] if row["volume"] > 0.01 * row["mean"] else float("nan")

    def both(value: float, form: str = "+.2f") -> str:
        of_volume = f"{100 * value * unit:{form}}" if np.isfinite(unit) else "-"
        return f"{100 * value:{form}} ({of_volume})"

    block = row["block"]
    return [
        key, verdict(row), row["solver"],
        f"{both(row['x']['mean'])} +- {100 * total_noise(row):.2f}",
        both(row["x"]["rmse"], ".2f"),
        f"{both(row['bias'], '.2f')} > {100 * max(row['bias_at_least'], 0):.2f}",
        f"{both(block['error'], '+.1f')} +- {100 * block['noise']:.1f}",
        f"{row['seconds']:.1f}", row["about"],
    ]  # fmt: skip


def table(rows: dict[str, dict], title: str) -> Table:
    """Tabulate errors in % of the mean."""
    head = [
        "scene",
        "verdict",
        "solver",
        "mean % (of volume)",
        "RMSE %",
        "of it bias",
        "worst block %",
    ]
    return Table(title, [*head, "cold s", "about"], [line(k, row) for k, row in rows.items()])


def is_outdated(row: dict | None, case: RandomScene, seconds: float) -> bool:
    """Return whether a row is of another version of its scene, or undecided with less time."""
    if row is None or row["drawn"] != json.loads(json.dumps(case.as_dict())):
        return True
    return verdict(row) == "undecided" and row["seconds_granted"] < seconds


def main() -> None:
    """Compute missing rows within the budget."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=60, help="scenes")
    parser.add_argument("--seed", type=int, default=1, help="of the scenes")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of scenes")
    parser.add_argument("--seconds", type=float, default=12, help="of a reference")
    parser.add_argument("--budget", type=float, default=480, help="no scene is begun later")
    add_document(parser)
    args = parser.parse_args()
    begin()
    folder = args.output / "random_scenes"
    folder.mkdir(parents=True, exist_ok=True)
    store, started = Store(folder / f"{args.seed}.json"), time.perf_counter()
    numbers = range(args.count) if args.only is None else args.only
    for number in numbers:
        key, case = str(number), RandomScene.draw(args.seed, number)
        if args.force or is_outdated(store.rows.get(key), case, args.seconds):
            store.rows.pop(key, None)
        if key not in store.rows and time.perf_counter() - started > args.budget:
            print(f"{number}: not computed yet; run again")
            continue
        row = store.row(key, partial(compute, case, args.seconds, folder))
        print(" | ".join(line(key, row)), flush=True)
    rows = {str(n): store.rows[str(n)] for n in numbers if str(n) in store.rows}
    wrong = {
        k: row for k, row in rows.items() if not verdict(row).startswith(("agrees", "refused"))
    }
    print(f"\n{table(rows, 'Random scenes').as_text()}")
    print(f"\n{table(wrong, 'Scenes that do not agree').as_text()}")
    counts = counts_of(rows)
    print("\n" + ", ".join(f"{word}: {count}" for word, count in counts.items()))
    if args.document:
        replace_tables(args.document, {"random-scenes": short_table(rows, wrong)})


def counts_of(rows: dict[str, dict]) -> dict[str, int]:
    """Return the number of scenes with each verdict."""
    words = [verdict(row).partition(":")[0].partition(",")[0] for row in rows.values()]
    return {word: words.count(word) for word in sorted(set(words))}


def short_table(rows: dict[str, dict], wrong: dict[str, dict]) -> Table:
    """Tabulate the counts, and the errors [%] of the scenes that do not agree."""
    body = [["all", f"{count} {word}", "", "", ""] for word, count in counts_of(rows).items()]
    for key, row in wrong.items():
        cells = line(key, row)
        means, block = (cells[column].split(" (")[0] for column in (3, 6))
        noises = [cells[column].partition("+- ")[2] for column in (3, 6)]
        errors = [f"{v} ({n})" for v, n in zip((means, block), noises, strict=True)]
        body.append([key, cells[1], *errors, cells[8]])
    return Table("", ["scene", "verdict", "mean [%]", "worst block [%]", "about"], body)


if __name__ == "__main__":
    main()
