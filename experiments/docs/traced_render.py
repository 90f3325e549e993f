"""Render a scene with the package of one checkout, and print which functions call each other.

    PYTHONPATH=CHECKOUT python experiments/docs/traced_render.py CHECKOUT SCENE

Prints JSON: pairs of caller and callee, each as (module, function), in the order of the first call.
Only functions of the package count. A function that is called by way of another package, or of one
of the `WRAPPERS`, counts as called by the function of the package before that.
`restructuring` runs it for several versions of the package.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import FrameType

#: Properties for a first image in seconds.
SMALL = {"solver": "sweep", "resolution": 16, "cache_spp": 32}
#: Modules and names of functions that wrap others: the recording of loops, and constructors.
WRAPPERS = {("symbolic", "call"), ("core.jit", "call"), ("core.immutable", "construct")}

Function = tuple[str, str]


class Calls:
    """Pairs of functions of the package in ``folders`` that call each other, see `observe`."""

    def __init__(self, folders: dict[str, str]) -> None:
        self.pairs: dict[tuple[Function, Function], None] = {}
        self._folders, self._modules = folders, {}

    def observe(self, frame: FrameType, event: str, _: object) -> None:
        """Record a call; to be passed to `sys.setprofile`."""
        if event != "call" or (callee := self._function(frame)) is None:
            return
        caller = frame.f_back
        while caller is not None and (found := self._function(caller)) is None:
            caller = caller.f_back
        if caller is not None:
            self.pairs.setdefault((found, callee))

    def _function(self, frame: FrameType) -> Function | None:
        code = frame.f_code
        file = code.co_filename
        if file not in self._modules:
            self._modules[file] = module_of(file, self._folders)
        module = self._modules[file]
        if module is None or code.co_name.startswith("<") or (module, code.co_name) in WRAPPERS:
            return None
        return module, code.co_qualname if hasattr(code, "co_qualname") else code.co_name


def module_of(file: str, folders: dict[str, str]) -> str | None:
    """Return the name of a module within the package, None for files of other packages.

    ``folders`` maps folders to prefixes of names.
    """
    for folder, prefix in folders.items():
        if file.startswith(folder) and file.endswith(".py"):
            parts = Path(file[len(folder) :]).with_suffix("").parts
            return ".".join([*filter(None, [prefix]), *(p for p in parts if p != "/")])
    return None


def main(checkout: Path, scene: Path) -> None:
    """Trace ``mi.render`` with an empty cache."""
    import mitsuba as mi

    import mitsuba_irrcache  # registers the plugin

    mi.set_variant("llvm_ad_rgb")
    loaded = mi.load_file(str(scene), size=16)
    integrator = mi.load_dict({"type": "irrcache"} | SMALL)
    package = Path(mitsuba_irrcache.__file__).parent
    folders = {
        f"{package}/integrators/": "integrators",
        f"{checkout}/integrators/": "integrators",
        f"{package}/": "",
    }
    calls = Calls(folders)
    sys.setprofile(calls.observe)
    mi.TensorXf(mi.render(loaded, integrator=integrator, spp=1)).numpy()
    sys.setprofile(None)
    print(json.dumps([*calls.pairs]))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]))
