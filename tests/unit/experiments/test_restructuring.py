"""The measures of the structure: import levels, calls between modules, longest functions."""

from __future__ import annotations

import pytest

from experiments.docs import restructuring
from experiments.docs.traced_render import module_of

FILES = {
    "top.py": '"""Docstring."""\nfrom mitsuba_irrcache.low import below\nfrom .high import a, b\n',
    "low/__init__.py": '"""Docstring."""\n',
    "low/below.py": "X = 1\n\n\ndef f():\n    from mitsuba_irrcache import high\n",
    "high/__init__.py": "from .a import value\nY = 2\n",
    "high/a.py": "value = 1\n\n\nclass C:\n    def g(self, x, *, y):\n        pass\n",
    "high/b.py": "from . import a\nvalue = 2\n",
}


@pytest.fixture
def checkout(tmp_path):
    for name, text in FILES.items():
        file = tmp_path / "mitsuba_irrcache" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path


def test_modules_without_code_do_not_count(checkout):
    assert set(restructuring.modules_of(checkout)) == {
        "top",
        "low.below",
        "high",
        "high.a",
        "high.b",
    }


def test_imports_and_levels(checkout):
    imports = restructuring.imports_of(restructuring.modules_of(checkout))
    assert imports == {
        "top": {"low.below", "high.a", "high.b"},
        "low.below": {"high"},
        "high": {"high.a"},
        "high.a": set(),
        "high.b": {"high.a"},
    }
    levels, circles = restructuring.levels_of(imports)
    assert levels == {"high.a": 1, "high": 2, "high.b": 2, "low.below": 3, "top": 4}
    assert circles == set()


def test_modules_that_import_each_other_share_a_level():
    levels, circles = restructuring.levels_of({"a": {"b"}, "b": {"a", "c"}, "c": set(), "d": {"a"}})
    assert levels == {"c": 1, "a": 2, "b": 2, "d": 3}
    assert circles == {"a", "b"}


def test_functions_have_lines_and_parameters(checkout):
    assert restructuring.functions_of(checkout) == [
        (2, 2, "`C.g` in high/a"),
        (2, 0, "`f` in low/below"),
    ]


def test_calls_between_modules():
    f, g, h = ("a.x", "f"), ("a.y", "g"), ("b", "h")
    calls = [(f, g), (g, h), (h, f), (f, h)]
    reached = {"a.x": {"a.y", "b"}, "a.y": {"b"}, "b": set()}
    # 3 functions and modules; 4 calls, all into another module, two into modules that had been
    # entered (a.x, b), one up (b to a.x); 3 into another folder, two into one that had been entered
    assert restructuring.calls_between(calls, reached) == [3, 3, 4, 4, 2, 1, 3, 2]


def test_names_of_modules():
    folders = {"/x/integrators/": "integrators", "/x/mitsuba_irrcache/": ""}
    assert module_of("/x/integrators/irrcache.py", folders) == "integrators.irrcache"
    assert module_of("/x/mitsuba_irrcache/core/jit.py", folders) == "core.jit"
    assert module_of("/y/numpy/core.py", folders) is None
