"""Long names in tables break after underscores and slashes instead of within words."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

_CELL = re.compile(r"<td>.*?</td>", re.DOTALL)
_NAME = re.compile(r'(?<=<span class="pre">)[^<]{12,}(?=</span>)')
_BREAK = re.compile(r"(?<=\w)(::|[/_])(?=\w)")


def _with_breaks(name: re.Match) -> str:
    return _BREAK.sub(r"\1<wbr>", name[0])


def add_breaks(app: Sphinx, page: str, template: str, context: dict[str, Any], *_: object) -> None:
    """Mark where names in the tables of a page may break."""
    if "body" in context:
        context["body"] = _CELL.sub(lambda cell: _NAME.sub(_with_breaks, cell[0]), context["body"])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the step with Sphinx."""
    app.connect("html-page-context", add_breaks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
