"""A real volume from views of it, with this integrator and with ``prbvolpath``, at equal CPU time.

    python -m experiments.validation.gradients.optimise [--volume cloud head] [--voxels 32]
        [--views 8] [--pixels 64] [--budgets 10,100] [--document docs/validation.md]

`fit` fits the extinction of the Disney cloud and of a CT head under a sky and a sun, from a uniform
start: the same optimiser, loss and bounds for both integrators. ``prbvolpath`` is tuned over step
size, camera samples, and number of views in a step: all of its settings run for the shorter of the
last two budgets, and the best two for all of them. Errors are those of views that are not fitted,
relative to their mean. Images to fit are by ``volpath``. Results are stored after each
run, and an interrupted experiment continues. One thread is used,
and budgets exclude the compilation of kernels.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from experiments.validation.gradients.real_volumes import VOLUMES, Subject, Truth
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.gradients.fit import fit
from mitsuba_irrcache.gradients.fit_state import Result, Settings, View

#: Samples of each pixel of the images to fit.
SPP = 1024
#: Steps from which the CPU time of a step is estimated, and steps before them.
PILOT, FIRST = 7, 2
#: The table of the documents for each number of voxels along a side.
TABLES = {32: "optimisation-32", 64: "optimisation-64"}
#: Ratio of the CPU time to the budget at which Adam is stopped: steps take longer as a medium
#: becomes denser, without limit where noise of the gradients does that.
LONGEST = 2.0
#: Largest number of iterations of L-BFGS, which ends with the last budget.
MANY = 10_000


@dataclass(frozen=True)
class Method:
    """An integrator with its properties, and the settings of `fit`."""

    integrator: str
    settings: Settings

    @property
    def label(self) -> str:
        """Integrator and optimiser."""
        return f"{self.integrator}, {self.settings.method}"

    @property
    def details(self) -> str:
        """The settings over which methods are tuned."""
        own = self.settings
        views = f"{own.views} views" if own.views else "all views"
        rate = f", rate {own.rate:g}" if own.method == "adam" else ""
        return f"{own.spp} spp, {views}{rate}"

    def properties(self, voxels: int) -> dict:
        """The integrator for so many ``voxels`` along a side."""
        own = {"type": self.integrator}
        if self.integrator == "irrcache":
            own |= {"solver": "sweep", "resolution": voxels}
        return own


def methods() -> list[Method]:
    """All methods with all settings."""
    adam = Settings(method="adam")
    prb = [
        replace(adam, spp=spp, views=views, rate=rate)
        for spp, views, rates in (
            (4, 1, (0.1, 0.3)),
            (16, 1, (0.1, 0.3)),
            (64, 1, (0.3,)),
            (16, 4, (0.3,)),
        )
        for rate in rates
    ]
    own = [replace(adam, rate=0.3)]
    own += [Settings(method="lbfgs"), Settings(method="lbfgs", spp=1)]
    return [Method("prbvolpath", s) for s in prb] + [Method("irrcache", s) for s in own]


def main() -> None:
    """Run all methods, print the table, and write images."""
    parser = parser_of(__doc__)
    parser.add_argument("--volume", nargs="*", choices=[*VOLUMES], default=[*VOLUMES])
    parser.add_argument("--voxels", type=int, default=32)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--budgets", type=_numbers, default=(10.0, 100.0), help="CPU times [s]")
    parser.add_argument("--methods", default="", help="part of the names of methods to run")
    add_document(parser)
    options = parser.parse_args()
    if options.document and options.voxels not in TABLES:
        parser.error(f"the documents have tables for {sorted(TABLES)} voxels, not {options.voxels}")
    begin()
    mi.set_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    # Threads of Dr.Jit that wait for others use CPU time.
    dr.set_thread_count(1)
    folder = options.output / "optimise"
    folder.mkdir(parents=True, exist_ok=True)
    store, rows = Store(folder / "results.json", options.force), []
    for name in options.volume:
        subject = Subject(name, options.voxels, options.views, options.pixels)
        if not subject.is_available:
            print(f"{name}: no data")
            continue
        comparison = Comparison(subject, folder, store, options.budgets)
        rows += comparison.rows([m for m in methods() if options.methods in m.label])
    size = f"{options.voxels}^3 voxels, {options.views} views of {options.pixels}^2 pixels"
    head = ["volume", "method", "settings", *(f"{b:g} CPU s" for b in options.budgets)]
    note = (
        f"{size}. Errors of 2 views that are not fitted, relative to their mean, and in brackets "
        "the actual CPU time. All settings of a method run for the second-last budget, the best "
        "for all."
    )
    table = Table("Volumes from views at equal CPU time", head, rows, note)
    print(table.as_text())
    if options.document:
        replace_tables(options.document, {TABLES[options.voxels]: table})


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(sorted(float(part) for part in text.split(",")))


class Comparison:
    """All methods for one subject."""

    def __init__(
        self, subject: Subject, folder: Path, store: Store, budgets: tuple[float, ...]
    ) -> None:
        self._subject, self._folder, self._store = subject, folder, store
        self._budgets = budgets
        self._truth = Truth.of(subject, SPP, folder)
        self._views = [
            View(sensor, image)
            for sensor, image in zip(subject.sensors(), self._truth.images, strict=False)
        ]

    def rows(self, chosen: list[Method]) -> list[list[str]]:
        """Run the methods, and return the rows of the table: the tuned ones first."""
        tuning, found = self._budgets[-2:][0], []
        for label in dict.fromkeys(method.label for method in chosen):
            own = [method for method in chosen if method.label == label]
            errors = [self._result(method, tuning)["error"] for method in own]
            for place in np.argsort(errors)[:1]:
                cells = [self._cell(own[place], budget) for budget in self._budgets]
                found.append([self._subject.name, label, own[place].details, *cells])
                print("  ".join(found[-1]), flush=True)
            for place in np.argsort(errors)[1:]:
                keys = [self._key(own[place], budget) for budget in self._budgets]
                cells = [
                    self._cell(own[place], budget) if key in self._store.rows else ""
                    for key, budget in zip(keys, self._budgets, strict=True)
                ]
                found.append([self._subject.name, label, own[place].details, *cells])
        return found

    def _cell(self, method: Method, budget: float) -> str:
        row = self._result(method, budget)
        return f"{row['error']:.2%} ({row['seconds']:.0f} s)"

    def _result(self, method: Method, budget: float) -> dict:
        """Return the stored result of a method after a CPU time; compute it if it is missing."""
        key = self._key(method, budget)
        if key not in self._store.rows:
            for each, values in self._after_budgets(method, budget).items():
                own = self._key(method, each)
                self._store.row(own, lambda v=values, m=method: self._measured(m, *v))
        return self._store.rows[key]

    def _key(self, method: Method, budget: float) -> str:
        return f"{self._subject.label}; {method.label}; {asdict(method.settings)}; {budget:g} s"

    def _measured(self, method: Method, seconds: float, steps: int, values: np.ndarray) -> dict:
        """Return the row of a result, and write images of the unseen views beside the truth."""
        error, images = self._truth.error(values)
        density = self._subject.sigma_t()
        difference = np.sqrt(np.mean(np.square(values - density))) / density.mean()
        truth = np.concatenate(self._truth.unseen, axis=1)
        both = np.concatenate([truth, np.concatenate(images, axis=1)])
        name = f"{self._subject.label} {method.label} {method.details} {seconds:.0f} s"
        file = self._folder / (name.replace(" ", "_").replace(",", "") + ".png")
        mi.util.write_bitmap(str(file), mi.Bitmap(both.astype(np.float32)))
        row = {"error": error, "extinction": float(difference), "seconds": seconds, "steps": steps}
        print(f"{name}: {error:.2%}, extinction {difference:.2f}, {steps} steps", flush=True)
        return row

    def _after_budgets(self, method: Method, budget: float) -> dict:
        """Return CPU time, number of steps and extinction after budgets: for Adam, whose step size
        falls towards the end of a run, after the one given, and for L-BFGS after all.
        """
        settings = method.settings
        self._run(method, replace(settings, steps=FIRST))
        if settings.method == "lbfgs":
            history, last = [], self._budgets[-1]

            def report(seconds: float, result: Result) -> None:
                history.append((seconds, result.step, result.values["sigma_t"]))
                if seconds > last:
                    raise BudgetSpentError

            self._run(method, replace(settings, steps=MANY), report)
            return {b: [h for h in history if h[0] <= b][-1] for b in self._budgets}
        seconds, _ = self._run(method, replace(settings, steps=PILOT))
        steps = max(round(budget / seconds * PILOT), 2)

        def stop(seconds: float, _: Result) -> None:
            if seconds > LONGEST * budget:
                raise BudgetSpentError

        seconds, values = self._run(method, replace(settings, steps=steps), stop)
        return {budget: (seconds, steps, values)}

    def _run(
        self, method: Method, settings: Settings, report: object = None
    ) -> tuple[float, np.ndarray]:
        """Return the CPU time of a fit, and the extinction that it finds."""
        scene, begun = self._subject.start(method.properties(self._subject.voxels)), process_time()
        last: list[np.ndarray] = []

        def done(result: Result) -> None:
            last[:] = [result.values["sigma_t"]]
            if report is not None:
                report(process_time() - begun, result)

        try:
            fit(scene, self._views, ["sigma_t"], settings, report=done)
        except BudgetSpentError:
            pass
        return process_time() - begun, last[0]


class BudgetSpentError(Exception):
    """A run has used its CPU time."""


if __name__ == "__main__":
    main()
