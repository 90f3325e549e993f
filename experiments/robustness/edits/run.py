"""Images after scene edits: a table of edits and outcomes.

    python -m experiments.robustness.edits.run

Parameters are assigned plain values, three times in a row in one process. After each the image must
equal that of an integrator which has not rendered before, bit by bit. An edit is "stale" if the
image is the previous one, and "wrong" if it is another one; edits of the camera must not rebuild a
cache. Only Mitsuba's interface is used, so that the same file measures older versions as well:
``PYTHONPATH=<checkout> python <this file>``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)

FACTORS = (0.8, 0.6, 0.4)
SOLVERS = ("sweep", "path")


def _rgb(*values: float) -> dict:
    return {"type": "rgb", "value": list(values)}


def _grid(channels: int = 1) -> dict:
    values = np.random.default_rng(1).uniform(0.2, 1, (3, 3, 3, channels)).astype(np.float32)
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = mi.VolumeGrid(values)
    return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": place}


def _number(factor: float) -> Callable:
    return lambda kind, v: float(v.ravel()[0]) * factor


def _colour(factor: float) -> Callable:
    return lambda kind, v: [factor * float(c) for c in v.ravel()]


def _array(factor: float) -> Callable:
    return lambda kind, v: kind(v * np.float32(factor))


def _placement(v: np.ndarray) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(v.reshape(4, 4).astype(np.float64))


def _turned(factor: float) -> Callable:
    return lambda kind, v: kind(_placement(v).rotate([0.48, 0.64, 0.6], 40 * factor))


def _smaller(factor: float) -> Callable:
    return lambda kind, v: kind(_placement(v).scale(0.5 + 0.5 * factor))


CUBE = {"type": "cube", "bsdf": {"type": "null"}}
FOG = {"type": "homogeneous", "sigma_t": _rgb(0.6, 0.9, 0.4), "albedo": _rgb(0.9, 0.7, 0.5)}
AIM = {"origin": [0, 3, -2], "target": [0, 0, 0], "up": [0, 1, 0]}
SKY = {"type": "constant"}


def scenes() -> dict[str, tuple[dict, list[tuple[str, Callable]]]]:
    """Return the objects of a scene, and its edits: a parameter's suffix, and new values."""
    cloud = {"type": "heterogeneous", "sigma_t": _grid(), "albedo": _rgb(0.9, 0.7, 0.5)}
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -3]),
        "emitter": {"type": "area", "radiance": _rgb(3, 2, 1)},
    }
    pixels = np.random.default_rng(2).uniform(0.1, 2, (4, 8, 3)).astype(np.float32)
    look = mi.ScalarTransform4f().look_at(**AIM)
    spot = {"type": "spot", "to_world": look, "cutoff_angle": 40.0, "beam_width": 5.0}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": FOG}
    return {
        "cloud, point": (
            {
                "shape": CUBE | {"interior": cloud},
                "lamp": {"type": "point", "position": [0, 3, -1], "intensity": _rgb(9, 8, 7)},
            },
            [
                ("lamp.position", _colour),
                ("lamp.intensity.value", _colour),
                ("albedo.value.value", _colour),
                ("sigma_t.data", _array),
                ("interior_medium.scale", _number),
                ("shape.vertex_positions", _array),
            ],
        ),
        "fog, area light": (
            {"shape": CUBE | {"interior": FOG}, "lamp": lamp},
            [
                ("lamp.emitter.radiance.value", _colour),
                ("lamp.to_world", _smaller),
                ("sigma_t.value.value", _colour),
                ("albedo.value.value", _colour),
            ],
        ),
        "fog, sun": (
            {
                "shape": CUBE | {"interior": FOG | {"phase": {"type": "hg", "g": 0.4}}},
                "lamp": {"type": "directional", "irradiance": _rgb(3, 2, 1)},
            },
            [
                ("irradiance.value", _colour),
                ("lamp.to_world", _turned),
                ("phase_function.g", _number),
            ],
        ),
        "cloud, spot": (
            {"shape": CUBE | {"interior": cloud}, "lamp": spot | {"intensity": _rgb(9, 8, 7)}},
            [
                ("lamp.cutoff_angle", _number),
                ("lamp.beam_width", _number),
                ("lamp.intensity.value", _colour),
                ("lamp.to_world", _turned),
            ],
        ),
        "ball, environment": (
            {"shape": ball, "lamp": {"type": "envmap", "bitmap": mi.Bitmap(pixels)}},
            [
                ("lamp.data", _array),
                ("lamp.scale", _number),
                ("lamp.to_world", _turned),
                ("shape.to_world", _smaller),
                ("sigma_t.value.value", _colour),
            ],
        ),
        "camera": (
            {"shape": CUBE | {"interior": cloud}, "lamp": SKY},
            [("sensor.to_world", _turned), ("sensor.x_fov", _number)],
        ),
    }


def _image(scene: mi.Scene, **options: object) -> np.ndarray:
    return np.array(mi.render(scene, spp=4, seed=1, **options))


def _outcomes(objects: dict, ending: str, new: Callable, solver: str) -> list[str]:
    settings = {"type": "irrcache", "solver": solver, "resolution": 4, "cache_spp": 32}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "component_format": "float32"}
    view = mi.ScalarTransform4f().look_at([1, 1, -5], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 34.0, "to_world": view, "film": film}
    scene = mi.load_dict(
        {"type": "scene", "integrator": mi.load_dict(settings), "sensor": sensor} | objects
    )
    params, old, found = mi.traverse(scene), _image(scene), []
    (key,) = [k for k in params.keys() if k.endswith(ending)]
    # No reference to the edited variable remains, so it is freed, as in a script that assigns
    # numbers.
    kind, cache = type(params[key]), scene.integrator().cache
    transform = hasattr(params[key], "inverse_transpose")
    original = np.array(params[key].matrix if transform else params[key])
    for factor in FACTORS:
        params[key] = new(factor)(kind, original)
        params.update()
        image = _image(scene)
        if "sensor" in ending:
            found.append("right" if scene.integrator().cache is cache else "cache made anew")
        elif np.array_equal(image, _image(scene, integrator=mi.load_dict(settings))):
            found.append("right")
        else:
            found.append("stale" if np.array_equal(image, old) else "wrong")
        old = image
    return found


def main() -> None:
    """Print the table; exit with 1 if an edit has not changed the image correctly."""
    right = total = 0
    print(f"| scene | parameter | {' | '.join(SOLVERS)} |\n|---|---|{'---|' * len(SOLVERS)}")
    for name, (objects, edits) in scenes().items():
        for ending, new in edits:
            found = [_outcomes(objects, ending, new, solver) for solver in SOLVERS]
            cells = " | ".join(", ".join(outcomes) for outcomes in found)
            print(f"| {name} | `{ending}` | {cells} |", flush=True)
            right += sum(outcomes.count("right") for outcomes in found)
            total += sum(map(len, found))
    print(f"\n{right} of {total} edits right")
    sys.exit(right < total)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    main()
