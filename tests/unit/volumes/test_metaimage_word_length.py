"""Words of a MetaImage's header that are too long for SimpleITK's reader are refused.

MetaIO has buffers of 80 bytes for the words of the list or pattern that names the data files, and
does not check their length. Longer words overwrite other memory of the process, which crashes later
or computes wrong values.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.readers import read_volume

VALUES = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
HEADER = """ObjectType = Image
NDims = 3
DimSize = 4 3 2
ElementType = MET_UCHAR
ElementSpacing = 1 1 1
ElementDataFile = {}
"""
FITS = "s" * 73 + "%d.raw"  # 79 bytes
assert len(FITS) == 79

#: Invalid values, and the length of the word for which they are refused.
TOO_LONG = {
    "pattern": (f"s{FITS} 0 1 1", 80),
    "pattern in a folder": ("./" * 60 + "s%d.raw 0 1 1", 127),
    "number": ("s%d.raw 0 1 " + "0" * 300 + "1", 301),
    "quoted": ('"' + "s " * 50 + '%d.raw" 0 1 1', 114),
    "list": ("LIST " + "2" * 100 + "\ns0.raw\ns1.raw", 100),
    "list in small letters": ("list " + "2" * 100 + "\ns0.raw\ns1.raw", 100),
    "list in one word": ("LIST" + "2" * 100 + "\ns0.raw\ns1.raw", 104),
}


def written(folder, value: str, slices: str = "s%d.raw"):
    """Write a header that names its data files by ``value``, with one file per slice beside it."""
    for k in range(2):
        (folder / (slices % k)).write_bytes(VALUES[k].tobytes())
    path = folder / "ct.mhd"
    path.write_text(HEADER.format(value))
    return path


@pytest.mark.parametrize(("value", "length"), TOO_LONG.values(), ids=TOO_LONG)
def test_words_that_are_too_long_are_refused(tmp_path, value, length):
    """Too long words are refused with their length and the remedy before SimpleITK reads them."""
    with pytest.raises(IrrcacheError, match=f"has {length} bytes.*beside the header"):
        read_volume(written(tmp_path, value))


def test_tabs_are_refused(tmp_path):
    """Tabs are refused: MetaIO takes them for a part of a word, and then divides by a step of 0."""
    with pytest.raises(IrrcacheError, match="with a tab"):
        read_volume(written(tmp_path, "s%d.raw\t0 1 1"))


def test_longest_word_is_read_without_overflow(tmp_path):
    """The longest word is read without memory errors, in a process of its own."""
    path = written(tmp_path, f"{FITS} 0 1 1", FITS)
    program = (
        "import sys; from mitsuba_irrcache.volumes.readers import read_volume\n"
        "for _ in range(20): values = read_volume(sys.argv[1]).values\n"
        "print(values.ravel().tolist())"
    )
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(list(range(24)))


def test_single_and_listed_names_have_no_limit(tmp_path):
    """Single names, and names in the lines of a list, have no such limit."""
    below = tmp_path / ("d" * 120)
    below.mkdir()
    (below / "voxels.raw").write_bytes(VALUES.tobytes())
    for k in range(2):
        (below / f"s{k}.raw").write_bytes(VALUES[k].tobytes())
    for value in (f"{below}/voxels.raw", f"LIST\n{below}/s0.raw\n{below.name}/s1.raw"):
        np.testing.assert_array_equal(read_volume(written(tmp_path, value)).values, VALUES)
