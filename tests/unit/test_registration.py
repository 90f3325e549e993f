"""The plugin is registered for every order of imports and variants, each tested in a new
process.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

LOAD = 'i = mi.load_dict({"type": "irrcache"}); assert "IrradianceCaching" in type(i).__name__;'
SET = 'mi.set_variant("llvm_ad_rgb");'
ORDERS = {
    "import first": f"import mitsuba_irrcache, mitsuba as mi; {SET} {LOAD}",
    "variant first": f"import mitsuba as mi; {SET} import mitsuba_irrcache; {LOAD}",
    "variants in turn": (
        f"import mitsuba as mi, mitsuba_irrcache; {SET} {LOAD}"
        f'mi.set_variant("llvm_ad_mono"); {LOAD} {SET} {LOAD}'
        "assert isinstance(i, mi.SamplingIntegrator)"
    ),
    "imported without a variant": (
        "import mitsuba_irrcache, mitsuba as mi; assert mi.variant() is None"
    ),
    "reloaded": (
        "import importlib, mitsuba as mi, mitsuba_irrcache, mitsuba_irrcache._register as r;"
        f"importlib.reload(r); importlib.reload(r); {SET} {LOAD}"
    ),
}


@pytest.mark.parametrize("program", ORDERS.values(), ids=ORDERS)
def test_order(program):
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


REFUSED = {
    "scalar_rgb": "voxel in interpreted Python",
    "llvm_ad_spectral": "not wavelengths",
    "llvm_ad_mono_polarized": "no polarisation",
}


@pytest.mark.parametrize(("variant", "reason"), REFUSED.items())
def test_other_variants_are_refused_when_used(variant, reason):
    """Importing with an unsupported variant works; loading the integrator raises an error.

    The error names the supported variants.
    """
    program = (
        f'import mitsuba as mi, mitsuba_irrcache; mi.set_variant("{variant}"); print("imported");'
        'mi.load_dict({"type": "irrcache"})'
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert "imported" in done.stdout
    assert done.returncode == 1
    assert variant in done.stderr and reason in done.stderr and "llvm_ad_rgb" in done.stderr


SEVERAL_VARIANTS = """
import mitsuba as mi
import numpy as np

means = []
for variant in ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_mono"):
    mi.set_variant(variant)
    import mitsuba_irrcache

    transform = mi.ScalarTransform4f()
    grid = mi.VolumeGrid(np.full((3, 3, 3, 1), 2, np.float32))
    place = transform.translate([-0.4, -0.5, -0.5])
    volume = {"type": "gridvolume", "grid": grid, "to_world": place, "filter_type": "nearest"}
    medium = {"type": "heterogeneous", "albedo": 0.8, "sigma_t": volume}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb"}
    origin = transform.look_at([0, 0, -4], [0, 0, 0], [0, 1, 0])
    lamp = transform.translate([0, 1.4, 0]).rotate([1, 0, 0], 90)
    for emitter in (
        {"type": "directional", "direction": [0.2, -1, 0.3]},
        {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 1.0}},
    ):
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "irrcache", "resolution": 8, "cache_spp": 64},
            "sensor": {"type": "perspective", "fov": 40, "to_world": origin, "film": film},
            "body": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
            "emitter": emitter,
        })
        means.append(float(np.mean(np.array(mi.render(scene, spp=16)))))
np.testing.assert_allclose(means[2:4], means[:2], rtol=5e-3)
np.testing.assert_allclose(means[4:], means[:2], rtol=1e-6)
assert min(means) > 0
"""


def test_scenes_of_several_variants_in_one_process():
    """Types that variants share, such as bounding boxes, accept the rays of each."""
    done = subprocess.run(
        [sys.executable, "-c", SEVERAL_VARIANTS], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
