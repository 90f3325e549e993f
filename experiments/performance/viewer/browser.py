"""A headless browser that displays ``irrcache view`` and records when images appear."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Locator, Page, sync_playwright

#: Names under which Chromium is installed.
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
#: Seconds after which an expected event counts as missing. Kernels may be compiled before it, while
#: other programs use the machine.
PATIENCE = 240.0
#: Milliseconds for which a folder of the panel moves when it is opened: a click would miss.
FOLDING = 400
#: Records the time of every mouse event, and of every displayed image.
_HOOKS = """
(() => {
  const now = () => performance.timeOrigin + performance.now();
  window.__moves = []; window.__shown = [];
  for (const kind of ['pointermove', 'wheel'])
    window.addEventListener(kind, () => window.__moves.push(now()), true);
  window.addEventListener('irrcache-picture', ({detail}) => {
    const entry = {...detail, at: 0};
    window.__shown.push(entry);
    requestAnimationFrame(() => { entry.at = now(); });
  });
})();
"""


def chromium() -> str | None:
    """Return the path of Chromium, or None."""
    return next(filter(None, map(shutil.which, CHROMIUM)), None)


@contextmanager
def viewer(arguments: Sequence[str], log: Path) -> Iterator[str]:
    """Start ``irrcache view`` with these arguments in a process of its own; return its address.

    Its output goes to ``log``, and to stderr if an exception is raised.
    """
    command = [sys.executable, "-m", "mitsuba_irrcache", "view", *arguments, "--no-browser"]
    with open(log, "w") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT)
    try:
        while not (found := re.search(r"http://\S+", log.read_text())):
            if process.poll() is not None:
                raise RuntimeError("the viewer ended before there was an address")
            time.sleep(0.05)
        yield found.group()
        if process.poll() is not None:
            raise RuntimeError(f"the viewer ended by itself: {process.returncode}")
    except BaseException:
        print(log.read_text(), file=sys.stderr)
        raise
    finally:
        process.terminate()
        process.wait(PATIENCE)


class Window:
    """A browser window that displays the viewer."""

    def __init__(self, page: Page, address: str, script: str = "") -> None:
        self.page = page
        page.set_default_timeout(1000 * PATIENCE)
        #: console messages: (kind, text)
        self.console: list[tuple[str, str]] = []
        page.on("console", lambda message: self.console.append((message.type, message.text)))
        page.on("pageerror", lambda error: self.console.append(("error", str(error))))
        page.add_init_script(_HOOKS + script)
        self.opened = time.time()
        page.goto(address)

    @property
    def errors(self) -> list[str]:
        """Return the errors in the console."""
        return [text for kind, text in self.console if kind == "error"]

    def moves(self) -> list[float]:
        """Return the times of mouse events in seconds."""
        return [t / 1000 for t in self.page.evaluate("window.__moves")]

    def shown(self) -> list[dict]:
        """Return the displayed images: "at" (seconds), "width", "height" and "final"."""
        entries = self.page.evaluate("window.__shown.filter(e => e.at > 0)")
        return [entry | {"at": entry["at"] / 1000} for entry in entries]

    def canvas(self) -> dict[str, float]:
        """Return the place of the image in the page: "x", "y", "width" and "height"."""
        return self.page.locator("#root canvas[data-engine]").bounding_box()

    def note(self) -> str:
        """Return the window's text about its image, "" before there is one."""
        found = self.page.get_by_text(re.compile(r"per pixel$")).first
        return found.inner_text() if found.count() else ""

    def wait_for(self, note: str, seconds: float = PATIENCE) -> None:
        """Wait until the window's text about its image matches."""
        pattern = re.compile(note)
        self.page.get_by_text(pattern).first.wait_for(state="attached", timeout=1000 * seconds)

    def wait_for_picture(self, after: int, width: int = 0, seconds: float = PATIENCE) -> None:
        """Wait for an image beyond the first ``after``, of this width if one is given."""
        self.page.wait_for_function(
            "([n, w]) => __shown.slice(n).some(e => e.at > 0 && (w == 0 || e.width == w))",
            arg=[after, width],
            timeout=1000 * seconds,
        )

    def wait_until_shown(self, size: tuple[int, int], seconds: float = PATIENCE) -> None:
        """Wait until the image on display, which may follow the text about it, has this size."""
        self.page.wait_for_function(
            "([w, h]) => { const e = __shown.at(-1); return e && e.width == w && e.height == h; }",
            arg=list(size),
            timeout=1000 * seconds,
        )

    def wait_until_final(self, seconds: float = PATIENCE) -> None:
        """Wait until the image on display is final, and the text about it says so, too."""
        self.wait_for("^final", seconds)
        self.page.wait_for_function(
            "() => { const e = __shown.at(-1); return e && e.at > 0 && e.final; }",
            timeout=1000 * seconds,
        )

    def field(self, label: str) -> Locator:
        """Return the input of the control with this label."""
        row = "ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
        return self.page.locator(
            f"xpath=//label[text()='{label}']/{row}//input[not(@type='hidden')]"
        ).first

    def enter(self, label: str, value: object) -> None:
        """Enter a value into a control."""
        field = self.field(label)
        field.fill(str(value))
        field.press("Enter")

    def choose(self, label: str, option: str) -> None:
        """Select the first option of a list with this beginning."""
        self.field(label).click()
        pattern = re.compile(rf"^{re.escape(option)}")
        self.page.get_by_role("option", name=pattern).filter(visible=True).first.click()

    def unfold(self, folder: str) -> None:
        """Open a folder of the panel, or close it."""
        self.page.get_by_text(folder, exact=True).click()
        self.page.wait_for_timeout(FOLDING)

    def curve(self) -> list[list[float]]:
        """Return the points [value, opacity] of the transfer function."""
        return self.page.evaluate("document.querySelector('irrcache-transfer').points.opacity")

    def wait_for_curve(self, points: int, seconds: float = PATIENCE) -> None:
        """Wait until the transfer function of the viewer has so many points."""
        self.page.wait_for_function(
            "n => document.querySelector('irrcache-transfer').state.opacity.length == n",
            arg=points,
            timeout=1000 * seconds,
        )

    def place_of(self, value: float, opacity: float) -> tuple[float, float]:
        """Return the place of a point on the plot of the transfer function, in the page."""
        place = """([value, opacity]) => {
            const editor = document.querySelector('irrcache-transfer');
            editor.scrollIntoView();
            const box = editor.canvas.getBoundingClientRect();
            return [box.left + editor.x(value), box.top + editor.y(opacity)];
        }"""
        return tuple(self.page.evaluate(place, [value, opacity]))

    def drag_point(self, index: int, value: float, opacity: float) -> None:
        """Drag a point of the transfer function to another place on its plot."""
        mouse = self.page.mouse
        mouse.move(*self.place_of(*self.curve()[index]))
        mouse.down()
        mouse.move(*self.place_of(value, opacity), steps=4)
        mouse.up()

    def tick(self, label: str) -> None:
        """Set or clear a check box."""
        self.page.get_by_text(label, exact=True).locator(
            "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]//input"
        ).first.click()

    def orbit(self, steps: int, pixels: float, pause: float, first: float = 60.0) -> None:
        """Drag the mouse over the image from ``first``, in ``steps`` of this many pixels."""
        mouse, height = self.page.mouse, self.page.viewport_size["height"]
        first += self.canvas()["x"]
        mouse.move(first, 0.8 * height)
        mouse.down()
        for step in range(1, steps + 1):
            mouse.move(first + step * pixels, 0.8 * height)
            self.page.wait_for_timeout(1000 * pause)
        mouse.up()

    def zoom(self, turns: int, pause: float = 0.05) -> None:
        """Turn the mouse wheel."""
        for _ in range(abs(turns)):
            self.page.mouse.wheel(0, 100 if turns > 0 else -100)
            self.page.wait_for_timeout(1000 * pause)


class Browser:
    """Chromium with any number of windows; a context manager."""

    def __enter__(self) -> Browser:
        self._playwright = sync_playwright().start()
        # Shared memory of containers is small, and a page that needs more of it crashes.
        arguments = ["--no-sandbox", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
        self._browser = self._playwright.chromium.launch(
            executable_path=chromium(), args=arguments, timeout=1000 * PATIENCE
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._browser.close()
        self._playwright.stop()

    def open(self, address: str, size: tuple[int, int] = (512, 512), script: str = "") -> Window:
        """Open a new window of this (width, height), with a ``script`` that runs in its page."""
        page = self._browser.new_page(viewport={"width": size[0], "height": size[1]})
        return Window(page, address, script)
