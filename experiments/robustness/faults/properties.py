"""Random properties of the integrator: each scene renders, or is refused by name.

A case is a JSON text, so that it is mutated like a file: through `load_dict` or as XML, rendered
with few pixels.
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from experiments.robustness.faults.fuzz import files_here, own_folder
from mitsuba_irrcache.errors import IrrcacheError, original_message
from mitsuba_irrcache.imaging.options import SOLVERS
from mitsuba_irrcache.render.quadrature import QUADRATURES

#: Limits that make rendering fast whatever else is changed.
VALID = {"solver": "sweep", "resolution": 4, "cache_spp": 32, "timeout": 0.5}
#: Every property with valid values.
PROPERTIES = {
    "max_depth": [-1, 0, 1, 2, 5],
    "rr_depth": [1, 5, 100],
    "hide_emitters": [True, False],
    "solver": list(SOLVERS),
    "resolution": [0, 1, 9],
    "cache_spp": [0, 1, 64],
    "cache_seed": [0, 7],
    "quadrature": list(QUADRATURES),
    "step": [0.5, 2.0, 1],
    "filter": ["none", "bilateral", "fixed"],
    "aovs": ["noise", "colour,depth", "a:transmittance", ""],
    "emission": [0.5, {"type": "rgb", "value": [0.1, 0.2, 0.3]}],
    "emission_scale": [0.0, 2.0],
    "cache_file": [""],
    "timeout": [-1.0, 0.2],
}
NAN, INF = float("nan"), float("inf")
WRONG = [
    NAN, INF, -INF, -1, -2, 0, 0.5, -0.0, 1e-300, 1e300, 2**31 - 1, 2**31, 2**32, 2**63, -(2**63),
    True, False, "", " ", "nan", "1", "-1", "x", "sweep ", "NOISE", "a:b:c", ":", ",,,", "ü\u0000",
    "x" * 5000, "a/b/c", "/", "../" * 40, [], [1, 2, 3], [[0.0]], {"type": "rgb", "value": [1, 2]},
    {"type": "rgb", "value": [NAN, 0, 0]}, {"type": "constvolume", "value": -1.0},
    {"type": "volpath"}, {"type": "none_such"}, {"type": "constant"},
]  # fmt: skip
UNKNOWN = ["", " ", "max_dept", "Solver", "spp", "type ", "ü", "a.b", "_arg_0", "x" * 300]


def mutated_properties(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a case with wrong properties, or a valid one."""

    def one(values: list) -> object:
        return values[int(rng.integers(0, len(values)))]

    properties = json.loads(content)["properties"]
    for _ in range(rng.integers(1, 4)):
        name = one(list(PROPERTIES)) if rng.random() < 0.9 else one(UNKNOWN)
        wrong = rng.random() < 0.6 or name in UNKNOWN
        properties[name] = one(WRONG if wrong else PROPERTIES[name])
    how = one(["dict", "xml"])
    return json.dumps({"how": how, "properties": properties}).encode()


def write_valid(path: Path) -> None:
    """Write the valid case."""
    path.write_text(json.dumps({"how": "dict", "properties": VALID}))


def render_case(path: Path) -> None:
    """Render the case in this file, in a folder of its own, where its `cache_file` may appear.

    Raises IrrcacheError if it is refused by a message that names a property or its value; other
    exceptions, invalid images, and other files are failures.
    """
    case = json.loads(path.read_text())
    with own_folder():
        try:
            _render(case)
        finally:
            strange = files_here() - {str(case["properties"].get("cache_file"))}
            assert not strange, f"left {strange}: {case}"


def _render(case: dict) -> None:
    import mitsuba as mi

    from experiments.robustness.stability.worlds import Matter, scene

    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    properties = case["properties"]
    try:
        if case["how"] == "xml":
            built = mi.load_string(_xml(properties))
        else:
            built = scene(properties, Matter())
        image = np.array(mi.render(built, spp=1))
    except (RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, IrrcacheError) or _names(original_message(error), properties):
            raise IrrcacheError(original_message(error)) from error
        raise
    if not np.isfinite(image).all():
        raise AssertionError(f"the picture is not finite: {properties}")


def _names(message: str, properties: dict) -> bool:
    """Return whether a one-paragraph message names a property or value."""
    changed = [
        text
        for name, value in properties.items()
        if name not in VALID or value != VALID[name]
        for text in (name, value if isinstance(value, str) else repr(value), _named(value))
    ]
    return len(message) < 12000 and any(text and text.strip() in message for text in changed)


def _named(value: object) -> str:
    """Return Mitsuba's notation of a nested object: a colour by its numbers, others by their
    plugin.
    """
    if not isinstance(value, dict):
        return ""
    return _colour(value) if value["type"] == "rgb" else value["type"]


def _colour(value: dict) -> str:
    return " ".join(str(v) for v in value["value"])


def _xml(properties: dict) -> str:
    """Return the scene of `worlds.scene` as XML."""
    body = "".join(_element(name, value) for name, value in properties.items())
    return f"""<scene version="3.0.0">
    <integrator type="irrcache">{body}</integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="1,1.5,-5" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="4"/>
        <integer name="height" value="4"/></film>
    </sensor>
    <shape type="cube"><bsdf type="null"/><medium name="interior" type="homogeneous">
        <float name="sigma_t" value="1.0"/><float name="albedo" value="0.9"/></medium></shape>
    <emitter type="constant"/>
</scene>"""


def _element(name: str, value: object) -> str:
    """Return a property as XML; as a string if its type has no element."""
    if isinstance(value, dict):
        kind = value["type"]
        if kind == "rgb":
            return f"<rgb name={quoteattr(name)} value={quoteattr(_colour(value))}/>"
        tag = {"constvolume": "volume", "constant": "emitter"}.get(kind, "integrator")
        return f"<{tag} name={quoteattr(name)} type={quoteattr(kind)}/>"
    tag = {bool: "boolean", int: "integer", float: "float"}.get(type(value), "string")
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f"<{tag} name={quoteattr(name)} value={quoteattr(text.replace(chr(0), ''))}/>"
