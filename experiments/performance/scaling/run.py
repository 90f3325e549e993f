"""Cost of the solver ``sweep`` as volumes and images grow, compared with the memory bandwidth.

    python -m experiments.performance.scaling.run [--full] [--force]

Single scattering in grey, 256 directions, on procedural clouds up to 128^3 voxels (``--full``: up
to 256^3, and the paper's 512 x 150 x 350 thorax), each in a process of its own: seconds, voxels
times directions per second, peak memory. Two bounds are measured in the same process. Stream, a
kernel y = a x: the time of a track's step if it only moved 12 bytes. Loads, a kernel with only the
loads and stores of a step: two words of the extinction, and the irradiance of a voxel before and
after. Then images of up to 512^2 (``--full``: 1024^2) pixels, and the kernels of a pass. Writes
output/scaling/results.json.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.methods import specify
from experiments.support.options import FULL, Options, parse
from experiments.support.scenes import scene_file
from experiments.support.store import Store
from mitsuba_irrcache.compare.processes import KERNEL_CACHE
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.compare.worker import peak_memory
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings
from mitsuba_irrcache.solvers.discrete_ordinates.solver import LARGEST_BATCH, SMALLEST_BATCH

VARIANT = "llvm_ad_mono"
#: Source and voxels along its longest side; 0: as the source has it.
QUICK_SIZES = (("procedural", 32), ("procedural", 64), ("procedural", 128))
FULL_SIZES = (*QUICK_SIZES, ("procedural", 192), ("procedural", 256), ("phantom-paper", 0))
QUICK_PIXELS = (128, 256, 512)
FULL_PIXELS = (*QUICK_PIXELS, 1024)
#: Volume of which images and kernels are measured.
MIDDLE = ("procedural", 128)
SAMPLES = LARGEST_BATCH
#: Samples per pixel of an image.
SPP = 4
REPEATS = 3
#: Voxels from which on memory is dominated by volumes, not kernels.
MANY = 1 << 22
#: Volume of which kernels are counted.
PASSES = 5
#: For the stream bound: numbers in an array, and bytes moved per step of a track.
STREAM = 64 << 20
STEP_BYTES = 12
#: For the loads bound: voxels by which tracks move from one slice to the next.
MOVED = 37


def run(options: Options) -> None:
    """Measure missing results, and print all."""
    store = Store(options.folder("scaling") / "results.json", options.force)
    full = options.size == FULL

    def row(key: str, function: Callable, source: tuple[str, int], *rest: int) -> dict:
        scene = scene_file(source[0], options.output, source[1])
        return store.row(key, partial(alone, function, scene, *rest))

    sizes = [
        row(f"size {name} {longest}", growth, (name, longest))
        for name, longest in (FULL_SIZES if full else QUICK_SIZES)
    ]
    images = [row(f"pixels {n}", image, MIDDLE, n) for n in (FULL_PIXELS if full else QUICK_PIXELS)]
    with no_kernels_on_disk():
        counts = row("kernels", kernels, MIDDLE)
    print(sizes_table(sizes).as_text(), images_table(images).as_text(), sep="\n\n")
    print(
        f"\nKernels of batches of {SMALLEST_BATCH} directions at 128^3, the first with all "
        "before it:"
    )
    for number, count in enumerate(counts["passes"], 1):
        print(f"  batch {number}: {count['launches']} launches, {count['compiled']} compilations")


def alone(function: Callable, scene: Path, *rest: int) -> dict:
    """Return the result of ``function`` in a new process, and the machine's load."""
    print(
        f"scaling: {function.__name__} {scene.parent.name} {' '.join(map(str, rest))}", flush=True
    )
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(function, (scene, *rest)) | {"load": os.getloadavg()[0]}


@contextmanager
def no_kernels_on_disk() -> Iterator[None]:
    """Hide the kernels of earlier processes on disk."""
    before = os.environ.get(KERNEL_CACHE)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[KERNEL_CACHE] = folder
        try:
            yield
        finally:
            del os.environ[KERNEL_CACHE]
            if before is not None:
                os.environ[KERNEL_CACHE] = before


def growth(scene: Path) -> dict:
    """Measure a whole cache, as many directions more, peak memory, and bandwidth."""
    set_up()
    parameters = {"max_depth": "2"}
    loaded = load_scene(scene, parameters)
    before = peak_memory()
    builder = build(loaded, SAMPLES)[0]
    peak = peak_memory()
    grid, sides = builder.cache.grid, swept_sides(builder.cache)
    whole, more = [], []
    for _ in range(REPEATS):
        builder = None  # its memory is reused
        builder, seconds = build(load_scene(scene, parameters), SAMPLES, also=(more,))
        whole.append(seconds)
    active = builder.cache.active_count
    builder = loaded = None
    return {
        "voxels": grid.voxel_count,
        "sides": grid.shape[::-1],
        "swept": int(np.prod(sides)),
        "active": active,
        "directions": SAMPLES,
        "seconds": float(np.median(whole)),
        "seconds_more": float(np.median(more)),
        "peak": peak,
        "peak_loaded": before,
        "bandwidth": bandwidth(),
        "loads": loads(sides),
    }


def build(scene: mi.Scene, samples: int, also: tuple[list, ...] = ()) -> tuple:
    """Return a builder with a filled cache, and its seconds.

    Those of as many samples more go to the lists in ``also``.
    """
    dr.sync_thread()
    builder = CacheBuilder(CacheSettings(max_depth=2, solver="sweep", samples=samples))
    started = time.perf_counter()
    builder.update(scene)
    dr.sync_thread()
    seconds = time.perf_counter() - started
    for times in also:
        builder.samples = 2 * samples
        started = time.perf_counter()
        builder.update(scene)
        dr.sync_thread()
        times.append(time.perf_counter() - started)
    return builder, seconds


def image(scene: Path, pixels: int) -> dict:
    """Seconds of an image from a cache that is there, and peak memory."""
    set_up()
    parameters = {"max_depth": "2", "width": str(pixels), "height": str(pixels)}
    integrator = specify("irrcache", solver="sweep", cache_spp=SAMPLES)
    loaded = load_scene(scene, parameters, integrator)
    np.array(mi.render(loaded, spp=SPP))
    times = []
    for seed in range(1, 6):
        started = time.perf_counter()
        np.array(mi.render(loaded, spp=SPP, seed=seed))
        times.append(time.perf_counter() - started)
    seconds = float(np.median(times))
    return {"pixels": pixels**2, "spp": SPP, "seconds": seconds, "peak": peak_memory()}


def kernels(scene: Path) -> dict:
    """Kernels launched and compiled pass by pass, the first with what comes before it."""
    set_up()
    loaded = load_scene(scene, {"max_depth": "2"})
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        builder = build(loaded, SMALLEST_BATCH)[0]
        passes = [counted(dr.kernel_history())]
        for number in range(2, PASSES + 1):
            builder.samples = number * SMALLEST_BATCH
            builder.update(loaded)
            passes.append(counted(dr.kernel_history()))
    return {"passes": passes}


def counted(history: list[dict]) -> dict[str, int]:
    """Count launches, and kernels that were compiled."""
    compiled = sum(k["type"] == dr.KernelType.JIT and not k["cache_hit"] for k in history)
    return {"launches": len(history), "compiled": compiled}


def bandwidth() -> float:
    """Return the bytes per second, read and written, of y = a x; the best of 5."""
    x = dr.arange(mi.Float, STREAM)
    a = dr.opaque(mi.Float, 2)
    dr.eval(x)
    times = []
    for _ in range(6):  # compiles the kernel
        y = x * a
        dr.sync_thread()
        started = time.perf_counter()
        dr.eval(y)
        dr.sync_thread()
        times.append(time.perf_counter() - started)
        del y
    return 2 * 4 * STREAM / min(times[1:])


def loads(sides: np.ndarray) -> float:
    """Return the throughput of a kernel that only loads and stores what a track does.

    In voxels times directions per second, both directions along tracks through a box of this many
    voxels; the best of 5.
    """
    slices, lines = int(sides[2]), int(sides[0] * sides[1])
    step = lines + MOVED
    words = dr.opaque(mi.UInt32, 1, slices * step + int(sides[0]))
    light = dr.opaque(mi.Float, 1, slices * step)
    numbers = [dr.opaque(mi.UInt32, n) for n in (slices, step, int(sides[0]))]
    lanes = dr.arange(mi.UInt32, lines)
    dr.eval(lanes)
    times = []
    for _ in range(6):  # compiles the kernel
        dr.sync_thread()
        started = time.perf_counter()
        dr.eval(_loaded(words, light, lanes, *numbers), light)
        dr.sync_thread()
        times.append(time.perf_counter() - started)
    return 2 * slices * lines / min(times[1:])


@symbolic
def _loaded(words, light, lanes, slices, step, row):
    """Run the kernel of `loads`; the extinction that it reads contributes to its result."""
    there, back = mi.UInt32(lanes), lanes + (slices - 1) * step
    found, k = mi.UInt32(0), mi.UInt32(0)
    while dr.hint(k < slices, label="loads"):
        for place in (there, there + row, back, back + row):
            found = found ^ dr.gather(mi.UInt32, words, place)
        ways = [dr.gather(mi.Float, light, place) for place in (there, back)]
        dr.scatter(light, ways[0] * 0.5, there)
        dr.scatter(light, ways[1] * 0.5, back)
        there += step
        back -= step
        k += 1
    return found


def swept_sides(cache) -> np.ndarray:
    """Return the sides of the smallest box of voxels that contains all active ones."""
    places = np.stack(np.unravel_index(np.array(cache.active), cache.grid.shape))
    return places.max(axis=1) - places.min(axis=1) + 1


def set_up() -> None:
    """Set the variant in a new process."""
    require_llvm()
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)


def rate(row: dict, kind: str = "seconds_more") -> float:
    """Return the voxels times directions per second, for the voxels that are swept."""
    return row["swept"] * row["directions"] / row[kind]


def floor(row: dict) -> float:
    """Return the same for the bytes of a step at the bandwidth of the machine."""
    return row["bandwidth"] / STEP_BYTES


def volumes(row: dict) -> float:
    """Return the four-byte numbers per voxel that the process took beyond those of the scene."""
    return (row["peak"] - row["peak_loaded"]) / (4 * row["voxels"])


def sizes_table(rows: list[dict]) -> Table:
    """Tabulate time, throughput and memory by size."""
    head = ["voxels", "swept", "s", "M/s", "s, sweeps", "M/s, sweeps", "stream", "share"]
    head += ["loads", "share", "peak MiB", "volumes"]
    cells = [
        [" x ".join(map(str, r["sides"])), f"{r['swept'] / r['voxels']:.0%}",
         f"{r['seconds']:.3f}", f"{rate(r, 'seconds') / 1e6:.0f}",
         f"{r['seconds_more']:.3f}", f"{rate(r) / 1e6:.0f}",
         f"{floor(r) / 1e6:.0f}", f"{rate(r) / floor(r):.0%}",
         f"{r['loads'] / 1e6:.0f}", f"{rate(r) / r['loads']:.0%}", f"{r['peak'] / 2**20:.0f}",
         f"{volumes(r):.1f}" if r["voxels"] >= MANY else "—"]
        for r in rows
    ]  # fmt: skip
    title = f"{SAMPLES} directions; M/s: million voxels times directions per second, of those swept"
    return Table(title, head, cells)


def images_table(rows: list[dict]) -> Table:
    """Tabulate time by size of the image."""
    head = ["pixels", "spp", "s", "ns per sample", "peak MiB"]
    cells = [
        [f"{r['pixels'] ** 0.5:.0f}^2", str(r["spp"]), f"{r['seconds']:.3f}",
         f"{1e9 * r['seconds'] / r['pixels'] / r['spp']:.0f}", f"{r['peak'] / 2**20:.0f}"]
        for r in rows
    ]  # fmt: skip
    return Table("Images of the 128^3 cloud from a cache that is there", head, cells)


if __name__ == "__main__":
    run(parse(__doc__))
