"""Modules that are named on the command line."""

from __future__ import annotations

import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.modules import import_modules


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("no_such_module", "", 'no_such_module: there is no module "no_such_module"; its folder'),
        ("os.no_such", "", 'os.no_such: there is no module "os.no_such"'),
        ("./mod.py", "", 'is "./mod.py", which is no name of a module; write'),
        ("..x", "", 'is "..x", which is no name'),
        ("", "", 'is "", which is no name'),
        ("needs_more", "import no_such_module", "needs_more: ModuleNotFoundError: No module named"),
        ("is_wrong", "1 / 0", "is_wrong: ZeroDivisionError: division by zero; correct"),
        ("cannot_be_read", "(", "cannot_be_read: SyntaxError: "),
    ],
)
def test_a_module_that_cannot_be_imported_is_named(tmp_path, monkeypatch, name, content, said):
    monkeypatch.syspath_prepend(tmp_path)
    if content:
        (tmp_path / f"{name}.py").write_text(content)
    with pytest.raises(IrrcacheError) as raised:
        import_modules(["os", name])
    assert str(raised.value).startswith("--import ") and said in str(raised.value)
