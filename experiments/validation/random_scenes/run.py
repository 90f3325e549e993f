"""Random scenes against volpath, at default settings.

    python -m experiments.validation.random_scenes.run [--count 20] [--seeds 301 302 303]
        [--only K ...] [--seconds 60] [--budget 480] [--force] [--document FILE]

Each scene (see generate.py) is loaded by `mi.load_dict`, with the integrator ``irrcache`` at
default settings except ``max_depth`` and ``hide_emitters``, and rendered with two values of
``cache_seed``, which separates the noise of the cache from its bias; with up to six where two do
not determine the mean. The reference (see references.py) is rendered by volpath (volpathmis where
the extinction is chromatic) in independent batches until the standard error of the mean radiance is
a quarter of a percent, for at most ``--seconds`` of processor time. A scene whose difference of
means has a standard error above a third of a percent counts as undecided; the table marks scenes
for which only the mean of the volume alone is uncertain.

The table has the difference of the means; the RMSE, net of the reference's noise, by
mean((x - a)(x - b)); its bias, by mean((x - a)(y - b)), with a lower bound of three standard
errors; the largest error of a block of 6 x 6 pixels. All in % of the mean radiance of the image
and, in brackets, of that of the volume alone: of the image without the
unscattered radiance (volpath at depth 1). A scene *disagrees* if one of these, in both
renderings, is beyond three standard errors (4.5 for the worst block) and beyond LIMITS.

Rows are stored in output/random_scenes/<seed>.json, images and references as .npz files;
``--force`` discards the rows and renders with irrcache again, against the stored references.
``--document`` writes the table to a Markdown file. No scene is started after ``--budget`` seconds:
run it again for the others, and with more ``--seconds`` for those that are undecided, whose
references are refined.
"""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path

import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from experiments.validation.random_scenes.generate import RandomScene
from experiments.validation.random_scenes.references import MEAN_NOISE, load, picture, reference
from mitsuba_irrcache.compare.metrics import block_means, net_rmse
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError, origin, original_message

#: Samples per pixel of an image by irrcache.
SPP = 256
BLOCK = 6
#: Most caches for the mean of a scene, and the standard error that two suffice for.
CACHES, OWN_NOISE = 6, 0.002
#: Thresholds of errors in units of the mean, and in standard errors.
LIMITS = {"mean": 0.01, "bias": 0.01, "block": 0.03}
SIGMAS = {"mean": 3.0, "bias": 3.0, "block": 4.5}


def compute(case: RandomScene, seconds: float, folder: Path) -> dict:
    """Measure a scene."""
    row = {"about": case.describe(), "drawn": case.as_dict(), "seconds_granted": seconds}
    ours = ours_of(case, folder)
    if "failed" in ours:
        return row | ours
    known = reference(case, seconds, folder)
    a, b = known.halves()
    images = {"a": a, "b": b, "unscattered": known.unscattered}
    images |= {name: ours.pop(name) for name in ("x", "y")}
    np.savez_compressed(folder / f"{case.seed}-{case.index}.npz", **images)
    judged = {"judge": known.judge, "rr_depth": known.rr_depth, "judge_seconds": known.seconds}
    row |= ours | judged | {"spp": known.spp * len(known.means)} | compare(**images)
    if "x" in row:
        row["noise"] = known.noise
        row |= mean_over_caches(case, folder, row, float(0.5 * (a + b).mean()))
    return row


def mean_over_caches(case: RandomScene, folder: Path, row: dict, mean: float) -> dict:
    """Return the error of the mean image with several caches, and its standard error.

    Two caches suffice unless they differ or disagree with the reference.
    """
    errors = [row["x"]["mean"], row["y"]["mean"]]

    def noise() -> float:
        return float(np.std(errors, ddof=1) / len(errors) ** 0.5)

    def is_clear() -> bool:
        return noise() <= OWN_NOISE and abs(np.mean(errors)) <= LIMITS["mean"]

    while len(errors) < CACHES and not is_clear():
        seed = len(errors)
        image = picture(load(case, "irrcache", folder, cache_seed=seed), SPP, seed)
        errors.append(float(image.mean() / mean - 1))
    return {"error": float(np.mean(errors)), "own_noise": noise(), "caches": len(errors)}


def ours_of(case: RandomScene, folder: Path) -> dict:
    """Return images with two seeds, the solver, and the CPU seconds of the first image.

    If there are none, ``refused`` says whether irrcache refused the scene with a message.
    """
    found: dict = {}
    try:
        for name, seed in (("x", 0), ("y", 1)):
            started = time.process_time()
            scene = load(case, "irrcache", folder, **({"cache_seed": seed} if seed else {}))
            found[name] = picture(scene, SPP, seed)
            found.setdefault("seconds", time.process_time() - started)
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
    # Standard errors of the mean image: by the cache, common to all pixels, and by camera samples.
    common, each = abs((x - y).mean()) / 2, np.sqrt(own.mean() / own.size / 2)
    found["own_noise"] = float(max(common, each) / mean)
    found["error"] = float((0.5 * (x + y) - r).mean() / mean)
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
        if abs(row["error"]) > max(LIMITS["mean"] * unit, SIGMAS["mean"] * total_noise(row)):
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
        f"{both(row['error'])} +- {100 * total_noise(row):.2f}",
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
    parser.add_argument("--count", type=int, default=20, help="scenes of each seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302, 303])
    parser.add_argument("--only", type=int, nargs="+", help="numbers of scenes")
    parser.add_argument("--seconds", type=float, default=60, help="of a reference")
    parser.add_argument("--budget", type=float, default=480, help="no scene is begun later")
    add_document(parser)
    args = parser.parse_args()
    begin()
    folder = args.output / "random_scenes"
    folder.mkdir(parents=True, exist_ok=True)
    started, rows = time.perf_counter(), {}
    for seed in args.seeds:
        store = Store(folder / f"{seed}.json")
        for number in range(args.count) if args.only is None else args.only:
            key, case = str(number), RandomScene.draw(seed, number)
            if args.force or is_outdated(store.rows.get(key), case, args.seconds):
                store.rows.pop(key, None)
            if key not in store.rows and time.perf_counter() - started > args.budget:
                print(f"{seed}:{number}: not computed yet; run again")
                continue
            row = store.row(key, partial(compute, case, args.seconds, folder))
            rows[f"{seed}:{number}"] = row
            print(" | ".join(line(f"{seed}:{number}", row)), flush=True)
    wrong = {
        k: row for k, row in rows.items() if not verdict(row).startswith(("agrees", "refused"))
    }
    print(f"\n{table(rows, 'Random scenes').as_text()}")
    print(f"\n{table(wrong, 'Scenes that do not agree').as_text()}")
    counts = counts_of(rows)
    print("\n" + ", ".join(f"{word}: {count}" for word, count in counts.items()))
    if args.document:
        replace_tables(args.document, {"random-scenes": short_table(rows)})


def counts_of(rows: dict[str, dict]) -> dict[str, int]:
    """Return the number of scenes with each verdict."""
    words = [verdict(row).partition(":")[0].partition(",")[0] for row in rows.values()]
    return {word: words.count(word) for word in sorted(set(words))}


def short_table(rows: dict[str, dict]) -> Table:
    """Tabulate the counts, and the errors [%] of all scenes."""
    body = [["all", f"{count} {word}", "", "", ""] for word, count in counts_of(rows).items()]
    for key, row in rows.items():
        cells = line(key, row)
        means, block = (cells[column].split(" (")[0] for column in (3, 6))
        noises = [cells[column].partition("+- ")[2] for column in (3, 6)]
        errors = [f"{v} ({n})" if n else v for v, n in zip((means, block), noises, strict=True)]
        body.append([key, cells[1], *errors, cells[8]])
    return Table("", ["scene", "verdict", "mean [%]", "worst block [%]", "about"], body)


if __name__ == "__main__":
    main()
