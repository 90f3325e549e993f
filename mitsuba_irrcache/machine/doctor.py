"""``irrcache doctor``: report the capabilities of this machine and remedies for problems.

Every backend is tried in a subprocess, so that an LLVM that aborts only ends that subprocess.
"""

from __future__ import annotations

import argparse
import glob
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine import llvm as runtime
from mitsuba_irrcache.machine import versions
from mitsuba_irrcache.machine.extras import remedy
from mitsuba_irrcache.machine.memory import available_memory, total_memory
from mitsuba_irrcache.machine.variants import SUPPORTED, require_variant

DEFAULT_VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
DEVELOPMENT = ("test", "docs")  # extras for developers only

_EXTENSIONS = ("sse4_2", "avx", "fma", "avx2", "avx512f", "avx512vl", "asimd", "sve")
_OPTIX_FILES = (
    "/usr/lib/*/libnvoptix.so.1",
    "/usr/lib64/libnvoptix.so.1",
    "/usr/lib/wsl/lib/*optix*",
)
_PROBE_TIMEOUT = 180  # seconds; the first render of a cold machine takes about five
# An old LLVM cannot compile dr.minimum; rendering additionally requires Embree or OptiX.
_PROBE = """
import sys
import drjit as dr
import mitsuba as mi
mi.set_variant(sys.argv[1])
falling = dr.minimum(dr.opaque(mi.Float, 2.0), 1.0 - dr.arange(mi.Float, 64))
assert float(dr.sum(falling)[0]) == -1952.0, "dr.minimum is wrong"
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 2},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
    "light": {"type": "constant"},
    "shape": {"type": "sphere", "center": [0, 0, 4]},
})
image = mi.TensorXf(mi.render(scene, spp=4))
assert 0.25 < float(dr.mean(image.array)[0]) <= 1.01, "the picture is wrong"
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``irrcache doctor``."""
    parser.add_argument(
        "-m",
        "--mode",
        metavar="VARIANT",
        help=f"the variant that has to work (default: one of {', '.join(DEFAULT_VARIANTS)})",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the report; return the exit status: 0 if at least one usable variant works."""
    report = examine([args.mode] if args.mode else list(DEFAULT_VARIANTS))
    print(json.dumps(report, indent=2) if args.json else as_text(report))
    return 0 if report["ok"] else 1


def examine(variants: list[str]) -> dict[str, Any]:
    """Collect the whole report.

    Args:
        variants: names of Mitsuba variants to try; one that works is enough.

    Returns:
        JSON-serialisable; ``ok`` states whether one of the variants works and all packages are new
        enough, ``remedies`` lists what to do otherwise.

    Raises:
        IrrcacheError: this Mitsuba does not have one of the variants.
    """
    built = _built_variants()
    unknown = [variant for variant in variants if variant not in built]
    if unknown:
        raise IrrcacheError(
            f'this Mitsuba has no variant "{unknown[0]}"; it has {", ".join(built)}.'
        )
    packages = examine_packages()
    trials = {variant: try_variant(variant) for variant in variants}
    ok = any(trial["works"] for trial in trials.values())
    return {
        "system": examine_system(),
        "packages": packages,
        "llvm": examine_llvm(),
        "cuda": examine_cuda(),
        "kernel_cache": examine_kernel_cache(),
        "variants": {"built": built, "tried": trials},
        "remedies": _remedies(packages, trials, ok),
        "ok": ok and all(package["ok"] for package in packages if package["needed_by"] == ""),
    }


def examine_system() -> dict[str, Any]:
    """Return versions of Python and the operating system, processor, cores and memory [bytes]."""
    return {
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": platform.platform(),
        "processor": _processor(),
        "vector_extensions": _vector_extensions(),
        "cores": available_cores(),
        "memory": total_memory(),
        "free_memory": available_memory(),
    }


def examine_packages() -> list[dict[str, Any]]:
    """Return name, version and state of all required and optional packages."""
    return [
        {
            "name": requirement.name,
            "needs": str(requirement.specifier),
            "version": versions.installed_version(requirement.name),
            "ok": versions.is_satisfied(requirement),
            "needed_by": extra,
        }
        for extra in ("", *versions.extras())
        if extra not in DEVELOPMENT
        for requirement in versions.requirements(extra)
    ]


def examine_llvm() -> dict[str, Any]:
    """Return the LLVM that the environment variable names, the loaded one, and all others found."""
    chosen = os.environ.get(runtime.LLVM_VARIABLE, "")
    loaded = runtime.loaded_llvm()
    problem = runtime.inspect_llvm(chosen).problem if chosen else ""
    if not problem:
        problem = runtime.version_problem(loaded) if loaded else "Dr.Jit could load none"
    return {
        "variable": chosen,
        "loaded": ".".join(map(str, loaded)),
        "problem": problem,
        "minimum": runtime.minimum_llvm(),
        "found": [
            {
                "path": str(library.path),
                "version": library.version_text,
                "problem": library.problem,
            }
            for library in runtime.find_llvm()
        ],
    }


def examine_cuda() -> dict[str, Any]:
    """Return whether Dr.Jit can use a GPU, the driver's CUDA version, and OptiX."""
    import drjit as dr

    available = bool(dr.has_backend(dr.JitBackend.CUDA))
    return {
        "available": available,
        "driver": ".".join(map(str, dr.detail.cuda_version())) if available else None,
        "optix": _optix_library(),
    }


def examine_kernel_cache() -> dict[str, Any]:
    """Return the folder of compiled kernels, its size [bytes], and whether it is writable."""
    folder = _kernel_cache_folder()
    exists = folder.is_dir()
    writable = os.access(folder if exists else folder.parent, os.W_OK)
    size = sum(file.stat().st_size for file in folder.glob("*.bin")) if exists else 0
    return {"folder": str(folder), "bytes": size, "writable": writable}


def try_variant(variant: str) -> dict[str, Any]:
    """Compile a kernel and render a sphere with a variant, in a subprocess.

    Variants that irrcache does not support count as not working, whatever Mitsuba can do with them.

    Returns:
        ``works``, the ``seconds`` it took, and in ``problem`` the last error message, if any.
    """
    try:
        require_variant(variant)
    except IrrcacheError as error:
        return {"works": False, "seconds": 0.0, "problem": str(error)}
    start = time.perf_counter()
    # Use an empty kernel cache: a cached kernel would hide that LLVM cannot compile it.
    with tempfile.TemporaryDirectory(prefix="irrcache-doctor-") as cache:
        problem = _probe(variant, {**os.environ, "DRJIT_CACHE_DIR": cache})
    seconds = round(time.perf_counter() - start, 2)
    return {"works": not problem, "seconds": seconds, "problem": problem}


def as_text(report: dict[str, Any]) -> str:
    """Format the report as text."""
    lines = [
        *_system_lines(report),
        *_package_lines(report["packages"]),
        *_llvm_lines(report["llvm"]),
    ]
    lines += ["", "Variants of Mitsuba"]
    for variant, trial in report["variants"]["tried"].items():
        verdict = "works" if trial["works"] else f"does not work: {trial['problem']}"
        lines.append(f"  {variant:14} {verdict} ({trial['seconds']} s)")
    lines.append(f"  {'built':14} {', '.join(report['variants']['built'])}")
    lines += ["", *report["remedies"]]
    if report["ok"] and not report["remedies"]:
        lines.append("All is well.")
    return "\n".join(lines)


def _probe(variant: str, environment: dict[str, str]) -> str:
    """Run the probe; return ``""`` on success, otherwise the error."""
    command = [sys.executable, "-c", _PROBE, variant]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_PROBE_TIMEOUT, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_PROBE_TIMEOUT} s"
    if done.returncode == 0:
        return ""
    fatal = re.search(r"LLVM ERROR: .*", done.stderr)
    if fatal:
        return f"Dr.Jit aborted the process, {fatal[0]}"
    if done.returncode < 0:
        return f"ended by {signal.Signals(-done.returncode).name}"
    said = done.stderr.strip().splitlines()
    return said[-1] if said else f"ended with status {done.returncode}"


def _remedies(packages: list[dict], trials: dict[str, dict], ok: bool) -> list[str]:
    """Return remedies, one line each; empty if everything required works."""
    remedies = []
    wrong = [
        package
        for package in packages
        if not package["ok"] and (package["version"] or not package["needed_by"])
    ]
    if wrong:
        wanted = " ".join(f'"{package["name"]}{package["needs"]}"' for package in wrong)
        remedies.append(f"Packages: {sys.executable} -m pip install --upgrade {wanted}")
    if ok:
        return remedies
    tried = [variant for variant in trials if variant in SUPPORTED]
    if any(variant.startswith("llvm") for variant in tried):
        remedies.append(f"LLVM: {runtime.llvm_remedy()}")
    if any(variant.startswith("cuda") for variant in tried):
        remedies.append("CUDA: an NVIDIA GPU with a current driver is needed for cuda_* variants.")
    if len(tried) < len(trials):
        remedies.append(f"Variant: name one that irrcache runs in: {', '.join(SUPPORTED)}.")
    return remedies


def _built_variants() -> list[str]:
    import mitsuba as mi

    return mi.variants()


def _processor() -> str:
    name = re.search(r"^model name\s*: (.*)", _read("/proc/cpuinfo"), re.MULTILINE)
    return name[1] if name else platform.processor() or platform.machine()


def _vector_extensions() -> list[str]:
    """Return the processor's vector extensions as Linux names them; empty on other systems."""
    flags = re.search(r"^(?:flags|Features)\s*: (.*)", _read("/proc/cpuinfo"), re.MULTILINE)
    present = flags[1].split() if flags else []
    return [extension for extension in _EXTENSIONS if extension in present]


def available_cores() -> int:
    """Return the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _optix_library() -> str | None:
    """Return the path of the OptiX library that the user selected, or of the driver's (Linux)."""
    named = os.environ.get("DRJIT_LIBOPTIX_PATH")
    found = [path for pattern in _OPTIX_FILES for path in glob.glob(pattern)]
    return named or (found[0] if found else None)


def _kernel_cache_folder() -> Path:
    named = os.environ.get("DRJIT_CACHE_DIR")
    if named:
        return Path(named)
    if platform.system() == "Windows":
        return Path(tempfile.gettempdir()) / "drjit"
    return Path.home() / ".drjit"


def _read(path: str) -> str:
    """Return the text of a system file, or ``""`` if it does not exist."""
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""


def _system_lines(report: dict[str, Any]) -> list[str]:
    system, cuda, cache = report["system"], report["cuda"], report["kernel_cache"]
    extensions = ", ".join(system["vector_extensions"]) or "vector extensions unknown"
    gpu = f"CUDA {cuda['driver']}" if cuda["available"] else "no GPU that Dr.Jit can use"
    writable = (
        "" if cache["writable"] else " - not writable: every process compiles its kernels again"
    )
    return [
        "System",
        f"  Python         {system['python']}",
        f"  platform       {system['platform']}",
        f"  processor      {system['processor']}, {system['cores']} cores ({extensions})",
        f"  memory         {_gib(system['free_memory'])} free of {_gib(system['memory'])}",
        f"  GPU            {gpu}; OptiX: {cuda['optix'] or 'not found'}",
        f"  kernel cache   {cache['folder']}, {cache['bytes'] / 2**20:.1f} MiB{writable}",
    ]


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"


def _package_lines(packages: list[dict[str, Any]]) -> list[str]:
    lines = ["", "Packages"]
    for package in packages:
        extra = f" [{package['needed_by']}]" if package["needed_by"] else ""
        version = package["version"] or "none"
        needs = package["needs"] + extra
        lines.append(f"  {package['name']:14} {version:12} {needs:20} {_verdict(package)}".rstrip())
    return lines


def _verdict(package: dict[str, Any]) -> str:
    if package["ok"]:
        return ""
    if package["version"]:
        return "TOO OLD"
    if not package["needed_by"]:
        return "MISSING"
    return f"not installed; if wanted: {remedy(package['needed_by'])}"


def _llvm_lines(llvm: dict[str, Any]) -> list[str]:
    lines = [
        "",
        f"LLVM (Dr.Jit needs {llvm['minimum']} or newer on this processor)",
        f"  {runtime.LLVM_VARIABLE}={llvm['variable']}",
        f"  loaded         {llvm['loaded'] or 'none'}",
    ]
    if llvm["problem"]:
        lines.append(f"  problem        {llvm['problem']}")
    for library in llvm["found"]:
        verdict = library["problem"] or "usable"
        lines.append(f"  found          {library['version']:8} {library['path']}: {verdict}")
    return lines
