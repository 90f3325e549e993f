"""Latency and frame rate of the viewer in a browser: ``python -m
experiments.performance.viewer.run SCENE``.

Frames per second while a camera orbits, from the mouse to the image, from the end of a drag to full
resolution, from an edit to the new illumination, and from the command to the first image.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from experiments.performance.viewer.browser import Browser, Window, viewer
from experiments.performance.viewer.load import processor_seconds

#: Relative error of the caches, percent, at which refinement is complete before an edit.
ENOUGH = 50
#: Width of the panel beside the image in pixels.
PANEL = 324


def main() -> None:
    """Measure and print; unknown options are passed to ``irrcache view``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="of the image, pixels")
    parser.add_argument("--repeats", type=int, default=5, help="of each measurement")
    parser.add_argument("-o", "--output", type=Path, default=Path("output/viewer"))
    args, view = parser.parse_known_args()
    args.output.mkdir(parents=True, exist_ok=True)
    started = time.time()
    with viewer(view, args.output / "viewer.log") as address, Browser() as browser:
        window = browser.open(address, (args.size + PANEL, args.size))
        window.wait_for("per pixel")
        results = {"first picture [s]": _first(window) - started}
        results["  of it the browser [s]"] = _first(window) - window.opened
        window.wait_for("at rest|final")
        time.sleep(2)
        for measure in (orbiting, latency, stopping, editing, turning_the_sun):
            found = measure(window, args.repeats)
            for name, value in found.items():
                print(f"{name:<48}{value:10.3f}", flush=True)
            results |= found
        window.page.screenshot(path=str(args.output / "window.png"))
        errors = window.errors
    print(f"first picture after {results['first picture [s]']:.2f} s")
    print("errors in the console:", errors or "none")
    (args.output / "results.json").write_text(json.dumps(results, indent=2))


def orbiting(window: Window, repeats: int) -> dict[str, float]:
    """Measure images per second while the mouse is dragged as fast as the page allows."""
    rates, sizes, loads = [], [], []
    for _ in range(repeats):
        before, load = len(window.shown()), processor_seconds()
        began = time.time()
        window.orbit(120, 3, 0.005)
        ended = time.time()
        now = processor_seconds()
        loads.append({name: (now[name] - load.get(name, 0)) / (ended - began) for name in now})
        seen = [s for s in window.shown()[before:] if began + 0.2 <= s["at"] <= ended]
        rates.append((len(seen) - 1) / (seen[-1]["at"] - seen[0]["at"]))
        sizes += [s["width"] for s in seen]
        time.sleep(1)
    users = {
        f"  processors busy with: {name}": float(np.median([load.get(name, 0) for load in loads]))
        for name in loads[-1]
    }
    return {
        "orbiting: pictures per second, median": float(np.median(rates)),
        "  slowest drag": float(np.min(rates)),
        "  width of pictures, median": float(np.median(sizes)),
    } | {name: value for name, value in users.items() if value >= 0.005}


def latency(window: Window, repeats: int) -> dict[str, float]:
    """Measure from a mouse event in a drag to the next image, with events a tenth of a second
    apart.
    """
    found = []
    for _ in range(repeats):
        moved, shown = len(window.moves()), len(window.shown())
        window.orbit(30, 4, 0.1)
        moves = window.moves()[moved + 2 :]
        times = np.array([s["at"] for s in window.shown()[shown:]])
        found += [float(times[times > move].min() - move) for move in moves if (times > move).any()]
        time.sleep(1)
    median, most = np.percentile(found, [50, 95])
    return {"mouse to picture, median [s]": median, "  95th percentile [s]": most}


def stopping(window: Window, repeats: int) -> dict[str, float]:
    """Measure from the last mouse event of a drag to an image of full resolution."""
    found, size = [], round(window.canvas()["width"])
    for _ in range(repeats):
        window.wait_for("at rest|final", 60)
        window.orbit(20, 4, 0.03)
        last, shown = window.moves()[-1], len(window.shown())
        window.wait_for_picture(shown, size)
        found.append(_seen(window, shown, last, size) - last)
    return {
        "full resolution after stopping, median [s]": float(np.median(found)),
        "  slowest stop [s]": max(found),
    }


def _seen(window: Window, shown: int, since: float, width: int = 0) -> float:
    """Return when the first image after this many, and after ``since``, was visible.

    That is a frame later than it was uploaded.
    """
    for _ in range(200):
        for picture in window.shown()[shown:]:
            if picture["at"] > since and width in (0, picture["width"]):
                return picture["at"]
        window.page.wait_for_timeout(10)
    raise RuntimeError("a picture was uploaded, but no frame shows it")


def editing(window: Window, repeats: int) -> dict[str, float]:
    """Measure from an edit of the transfer function, or else the density, to the new image."""
    found, has_curve = [], window.page.locator("irrcache-transfer").count() > 0
    window.unfold("Scattering and error")
    window.enter("target error %", ENOUGH)
    for number in range(repeats):
        window.wait_for("^final", 60)  # no other image is displayed from now on
        shown, height = len(window.shown()), round(0.2 + 0.05 * number, 2)
        if has_curve:
            window.drag_point(4, window.curve()[4][0], height)
            began = time.time()
        else:
            began = time.time()
            window.enter("density, ×", height)
        window.wait_for_picture(shown)
        found.append(_seen(window, shown, began) - began)
    label = "a point dragged" if has_curve else "density"
    return {
        f"picture after an edit ({label}), median [s]": float(np.median(found)),
        "  slowest edit [s]": max(found),
    }


def turning_the_sun(window: Window, repeats: int) -> dict[str, float]:
    """Measure from a new direction of the sun, clicked on its sphere, to the new image."""
    sphere = window.page.locator("irrcache-light canvas")
    if not sphere.count():
        return {}
    sphere.scroll_into_view_if_needed()
    found, place, mouse = [], sphere.bounding_box(), window.page.mouse
    for number in range(repeats):
        window.wait_for("^final", 60)
        time.sleep(1)  # the note of the previous image may be older than the last turn
        window.wait_for("^final", 60)  # no other image is displayed from now on
        shown = len(window.shown())
        mouse.move(place["x"] + 45 - 6 * number, place["y"] + 20 + 4 * number)
        began = time.time()
        mouse.down()
        mouse.up()
        window.wait_for_picture(shown)
        found.append(_seen(window, shown, began) - began)
    return {
        "picture after turning the sun, median [s]": float(np.median(found)),
        "  slowest turn [s]": max(found),
    }


def _first(window: Window) -> float:
    return window.shown()[0]["at"]


if __name__ == "__main__":
    main()
