"""Serialise a parsed scene to XML.

Mitsuba's own writer decomposes transforms into scale, rotation and translation, with errors of up
to 1 %; here transforms are written as matrices with all digits.
"""

from __future__ import annotations

from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError

_TAGS = {
    "Scene": "scene",
    "Sensor": "sensor",
    "Film": "film",
    "Emitter": "emitter",
    "Sampler": "sampler",
    "Shape": "shape",
    "Texture": "texture",
    "Volume": "volume",
    "Medium": "medium",
    "BSDF": "bsdf",
    "Integrator": "integrator",
    "PhaseFunction": "phase",
    "ReconstructionFilter": "rfilter",
}
#: Prefix of the names that Mitsuba gives to unnamed nested objects.
_UNNAMED_PREFIX = "_arg_"


def scene_element(state: mi.parser.ParserState) -> ElementTree.Element:
    """Return the root element of a scene in one file, without $parameters, includes, defaults."""
    return _element(state, state.nodes[0])


def _element(state: mi.parser.ParserState, node: mi.parser.SceneNode) -> ElementTree.Element:
    props, tag = node.props, _TAGS[node.type.name]
    element = ElementTree.Element(tag)
    element.set(*(("version", "3.0.0") if tag == "scene" else ("type", props.plugin_name())))
    if props.id():
        element.set("id", props.id())
    for name in props.keys():
        child = _child(state, props, name)
        if not name.startswith(_UNNAMED_PREFIX):
            child.set("name", name)
        element.append(child)
    return element


def _child(state: mi.parser.ParserState, props: mi.Properties, name: str) -> ElementTree.Element:
    value, kind = props[name], props.type(name).name
    if kind == "ResolvedReference":
        return _element(state, state.nodes[value.index()])
    if kind == "Reference":
        return ElementTree.Element("ref", id=value.id())
    if kind == "Transform":
        matrix = np.array(value.matrix, dtype=np.float64).reshape(4, 4)
        transform = ElementTree.Element("transform")
        ElementTree.SubElement(transform, "matrix", value=_text(matrix))
        return transform
    if kind == "Vector":
        x, y, z = (repr(float(c)) for c in value)
        return ElementTree.Element("vector", x=x, y=y, z=z)
    if kind == "Color":
        return ElementTree.Element("rgb", value=_text(value))
    if kind == "Spectrum":
        numbers = [repr(float(v)) for v in value.values]
        if not value.is_uniform():
            lengths = [repr(float(w)) for w in value.wavelengths]
            numbers = [":".join(pair) for pair in zip(lengths, numbers, strict=True)]
        return ElementTree.Element("spectrum", value=", ".join(numbers))
    if kind not in ("Bool", "Integer", "Float", "String"):
        raise IrrcacheError(
            f'scene: the property "{name}" of "{props.plugin_name()}" is a {kind.lower()}, which '
            "cannot be written to XML."
        )
    tag = {"Bool": "boolean"}.get(kind, kind.lower())
    text = str(value).lower() if kind == "Bool" else str(value)
    return ElementTree.Element(tag, value=text if kind != "Float" else repr(float(value)))


def _text(numbers: object) -> str:
    return " ".join(repr(float(n)) for n in np.ravel(numbers))
