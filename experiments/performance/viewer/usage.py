"""Random usage of the viewer: ``python -m experiments.performance.viewer.usage --seconds 280
--seed 0 SCENE``.

A browser drags, zooms, edits, saves, reloads, compares, and opens and closes further windows, at
random from a seed. Records the memory of the viewer, second by second, the actions, and the errors:
tracebacks in its log, errors in the browsers' consoles. Memory depends on the number of windows and
on what they do, and on the transfer function, which determines the voxels of the cache; hence it is
also measured after each quarter of the time with a single window that shows a final image of the
same matter.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.performance.viewer.browser import Browser, Window, viewer
from experiments.performance.viewer.load import viewer_memory
from mitsuba_irrcache.view.comparison import KINDS as COMPARISONS
from mitsuba_irrcache.view.picture import KINDS
from mitsuba_irrcache.view.session import IDLE_SECONDS, TARGET_ERROR
from mitsuba_irrcache.view.slice_panel import ALL, AXES, NONE, THIS

#: Maximum number of windows.
MOST_WINDOWS = 3
SIZE = (800, 400)
PRESETS = ("ct-bone", "ct-chest")
#: Target error [%] of windows at rest, which dense media reach within seconds, and seconds until
#: the memory of a final image has been released.
REST_TARGET, REST = 50, 1.2 * IDLE_SECONDS


@dataclass
class Usage:
    """The results: ``memory`` as (seconds, MB), ``at_rest`` likewise, with a single window at rest,
    and ``done`` with counts by name.
    """

    memory: list[tuple[float, float]] = field(default_factory=list)
    at_rest: list[tuple[float, float]] = field(default_factory=list)
    done: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    pictures: int = 0

    @property
    def growth(self) -> float:
        """Return the growth in MB of ``at_rest`` after the first quarter, which includes
        initialisations.
        """
        return self.at_rest[-1][1] - self.at_rest[0][1]


class User:
    """Interact with an open viewer at random."""

    def __init__(self, browser: Browser, address: str, rng: np.random.Generator) -> None:
        self._browser, self._address, self._rng = browser, address, rng
        self.usage, self.began = Usage(), time.monotonic()
        self.windows = [browser.open(address, SIZE)]
        self.windows[0].wait_for("per pixel")
        self._actions = {
            self.drag: 8, self.zoom: 4, self.opacity: 4, self.density: 2, self.sun: 2,
            self.undo: 2, self.turn_sun: 2, self.kind: 2, self.compare: 1, self.preset: 1,
            self.save: 1, self.reload: 1, self.open: 1, self.close: 1, self.slices: 1,
        }  # fmt: skip

    def act(self) -> None:
        """Do one action in one of the windows."""
        actions, weights = list(self._actions), np.array(list(self._actions.values()), float)
        action = actions[self._rng.choice(len(actions), p=weights / weights.sum())]
        window = self.windows[self._rng.integers(len(self.windows))]
        action(window)
        self.usage.done[action.__name__] = self.usage.done.get(action.__name__, 0) + 1

    def drag(self, window: Window) -> None:
        """Drag, and sometimes wait."""
        steps = int(self._rng.integers(3, 20))
        window.orbit(steps, float(self._rng.uniform(-4, 4)), 0.02, 200)
        if self._rng.random() < 0.3:
            window.wait_for("at rest|final")

    def zoom(self, window: Window) -> None:
        """Zoom in or out, at most into the medium."""
        window.page.mouse.move(200, SIZE[1] / 2)
        window.zoom(int(self._rng.choice([-4, -2, 2, 4])))

    def opacity(self, window: Window) -> None:
        """Drag a point of the transfer function."""
        points = window.curve()
        index = int(self._rng.integers(1, len(points) - 1))
        low, high = points[index - 1][0], points[index + 1][0]
        share = float(self._rng.uniform(0.1, 0.9))
        window.drag_point(index, low + share * (high - low), float(self._rng.uniform(0.0, 0.9)))

    def undo(self, window: Window) -> None:
        """Undo or redo an edit of the transfer function."""
        button = window.page.locator(
            f"irrcache-transfer [data-id={self._rng.choice(['undo', 'redo'])}]"
        )
        if button.is_enabled():
            button.click()

    def turn_sun(self, window: Window) -> None:
        """Drag the sun on its sphere."""
        x, y = (int(c) for c in self._rng.integers(15, 57, 2))
        window.page.locator("irrcache-light canvas").click(position={"x": x, "y": y})

    def density(self, window: Window) -> None:
        """Change the density, sometimes to an invalid value."""
        unfolded(window, "Scattering and error", "density, ×").enter(
            "density, ×", self._rng.choice(["0.5", "1", "2", "-3"])
        )

    def sun(self, window: Window) -> None:
        """Switch the sun on and off."""
        window.enter("sun", self._rng.choice(["0", "2", "5"]))

    def kind(self, window: Window) -> None:
        """Display another quantity."""
        window.choose("show", str(self._rng.choice(KINDS)))

    def slices(self, window: Window) -> None:
        """Display other slices."""
        unfolded(window, "Crop and slices", "in the image").choose(
            "in the image", self._rng.choice([NONE, THIS, ALL])
        )
        window.choose("slice across", self._rng.choice(AXES))

    def compare(self, window: Window) -> None:
        """Switch the comparison with volpath."""
        window.choose("compare", str(self._rng.choice(COMPARISONS)))

    def preset(self, window: Window) -> None:
        """Select a preset of the transfer function."""
        window.choose("preset", str(self._rng.choice(PRESETS)))

    def save(self, window: Window) -> None:
        """Save all kinds of files."""
        button = window.page.get_by_role("button", name=re.compile("^(save|download) view$"))
        if not button.is_visible():
            window.unfold("Save")
        button.click()
        window.page.get_by_text(re.compile("^(saved|downloaded) ")).first.wait_for()

    def reload(self, window: Window) -> None:
        """Reload the page."""
        window.page.reload()
        window.wait_for("per pixel")

    def open(self, _: Window) -> None:
        """Open another window."""
        if len(self.windows) < MOST_WINDOWS:
            self.windows.append(self._browser.open(self._address, SIZE))
            self.windows[-1].wait_for("per pixel")

    def close(self, window: Window) -> None:
        """Close a window unless it is the last one."""
        if len(self.windows) > 1:
            self.leave(window)
            self.windows.remove(window)

    def rest(self) -> None:
        """Close all windows but one, and wait for an image of the same matter each time that is
        final with a larger target.
        """
        while len(self.windows) > 1:
            self.close(self.windows[-1])
        (window,) = self.windows
        window.choose("compare", COMPARISONS[0])
        window.choose("show", KINDS[0])
        window.choose("preset", PRESETS[0])
        label = "target error %"
        fields = unfolded(window, "Scattering and error", label)
        fields.enter("density, ×", "1")
        fields.enter(label, str(REST_TARGET))
        time.sleep(REST)  # the edits begin
        window.wait_until_final()
        time.sleep(REST)
        self.usage.at_rest.append((time.monotonic() - self.began, viewer_memory()))
        fields.enter(label, str(100 * TARGET_ERROR))

    def leave(self, window: Window) -> None:
        """Record the errors of a window, and close it."""
        self.usage.errors += window.errors
        self.usage.pictures += len(window.shown())
        window.page.close()


def unfolded(window: Window, folder: str, label: str) -> Window:
    """Open a folder unless its control is visible, and return the window."""
    if not window.field(label).is_visible():
        window.unfold(folder)
    return window


def use(browser: Browser, view: list[str], seconds: float, seed: int, log: Path) -> Usage:
    """Use ``irrcache view`` with these arguments for a time, not counting rests and the first
    image; its output goes to ``log``.
    """
    rng = np.random.default_rng(seed)
    with viewer(view, log) as address:
        user = User(browser, address, rng)
        usage = user.usage
        for _ in range(4):
            quarter = time.monotonic()
            while time.monotonic() - quarter < seconds / 4:
                usage.memory.append((time.monotonic() - user.began, viewer_memory()))
                user.act()
            user.rest()
        for window in user.windows:
            user.leave(window)
    said = log.read_text()
    # Warnings may speak of errors: "errors of about 4 % are expected there".
    usage.errors += [line for line in said.splitlines() if re.search(r"Traceback|rror:", line)]
    return usage


def main() -> None:
    """Run and report; unknown options are passed to ``irrcache view``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=Path("output/viewer"))
    args, view = parser.parse_known_args()
    args.output.mkdir(parents=True, exist_ok=True)
    log = args.output / f"usage{args.seed}.log"
    with Browser() as browser:
        usage = use(browser, view, args.seconds, args.seed, log)
    sizes = [size for _, size in usage.memory]
    print(", ".join(f"{count} x {name}" for name, count in sorted(usage.done.items())))
    print(f"{usage.pictures} pictures were shown in {usage.at_rest[-1][0]:.0f} s")
    print(
        f"memory {sizes[0]:.0f} MB at first, {max(sizes):.0f} MB at most, {sizes[-1]:.0f} MB last"
    )
    sizes = ", ".join(f"{size:.0f}" for _, size in usage.at_rest)
    print(f"with one window at rest, after each quarter of the time: {sizes} MB")
    print("errors:", "\n".join(usage.errors) or "none")
    found = vars(usage) | {"growth": usage.growth}
    (args.output / f"usage{args.seed}.json").write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
