"""Sphinx directives for plugin pages in the format of Mitsuba's manual.

``mitsuba-plugin`` inserts the docstring of a plugin's class, ``pluginparameters`` is the table in
it, and the substitutions and roles that Mitsuba's docstrings use are defined for both.
"""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst.directives.tables import ListTable
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

TYPES = ("int", "float", "bool", "string", "rgb", "volume", "true", "false")
PROLOG = [
    ".. role:: monosp(code)",
    "",
    *(f".. |{name}| replace:: :monosp:`{name}`" for name in TYPES),
    "",
]


class PluginParameters(ListTable):
    """A table of name, type and description of each property; the head row is added."""

    def run(self) -> list[nodes.Node]:
        head = StringList(
            ["* - Parameter", "  - Type", "  - Description", ""],
            self.content.source(0) if self.content else "",
        )
        self.content = head + self.content
        self.options |= {"header-rows": 1, "widths": [16, 12, 72], "class": ["pluginparameters"]}
        return super().run()


class MitsubaPlugin(SphinxDirective):
    """The docstring of the one class in a plugin's file, which is named relative to the page."""

    required_arguments = 1
    has_content = False

    def run(self) -> list[nodes.Node]:
        _, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(path)
        documented = [
            text
            for node in ast.parse(Path(path).read_text(encoding="utf-8")).body
            if isinstance(node, ast.ClassDef) and (text := ast.get_docstring(node, clean=False))
        ]
        if len(documented) != 1:
            raise self.error(f"{path} has {len(documented)} documented classes, not one")
        lines = [*PROLOG, *inspect.cleandoc(documented[0]).splitlines()]
        return self.parse_content_to_nodes_from(lines, path)

    def parse_content_to_nodes_from(self, lines: list[str], path: str) -> list[nodes.Node]:
        """Parse lines that have section headings."""
        self.content = StringList(lines, path)
        return self.parse_content_to_nodes(allow_section_headings=True)


def setup(app) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("mitsuba-plugin", MitsubaPlugin)
    return {"parallel_read_safe": True}
