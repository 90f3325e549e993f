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
