"""A closed mesh that is neither convex nor simply connected."""

from __future__ import annotations

import mitsuba as mi
import numpy as np


def torus(interior: dict, radius: float, thickness: float, count: int = 48) -> mi.Mesh:
    """Return a ring about the y axis with a null BSDF, of ``count`` x ``count`` / 2 quads.

    ``radius`` is that of its centre line, ``thickness`` that of its cross section.
    """
    angles = [np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (count, count // 2)]
    u, v = np.meshgrid(*angles, indexing="ij")
    across = radius + thickness * np.cos(v)
    p = np.stack([across * np.cos(u), thickness * np.sin(v), across * np.sin(u)], axis=-1)
    a = np.arange(u.size).reshape(u.shape)
    b, d = np.roll(a, -1, axis=0), np.roll(a, -1, axis=1)
    c = np.roll(b, -1, axis=1)
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, d, b), (b, d, c))])
    props = mi.Properties()
    props["bsdf"], props["interior"] = mi.load_dict({"type": "null"}), mi.load_dict(interior)
    mesh = mi.Mesh("ring", u.size, len(faces), props=props)
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.float32(p).ravel()
    values["faces"] = np.uint32(faces).ravel()
    values.update()
    return mesh
