"""The first seconds of the viewer: ``python -m experiments.performance.viewer.opening``.

Seconds from the command to the address, from opening the page to its first image, to its controls
and to the first image for its own camera, with the processor seconds until then and all messages
meanwhile. The first run, which may compile kernels, is not counted.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from experiments.performance.viewer.browser import Browser, viewer
from experiments.performance.viewer.load import processor_seconds

VIEW = ("phantom:thorax:190,120,165", "--preset", "ct-chest")
#: Records when the page shows its first image, its controls, and each message. The first image is
#: in an element of its own until viser's client has one for its canvas.
_HOOKS = """
(() => {
  const now = () => performance.timeOrigin + performance.now();
  const found = window.__opening = {messages: []};
  const part = (name) => document.querySelector(`#irrcache-overlay .${name}`);
  const text = (name) => { const p = part(name); return p && !p.hidden ? p.textContent : ''; };
  const isLoaded = (image) => image && !image.hidden && image.complete && image.naturalWidth;
  const look = () => {
    if (!found.image && isLoaded(part('preview'))) found.image = now();
    if (!found.note && /per pixel/.test(text('note'))) found.note = now();
    if (!found.controls && document.querySelector('irrcache-light canvas')) found.controls = now();
    const message = text('message'), last = found.messages.at(-1);
    if (message !== (last ? last[1] : '')) found.messages.push([now(), message]);
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})();
"""


def opening(browser: Browser, view: list[str], log: Path, size: tuple[int, int]) -> dict:
    """Start the viewer and open its page at once; return seconds of each event."""
    before, started = processor_seconds(), time.time()
    with viewer(view, log) as address:
        printed = time.time()
        window = browser.open(address, size, _HOOKS)
        window.wait_for("per pixel")
        window.page.wait_for_function("__opening.note && __opening.controls")
        used, found = processor_seconds(), window.page.evaluate("__opening")
        since = window.opened
        shown = [s["at"] for s in window.shown()]
        errors = window.errors
        window.page.close()
    own = found["note"] / 1000 if not shown else min(min(shown), found["note"] / 1000)
    first = min([found[k] / 1000 for k in ("image",) if k in found] + [own])
    return {
        "address": printed - started,
        "first image": first - since,
        "controls": found["controls"] / 1000 - since,
        "own camera": own - since,
        "processor, viewer": used.get("viewer", 0.0) - before.get("viewer", 0.0),
        "processor, all": sum(used.values()) - sum(before.values()),
        "messages": [(round(at / 1000 - since, 2), text) for at, text in found["messages"]],
        "errors": errors,
    }


def main() -> None:
    """Measure and print; unknown options are passed to ``irrcache view``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", type=int, nargs=2, default=(1400, 900))
    parser.add_argument("-o", "--output", type=Path, default=Path("output/viewer"))
    args, view = parser.parse_known_args()
    args.output.mkdir(parents=True, exist_ok=True)
    runs = []
    with Browser() as browser:
        for number in range(args.repeats + 1):
            log = args.output / "opening.log"
            found = opening(browser, view or list(VIEW), log, tuple(args.size))
            print("not counted:" if number == 0 else f"{number}:", found, flush=True)
            runs += [found] if number else []
    for name in (n for n in runs[0] if n not in ("messages", "errors")):
        values = [run[name] for run in runs]
        print(f"{name:<20} median {np.median(values):6.2f} s, most {max(values):6.2f} s")
    (args.output / "opening.json").write_text(json.dumps(runs, indent=1))


if __name__ == "__main__":
    main()
