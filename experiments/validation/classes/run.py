"""Ten further cases of each class of wrong images that tests from outside have found.

    python -m experiments.validation.classes.run [--only TEXT] [--budget 900] [--force] [-o output]
        [--document FILE]

Classes (see cases.py), all with default settings except small caches where images are compared
exactly:

- edits: images after `params.update()`, one edit after the other, equal those of new scenes (a
  difference of rounding is stated);
- lamps, grids, and objects: emitters close to few dense voxels, default resolutions of few or thick
  voxels, and objects that cut the faces of homogeneous media at odd angles, against volpath, as in
  experiments/validation/random_scenes: a difference of means beyond three standard errors and 1 %,
  or of a block of 6 x 6 pixels beyond 4.5 standard errors and 3 % of the mean, is a disagreement;
- threads: four threads that render a new scene get the image of one thread;
- scenes that are accepted agree with volpath, others are refused with a message that names the
  object; a file of a cache does not serve a scene with other normals.

Rows and references are saved in output/classes; ``--document`` writes all rows into a marked table.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Barrier
from time import process_time

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.case_rows import CaseRows, with_budget
from experiments.validation.classes import cases
from experiments.validation.random_scenes.references import PIXELS, Reference, picture, pilot
from experiments.validation.random_scenes.run import compare, total_noise, verdict
from experiments.validation.thick.cases import scene
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError, origin, original_message

SPP, THREADS = 256, 4
#: Most CPU seconds of a reference.
SECONDS = 30.0
#: Differences below this, in units of the mean, are those of single precision.
ROUNDING = 1e-6
#: Caches of images that are compared exactly.
SMALL = {"resolution": 8, "cache_spp": 32}


def loaded(objects: dict, pixels: int = 12, wrapper: dict | None = None, **settings) -> mi.Scene:
    """Load a scene with the integrator ``irrcache``, alone in the process.

    With a ``wrapper`` it has a film for each thread: in several threads that share one, Mitsuba's
    `aov` aborts with its own integrators, too. (Mitsuba would share one between equal films.)
    """
    gc.collect()
    integrator = {"type": "irrcache"} | settings
    if not wrapper:
        return mi.load_dict(scene(objects, integrator, pixels))
    sensors = {f"sensor{i}": scene({}, {}, pixels + i)["sensor"] for i in range(1, THREADS)}
    return mi.load_dict(scene(objects | sensors, wrapper | {"inner": integrator}, pixels))


def image(made: mi.Scene, **options) -> np.ndarray:
    """Render few samples."""
    return np.array(mi.render(made, spp=4, **options))


def edits() -> dict[str, dict]:
    """Return a row for each edit."""
    made = loaded(cases.yard(), **SMALL)
    params, images = mi.traverse(made), [image(made)]
    for key, value, _ in cases.EDITS.values():
        params[key] = value()
        params.update()
        images.append(image(made))
    del made, params
    rows = {}
    for count, title in enumerate(cases.EDITS, 1):
        new = new_scene(count)
        expected, before = image(new), images[count - 1]
        del new
        changed = float(np.abs(images[count] - before).mean() / before.mean())
        apart = float(np.abs(images[count] - expected).max() / expected.mean())
        same = (
            "equal" if not apart else f"equal to {apart:.1g}" if apart < ROUNDING else "NOT EQUAL"
        )
        rows[title] = {
            "passed": apart < ROUNDING < changed,
            "figure": f"{same}; the edit changes pixels by {100 * changed:.1f} %",
        }
    return rows


def new_scene(count: int) -> mi.Scene:
    """Load the scene after this many edits."""
    objects, assigned = cases.yard(), {}
    for key, value, describe in list(cases.EDITS.values())[:count]:
        if describe is None:
            assigned[key] = value()
        else:
            describe(objects)
    made = loaded(objects, **SMALL)
    params = mi.traverse(made)
    for key, value in assigned.items():
        params[key] = value
    if assigned:
        params.update()
    return made


def against_volpath(objects: dict, depth: int, file: Path) -> dict:
    """Return a row of the comparison with volpath, or of the message if irrcache refuses."""
    try:
        return _compared(objects, depth, file)
    except Exception as error:  # any exception that a user would see
        return {"passed": False, "figure": f"ERROR: {original_message(error)[:100]}"}


def _compared(objects: dict, depth: int, file: Path) -> dict:
    images, seconds = [], process_time()
    for seed in (0, 1):
        made = loaded(objects, PIXELS, max_depth=depth, cache_seed=seed)
        images.append(picture(made, SPP, seed))
    seconds = (process_time() - seconds) / 2
    del made
    settings = {"type": "volpath", "max_depth": depth, "rr_depth": 50}
    stock = mi.load_dict(scene(_enlarged(objects), settings, PIXELS))
    found = Reference.read(file, "")
    if found is None:
        _, each, _ = pilot(stock)
        found = Reference("volpath", 50, int(np.clip(0.3 / each, 16, 2048)))
    found.refine(stock, SECONDS)
    found.save(file, "")
    a, b = found.halves()
    row = compare(a, b, np.zeros_like(a), *images) | {"noise": found.noise, "solver": ""}
    block = row["block"]
    figure = (
        f"{verdict(row)}: mean {100 * row['error']:+.2f} ({100 * total_noise(row):.2f}) %, "
        f"block {100 * block['error']:+.1f} ({100 * block['noise']:.1f}) %, {seconds:.0f} s"
    )
    return {"passed": verdict(row) == "agrees", "figure": figure}


def _enlarged(objects: dict) -> dict:
    """Enlarge the boundaries of grids for volpath, whose rays are offset there, into matter."""
    box = objects.get("box")
    if box is None:
        return objects
    return objects | {"box": box | {"to_world": box["to_world"].scale(1.002)}}


def threads(wrapper: dict | None, settings: dict, objects: dict) -> dict:
    """Return a row that compares threads with one."""
    chosen = SMALL | settings
    alone = loaded(objects, 8, wrapper, **chosen)
    sensors = range(THREADS) if wrapper else [0] * THREADS
    expected = [image(alone, seed=seed, sensor=i) for seed, i in enumerate(sensors)]
    del alone
    made, barrier = loaded(objects, 8, wrapper, **chosen), Barrier(THREADS)

    def begin(seed: int) -> np.ndarray:
        mi.set_variant("llvm_ad_rgb")
        barrier.wait()
        return image(made, seed=seed, sensor=sensors[seed])

    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(begin, range(THREADS)))
    apart = [float(np.abs(x - y).max()) for x, y in zip(found, expected, strict=True)]
    figure = "equal" if not any(apart) else f"NOT EQUAL, by up to {max(apart):.2g}"
    return {"passed": not any(apart), "figure": figure}


def refusal(objects: dict, message: str) -> dict:
    """Return a row of a scene that is to be refused."""
    try:
        image(loaded(objects, 4, **SMALL))
    except Exception as error:  # any exception that a user would see
        said = original_message(error)
        known = isinstance(origin(error), IrrcacheError)
        passed = bool(known and re.search(message, said, re.DOTALL))
        return {"passed": passed, "figure": f"{'refused' if passed else 'ERROR'}: {said[:100]}"}
    return {"passed": False, "figure": "ACCEPTED"}


def one_file(first: dict, second: dict, file: Path) -> dict:
    """Return a row of two scenes that name one file."""
    expected = image(loaded(second, **SMALL))
    file.unlink(missing_ok=True)
    image(loaded(first, cache_file=str(file), **SMALL))
    try:
        found = image(loaded(second, cache_file=str(file), **SMALL))
    except Exception as error:  # any exception that a user would see
        said = original_message(error).replace(str(file), file.name)[:100]
        return {"passed": isinstance(origin(error), IrrcacheError), "figure": f"refused: {said}"}
    same = np.array_equal(found, expected)
    return {"passed": same, "figure": "another cache" if same else "THE CACHE OF THE OTHER"}


def titled(rows: CaseRows) -> Iterator[tuple[str, Callable[[], dict]]]:
    """Yield titles of cases, and the functions that measure them."""
    known: dict[str, dict] = {}

    def edit(title: str) -> dict:
        if not known:
            known.update(edits())
        return known[title]

    for title in cases.EDITS:
        yield f"edits: {title}", partial(edit, title)
    agreeing = {f"scenes: {title}": build for title, build in cases.ACCEPTED.items()}
    agreeing |= {f"lamps: {t}": lambda c=c: c for t, c in cases.near_lights().items()}
    agreeing |= {f"grids: {t}": lambda c=c: c for t, c in cases.coarse_grids().items()}
    agreeing |= {f"objects: {t}": lambda c=c: c for t, c in cases.cutting_objects().items()}
    for title, case in cases.shared().items():
        yield f"threads: {title}", partial(threads, *case)
    for title, (build, message) in cases.REFUSED.items():
        yield f"scenes: {title}", lambda b=build, m=message: refusal(b(rows.folder), m)
    for title, (first, second) in cases.FILES.items():
        yield (
            f"scenes: {title}",
            lambda a=first, b=second: one_file(a(), b(), rows.folder / "cache.npz"),
        )
    for title, build in agreeing.items():
        file = rows.file(title).with_suffix(".npz")
        yield title, lambda b=build, f=file: against_volpath(*b(), f)


def run() -> None:
    """Compute missing rows and print the table."""
    rows = CaseRows(__doc__, "classes", with_budget(900))
    body = []
    for (title, _), row in rows.rows(
        ((title, (title, measure)) for title, measure in titled(rows)),
        lambda case: case[1](),
        lambda title, _, row: f"{'  ' if row['passed'] else '! '}{title:75} {row['figure']}",
    ):
        kind, _, name = title.partition(": ")
        body.append([kind, name, row["figure"]])
    body.sort(key=lambda row: row[0])
    rows.write({"classes": Table("", ["class", "case", "result"], body)})


if __name__ == "__main__":
    run()
