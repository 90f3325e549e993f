"""The scenes that come with the package are found by name."""

from __future__ import annotations

from pathlib import Path

import pytest
from mitsuba_irrcache.scenes import scene_path

from mitsuba_irrcache.errors import IrrcacheError

FOLDER = Path(__file__).parents[2] / "scenes"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.xml")), ids=lambda path: path.stem)
def test_scenes_are_found(path):
    assert Path(scene_path(path.stem)).read_text() == path.read_text()


@pytest.mark.parametrize("name", ["clouds", "", "cloud.xml", "../scenes/cloud"])
def test_other_names_are_refused_with_those_that_exist(name):
    with pytest.raises(IrrcacheError, match=r'no scene ".*"; the package has "cloud"'):
        scene_path(name)
